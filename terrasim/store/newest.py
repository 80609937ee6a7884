"""Heights of the newest checkpoint, while newer ones come."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from terrasim.counts import Counts
from terrasim.grid import Block, Grid, Indices
from terrasim.sources.source import BlockData
from terrasim.store.edited import At, Collected
from terrasim.store.store import StoreSource

T = TypeVar("T")


class Newest:
    """A source that follows a branch. Each read is of one state, any number of threads may read."""

    def __init__(self, view: StoreSource) -> None:
        """Begin with a state."""
        self._view = view

    @property
    def grid(self) -> Grid:
        """Placement of the level-0 posts."""
        return self._view.grid

    @property
    def synthetic(self) -> str:
        """What part of the heights is invented, in a few words; empty if none is."""
        return self._view.synthetic

    @property
    def provenance(self) -> dict[str, object]:
        """Where the imported heights come from, ready for JSON."""
        return self._view.provenance

    @property
    def summary(self) -> dict[str, Any]:
        """What the import found."""
        return self._view.summary

    @property
    def detail_factor(self) -> int:
        """Detail posts to a base post; 1 if there is no detail."""
        return self._view.detail_factor

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the newest checkpoint; see :meth:`terrasim.store.store.StoreSource.posts`."""
        return self._newest(lambda view: view.posts(level, rows, cols))

    def block(self, key: Block) -> BlockData:
        """One block of the newest checkpoint: :meth:`terrasim.store.store.StoreSource.block`."""
        return self._newest(lambda view: view.block(key))

    def details(self, key: Block) -> list[Block]:
        """Detail blocks within a level-0 block that are not zero at the newest checkpoint."""
        return self._newest(lambda view: view.details(key))

    def _follow(self, at: At) -> None:
        """Read from another state from now on."""
        if at != self._view.state:
            self._view = self._view.at(at)

    def _newest(self, read: Callable[[StoreSource], T]) -> T:
        """Read; again if the state was dropped and collected while another came."""
        while True:
            view = self._view
            try:
                return read(view)
            except Collected:
                if view is self._view:
                    raise
