"""Edits that are refused, and disks and reads that fail: nothing changes, and nothing is lost."""

from __future__ import annotations

import functools
import math
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edited_ground import (
    GRID,
    SMALL,
    Bits,
    bits,
    build,
    held,
    hill,
    model,
    opened,
    operations,
)
from faulty_disk import Fault, FaultyVFS
from stored import killed

import terrasim as ts
from terrasim.deform.edits import Edits, edits_of
from terrasim.deform.operations import Relaxing, Stamping, Undoing
from terrasim.deform.patch import Patch
from terrasim.errors import InputError, RunError
from terrasim.store.branch import open_branch
from terrasim.store.verify import verify

NAN, INF = math.nan, math.inf
IMAGE = ts.HeightImage(np.eye(2))
ONES = np.ones((3, 3), np.int32)
any_: Any = ts
"""The library for those who do not look at types."""


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with something done to it."""
    path = build(tmp_path_factory.mktemp("imported") / "ground.store")
    with opened(path) as terrain:
        for one in operations()[:4]:
            edits_of(terrain).commit(one)
        edits_of(terrain).snapshot("four")
    return path


@pytest.fixture
def path(imported: Path, tmp_path: Path) -> Path:
    """A store."""
    return killed(imported, tmp_path / "here")


Bad = Callable[[ts.Terrain], object]


def _stamping(make: Callable[..., ts.Stamp], *values: Any, **more: Any) -> Bad:
    return lambda one: ts.apply(one, [hill(), make(*values, **more)])


def _operation(make: Callable[..., Any], *values: Any, **more: Any) -> Bad:
    return lambda one: edits_of(one).commit(make(*values, **more))


BAD: dict[str, Bad] = {
    "NaN place": _stamping(ts.Gaussian, NAN, 128.0, 1.0, 4.0),
    "infinite place": _stamping(ts.Gaussian, 50.0, -INF, 1.0, 4.0),
    "a place past all numbers": _stamping(ts.Gaussian, 1e300, 128.0, 1.0, 4.0),
    "NaN height": _stamping(ts.Gaussian, 50.0, 128.0, NAN, 4.0),
    "infinite height": _stamping(ts.Gaussian, 50.0, 128.0, INF, 4.0),
    "a height past all counts": _stamping(ts.Gaussian, 50.0, 128.0, 1e5, 4.0),
    "negative radius": _stamping(ts.ConeStamp, 50.0, 128.0, -3.0, 1.0),
    "no radius": _stamping(ts.SphericalCap, 50.0, 128.0, 0.0, 1.0),
    "a radius over the terrain": _stamping(ts.Crater, 50.0, 128.0, 2e3, 1.0),
    "a radius of 10^9": _stamping(ts.HalfCosine, 50.0, 128.0, 1e9, 1.0),
    "zero extent": _stamping(ts.Flatten, 50.0, 128.0, size_x=0.0, size_y=3.0, z=1.0),
    "a footprint of both kinds": _stamping(ts.Flatten, 50.0, 128.0, radius=2.0, size_x=2.0, z=1.0),
    "text for a number": _stamping(any_.Gaussian, "50", 128.0, 1.0, 4.0),
    "nothing for a number": _stamping(any_.Gaussian, None, 128.0, 1.0, 4.0),
    "unknown mode": _stamping(any_.Gaussian, 50.0, 128.0, 1.0, 4.0, mode="raise"),
    "a mode without its height": _stamping(ts.Gaussian, 50.0, 128.0, 1.0, 4.0, mode="fill"),
    "add with a height": _stamping(ts.Gaussian, 50.0, 128.0, 1.0, 4.0, z=1.0),
    "NaN height of a mode": _stamping(hill, mode="fill", z=NAN),
    "detail that is no flag": _stamping(any_.Gaussian, 50.0, 128.0, 1.0, 4.0, detail=1),
    "no image": _stamping(any_.Texture, 50.0, 128.0, "hill.png", 3.0, 3.0),
    "an image of one sample": lambda _: ts.HeightImage(np.ones((1, 1))),
    "an image with NaN": lambda _: ts.HeightImage(np.full((3, 3), NAN)),
    "an image of no size": _stamping(ts.Texture, 50.0, 128.0, IMAGE, 0.0, 3.0),
    "a polyline of one point": _stamping(ts.Trench, 50.0, 128.0, ((0.0, 0.0),), 1.0, 1.0),
    "a polyline of no length": _stamping(ts.Berm, 50.0, 128.0, ((0.0, 1.0), (0.0, 1.0)), 1.0, 1.0),
    "a polyline with NaN": _stamping(ts.Trench, 0.0, 0.0, ((0.0, 0.0), (NAN, 5.0)), 1.0, 1.0),
    "a seed that is no whole number": _stamping(any_.Noise, 0.0, 0.0, 1.0, 4.0, seed=0.5, radius=5),
    "what is no stamp": lambda one: any_.apply(one, ["hill"]),
    "an anchor that is no post": lambda one: any_.apply(one, [hill()], anchor=(0.5, 0)),
    "an anchor past all numbers": lambda one: ts.apply(one, [hill()], anchor=(2**40, 0)),
    "what is no operation": _operation(hill),
    "no operation": _operation(lambda: None),
    "a patch beside the terrain": _operation(Patch, GRID.row - 1, 100, ONES),
    "a patch of metres": _operation(Patch, 0, 100, ONES * 0.5),
    "an empty patch": _operation(Patch, 0, 100, ONES[:0]),
    "a patch without a negative": _operation(Patch, 0, 100, ONES * np.int32(-(2**31))),
    "an angle of 90 degrees": _operation(Relaxing, (ts.Rect(0, 9, 90, 99),), 90.0, 3),
    "a NaN angle": _operation(Relaxing, (ts.Rect(0, 9, 90, 99),), NAN, 3),
    "no iterations": _operation(Relaxing, (ts.Rect(0, 9, 90, 99),), 30.0, 0),
    "an empty region": _operation(Relaxing, (ts.Rect(9, 9, 90, 99),), 30.0, 3),
    "an empty key": lambda one: edits_of(one).commit(Stamping((hill(),)), idem=""),
    "a key that is too long": lambda one: edits_of(one).commit(Stamping((hill(),)), idem="k" * 256),
    "a key that is no text": lambda one: any_edits(one).commit(Stamping((hill(),)), idem=5),
    "an undo of what fills": _operation(Undoing, 3, Stamping((hill(mode="fill", z=1.0),))),
    "an undo of what slumps": _operation(Undoing, 3, operations()[5]),
    "an undo of no number": _operation(Undoing, "3", Stamping((hill(),))),
    "an undo of nothing": lambda one: ts.undo(one, 0),
    "an undo of what is not there": lambda one: ts.undo(one, 5),
    "an undo of true": lambda one: ts.undo(one, True),
    "an undo of what filled": lambda one: ts.undo(one, 3),
    "a snapshot without a name": lambda one: edits_of(one).snapshot(""),
    "a snapshot that is there": lambda one: edits_of(one).snapshot("four"),
    "a branch that is there": lambda one: edits_of(one).fork("main"),
    "a name that leads elsewhere": lambda one: edits_of(one).fork("../main"),
    "a reset to nowhere": lambda one: edits_of(one).reset("five"),
    "a reset between checkpoints": lambda one: edits_of(one).reset(2),
}


def any_edits(terrain: ts.Terrain) -> Any:
    return edits_of(terrain)


def test_what_is_refused_changes_nothing(path: Path) -> None:
    """No row, no block, no name, no post; and what comes after is done."""
    with opened(path) as terrain:
        before, ground = held(path), bits(terrain)
        for name, bad in BAD.items():
            with pytest.raises(InputError) as caught:
                bad(terrain)
            assert "\n" not in str(caught.value), name
            assert held(path) == before, name
        assert bits(terrain) == ground
        for one in operations()[4:]:
            edits_of(terrain).commit(one)
    with opened(path) as terrain:
        assert bits(terrain) == model(operations())


@pytest.mark.parametrize(
    "options",
    [{"threads": 0}, {"pool_bytes": 1}, {"device": "none"}, {"late": "never"}],
    ids=lambda one: next(iter(one)),
)
def test_an_option_that_is_refused_leaves_the_store_as_it_was(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    """Also the detail's factor, and it can be opened at once."""
    path = build(tmp_path / "ground.store")
    for factor in (2, 3, 0):
        with pytest.raises(InputError):
            ts.open_terrain(path, detail_factor=factor, **options)
    with open_branch(path) as branch:
        assert branch.detail_factor == 1


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[FaultyVFS]:
    """The disk that terrains are opened on."""
    name = "edits-faulty"
    vfs = FaultyVFS(name)

    def on_it(path: Path, branch: str = "main", *, create: bool = False) -> Any:
        return open_branch(path, branch, create=create, vfs=name)

    # The module's name is its function's, too.
    monkeypatch.setattr(sys.modules["terrasim.open_terrain"], "open_branch", on_it)
    yield vfs
    vfs.unregister()


@pytest.mark.parametrize("lasting", [True, False], ids=["lasting", "once"])
@pytest.mark.parametrize("kind", ["full", "short", "write", "sync", "read-only"])
@pytest.mark.parametrize("at", [1, 3])
def test_a_disk_that_fails_loses_nothing_acknowledged_and_edits_go_on(
    path: Path, disk: FaultyVFS, kind: str, lasting: bool, at: int
) -> None:
    """Refused again and again until it is well; nothing that was refused is done."""
    terrain = opened(path)
    try:
        acknowledged = operations()[:4]
        for one in operations()[4:]:
            before = bits(terrain)
            disk.begin(Fault(kind, at, lasting))
            for _ in range(3):
                failures = disk.failures
                try:
                    edits_of(terrain).commit(one, idem=f"{len(acknowledged)}")
                except RunError:
                    assert disk.failures > failures or lasting
                    assert bits(terrain) == before
            disk.begin(None)
            edits_of(terrain).commit(one, idem=f"{len(acknowledged)}")
            acknowledged.append(one)
            assert bits(terrain) == model_of(len(acknowledged))
    finally:
        disk.begin(None)
        terrain.close()
    with opened(path) as terrain:
        assert bits(terrain) == model_of(len(operations()))
        assert edits_of(terrain).require_branch().last_seq == len(operations())
    assert verify(path)["sound"]


@functools.cache
def model_of(done: int) -> Bits:
    """The ground after so many operations."""
    return model(operations()[:done])


@pytest.mark.parametrize("kind", ["full", "write", "sync"])
def test_a_checkpoint_that_fails_is_made_up_for(path: Path, disk: FaultyVFS, kind: str) -> None:
    """Said when asked for, counted when not; the next one holds all of it."""
    with opened(path) as terrain:
        edits = edits_of(terrain)
        for one in operations()[4:8]:
            edits.commit(one)
        ground = bits(terrain)
        disk.begin(Fault(kind, 1))
        for wanted in (edits.checkpoint, lambda: edits.snapshot("no"), lambda: edits.fork("no")):
            with pytest.raises(RunError):
                wanted()
        assert edits.failed_checkpoints == 3
        assert bits(terrain) == ground
        with pytest.raises(RunError):
            edits.commit(operations()[8])
        assert bits(terrain) == ground == model_of(8)
        disk.begin(None)
        copy = killed(path, path.parent / "copy")
        edits.checkpoint()
        assert edits.require_branch().checkpoint_seq == 8
        for one in operations()[8:]:
            edits.commit(one)
        edits.checkpoint()
        assert edits.require_branch().checkpoint_seq == 10
        assert sorted(edits.require_branch().snapshots()) == ["four"]
        assert sorted(edits.require_branch().branches()) == ["main"]
    for name, done in ((copy, 8), (path, 10)):
        with opened(name) as terrain:
            assert bits(terrain) == model_of(done)
            assert edits_of(terrain).replayed == (4 if done == 8 else 0)


def test_what_changes_while_a_checkpoint_is_written_is_in_the_next(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same blocks again, out of the pool already when the first writing ends."""
    begun, goes_on = threading.Event(), threading.Event()
    with opened(path) as terrain:
        edits = edits_of(terrain)
        branch = edits.require_branch()
        write = branch.checkpoint

        def slowly(blocks: Any, seq: int) -> Any:
            begun.set()
            goes_on.wait()
            return write(blocks, seq)

        monkeypatch.setattr(branch, "checkpoint", slowly)
        monkeypatch.setattr(sys.modules[Edits.__module__], "DIRTY_BYTES", -1)
        edits.commit(operations()[4])
        begun.wait()
        for one in operations()[5:]:
            edits.commit(one)
        terrain.cache.flush()
        goes_on.set()
        edits.checkpoint()
        assert bits(terrain) == model_of(10)
        copy = killed(path, path.parent / "copy")
    for name in (copy, path):
        with opened(name) as terrain:
            assert edits_of(terrain).replayed == 0
            assert bits(terrain) == model_of(10)


def test_closing_on_a_disk_that_fails_says_so_and_loses_nothing(
    path: Path, disk: FaultyVFS
) -> None:
    terrain = opened(path)
    for one in operations()[4:]:
        edits_of(terrain).commit(one, wait=False)
    disk.begin(Fault("write", 1))
    with pytest.raises(RunError):
        terrain.close()
    disk.begin(None)
    with opened(path) as terrain:
        assert bits(terrain) == model_of(10)


@pytest.mark.parametrize("wait", [True, False])
def test_a_block_that_cannot_be_read_stops_all_until_it_is_opened_again(
    path: Path, monkeypatch: pytest.MonkeyPatch, wait: bool
) -> None:
    """Nobody reads ground that lacks what was acknowledged, and no such ground is written."""
    terrain = opened(path, pool_bytes=SMALL, detail_pool_bytes=SMALL)
    edits = edits_of(terrain)
    edits.commit(operations()[4])
    load = terrain.ground.source.block

    def broken(key: ts.Block) -> Any:
        raise RunError(f"block {key} is not to be read")

    monkeypatch.setattr(terrain.ground.source, "block", broken)
    far = Stamping((ts.Gaussian(230.0, 230.0, 1.0, 9.0),))
    if wait:
        with pytest.raises(RunError, match="is not to be read"):
            edits.commit(far)
    else:
        edits.commit(far, wait=False)
        with pytest.raises(RunError, match="is not to be read"):
            ts.sample(terrain, [[20.0, 20.0]])
    monkeypatch.setattr(terrain.ground.source, "block", load)
    readers: list[Callable[[], object]] = [
        lambda: ts.sample(terrain, [[20.0, 20.0]]),
        lambda: ts.raycast(terrain, [[20.0, 20.0, 99.0]], [[0.0, 0.0, -1.0]], max_distance=200.0),
        lambda: edits.commit(operations()[5]),
        lambda: edits.snapshot("no"),
        edits.checkpoint,
    ]
    for read in readers:
        with pytest.raises(RunError, match=r"half-changed .*open the terrain again"):
            read()
    terrain.close()
    with opened(path) as terrain:
        assert edits_of(terrain).replayed == 2
        assert bits(terrain) == model([*operations()[:5], far])
        for one in operations()[5:]:
            edits_of(terrain).commit(one)
        assert edits_of(terrain).require_branch().last_seq == 11
