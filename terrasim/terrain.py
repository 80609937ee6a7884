"""A terrain: heights from a source, held in a pool, read through one surface."""

from __future__ import annotations

import math
from types import TracebackType
from typing import Any, Literal, Self

import warp as wp

from terrasim.cache.cache import Cache
from terrasim.cache.detail_table import DetailTable
from terrasim.cache.ground import Detailed, Ground
from terrasim.cache.pool import detail_layers_for, layers_for
from terrasim.detail.grid import DetailGrid
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.kernels.lattice import Lattice
from terrasim.sources.source import Source

Late = Literal["wait", "fallback"]

DEFAULT_POOL_BYTES = 64 << 20
"""Bytes of the pool's posts unless the caller says otherwise: 256 blocks."""
DEFAULT_DETAIL_POOL_BYTES = 64 << 20
"""Bytes of the detail's posts unless the caller says otherwise: 256 blocks."""


class Terrain:
    """Ground of any size with a pool of fixed size, on one device.

    Close it, or use it as a context manager, to end its loader threads.
    """

    def __init__(
        self,
        source: Source,
        *,
        device: str = "cpu",
        pool_bytes: int = DEFAULT_POOL_BYTES,
        threads: int = 1,
        loaders: int = 2,
        late: Late = "wait",
        detail_factor: int | None = None,
        detail_pool_bytes: int = DEFAULT_DETAIL_POOL_BYTES,
    ) -> None:
        """Open a terrain; the coarsest level is read at once, everything else when needed.

        Args:
            source: Where the heights come from.
            device: ``"cpu"`` or a CUDA device such as ``"cuda:0"``.
            pool_bytes: Bytes of posts to hold on the device.
            threads: CPU threads a launch may be split over.
            loaders: Threads that read blocks beside the step.
            late: What a step does about ground that it requires and that is not there yet:
                ``"wait"`` for it, so that results never depend on how fast a disk is, or
                ``"fallback"`` to the finest resident level above. Then they do.
            detail_factor: How many detail cells lie along a cell's side, where the ground is edited
                finer than its posts; 1 for no detail. Without it the source's own, or 1.
            detail_pool_bytes: Bytes of detail posts to hold on the device, beside ``pool_bytes``;
                nothing without detail.

        Raises:
            InputError: If the device is unknown, a pool cannot hold what it must, a number of
                threads is below 1, or the detail factor is no whole number, makes more posts than
                can be numbered, or is not that of detail the source has.
        """
        if threads < 1 or loaders < 1:
            raise InputError(f"threads and loaders must be at least 1, got {threads}, {loaders}")
        self.source = source
        self.grid: Grid = source.grid
        self.device = open_device(device)
        self.threads = threads
        self.detail = DetailGrid(self.grid, _factor_of(source, detail_factor))
        """Numbering of the detail; of factor 1 if there is none."""
        self.ground = Ground(source, self.detail)
        layers = layers_for(self.grid, pool_bytes)
        if late not in {"wait", "fallback"}:
            raise InputError(f"late must be 'wait' or 'fallback', got {late!r}")
        self.late = late
        self.cache = Cache(
            self.grid,
            self.ground,
            layers,
            self.device,
            loaders,
            detail_layers=detail_layers_for(self.detail, detail_pool_bytes, layers),
            waits=late == "wait",
        )
        self.lattice = lattice_of(self.grid)
        if self.cache.detail_table is not None:
            _add_detail(self.lattice, self.detail, self.cache.detail_table, layers)
        self.cache.before_reading = self.settle
        self.edits: Any = None
        """What is done to the ground, once something was; see :mod:`terrasim.deform.edits`."""

    def settle(self) -> None:
        """Let what waits to be done to the ground be done, before anyone reads it."""
        if self.edits is not None:
            self.edits.settle()

    @property
    def pool(self) -> Any:
        """Resident posts [counts], int32, shape ``(layers * BLOCK * BLOCK,)``.

        Whoever reads the ground comes through here, so what waits is done first.
        """
        self.settle()
        return self.cache.pool.posts

    @property
    def error(self) -> Any:
        """Error bound of each layer's block [counts], int32, shape ``(layers,)``."""
        return self.cache.pool.error

    @property
    def used(self) -> Any:
        """Flags in which queries note the layers they read, uint8, shape ``(layers,)``."""
        return self.cache.pool.used

    @property
    def resident(self) -> Any:
        """Pointer table of all resident blocks, for queries and views."""
        return self.cache.resident.entries

    @property
    def required(self) -> Any:
        """Pointer table of the ground that contact reads.

        Exactly what the step requires, brought back if something displaced it; with
        ``late = "fallback"``, all that is resident.
        """
        if self.late == "wait":
            self.cache.restore()
        return (self.cache.required if self.late == "wait" else self.cache.resident).entries

    def close(self) -> None:
        """Write what was done, if there is a store, and end the loader threads.

        The terrain must not be used afterwards.
        """
        try:
            if self.edits is not None:
                self.edits.close()
        finally:
            self.cache.close()
            # What is done to it holds the terrain in turn: its memory would wait for the collector.
            self.edits = None
            self.cache.before_reading = _nothing

    def __enter__(self) -> Self:
        """Use the terrain as a context manager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close."""
        self.close()


def _nothing() -> None:
    """Nothing waits any more."""


def lattice_of(grid: Grid) -> Any:
    """The grid as kernels take it."""
    lattice: Any = Lattice()
    lattice.x = grid.x
    lattice.y = grid.y
    lattice.z = grid.datum
    lattice.spacing = grid.spacing
    lattice.row = grid.row
    lattice.col = grid.col
    lattice.last_row = grid.row + grid.rows - 2
    lattice.last_col = grid.col + grid.cols - 2
    lattice.levels = grid.levels
    lattice.factor = 1
    return lattice


def _add_detail(lattice: Any, detail: DetailGrid, table: DetailTable, layers: int) -> None:
    """Say where the detail lies and where a pointer table has it."""
    lattice.factor = detail.factor
    lattice.row0, lattice.col0 = detail.row0, detail.col0
    lattice.detail, lattice.layers, lattice.mask = table.start, layers, table.mask


def _factor_of(source: Source, asked: int | None) -> int:
    """The detail's factor: what is asked for, which must be the source's own if it has one."""
    own = source.detail_factor if isinstance(source, Detailed) else 1
    if asked is None:
        return own
    if own > 1 and asked != own:
        raise InputError(f"detail_factor must be {own}, that of the source's detail, got {asked}")
    return asked


def open_device(name: str) -> Any:
    """The Warp device of a name.

    Raises:
        InputError: If there is no such device.
    """
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError):
        known = ", ".join(str(device) for device in wp.get_devices())
        raise InputError(f"no device {name!r}: this machine has {known}") from None


def finite(value: float, name: str) -> float:
    """A number that is neither NaN nor infinite.

    Raises:
        InputError: If it is one of them.
    """
    if not math.isfinite(value):
        raise InputError(f"{name} must be finite, got {value}")
    return value
