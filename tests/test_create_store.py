"""A terrain that is a formula is a store at once, whatever its size, and holds what changed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stored import GRID, alter, build, detail, same

from terrasim.errors import InputError, RunError
from terrasim.grid import Block, Grid
from terrasim.sources.analytic import Cone, Flat, Plane, Sine
from terrasim.sources.array_source import ArraySource
from terrasim.sources.fractal import Fractal
from terrasim.sources.mirror import Mirrored
from terrasim.sources.refine import Refined
from terrasim.sources.source import BlockData, Source, describe
from terrasim.store.branch import open_branch
from terrasim.store.codec import StoreCorrupt
from terrasim.store.create import create_store
from terrasim.store.formula import describe_formula, source_of
from terrasim.store.info import info
from terrasim.store.store import open_store
from terrasim.store.verify import verify

SMALL = Grid(257, 257, 2.0, x=1.0 / 3.0, row=-5, col=3, datum=12.0)
LARGE = Grid(1_000_000, 1_000_000, 0.5)
SOURCES: list[Source] = [
    Flat(SMALL, 3.0),
    Plane(SMALL, 3.0, 0.1, -0.2, row=2, col=9),
    Sine(SMALL, 2.0, 300.0),
    Cone(SMALL, 9.0, radius=60.0),
    Fractal(SMALL, 20.0, seed=2**62),
    Refined(Fractal(SMALL, 20.0), 4),
    Mirrored(Refined(Fractal(SMALL, 20.0), 2), 3000, 2000),
]


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: type(source).__name__)
def test_its_heights_are_the_formulas(tmp_path: Path, source: Source) -> None:
    """Blocks and posts of all levels, edges included; its description makes it again."""
    path = tmp_path / "a.store"
    create_store(path, source)
    said = describe_formula(source)
    assert source_of(said) == source
    with open_store(path) as store:
        assert (store.grid, store.synthetic) == (source.grid, source.synthetic)
        assert store.provenance == said
        for level in range(source.grid.levels):
            span = source.grid.blocks(level)
            for key in (
                Block(level, span.row0, span.col0),
                Block(level, span.row1 - 1, span.col1 - 1),
            ):
                assert same(store.block(key), source.block(key))
            at = np.array([-9, 100, 3, 100, 500])
            np.testing.assert_array_equal(store.posts(level, at, at), source.posts(level, at, at))
    assert verify(path)["sound"]
    assert info(path)["lowest_m"] is None


def test_a_million_posts_a_side_hold_what_changed_alone(tmp_path: Path) -> None:
    """Blocks anywhere, detail too, and posts in and beside them; a few kB each."""
    path = tmp_path / "a.store"
    source = Fractal(LARGE, 100.0)
    create_store(path, describe_formula(source))
    empty = path.stat().st_size
    assert empty < 100_000
    keys = [Block(level, 3000 >> level, 1234 >> level) for level in range(LARGE.levels)]
    with open_branch(path) as branch:
        branch.set_detail_factor(16)
        images = {}
        for key in keys:
            posts = source.block(key).posts.copy()
            posts[100:120, 90:200] += 77
            images[key] = describe(posts, source.block(key).error + 77)
        inside = Block(-1, 3000 * 16 + 5, 1234 * 16 + 15)
        branch.checkpoint({**images, inside: detail(1)}, 0)
        assert all(same(branch.block(key), images[key]) for key in keys)
        assert branch.details(Block(0, 3000, 1234)) == [inside]
        rows = np.array([3000 * 256 + 110, 5, 3000 * 256 + 3])
        cols = np.array([1234 * 256 + 95, 999_999])
        wanted = source.posts(0, rows, cols)
        wanted[0, 0] += 77
        np.testing.assert_array_equal(branch.posts(0, rows, cols), wanted)
    assert path.stat().st_size - empty < 4000 * len(keys)
    assert verify(path)["sound"]


@pytest.mark.parametrize(
    "said",
    [
        {},
        {"kind": "cheese"},
        {"kind": "flat"},
        {"kind": "flat", "grid": {"rows": 5}},
        {"kind": "flat", "grid": {"rows": 5, "cols": 5, "spacing": 1.0}, "wet": True},
        {"kind": "flat", "grid": {"rows": 5, "cols": 5, "spacing": -1.0}},
        {"kind": "refined", "source": {"kind": "cheese"}, "factor": 2},
    ],
)
def test_what_describes_no_terrain_is_refused(tmp_path: Path, said: dict[str, Any]) -> None:
    """And nothing is made."""
    with pytest.raises(InputError):
        create_store(tmp_path / "a.store", said)
    assert list(tmp_path.iterdir()) == []


def test_a_terrain_that_is_no_formula_is_refused(tmp_path: Path) -> None:
    """Also inside another; nothing is made."""
    array = ArraySource(np.zeros((257, 257), np.int32), Grid(257, 257, 1.0))
    for source in (array, Refined(array, 2)):
        with pytest.raises(InputError, match="got ArraySource; import anything else"):
            create_store(tmp_path / "a.store", source)
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_replaced_only_on_demand(tmp_path: Path) -> None:
    """And not while it is written; what its writer noted goes with it."""
    path = build(tmp_path / "a.store")
    flat = Flat(GRID)
    with pytest.raises(InputError, match="exists"):
        create_store(path, flat)
    with open_branch(path) as branch:
        branch.append(b"op")
        with pytest.raises(RunError, match="open for writing already"):
            create_store(path, flat, replace=True)
        assert branch.append(b"op") == 2
    create_store(path, flat, replace=True)
    with open_branch(path) as branch:
        assert branch.last_seq == 0
        assert not branch.block(Block(0, 0, 0)).posts.any()


def test_a_formula_that_changed_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another release may compute other heights: they are not the store's."""
    path = tmp_path / "a.store"
    create_store(path, Fractal(SMALL, 20.0))
    right = Fractal.posts
    monkeypatch.setattr(Fractal, "posts", lambda self, *at: right(self, *at) + 1)
    with pytest.raises(RunError, match="other heights in this release"):
        open_store(path)
    assert not verify(path)["sound"]
    monkeypatch.undo()
    assert alter(path, "UPDATE meta SET value = replace(value, '20.0', '20.5')") > 0
    with pytest.raises(RunError, match="meta rows are damaged"):
        open_store(path)


def test_changed_ground_on_another_formula_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the few heights that are looked at when it is opened do not show it."""
    path, key = tmp_path / "a.store", Block(0, 0, 0)
    source = Fractal(SMALL, 20.0)
    create_store(path, source)
    with open_branch(path) as branch:
        posts = source.block(key).posts + np.int32(3)
        branch.checkpoint({key: describe(posts, 0)}, 0)
    right = Fractal.block

    def other(self: Fractal, key: Block) -> BlockData:
        data = right(self, key)
        data.posts[77, 77] += 1
        return data

    monkeypatch.setattr(Fractal, "block", other)
    with (
        open_store(path) as store,
        pytest.raises(StoreCorrupt, match="not the one that was written"),
    ):
        store.block(key)
