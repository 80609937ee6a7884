"""What pictures and stages need to know of anything that deforms the ground."""

from __future__ import annotations

from typing import Protocol


class Footprint(Protocol):
    """A rectangle around a place: a stamp, or something that changes over time."""

    @property
    def x(self) -> float:
        """Its place, metres east of the anchor post."""

    @property
    def y(self) -> float:
        """Its place, metres north of the anchor post."""

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, south, east and north end [m from its place]."""

    @property
    def reach(self) -> float:
        """Half the side of the square around its place that holds its extent [m]."""

    @property
    def volume(self) -> float:
        """Volume that it adds [m^3]; NaN where that is not known."""
