"""Pictures: hillshades with what was deformed, where balls are and how they came there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.errors import RunError
from terrasim.output.colours import FAINTEST_M, LOWERED, RAISED, ramp, tinted

Metres = npt.NDArray[np.float64]

AZIMUTH_DEG = 315.0
"""Light from the north-west, as maps have it."""
ALTITUDE_DEG = 40.0
MOST_TRAILS = 120
"""Trails in one view."""
BALL = "#ffd21f"
TRAIL = "white"


@dataclass(frozen=True)
class View:
    """A rectangle of ground to draw."""

    title: str
    """What is seen."""
    heights: Metres
    """Heights [m], shape ``(rows, cols)``, south to north; NaN in holes."""
    x: float
    """Place of the first column [m east of the anchor]."""
    y: float
    """Place of the first row [m north of the anchor]."""
    spacing: float
    """Distance between the posts that are drawn [m]."""
    change: Metres | None = None
    """What deformations added to each post [m], same shape."""

    @property
    def box(self) -> tuple[float, float, float, float]:
        """West, east, south and north end [m from the anchor]."""
        rows, cols = self.heights.shape
        return (
            self.x,
            self.x + (cols - 1) * self.spacing,
            self.y,
            self.y + (rows - 1) * self.spacing,
        )


@dataclass(frozen=True)
class Tracks:
    """Balls over time."""

    places: Metres
    """Centres [m from the anchor], shape ``(frames, count, 2)``."""
    radii: Metres
    """Radii [m], shape ``(count,)``."""


def draw_picture(
    path: Path,
    views: Sequence[View],
    *,
    title: str,
    note: str = "",
    tracks: Tracks | None = None,
) -> None:
    """Draw views of one ground side by side, each marked in the one before it.

    Args:
        path: The PNG to make.
        views: From the widest to the closest.
        title: Stands above all.
        note: Stands below all, such as what part of the heights is invented.
        tracks: Balls over time.

    Raises:
        RunError: If the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4 * len(views) + 0.4, 6.9), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=15, fontweight="bold")
    axes = figure.subplots(1, len(views), squeeze=False)[0]
    for ax, view, following in zip(axes, views, [*views[1:], None], strict=True):
        _draw_ground(figure, ax, view)
        handles = _draw_change(ax, view)
        if tracks is not None:
            handles += _draw_balls(ax, view, tracks, moving=view is not views[0])
        if following is not None:
            _mark(ax, view, following)
        _scale_bar(ax, view)
        if handles:
            ax.legend(handles=handles, loc="upper right", fontsize=8, framealpha=0.85)
    if note:
        figure.supxlabel(note, fontsize=9, color="#555555")
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise RunError(f"{path}: the picture cannot be written ({error.strerror})") from None


def hillshade(heights: Metres, spacing: float) -> Metres:
    """Brightness of each post under the light, 0 to 1, same shape; NaN beside holes."""
    rise_y, rise_x = np.gradient(heights, spacing)
    azimuth, altitude = math.radians(AZIMUTH_DEG), math.radians(ALTITUDE_DEG)
    light = np.array(
        [
            math.sin(azimuth) * math.cos(altitude),
            math.cos(azimuth) * math.cos(altitude),
            math.sin(altitude),
        ]
    )
    facing = light[2] - rise_x * light[0] - rise_y * light[1]
    shade: Metres = np.clip(facing / np.sqrt(1.0 + rise_x**2 + rise_y**2), 0.0, 1.0)
    return shade


def _draw_ground(figure: Any, ax: Any, view: View) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    known = view.heights[np.isfinite(view.heights)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    norm = Normalize(low, max(high, low + 0.01))
    colours = ramp(norm(np.nan_to_num(view.heights, nan=low)))
    if view.change is not None:
        most = float(np.abs(np.nan_to_num(view.change)).max())
        colours = tinted(colours, view.change, most)
    shade = hillshade(view.heights, view.spacing)
    # Around the shade of level ground, so that flats keep their colour.
    flat = math.sin(math.radians(ALTITUDE_DEG))
    lit = np.clip(colours * (0.35 + 0.65 * shade[..., None] / flat), 0.0, 1.0)
    lit[~np.isfinite(shade)] = 1.0
    west, east, south, north = view.box
    half = view.spacing / 2.0
    ax.imshow(
        lit,
        origin="lower",
        extent=(west - half, east + half, south - half, north + half),
        interpolation="antialiased",
    )
    ax.set_xlim(west, east)
    ax.set_ylim(south, north)
    ax.set_title(view.title, fontsize=11)
    _label_axes(ax, east - west)
    levels = ListedColormap(ramp(np.linspace(0.0, 1.0, 256)))
    bar = figure.colorbar(ScalarMappable(norm, levels), ax=ax, shrink=0.7, aspect=30, pad=0.01)
    bar.set_label("height [m]", fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _label_axes(ax: Any, width: float) -> None:
    unit, metres = ("km", 1000.0) if width > 5000.0 else ("m", 1.0)
    ax.set_xlabel(f"east of the anchor [{unit}]", fontsize=9)
    ax.set_ylabel(f"north of the anchor [{unit}]", fontsize=9)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(lambda value, _position: f"{value / metres:g}")
    ax.tick_params(labelsize=8)


def _draw_change(ax: Any, view: View) -> list[Any]:
    from matplotlib.patches import Patch

    del ax
    if view.change is None or not np.isfinite(view.change).any():
        return []
    low, high = float(np.nanmin(view.change)), float(np.nanmax(view.change))
    handles = []
    if low < -FAINTEST_M:
        handles.append(Patch(color=LOWERED, alpha=0.6, label=f"lowered, up to {-low:.2g} m"))
    if high > FAINTEST_M:
        handles.append(Patch(color=RAISED, alpha=0.6, label=f"raised, up to {high:.2g} m"))
    return handles


def _draw_balls(ax: Any, view: View, tracks: Tracks, *, moving: bool) -> list[Any]:
    """Balls at their true size, but never too small to be seen, and where they came from."""
    from matplotlib.collections import EllipseCollection, LineCollection
    from matplotlib.lines import Line2D

    west, east, south, north = view.box
    last = tracks.places[-1]
    inside = (last[:, 0] > west) & (last[:, 0] < east) & (last[:, 1] > south) & (last[:, 1] < north)
    if not inside.any():
        return []
    drawn = _trails(inside) if moving else inside[:0]
    if moving:
        # The darker line below keeps a trail visible on pale ground.
        lines: Any = np.swapaxes(tracks.places[:, drawn], 0, 1)
        ax.add_collection(LineCollection(lines, colors="#5a4a20", linewidths=1.6, alpha=0.5))
        ax.add_collection(LineCollection(lines, colors=TRAIL, linewidths=0.6, alpha=0.9))
    smallest = 0.006 * (east - west)
    size = 2.0 * np.maximum(tracks.radii[inside], smallest / 2.0)
    true = bool((2.0 * tracks.radii[inside] >= smallest).all())
    ax.add_collection(
        EllipseCollection(
            size, size, np.zeros(size.size), units="xy", offsets=last[inside],
            offset_transform=ax.transData, facecolors=BALL, edgecolors="#3a2a00", linewidths=0.4,
            zorder=3,
        )
    )  # fmt: skip
    count = int(inside.sum())
    label = f"{count} ball{'s' if count > 1 else ''}" + ("" if true else " (drawn larger)")
    dot = Line2D([], [], marker="o", ls="", color=BALL, mec="#3a2a00", mew=0.5, label=label)
    count = int(inside.sum())
    of = "" if drawn.size == count else f" of {drawn.size} of them"
    trail = Line2D([], [], color="#5a4a20", lw=1.2, label=f"trails{of}")
    return [dot, trail] if moving else [dot]


def _trails(inside: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Balls whose trails are drawn: so many that they can be told apart."""
    numbers = np.flatnonzero(inside)
    return numbers[:: max(1, -(-numbers.size // MOST_TRAILS))]


def _mark(ax: Any, view: View, following: View) -> None:
    """Where the next view lies."""
    from matplotlib.patches import Rectangle

    west, east, south, north = following.box
    wide = view.box[1] - view.box[0]
    # A view too small to see is marked by a frame around its place.
    grow = max(0.0, 0.02 * wide - (east - west)) / 2.0
    ax.add_patch(
        Rectangle(
            (west - grow, south - grow),
            east - west + 2.0 * grow,
            north - south + 2.0 * grow,
            fill=False,
            ec="#c00000",
            lw=1.6,
            zorder=4,
        )
    )


def _scale_bar(ax: Any, view: View) -> None:
    west, east, south, north = view.box
    wide, high = east - west, north - south
    length = _round_length(wide / 4.0)
    x, y = west + 0.05 * wide, south + 0.05 * high
    box = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 2.0}
    ax.plot([x, x + length], [y, y], color="white", lw=6, solid_capstyle="butt", zorder=5)
    ax.plot([x, x + length], [y, y], color="black", lw=3, solid_capstyle="butt", zorder=6)
    text = f"{length / 1000:g} km" if length >= 1000.0 else f"{length:g} m"
    ax.text(
        x, y + 0.02 * high, text, fontsize=9, va="bottom", ha="left", bbox=box, zorder=6
    )  # fmt: skip


def _round_length(most: float) -> float:
    """The largest of 1, 2 or 5 times a power of ten that is not above a length."""
    base = 10.0 ** math.floor(math.log10(most))
    return max(step * base for step in (1.0, 2.0, 5.0) if step * base <= most * (1 + 1e-12))
