"""How files of heights are to be read."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from terrasim.errors import InputError

_FOOT = 0.3048
_US_SURVEY_FOOT = 1200.0 / 3937.0
_UNITS = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), _FOOT),
    **dict.fromkeys(("us survey foot", "us-ft", "ftus", "foot us", "us foot"), _US_SURVEY_FOOT),
    "km": 1000.0,
    "dm": 0.1,
    "cm": 0.01,
    "mm": 0.001,
}


def unit_metres(unit: str) -> float:
    """Metres in one vertical unit, such as ``"ft"``.

    Raises:
        InputError: If the unit is unknown.
    """
    name = " ".join(unit.replace("_", " ").lower().split())
    if name not in _UNITS:
        raise InputError(
            f"vertical unit {unit!r} is unknown: it must be one of {', '.join(sorted(_UNITS))}; "
            "name one with --z-unit"
        )
    return _UNITS[name]


@dataclass(frozen=True)
class ImportOptions:
    """What the user says about the files; everything else is read from them."""

    spacing: float | None = None
    """Distance between posts [m]. Images need it; rasters are resampled where theirs differs."""
    crs: str | None = None
    """Coordinate reference system of rasters that name none, such as ``EPSG:32611``."""
    to_crs: str | None = None
    """Coordinate reference system of the terrain, in metres. By default the raster's own, or the
    UTM zone of its centre where that is not metric."""
    extent: Literal["inside", "all"] = "inside"
    """What a reprojected raster covers: the upright rectangle inside it, or all of it, with holes
    along the rim."""
    z_unit: str | None = None
    """Vertical unit of a raster; by default what the raster says, and metres where it is silent."""
    z_scale: float = 1.0
    """Metres in one count of an image or array; for rasters a factor after the unit."""
    z_offset: float = 0.0
    """Metres added after scaling."""
    nodata: Literal["hole", "fill"] = "hole"
    """Posts without a height stay holes, or are filled from their neighbours."""
    nodata_value: float | None = None
    """Value in the file that means no height; by default what the file declares."""
    fill_distance: int = 100
    """How far a filled post may lie from the nearest height [posts]; beyond, holes stay."""
    band: int | None = None
    """Band or channel to read, from 1; files of several need it."""
    encoding: Literal["plain", "terrarium"] = "plain"
    """How an image holds heights; Terrarium: red * 256 + green + blue / 256 - 32768 metres."""
    datum: float = 0.0
    """World z of count 0 [m]."""

    def __post_init__(self) -> None:
        """Refuse what no file could satisfy."""
        if self.spacing is not None and not (math.isfinite(self.spacing) and self.spacing > 0.0):
            raise InputError(f"spacing must be positive and finite [m], got {self.spacing}")
        if not math.isfinite(self.z_scale) or self.z_scale == 0.0:
            raise InputError(f"z_scale must be finite and not zero, got {self.z_scale}")
        for name in ("z_offset", "datum"):
            if not math.isfinite(getattr(self, name)):
                raise InputError(f"{name} must be finite [m], got {getattr(self, name)}")
        for name, allowed in (
            ("nodata", ("hole", "fill")),
            ("extent", ("inside", "all")),
            ("encoding", ("plain", "terrarium")),
        ):
            if getattr(self, name) not in allowed:
                raise InputError(
                    f"{name} must be {' or '.join(allowed)}, got {getattr(self, name)!r}"
                )
        if self.band is not None and self.band < 1:
            raise InputError(f"band counts from 1, got {self.band}")
        if not 1 <= self.fill_distance <= 1000:
            raise InputError(f"fill_distance must be 1 to 1000 posts, got {self.fill_distance}")
        if self.z_unit is not None:
            unit_metres(self.z_unit)
