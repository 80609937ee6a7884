"""Stamps: shapes that change the ground.

A stamp is a small frozen dataclass. It says where it stands, in metres from an anchor post, how it
meets the ground, and what its shape is at a distance from there. To add a stamp: write its formula
into ``kernels/shapes.py`` under a new kind, write its dataclass into ``terrasim/deform/shapes``,
and enter it in :data:`REGISTRY`. Everything else follows from those.
"""

from __future__ import annotations

from terrasim.deform.shapes.crater import Crater
from terrasim.deform.shapes.mounds import (
    ConeStamp,
    Gaussian,
    HalfCosine,
    Paraboloid,
    SphericalCap,
)
from terrasim.deform.shapes.stamp import Bounds, Stamp

__all__ = [
    "REGISTRY",
    "Bounds",
    "ConeStamp",
    "Crater",
    "Gaussian",
    "HalfCosine",
    "Paraboloid",
    "SphericalCap",
    "Stamp",
]

REGISTRY: dict[str, type[Stamp]] = {
    kind.name: kind for kind in (Gaussian, Crater, ConeStamp, Paraboloid, SphericalCap, HalfCosine)
}
"""Every stamp by the name that files give it. A stamp's dataclass fields are its schema: enter a
new class here and files can use it."""
