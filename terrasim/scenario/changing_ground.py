"""The ground of a run: opened, stamped, slumping, kept in a store, closed and opened again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from terrasim.deform.ledger import Ledger
from terrasim.grid import Span
from terrasim.scenario.scenario import Scenario
from terrasim.scenario.stages import StageTimer
from terrasim.sources.source import Source
from terrasim.terrain import Terrain


class ChangingGround:
    """A scenario's terrain and what is done to it."""

    def __init__(
        self, scenario: Scenario, source: Source, store: Path | None, timer: StageTimer
    ) -> None:
        """Open it.

        Args:
            scenario: The scenario.
            source: Its heights before.
            store: Where its store is to be made; None for none.
            timer: Where its stages are counted.
        """
        self._scenario = scenario
        self._source = source
        self._store = store if scenario.store is not None else None
        self._timer = timer
        self.ledger = Ledger()
        """What was done to the posts."""
        self.slumped = Ledger()
        """What slumping did of that."""
        self.reopened: list[dict[str, Any]] = []
        """Each time that it was opened again, ready for JSON."""
        self.snapshots = 0
        """States that were given a name."""
        self._awake: tuple[Any, ...] = ()
        with timer.stage("open the terrain"):
            if self._store is not None:
                _make_store(source, self._store)
            self.terrain = self._open()

    def stamp(self, stamps: Sequence[Any], anchor: tuple[int, int]) -> None:
        """Make stamps; what they touched may slump from now on."""
        from terrasim.deform.edits import edits_of
        from terrasim.deform.operations import Stamping

        operation = Stamping(tuple(stamps), anchor)
        with self._timer.stage("apply stamps"):
            self.ledger += edits_of(self.terrain).commit(operation).ledger
        if self._scenario.relaxation is not None:
            from terrasim.deform.overlap import boxes

            self._awake += tuple(self._within(boxes(self.terrain, operation)))

    def go_on(self, dynamics: Any, step: int) -> list[Span]:
        """Let dynamics go on to the time of a step.

        Args:
            dynamics: A :class:`~terrasim.scenario.running_dynamics.RunningDynamics`.
            step: The step.

        Returns:
            Rectangles of level-0 cells to look at again.
        """
        with self._timer.stage("advance dynamics"):
            ledger, boxes = dynamics.go_on(self.terrain, step)
        self.ledger += ledger
        if self._scenario.relaxation is not None and ledger.posts:
            self._awake += tuple(self._within(dynamics.boxes))
        found: list[Span] = boxes
        return found

    def slump(self) -> list[Span]:
        """Let what is awake slump for a step.

        Returns:
            Rectangles of level-0 cells in which the ground may have changed.
        """
        settings = self._scenario.relaxation
        if settings is None or not self._awake:
            return []
        from terrasim.deform.edits import edits_of
        from terrasim.deform.operations import Relaxing
        from terrasim.deform.overlap import boxes

        operation = Relaxing(self._awake, settings.angle_deg, settings.iterations, settings.detail)
        with self._timer.stage("relax"):
            done = edits_of(self.terrain).commit(operation)
        self._awake = done.awake
        self.ledger += done.ledger
        self.slumped += done.ledger
        if not done.ledger.posts:
            return []
        return [
            Span(one.row0, one.row1, one.col0, one.col1) for one in boxes(self.terrain, operation)
        ]

    def keep(self, before_s: float, time_s: float) -> bool:
        """Do what the store's table says for times after ``before_s`` up to ``time_s``.

        Returns:
            Whether the terrain is another object now.
        """
        settings = self._scenario.store
        if settings is None or self._store is None:
            return False
        from terrasim.deform.edits import edits_of

        for _ in _between(settings.snapshots_s, before_s, time_s):
            self.snapshots += 1
            with self._timer.stage("name a snapshot"):
                edits_of(self.terrain).snapshot(f"snapshot-{self.snapshots}")
        again = _between(settings.reopen_s, before_s, time_s)
        if again:
            self._reopen(time_s)
        return bool(again)

    def height_difference(self) -> int | None:
        """What the heights say was added [counts / the ledger's unit]; None without a change."""
        if not self.ledger.posts:
            return None
        from terrasim.scenario.balance import height_difference

        with self._timer.stage("add up the heights"):
            return height_difference(self.terrain, self._source, self.ledger.unit)

    def summary(self) -> dict[str, Any]:
        """What slumped and what is kept, ready for JSON."""
        said: dict[str, Any] = {}
        if self._scenario.relaxation is not None:
            slumped = self.slumped
            said["relaxation"] = {
                "moved_counts": slumped.added,
                "removed_counts": slumped.removed,
                "net_counts": slumped.net,
                "unit": slumped.unit,
                "still_slumping": len(self._awake),
            }
        if self._store is not None:
            branch = self.terrain.edits.branch
            said["store"] = {
                "file": self._store.name,
                "operations": branch.last_seq,
                "checkpoint": branch.checkpoint_seq,
                "snapshots": self.snapshots,
                "reopened": self.reopened,
                "failed_checkpoints": self.terrain.edits.failed_checkpoints,
            }
        return said

    def close(self) -> None:
        """Write what was done, if there is a store, and end the terrain's threads."""
        self.terrain.close()

    def _open(self) -> Terrain:
        scenario = self._scenario
        options: dict[str, Any] = {
            "device": scenario.run.device,
            "pool_bytes": scenario.pool.bytes,
            "threads": scenario.run.threads,
            "loaders": scenario.pool.loaders,
            "late": scenario.run.late,
        }
        if scenario.detail is not None:
            options["detail_factor"] = scenario.detail.factor
            options["detail_pool_bytes"] = scenario.detail.bytes
        if self._store is None:
            return Terrain(self._source, **options)
        from terrasim.open_terrain import open_terrain

        return open_terrain(self._store, **options)

    def _reopen(self, time_s: float) -> None:
        """Close the store and open it again; the ground must be what it was."""
        from terrasim.scenario.fingerprint import hash_heights

        with self._timer.stage("close and open again"):
            before = hash_heights(self.terrain)
            counters = self.terrain.cache.counters
            self.terrain.close()
            self.terrain = self._open()
            self.terrain.cache.counters = counters
            after = hash_heights(self.terrain)
        self.reopened.append(
            {
                "time_s": time_s,
                "replayed": self.terrain.edits.replayed,
                "same_heights": before == after,
            }
        )

    def _within(self, boxes: Sequence[Any]) -> list[Any]:
        """The posts that slump within rectangles of level-0 posts, their ends included."""
        from terrasim.deform.relaxation import Rect

        grid, settings = self.terrain.grid, self._scenario.relaxation
        if settings is None:
            return []
        found = []
        for box in boxes:
            row0, row1 = max(box.row0, grid.row), min(box.row1, grid.row + grid.rows - 1)
            col0, col1 = max(box.col0, grid.col), min(box.col1, grid.col + grid.cols - 1)
            if row0 > row1 or col0 > col1:
                continue
            if settings.detail:
                detail = self.terrain.detail
                row0, row1 = ((one - detail.row0) * detail.factor for one in (row0, row1))
                col0, col1 = ((one - detail.col0) * detail.factor for one in (col0, col1))
            found.append(Rect(row0, row1 + 1, col0, col1 + 1))
        return found


def _make_store(source: Source, path: Path) -> None:
    """A store of a source: its formula if it is one, else its blocks."""
    from terrasim.errors import InputError
    from terrasim.store.build import build_store
    from terrasim.store.create import create_store
    from terrasim.store.pyramid import SourceRows

    try:
        create_store(path, source)
    except InputError:
        provenance = getattr(source, "provenance", {})
        build_store(
            SourceRows(source),
            source.grid,
            path,
            provenance=provenance,
            synthetic=source.synthetic,
        )


def _between(times_s: Sequence[float], before_s: float, time_s: float) -> list[float]:
    """Those of the times that come after one and not after another, rounding aside."""
    early, late = (math.nextafter(one + 1e-9, math.inf) for one in (before_s, time_s))
    return [one for one in times_s if early < one <= late]
