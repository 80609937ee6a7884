"""One launch of stamps over a group of resident blocks, and what it did to each of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.deform.binning import Group
from terrasim.deform.placing import Placed, Records
from terrasim.deform.target import Target
from terrasim.kernels import edit_row, stamps
from terrasim.kernels.addressing import BLOCK
from terrasim.launch import launch
from terrasim.terrain import Terrain

Shares = npt.NDArray[np.int64]
"""What each stamp removed and added [counts], shape ``(stamps, 2)``."""


class Batch:
    """Stamps on the device, ready to be put to any of their blocks."""

    def __init__(
        self, terrain: Terrain, placed: Placed, target: Target, *, undo: bool, by_stamp: bool
    ) -> None:
        """Send the stamps to the device.

        Args:
            terrain: The terrain.
            placed: The stamps.
            target: The posts they change.
            undo: Take back what they once added.
            by_stamp: Keep account of each stamp.
        """
        self._terrain = terrain
        self._posts = target.posts(undo=undo)
        self._plain = placed.in_parts and not by_stamp and target.level == 0
        self._stamps = self._sent(placed.records, stamps.Stamp)
        self._across = self._parts_of_x(placed)
        data = np.concatenate(placed.data) if placed.data and not self._plain else np.empty(0)
        self._data = self._sent(data, wp.float64)
        self.shares: Shares | None = (
            np.zeros((len(placed.records), 2), dtype=np.int64) if by_stamp else None
        )
        """What each stamp removed and added so far, if asked for."""

    def run(self, group: Group, layers: list[int]) -> Records:
        """Change a group of blocks.

        Args:
            group: The blocks and their stamps.
            layers: The layers they are in.

        Returns:
            ``kernels.edit_row.RowTally``, shape ``(blocks, BLOCK)``.
        """
        terrain, device = self._terrain, self._terrain.device
        group.work["layer"] = layers
        rows = len(layers) * BLOCK
        blocks = self._sent(group.work, stamps.BlockStamps)
        listed = self._sent(group.listed, wp.vec4i)
        tally: Any = wp.empty(rows, dtype=edit_row.RowTally, device=device)
        shared = [terrain.pool, self._posts, self._stamps, self._across]
        if self._plain:
            kernel, shared = stamps.add_stamps, [*shared, blocks, listed]
        else:
            # A scene whose stamps are few and simple never compiles the others.
            from terrasim.kernels import stamp_modes

            kernel = stamp_modes.apply_stamps
            share: Any = wp.zeros(
                group.rows if self.shares is not None else 0, dtype=wp.vec2l, device=device
            )
            shared = [
                *(terrain.pool, terrain.resident, terrain.lattice),
                *shared[1:],
                *(self._data, blocks, listed, share),
            ]
        launch(
            kernel,
            rows,
            shared=shared,
            items=[self._places(rows), tally],
            device=device,
            threads=terrain.threads,
        )
        if self.shares is not None:
            first = group.listed[:, 3]
            # Every stamp of a block has a row in it, so that no two of these are the same.
            of_pair = np.add.reduceat(share.numpy()[:, ::-1], first, axis=0)
            np.add.at(self.shares, group.listed[:, 0], of_pair)
        found: Records = tally.numpy().reshape(len(layers), BLOCK)
        return found

    def _parts_of_x(self, placed: Placed) -> Any:
        device = self._terrain.device
        across: Any = wp.empty(placed.columns, dtype=wp.float64, device=device)
        width = np.diff(placed.records["across"], append=placed.columns)
        owner = np.repeat(np.arange(len(width), dtype=np.int32), width)
        launch(
            stamps.parts_of_x,
            placed.columns,
            shared=[self._posts, self._stamps],
            items=[self._places(placed.columns), self._sent(owner, wp.int32), across],
            device=device,
            threads=self._terrain.threads,
        )
        return across

    def _sent(self, values: npt.NDArray[Any], dtype: Any) -> Any:
        """An array on the device; on the CPU the same memory where that is quick."""
        if values.dtype.names and not self._terrain.device.is_cuda:
            # Warp takes eight times as long to compare the types of structs.
            sent: Any = wp.empty(len(values), dtype=dtype, device=self._terrain.device)
            sent.numpy()[...] = values
            return sent
        return wp.array(values, dtype=dtype, device=self._terrain.device, copy=False)

    def _places(self, count: int) -> Any:
        """0, 1, 2 ...: where an item stands, whichever part of a launch it falls into."""
        return self._sent(np.arange(count, dtype=np.int32), wp.int32)
