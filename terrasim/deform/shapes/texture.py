"""An image laid on the ground."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from terrasim.deform.shapes.checks import TALLEST, check_size, refuse
from terrasim.deform.shapes.footprint import turn_of, turned_box
from terrasim.deform.shapes.height_image import Floats, HeightImage
from terrasim.deform.shapes.stamp import Bounds, Data, Extent, Shape, Stamp
from terrasim.kernels.shapes import TEXTURE


@dataclass(frozen=True)
class Texture(Stamp):
    """An image of heights, placed, scaled to metres and turned.

    A sample ``v`` is ``intensity * (offset + scale * v)`` metres. The outermost samples lie on the
    rectangle's edges, as posts do, the first row along the north; between samples heights and
    weights are bilinear. Outside it changes nothing, so an image that does not fall to 0 at its
    edges leaves a step. Its weight is the image's alpha, 1 without; what is added is multiplied by
    it.
    """

    image: HeightImage
    """Samples and their weights; an array of samples will do."""
    size_x: float
    """Width along x before it is turned [m]."""
    size_y: float
    """Width along y before it is turned [m]."""
    _: KW_ONLY
    turn_deg: float = 0.0
    """By how much it is turned, counter-clockwise from above [degrees]."""
    scale: float = 1.0
    """Metres of a sample of 1: white, in images of 8 and 16 bits."""
    offset: float = 0.0
    """Metres of a sample of 0."""
    intensity: float = 1.0
    """Factor on all heights [-]; negative turns them over."""

    kind: ClassVar[int] = TEXTURE
    name: ClassVar[str] = "texture"
    lengths: ClassVar[tuple[str, ...]] = ("size_x", "size_y", "scale", "offset")

    @classmethod
    def load(
        cls,
        path: str | Path,
        *args: float,
        channel: int | None = None,
        alpha: bool = True,
        **settings: Any,
    ) -> Self:
        """A texture from an image file: PNG, TIFF, OpenEXR, or an array in NumPy's format.

        Unsigned samples of 8 and 16 bits run from 0 to 1; all others are taken as they are.

        Args:
            path: The file.
            *args: ``x``, ``y``, ``size_x`` and ``size_y`` [m], as far as they are not named.
            channel: Channel that holds the heights, from 1; needed if there are several beside
                alpha.
            alpha: Whether the image's alpha channel, if it has one, is the weight.
            **settings: All other fields.

        Raises:
            InputError: If the image cannot be read or a field breaks a rule.
        """
        names = ("x", "y", "size_x", "size_y")
        settings |= dict(zip(names, args, strict=False))
        return cls(image=HeightImage.load(path, channel=channel, alpha=alpha), **settings)

    def _check(self) -> None:
        for name in ("size_x", "size_y"):
            check_size(getattr(self, name), self.name, name)
        if not isinstance(self.image, HeightImage):
            object.__setattr__(self, "image", HeightImage(self.image))
        with np.errstate(over="ignore", invalid="ignore"):
            ends = self._metres(np.array([self.image.samples.min(), self.image.samples.max()]))
        worst = float(np.abs(ends).max())
        if not worst <= TALLEST:
            rule = f"keep the image's heights within {TALLEST:.0f} m"
            refuse(self.name, "scale", rule, f"{self.scale} for {worst:g} m")

    def _metres(self, samples: Floats) -> Floats:
        metres: Floats = self.intensity * (self.offset + self.scale * samples)
        return metres

    @property
    def extent(self) -> Extent:
        """The box that holds the turned rectangle [m]."""
        wide, high = turned_box(self.size_x / 2.0, self.size_y / 2.0, self.turn_deg)
        return (-wide, -high, wide, high)

    @property
    def volume(self) -> float:
        """Integral of the bilinear heights, times the bilinear weights where it has them [m^3]."""
        rows, cols = self.image.samples.shape
        heights = self._metres(self.image.samples)
        cell = self.size_x / (cols - 1) * self.size_y / (rows - 1)
        weights = self.image.weights
        return float(
            cell * _product(heights, np.ones_like(heights) if weights is None else weights)
        )

    @property
    def bounds(self) -> Bounds:
        """It has kinks between its cells, and steps at its edges."""
        heights = self._metres(self.image.samples)
        low, high = min(0.0, float(heights.min())), max(0.0, float(heights.max()))
        return Bounds(low, high, math.inf, math.inf)

    @property
    def shape(self) -> Shape:
        """Samples a metre along x and y, 1 if the weight is in the height, 1 if it has weights."""
        rows, cols = self.image.samples.shape
        added, weighted = self.mode == "add", self.image.weights is not None
        across, along = (cols - 1) / self.size_x, (rows - 1) / self.size_y
        return (across, along, float(added), float(weighted))

    @cached_property
    def data(self) -> Data:
        """Half sizes, turn, rows and columns, heights from the south [m], weights likewise."""
        rows, cols = self.image.samples.shape
        head = [self.size_x / 2.0, self.size_y / 2.0, *turn_of(self.turn_deg), rows, cols]
        parts = [np.array(head, dtype=np.float64), self._metres(self.image.samples)[::-1].ravel()]
        if self.image.weights is not None:
            parts.append(self.image.weights[::-1].ravel())
        return np.concatenate(parts)


def _product(a: Floats, b: Floats) -> float:
    """Integral of the product of two bilinear fields over cells of area 1.

    Along one axis of a cell the integral is ``(2 a0 b0 + a0 b1 + a1 b0 + 2 a1 b1) / 6``.
    """
    weights = {0: 2.0, 1: 1.0}
    total = 0.0
    ends = (slice(None, -1), slice(1, None))
    for i in range(16):
        ra, ca, rb, cb = i & 1, i >> 1 & 1, i >> 2 & 1, i >> 3 & 1
        weight = weights[ra ^ rb] * weights[ca ^ cb] / 36.0
        total += weight * float((a[ends[ra], ends[ca]] * b[ends[rb], ends[cb]]).sum())
    return total
