"""Scenarios whose ground slumps, has detail and is kept in a store."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from terrasim.errors import InputError
from terrasim.scenario.run import run_scenario
from terrasim.scenario.scenario import parse_scenario
from terrasim.store.history import history
from terrasim.store.store import open_store
from terrasim.store.verify import verify

FLAT = {"kind": "flat", "rows": 300, "cols": 300, "spacing": 0.1}
CONE = {"kind": "cone", "x": 1.0, "y": -2.0, "radius": 1.0, "height": 1.5, "time_s": 0.1}


def ran(out: Path, **tables: Any) -> dict[str, Any]:
    scene = {"terrain": FLAT, "run": {"duration_s": 0.5, "dt_s": 0.05}} | tables
    return run_scenario(parse_scenario(scene), out.parent, out)


def test_a_heap_that_is_too_steep_comes_to_rest_and_nothing_is_lost(tmp_path: Path) -> None:
    """A cone of 56 degrees slumps to 35; what fell rose elsewhere, to the count."""
    record = ran(
        tmp_path / "out",
        stamps=[CONE],
        relaxation={"angle_deg": 35.0, "iterations": 400},
        samples=[{"count": 2000, "region": {"x": 1.0, "y": -2.0, "size_x": 4.0, "size_y": 4.0}}],
    )
    said = record["relaxation"]
    assert said["moved_counts"] == said["removed_counts"] > 0
    assert said["net_counts"] == 0
    assert record["ledger"]["net"] == record["ledger"]["heights"] > 0
    assert record["samples"][0]["highest_m"] < 1.3


def test_ground_that_is_not_too_steep_stays_as_it_is(tmp_path: Path) -> None:
    """With an angle above the cone's, slumping changes no post: the hashes are the same."""
    with_it = ran(tmp_path / "a", stamps=[CONE], relaxation={"angle_deg": 60.0})
    without = ran(tmp_path / "b", stamps=[CONE])
    assert with_it["hashes"] == without["hashes"]
    assert with_it["relaxation"]["moved_counts"] == 0


def test_what_grows_wakes_the_ground_it_steepens(tmp_path: Path) -> None:
    """A heap that grows too steep slumps as it does."""
    growth = {
        "kind": "growth",
        "stamp": {"kind": "cone", "x": 0.0, "y": 0.0, "radius": 1.0, "height": 1.5},
        "duration_s": 0.4,
        "profile": {"kind": "linear"},
        "end": "freeze",
    }
    record = ran(
        tmp_path / "out", dynamics=[growth], relaxation={"angle_deg": 35.0, "iterations": 50}
    )
    assert record["relaxation"]["moved_counts"] > 0
    assert record["ledger"]["net"] == record["ledger"]["heights"]


def test_a_store_closed_and_opened_again_changes_nothing(tmp_path: Path) -> None:
    """The same scene with and without a store, reopened twice: the same ground to the bit."""
    fine = CONE | {"time_s": 0.3, "detail": True, "height": 0.2}
    scene = {"stamps": [CONE, fine], "detail": {"factor": 4}, "relaxation": {"angle_deg": 35.0}}
    kept = ran(
        tmp_path / "kept", store={"reopen_s": [0.2, 0.4], "snapshots_s": [0.0, 0.25]}, **scene
    )
    assert kept["hashes"] == ran(tmp_path / "plain", **scene)["hashes"]
    assert [one["same_heights"] for one in kept["store"]["reopened"]] == [True, True]
    assert kept["store"]["snapshots"] == 2
    store = tmp_path / "kept" / "ground.store"
    assert verify(store)["sound"]
    assert len(history(store, limit=100)) == kept["store"]["operations"]
    with open_store(store, snapshot="snapshot-1") as first, open_store(store) as last:
        assert not list(first.changed())
        assert list(last.changed())
    assert "the same to the bit" in (tmp_path / "kept" / "report.html").read_text()


@pytest.mark.parametrize(
    ("tables", "told"),
    [
        ({"relaxation": {"angle_deg": 90.0}}, r"angle_deg"),
        ({"relaxation": {"angle_deg": float("nan")}}, r"angle_deg"),
        ({"relaxation": {"angle_deg": 30.0, "iterations": 0}}, r"iterations"),
        ({"relaxation": {"angle_deg": 30.0, "detail": True}}, r"add a table \[detail\]"),
        ({"stamps": [CONE | {"detail": True}]}, r"stamps\[1\]\.detail is true"),
        ({"detail": {"factor": 1}}, r"detail\.factor"),
        ({"detail": {"factor": 2.5}}, r"detail\.factor"),
        ({"store": {"reopen_s": [9.0]}}, r"within the run of 0\.5 s"),
        ({"store": {"path": "elsewhere"}}, r"path"),
    ],
)
def test_what_cannot_be_is_refused_by_name(
    tables: dict[str, Any], told: str, tmp_path: Path
) -> None:
    """A wrong angle, factor or time names its table and its rule, and nothing is made."""
    with pytest.raises(InputError, match=told):
        ran(tmp_path / "out", **tables)
    assert not list(tmp_path.iterdir())
