"""Seeded roughness."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

import numpy as np

from terrasim.deform.shapes.checks import check_height, check_size, refuse
from terrasim.deform.shapes.footprint import Windowed
from terrasim.deform.shapes.stamp import Bounds, Data, Shape
from terrasim.kernels.shapes import NOISE

MAX_OCTAVES = 16
"""Most octaves of noise."""
MAX_NODE = 2.0**52
"""Largest number of a lattice node: up to there a place keeps a part of a cell."""
_STEEPEST = 3.2222 * math.sqrt(2.0)
"""Bound of one octave's slope in heights a lattice spacing: 1.3472 + 1.875 along each axis."""


@dataclass(frozen=True)
class Noise(Windowed):
    """Seeded gradient noise in a footprint: ``amplitude`` times a sum of octaves.

    An octave is random planes through 0 at the nodes of a square lattice, blended between the nodes
    by ``6 t^5 - 15 t^4 + 10 t^3`` (Perlin 2002). A node's plane has gradients of at most 1 along
    each axis, from a hash (SplitMix64) of the seed and of the node's place from the anchor: nothing
    is stored, stamps of one seed side by side are one noise, and it is the same to the bit wherever
    the terrain lies. Each further octave has half the wavelength and ``gain`` times the height; the
    sum is scaled to lie within ``amplitude``. Added, it fades with its footprint.
    """

    amplitude: float
    """Largest height it can have [m]."""
    wavelength: float
    """Spacing of the first octave's lattice [m]."""
    _: KW_ONLY
    seed: int = 0
    """Which of the possible noises, 0 to 2^63 - 1."""
    octaves: int = 1
    """Number of octaves, 1 to 16."""
    gain: float = 0.5
    """Height of an octave relative to the one before, above 0 and at most 1."""

    kind: ClassVar[int] = NOISE
    name: ClassVar[str] = "noise"
    lengths: ClassVar[tuple[str, ...]] = (
        "amplitude",
        "wavelength",
        "radius",
        "size_x",
        "size_y",
        "fade",
    )

    def _check(self) -> None:
        super()._check()
        check_height(self.amplitude, self.name, "amplitude")
        check_size(self.wavelength, self.name, "wavelength")
        if not 0 <= self.seed < 2**63:
            refuse(self.name, "seed", "lie between 0 and 2^63 - 1", self.seed)
        if not 1 <= self.octaves <= MAX_OCTAVES:
            refuse(self.name, "octaves", f"lie between 1 and {MAX_OCTAVES}", self.octaves)
        if not 0.0 < self.gain <= 1.0:
            refuse(self.name, "gain", "be above 0 and at most 1", self.gain)
        farthest = max(abs(self.x), abs(self.y)) + self.reach
        if farthest / self.wavelength * 2.0**self.octaves > MAX_NODE:
            rule = f"be longer, {farthest:g} m from the anchor, for {self.octaves} octaves"
            refuse(self.name, "wavelength", rule, self.wavelength)

    @property
    def volume(self) -> float:
        """NaN: there is no closed form."""
        return math.nan

    @property
    def bounds(self) -> Bounds:
        """Those of any seed; without a fade it has a step."""
        heights = [self.gain**k for k in range(self.octaves)]
        steep = sum(height * 2.0**k for k, height in enumerate(heights)) / sum(heights)
        height = abs(self.amplitude)
        slope = height * (_STEEPEST * steep / self.wavelength + self.fade_slope)
        return Bounds(-height, height, slope if height else 0.0, math.inf)

    @property
    def shape(self) -> Shape:
        """Amplitude [m], one over the wavelength [1/m], gain, and 1 if the weight is in both."""
        return (self.amplitude, 1.0 / self.wavelength, self.gain, float(self.mode == "add"))

    @property
    def data(self) -> Data:
        """Footprint, place [m], the seed's high and low 32 bits, octaves."""
        words = [self.x, self.y, self.seed >> 32, self.seed & 0xFFFFFFFF, self.octaves]
        return np.concatenate((self.footprint, np.array(words, dtype=np.float64)))
