"""Where a raster's posts come to stand: on its own lattice if metric and square, else resampled."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.dem.import_options import ImportOptions
from terrasim.dem.input_file import MAX_SAMPLES, MAX_SIDE
from terrasim.dem.mosaic import Mosaic
from terrasim.dem.raster import gdal, parse_crs
from terrasim.errors import InputError
from terrasim.grid import Grid

_EDGE_POINTS = 101
_LEAST_INSIDE = 0.5
"""Share of a raster's area that a rectangle inside it must hold to stand for it."""
_SAME_LATTICE = 0.01
"""How far the last post may drift, in spacings, for two spacings to count as one."""
_WEB_MERCATOR = 3857

Points = npt.NDArray[np.float64]
"""Coordinates, shape ``(2, count)``."""


@dataclass(frozen=True)
class Placement:
    """The grid of a raster, and how to get from its samples to the posts."""

    grid: Grid
    """Placement of the posts."""
    crs: Any
    """Coordinate reference system of the grid, or None: local metres."""
    native: bool
    """Whether the posts are the raster's own samples."""
    note: str
    """What was done, in a sentence."""

    @property
    def transform(self) -> Any:
        """Affine transform of a north-up raster whose pixel centres are the posts."""
        from rasterio import Affine

        s, grid = self.grid.spacing, self.grid
        return Affine(s, 0.0, grid.x - s / 2, 0.0, -s, grid.y + (grid.rows - 0.5) * s)


def place(name: str, mosaic: Mosaic, options: ImportOptions) -> Placement:
    """Choose the terrain's CRS, spacing and extent.

    Raises:
        InputError: If the raster has no CRS and the user gives neither CRS nor spacing, if the
            target is not metric, or if the terrain would be too large or too small.
    """
    if mosaic.crs is None and options.spacing is None:
        raise InputError(
            f"{name}: names no CRS, so its unit of length is unknown: give --crs, or --spacing in "
            "metres to take its coordinates for local metres"
        )
    if mosaic.crs is None and options.to_crs is not None:
        raise InputError(f"{name}: names no CRS, so --to-crs {options.to_crs} needs --crs")
    crs = _target_crs(name, mosaic, options)
    with gdal(name):
        width, height = _pixel_size(name, mosaic, crs)
    spacing = _native_spacing(mosaic, options, width, height) if crs == mosaic.crs else None
    if spacing is not None:
        return _as_it_is(mosaic, crs, spacing, options.datum)
    chosen = float(options.spacing or f"{min(width, height):.2g}")
    if crs == mosaic.crs:
        return _same_crs(name, mosaic, crs, chosen, options)
    return _reprojected(name, mosaic, crs, chosen, options)


def _target_crs(name: str, mosaic: Mosaic, options: ImportOptions) -> Any:
    if options.to_crs is not None:
        crs = parse_crs(options.to_crs)
        if not _metric(crs):
            raise InputError(
                f"--to-crs {options.to_crs} is not in ground metres: name a projected one, such "
                "as a UTM zone"
            )
        return crs
    if mosaic.crs is None or _metric(mosaic.crs):
        return mosaic.crs
    centre = _coordinates(mosaic, np.array([mosaic.cols / 2]), np.array([mosaic.rows / 2]))
    with gdal(name):
        lon, lat = _project(name, mosaic.crs, parse_crs("EPSG:4326"), centre)[:, 0]
    return parse_crs(f"EPSG:{_utm(lon, lat)}")


def _metric(crs: Any) -> bool:
    """Whether coordinates are metres on the ground; Web Mercator's are stretched."""
    if not crs.is_projected or crs.to_epsg() == _WEB_MERCATOR:
        return False
    return bool(abs(crs.linear_units_factor[1] - 1.0) < 1e-12)


def _utm(lon: float, lat: float) -> int:
    """EPSG code of the UTM zone, or of the polar stereographic beyond 84 N and 80 S."""
    if lat > 84.0:
        return 32661
    if lat < -80.0:
        return 32761
    zone = int((lon + 180.0) // 6.0) % 60 + 1
    return (32600 if lat >= 0.0 else 32700) + zone


def _coordinates(mosaic: Mosaic, cols: Points, rows: Points) -> Points:
    """Coordinates in the mosaic's CRS of pixel positions, whole numbers at corners."""
    t = mosaic.transform
    return np.array([t.a * cols + t.b * rows + t.c, t.d * cols + t.e * rows + t.f])


def corner_coordinates(mosaic: Mosaic, inset: float) -> Points:
    """Coordinates in the mosaic's CRS of its corners, or of points so many pixels inside."""
    west, east, north, south = inset, mosaic.cols - inset, inset, mosaic.rows - inset
    cols, rows = np.array([west, east, west, east]), np.array([north, north, south, south])
    return _coordinates(mosaic, cols, rows)


def _project(name: str, source: Any, target: Any, points: Points) -> Points:
    from rasterio._err import CPLE_BaseError
    from rasterio.warp import transform

    if source == target:
        return points
    try:
        xy = np.array(transform(source, target, points[0].tolist(), points[1].tolist())[:2])
    except CPLE_BaseError:
        xy = np.full(points.shape, np.nan)
    if not np.isfinite(xy).all():
        raise InputError(
            f"{name}: lies outside {target.to_string()[:60]}; choose a nearer one with --to-crs"
        )
    return xy


def _pixel_size(name: str, mosaic: Mosaic, crs: Any) -> tuple[float, float]:
    """Width and height of the middle pixel in the target's metres."""
    if mosaic.crs == crs:
        t = mosaic.transform
        return math.hypot(t.a, t.d), math.hypot(t.b, t.e)
    col, row = mosaic.cols / 2, mosaic.rows / 2
    corner = _coordinates(mosaic, np.array([col, col + 1, col]), np.array([row, row, row + 1]))
    xy = _project(name, mosaic.crs, crs, corner)
    return math.hypot(*(xy[:, 1] - xy[:, 0])), math.hypot(*(xy[:, 2] - xy[:, 0]))


def _native_spacing(
    mosaic: Mosaic, options: ImportOptions, width: float, height: float
) -> float | None:
    """The raster's spacing if its samples can stand as posts, else None."""
    t = mosaic.transform
    wanted = options.spacing or width
    drift = max(mosaic.rows, mosaic.cols) * max(abs(width - height), abs(width - wanted)) / width
    if t.b or t.d or t.a < 0 or t.e > 0 or drift > _SAME_LATTICE:
        return None
    return width


def _as_it_is(mosaic: Mosaic, crs: Any, spacing: float, datum: float) -> Placement:
    x, y = _coordinates(mosaic, np.array([0.5]), np.array([mosaic.rows - 0.5]))[:, 0]
    grid = Grid(mosaic.rows, mosaic.cols, spacing, float(x), float(y), datum=datum, crs=_text(crs))
    return Placement(grid, crs, True, "posts are the raster's samples, at its pixel centres")


def _same_crs(
    name: str, mosaic: Mosaic, crs: Any, spacing: float, options: ImportOptions
) -> Placement:
    """Bilinear at another spacing, from the south-western sample on."""
    corners = corner_coordinates(mosaic, 0.5)
    (x, y), (right, top) = corners.min(axis=1), corners.max(axis=1)
    cols = math.floor((right - x) / spacing + 1e-6) + 1
    rows = math.floor((top - y) / spacing + 1e-6) + 1
    grid = _grid(name, rows, cols, spacing, float(x), float(y), options.datum, crs)
    return Placement(grid, crs, False, f"resampled bilinearly at {spacing:g} m in its own CRS")


def _reprojected(
    name: str, mosaic: Mosaic, crs: Any, spacing: float, options: ImportOptions
) -> Placement:
    """Bilinear in another CRS, posts at whole multiples of the spacing."""
    with gdal(name):
        edges = _edges(name, mosaic, crs)
    box, share = _extent(edges, options.extent)
    col, row = math.ceil(box[0] / spacing - 1e-6), math.ceil(box[1] / spacing - 1e-6)
    cols = math.floor(box[2] / spacing + 1e-6) - col + 1
    rows = math.floor(box[3] / spacing + 1e-6) - row + 1
    grid = _grid(name, rows, cols, spacing, col * spacing, row * spacing, options.datum, crs)
    covers = "all of it, with holes along the rim"
    if share < 1.0:
        covers = f"the upright rectangle inside it, which leaves out {1.0 - share:.1%} of its area"
    note = f"resampled bilinearly from {_text(mosaic.crs)} to {_text(crs)} at {spacing:g} m"
    return Placement(grid, crs, False, f"{note}; covers {covers}")


def _edges(name: str, mosaic: Mosaic, crs: Any) -> list[Points]:
    """The edges of the samples' area in the target, all the way around: two along rows, two not."""
    along = np.linspace(0.0, 1.0, _EDGE_POINTS)
    cols, rows = 0.5 + along * (mosaic.cols - 1), 0.5 + along * (mosaic.rows - 1)
    first, ones = np.full(_EDGE_POINTS, 0.5), np.ones(_EDGE_POINTS)
    last_col, last_row = ones * (mosaic.cols - 0.5), ones * (mosaic.rows - 0.5)
    around = ((cols, last_row), (last_col, rows[::-1]), (cols[::-1], first), (first, rows))
    return [_project(name, mosaic.crs, crs, _coordinates(mosaic, *edge)) for edge in around]


def _extent(edges: list[Points], extent: str) -> tuple[tuple[float, float, float, float], float]:
    """Left, bottom, right and top of what is covered, and the share of the raster's area in it.

    A raster too askew for an upright rectangle inside it is covered as a whole.
    """
    x, y = np.hstack(edges)
    area = abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))) / 2
    # Rows may run from the south as well, columns from the east.
    south, north = sorted((edges[0][1], edges[2][1]), key=lambda edge: float(edge.mean()))
    west, east = sorted((edges[1][0], edges[3][0]), key=lambda edge: float(edge.mean()))
    left, right, bottom, top = (
        float(value) for value in (west.max(), east.min(), south.max(), north.min())
    )
    share = max(right - left, 0.0) * max(top - bottom, 0.0) / area
    if extent == "all" or share < _LEAST_INSIDE:
        return (float(x.min()), float(y.min()), float(x.max()), float(y.max())), 1.0
    return (left, bottom, right, top), min(share, 1.0)


def _grid(
    name: str, rows: int, cols: int, spacing: float, x: float, y: float, datum: float, crs: Any
) -> Grid:
    if min(rows, cols) < 2 or max(rows, cols) > MAX_SIDE or rows * cols > MAX_SAMPLES:
        raise InputError(
            f"{name}: at a spacing of {spacing:g} m it makes {max(rows, 0)} x {max(cols, 0)} "
            f"posts: 2 to {MAX_SIDE} a side and {MAX_SAMPLES} in all; choose another --spacing"
        )
    return Grid(rows, cols, spacing, x, y, datum=datum, crs=_text(crs))


def _text(crs: Any) -> str | None:
    return str(crs.to_string()) if crs else None
