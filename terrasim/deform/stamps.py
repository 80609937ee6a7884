"""Stamps: shapes that change the ground.

A stamp is a small frozen dataclass. It says where it stands, in metres from an anchor post, how it
meets the ground, and what its shape is at a distance from there. To add a stamp: write its formula
into ``kernels/shapes.py`` under a new kind, write its dataclass into ``terrasim/deform/shapes``,
and enter it in :data:`REGISTRY`. Everything else follows from those.
"""

from __future__ import annotations

from terrasim.deform.shapes.crater import Crater
from terrasim.deform.shapes.flatten import Flatten
from terrasim.deform.shapes.height_image import HeightImage
from terrasim.deform.shapes.mounds import (
    ConeStamp,
    Gaussian,
    HalfCosine,
    Paraboloid,
    SphericalCap,
)
from terrasim.deform.shapes.noise import Noise
from terrasim.deform.shapes.stamp import Bounds, Stamp
from terrasim.deform.shapes.swept import Berm, Trench
from terrasim.deform.shapes.texture import Texture

__all__ = [
    "REGISTRY",
    "Berm",
    "Bounds",
    "ConeStamp",
    "Crater",
    "Flatten",
    "Gaussian",
    "HalfCosine",
    "HeightImage",
    "Noise",
    "Paraboloid",
    "SphericalCap",
    "Stamp",
    "Texture",
    "Trench",
]

_KINDS: tuple[type[Stamp], ...] = (
    Gaussian,
    Crater,
    ConeStamp,
    Paraboloid,
    SphericalCap,
    HalfCosine,
    Trench,
    Berm,
    Flatten,
    Noise,
    Texture,
)

REGISTRY: dict[str, type[Stamp]] = {kind.name: kind for kind in _KINDS}
"""Every stamp by the name that files give it. A stamp's dataclass fields are its schema: enter a
new class here and files can use it."""
