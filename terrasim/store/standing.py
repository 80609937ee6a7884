"""Where a branch stands: its epoch, its newest checkpoint, its newest journal row, all checked."""

from __future__ import annotations

from dataclasses import dataclass, replace

import apsw

from terrasim.store import records
from terrasim.store.codec import StoreCorrupt
from terrasim.store.edited import At
from terrasim.store.epochs import begin, newest_seq
from terrasim.store.journal import Fetch, Tail, chain_at, read_rows
from terrasim.store.names import MAIN, Names, check_name, find_branch, read_names
from terrasim.store.noted import check_note
from terrasim.store.readers import Readers
from terrasim.store.records import BranchRow, Checkpoint, Epoch, names_with
from terrasim.store.store_file import REMEDY
from terrasim.store.writer import Writer


@dataclass(frozen=True)
class Standing:
    """Where a branch stands."""

    row: BranchRow
    """The branch as its row says."""
    checkpoint: Checkpoint
    """Its newest checkpoint."""
    tail: Tail
    """Its newest journal row."""
    last: int
    """Highest number of a journal row in the store."""
    factor: int
    """Detail posts to a base post."""

    @property
    def at(self) -> At:
        """The state of its newest checkpoint."""
        return At(self.checkpoint.id, self.checkpoint.root, self.factor)

    @property
    def pending(self) -> bool:
        """Whether there are rows after the newest checkpoint."""
        return self.tail.seq > self.checkpoint.seq


def stand(writer: Writer, readers: Readers, name: str, create: bool) -> Standing:
    """Where a branch stands; one that is not there begins, if it may, on the imported terrain.

    Raises:
        InputError: If there is no such branch.
        StoreCorrupt: If a row of it is missing or damaged.
        RunError: If the disk fails.
    """
    check_name(name)
    with writer.transaction() as work:
        names = read_names(work.db)
        if name not in names.branches and (create or name == MAIN):
            _begin(work.db, names, name)
            names = read_names(work.db)
        row = find_branch(names, name)
        last = newest_seq(work.db, names.state)
        if (names.state.epoch, names.state.seq) != (row.epoch, last):
            # Rows beyond what the state row says are in its epoch alone.
            records.write(work.db, replace(names.state, epoch=row.epoch, seq=last))
        epoch = records.required(work.db, Epoch, row.epoch)
        checkpoint = records.required(work.db, Checkpoint, row.checkpoint)
        if writer.last_note is not None:
            check_note(writer.path, work.db, writer.last_note, names.state)
    tail = _checked_tail(readers.fetch, row, epoch, checkpoint)
    writer.note(tail)
    return Standing(row, checkpoint, tail, last, names.state.factor)


def _begin(db: apsw.Connection, names: Names, name: str) -> None:
    last = newest_seq(db, names.state)
    state, first = begin(db, replace(names.state, seq=last), None)
    row = BranchRow(name, first.epoch, first.id, first.seq, first.chain)
    records.write(db, row, replace(state, names=names_with(state.names, row)))


def _checked_tail(fetch: Fetch, row: BranchRow, epoch: Epoch, checkpoint: Checkpoint) -> Tail:
    """The newest row, after a look at all those that no checkpoint holds.

    Raises:
        StoreCorrupt: If one is missing or not as it was written.
    """
    if checkpoint.epoch != epoch.id:
        raise StoreCorrupt(f"branch {row.name} is in two epochs at once; {REMEDY}")
    if row.tail > epoch.floor and chain_at(fetch, epoch, row.tail).chain != row.tail_chain:
        raise StoreCorrupt(f"journal row {row.tail} is missing or damaged; {REMEDY}")
    newest = Tail(epoch.id, checkpoint.seq, checkpoint.chain)
    for _, tail in read_rows(fetch, newest):
        newest = tail
    return newest
