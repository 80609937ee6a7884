"""What is done to a terrain, in order: a journal row first, then the ground, then block images.

Without a branch of a store the ground is changed in memory alone. With one, an operation is
acknowledged when its row is on the disk; the changed blocks follow at checkpoints, in the
background. Opening again is the newest checkpoint and the rows after it, done once more.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from terrasim.cache.ground import Edit
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.deform.engine import engine_hash
from terrasim.deform.ledger import Ledger
from terrasim.deform.operations import Operation, Stamping, decode, encode, summary
from terrasim.deform.perform import Done, check, perform
from terrasim.deform.relaxation import Rect
from terrasim.deform.waiting import together
from terrasim.errors import InputError, RunError
from terrasim.grid import Block
from terrasim.store.branch import Branch
from terrasim.terrain import Terrain

INTERVAL_S = 1.0
"""Longest time between checkpoints while the ground changes [s]."""
DIRTY_BYTES = 64 << 20
"""Bytes of changed blocks at which a checkpoint does not wait for the time."""
REPLAYED_AT_ONCE = 1024
"""Rows of stamps that are done again together at opening."""
LEDGERS_KEPT = 10_000
"""Ledgers of operations that are kept for those who ask again."""


@dataclass(frozen=True)
class Receipt:
    """What came of an operation."""

    seq: int | None
    """Its number in the journal; None without a store."""
    ledger: Ledger
    """What it did; ``pending`` while it waits, empty if it was repeated and is not known."""
    durability: str
    """``journal``: the row is on the disk. ``memory``: there is no store."""
    repeated: bool = False
    """Whether it had been done before under the same key and was not done again."""
    awake: tuple[Rect, ...] = ()
    """Where ground that relaxes is not done yet."""


class Edits:
    """The operations of one terrain. Use :func:`edits_of` to come by it."""

    def __init__(self, terrain: Terrain, branch: Branch | None = None) -> None:
        """Begin, and do again what the branch's newest checkpoint does not hold.

        Raises:
            StoreCorrupt: If a journal row is damaged.
            RunError: If a block cannot be read.
        """
        self.terrain = terrain
        self.branch = branch
        self.ledger = Ledger()
        """What has been done since opening."""
        self.replayed = 0
        """Operations done again at opening."""
        self.other_engine = 0
        """How many of them were first done by another version or on another kind of device."""
        self.failed_checkpoints = 0
        """Checkpoints that could not be written; the journal holds what they would have."""
        self._queue: list[Stamping] = []
        self._ledgers: OrderedDict[int, Ledger] = OrderedDict()
        self._broken = ""
        self._busy = False
        self._applied = 0
        self._writer: ThreadPoolExecutor | None = None
        self._writing: Future[None] | None = None
        self._last_checkpoint = time.monotonic()
        if branch is not None:
            self._writer = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
            try:
                self._replay(branch)
            except BaseException:
                self._writer.shutdown(wait=True)
                raise

    def commit(
        self, operation: Operation, *, idem: str | None = None, wait: bool = True
    ) -> Receipt:
        """Do something to the ground.

        Args:
            operation: What.
            idem: A key of the caller's, kept by the store: the same operation under the same key
                is done once.
            wait: Change the ground now. Otherwise stamps that are only added may wait until the
                ground is next read or written; the bits are the same.

        Raises:
            InputError: If the operation cannot be done here, the key stands for another one, or
                there is a key and no store. Nothing is changed then.
            RunError: If the journal cannot be written: nothing is changed, and it may be tried
                again when the disk is well; or if a block cannot be read after that: then the
                terrain must be opened again.
        """
        self._require_sound()
        check(self.terrain, operation)
        if idem is not None:
            self.require_branch()
        seq = None
        if self.branch is not None:
            self._mend(self.branch)
            newest = self.branch.last_seq
            seq = self.branch.append(
                encode(operation), idem=idem, engine=engine_hash(), summary=summary(operation)
            )
            if seq <= newest:
                return Receipt(seq, self._ledgers.get(seq, Ledger()), "journal", repeated=True)
        durability = "memory" if self.branch is None else "journal"
        if not wait and isinstance(operation, Stamping) and operation.additive:
            self._queue.append(operation)
            self._applied = seq or 0
            self._checkpoint_if_due()
            return Receipt(seq, Ledger(pending=len(operation.stamps)), durability)
        self.settle()
        done = self._do(operation)
        self._applied = seq or 0
        self._keep(seq, done.ledger)
        self._checkpoint_if_due()
        return Receipt(seq, done.ledger, durability, awake=done.awake)

    def settle(self) -> Ledger:
        """Do what waits, all stamps in as few launches as their anchors allow.

        Returns:
            What it did.

        Raises:
            RunError: If an operation failed, now or earlier: nobody reads half-changed ground.
        """
        done = Ledger()
        if self._busy:
            return done
        self._require_sound()
        if not self._queue:
            return done
        queue, self._queue = self._queue, []
        for one in together(self.terrain, queue):
            done += self._do(one).ledger
        return done

    def checkpoint(self) -> None:
        """Write the changed blocks into the store now and wait for it; without a store, nothing.

        Raises:
            RunError: If they cannot be written. The journal holds everything; try again.
        """
        if self.branch is None:
            return
        self._await_writer()
        self._begin_checkpoint()
        failed = self._await_writer()
        if failed is not None:
            raise failed

    def fork(self, name: str) -> None:
        """Begin a branch with the ground as it is now."""
        branch = self.require_branch()
        self.checkpoint()
        branch.fork(name)

    def snapshot(self, name: str) -> None:
        """Give the ground as it is now a name to come back to."""
        branch = self.require_branch()
        self.checkpoint()
        branch.snapshot(name)

    def reset(self, to: str | int) -> None:
        """Make the ground what it was at a snapshot or a checkpoint; costs the same for any size.

        Raises:
            InputError: If there is no such state; nothing is changed then.
        """
        branch = self.require_branch()
        self.checkpoint()
        branch.reset(to)
        self._queue.clear()
        self.terrain.ground.clear()
        self.terrain.cache.discard()
        self._applied = branch.last_seq

    def close(self) -> None:
        """Write what has changed and let go of the branch."""
        if self.branch is None:
            return
        try:
            if not self._broken:
                self.checkpoint()
        finally:
            if self._writer is not None:
                self._writer.shutdown(wait=True)
            self.branch.close()

    def _replay(self, branch: Branch) -> None:
        mine = engine_hash()
        self._applied = branch.checkpoint_seq
        for seq, row, engine in branch.pending():
            operation = decode(row)
            self.other_engine += engine != mine
            self.replayed += 1
            if isinstance(operation, Stamping) and operation.additive:
                self._queue.append(operation)
            else:
                self.settle()
                self._keep(seq, self._do(operation).ledger)
            self._applied = seq
            if len(self._queue) >= REPLAYED_AT_ONCE:
                self.settle()
            self._checkpoint_if_due()
        self.settle()

    def _do(self, operation: Operation) -> Done:
        self._busy = True
        try:
            done = perform(self.terrain, operation)
        except BaseException as error:
            self._broken = str(error) or type(error).__name__
            raise
        finally:
            self._busy = False
        self.ledger += done.ledger
        return done

    def _keep(self, seq: int | None, ledger: Ledger) -> None:
        if seq is None:
            return
        self._ledgers[seq] = ledger
        while len(self._ledgers) > LEDGERS_KEPT:
            self._ledgers.popitem(last=False)

    def _checkpoint_if_due(self) -> None:
        if self.branch is None or (self._writing is not None and not self._writing.done()):
            return
        cache, ground = self.terrain.cache, self.terrain.ground
        waited = time.monotonic() - self._last_checkpoint > INTERVAL_S
        dirty = BLOCK_BYTES * (cache.dirty + len(ground.edited)) > DIRTY_BYTES
        if waited or dirty:
            self._await_writer()
            self._begin_checkpoint()

    def _begin_checkpoint(self) -> None:
        """Take the changed blocks as they are now and have them written in the background."""
        self._require_sound()
        self.settle()
        self._last_checkpoint = time.monotonic()
        self.terrain.cache.flush()
        kept = self.terrain.ground.kept()
        branch = self.branch
        if self._writer is None or branch is None:
            return
        if kept or self._applied > branch.checkpoint_seq:
            self._writing = self._writer.submit(self._write, branch, kept, self._applied)

    def _write(self, branch: Branch, kept: Mapping[Block, Edit], seq: int) -> None:
        if branch.writer.failed:
            branch.reopen()
        branch.checkpoint({key: edit.data for key, edit in kept.items()}, seq)
        # From here on the branch answers for them.
        self.terrain.ground.forget(kept)

    def _await_writer(self) -> RunError | None:
        """Wait for the last checkpoint; what one that failed left is in the next."""
        if self._writing is None:
            return None
        writing, self._writing = self._writing, None
        try:
            writing.result()
        except RunError as error:
            self.failed_checkpoints += 1
            return error
        return None

    def _mend(self, branch: Branch) -> None:
        """Go on after the disk failed, if it is well again."""
        if branch.writer.failed:
            self._await_writer()
            branch.reopen()

    def require_branch(self) -> Branch:
        """The branch of the store behind the terrain.

        Raises:
            InputError: If there is none.
        """
        if self.branch is None:
            raise InputError("this terrain has no store; open one with open_terrain")
        return self.branch

    def _require_sound(self) -> None:
        if self._broken:
            raise RunError(
                f"the ground is half-changed because an operation failed ({self._broken}); "
                "open the terrain again: what was acknowledged is in its journal"
            )


def edits_of(terrain: Terrain) -> Edits:
    """The edits of a terrain, begun in memory where no store stands behind it."""
    if terrain.edits is None:
        terrain.edits = Edits(terrain)
    edits: Edits = terrain.edits
    return edits
