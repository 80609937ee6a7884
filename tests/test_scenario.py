"""Scenario files: what may stand in them, and what a wrong one is told."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrasim.deform.stamps import REGISTRY
from terrasim.errors import InputError
from terrasim.scenario.scenario import (
    flat_settings,
    load_scenario,
    parse_scenario,
    scenario_schema,
    scenario_settings,
)
from terrasim.scenario.schedule import schedule, timed_stamps
from terrasim.scenario.terrain import FORMULAS

SCENARIOS = sorted((Path(__file__).resolve().parents[1] / "scenarios").glob("*.toml"))
REGION = {"size_x": 100.0, "size_y": 50.0}
CRATER = {"kind": "crater", "x": 1.0, "y": 2.0, "radius": 3.0, "depth": 1.0}
SCATTER = {"kind": "crater", "count": 30, "region": REGION, "radius": 1.0, "depth": 0.2}
BALLS = {"count": 10, "region": REGION, "radius": [0.2, 0.5]}
FLAT = {"kind": "flat", "rows": 65, "cols": 65, "spacing": 1.0}


def table(**more: Any) -> dict[str, Any]:
    """A scenario of everything, with some of it replaced."""
    whole = {
        "terrain": {**FLAT, "refine": {"factor": 4}},
        "stamps": [CRATER],
        "scatter": [SCATTER],
        "balls": [BALLS],
        "agents": [{"path": [[0.0, 0.0]], "radius": 9.0}],
        "samples": [{"count": 3, "region": REGION}],
        "run": {"duration_s": 2.0},
    }
    return copy.deepcopy(whole | more)


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_every_shipped_scenario_is_valid_and_says_what_it_is_for(path: Path) -> None:
    scenario = load_scenario(path)
    assert scenario.name == path.stem
    assert scenario.description
    assert path.read_text().startswith("# ")


def test_settings_written_out_are_the_same_scenario() -> None:
    scenario = parse_scenario(table())
    written = json.loads(json.dumps(scenario_settings(scenario)))
    again = parse_scenario(without_none(written))
    assert again == scenario


def without_none(value: Any) -> Any:
    """As TOML has it."""
    if isinstance(value, dict):
        return {key: without_none(one) for key, one in value.items() if one is not None}
    return [without_none(one) for one in value] if isinstance(value, list) else value


def changed(path: str, value: Any) -> dict[str, Any]:
    """A scenario with one thing changed; a step of a path is a key or an index."""
    whole: Any = table()
    place = whole
    *above, last = path.split("/")
    for part in above:
        place = place[int(part)] if part.isdigit() else place.setdefault(part, {})
    place[last] = value
    return dict(whole)


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        ("planet", 1, "planet is unknown: a scenario takes agents, anchor, balls,"),
        ("terrain/colour", 1, "terrain.colour is unknown: terrain takes col, cols, datum, height,"),
        ("terrain/refine/fine", 1, "terrain.refine.fine is unknown: terrain.refine takes factor,"),
        ("stamps/0/size", 1, "stamps[1].size is unknown: stamps[1] takes balanced, depth,"),
        ("terrain/kind", "moon", "terrain.kind must be one of cone, dem, flat, fractal, plane,"),
        ("stamps/0/kind", "hat", "stamps[1].kind must be one of "),
        ("stamps/0/radius", -1.0, "stamps[1]: crater: radius must"),
        ("stamps/0/radius", float("nan"), "stamps[1].radius must be a finite number, got nan"),
        ("stamps/0/x", float("inf"), "stamps[1].x must be a finite number, got inf"),
        ("stamps/0/time_s", 3.0, "stamps[1].time_s must be within the run of 2 s"),
        ("scatter/0/time_s", [0, 3], "scatter[1].time_s must be within the run of 2 s"),
        ("scatter/0/size", [3, 1], "scatter[1].size: a range runs from low to high, got [3"),
        ("scatter/0/depth", -1.0, "scatter[1]: crater: depth must be at least 0 m, got -1.0"),
        ("balls/0/count", 0, "balls[1].count must be greater than or equal to 1, got 0"),
        ("balls/0/count", 2.5, "balls[1].count must be a valid integer"),
        ("balls/0/radius", 0.0, "balls[1].radius[1] must be greater than 0, got 0.0"),
        ("balls/0/restitution", 1.5, "balls[1].restitution must be less than or equal to 1"),
        ("balls/0/mass", -1.0, "balls[1].mass must be greater than 0, got -1.0"),
        ("balls/0/rolling_friction", -1, "balls[1].rolling_friction must be greater than or equal"),
        ("collision/contact", "round", "collision.contact must be 'plane' or 'vertical', got"),
        ("collision/stiffness", 1.0, "collision: stiffness is of springs: it needs integrator"),
        ("collision/integrator", "spring", "needs a stiffness [N/m]"),
        ("collision", {"integrator": "spring", "stiffness": 1.0}, "balls[1].mass is missing"),
        ("pairs", {"restitution": 2.0}, "pairs.restitution must be less than or equal to 1"),
        ("balls/0/region/size_x", 0, "balls[1].region.size_x must be greater than 0, got 0"),
        ("balls/0/velocity", [1, 2], "balls[1].velocity[3] is missing"),
        ("run/dt_s", 0, "run.dt_s must be greater than 0, got 0"),
        ("run/threads", 0, "run.threads must be greater than or equal to 1, got 0"),
        ("run/gravity_m_s2", "9.81", "run.gravity_m_s2 must be a valid number, got '9.81'"),
        ("run/threads", True, "run.threads must be a valid integer, got True"),
        ("run/paced", 1, "run.paced must be a valid boolean, got 1"),
        ("run/device", 0, "run.device must be a valid string, got 0"),
        ("pool/bytes", -5, "pool.bytes must be greater than or equal to 1, got -5"),
        ("terrain", 3, "terrain must be a table, got 3"),
        ("balls", 3, "balls must be"),
        ("name", "../x", "name must"),
    ],
)
def test_what_breaks_a_rule_is_named_with_the_rule(path: str, value: Any, told: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_scenario(changed(path, value), "s.toml")
    message = str(caught.value)
    assert message.startswith("s.toml: ")
    assert told in message
    assert "\n" not in message


def test_what_is_missing_is_named() -> None:
    whole = table()
    del whole["terrain"]
    with pytest.raises(InputError, match="terrain is missing: add it"):
        parse_scenario(whole)
    whole = table(terrain={"rows": 9})
    with pytest.raises(InputError, match=r"terrain\.kind is missing: it must be one of cone"):
        parse_scenario(whole)


def test_several_errors_stand_in_one_line() -> None:
    bad = {"dt_s": 0, "duration_s": -1, "threads": 0, "device": 3, "seed": -1, "paced": 7}
    whole = table(run=bad, stamps=[], scatter=[])
    with pytest.raises(InputError) as caught:
        parse_scenario(whole)
    assert str(caught.value).count(";") == 4
    assert str(caught.value).endswith("; and 2 more")


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"[terrain\n", "is no TOML"),
        (b"\xff\xfe\x00", "is no text in UTF-8"),
        (b"# " + b"x" * (1 << 20), "is longer than 1048576 bytes"),
        (b"", "terrain is missing"),
    ],
)
def test_a_file_that_is_no_scenario_is_refused(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=told):
        load_scenario(path)


def test_a_missing_file_or_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_scenario(tmp_path / "none.toml")
    with pytest.raises(InputError, match="is a folder"):
        load_scenario(tmp_path)


def test_the_schema_is_json_and_describes_every_setting() -> None:
    schema = scenario_schema()
    text = json.dumps(schema, allow_nan=False)
    for kind in (*REGISTRY, *FORMULAS, "store", "dem", "sample"):
        assert f'"const": "{kind}"' in text
    for name, model in schema["$defs"].items():
        assert model["additionalProperties"] is False, name
        for key, field in model["properties"].items():
            assert field.get("description"), (name, key)


@pytest.mark.parametrize("kind", sorted(FORMULAS))
def test_every_formula_makes_a_source(kind: str, tmp_path: Path) -> None:
    own: dict[str, dict[str, Any]] = {
        "sine": {"amplitude": 1.0, "wavelength": 16.0},
        "cone": {"height": 3.0, "radius": 9.0},
        "fractal": {"amplitude": 3.0, "wavelength": 16, "octaves": 3},
    }
    terrain = {**FLAT, "kind": kind, "row": 1000, "col": -2000, **own.get(kind, {})}
    source = parse_scenario({"terrain": terrain}).terrain.source(tmp_path)
    assert (source.grid.row, source.grid.col) == (1000, -2000)
    assert source.grid.rows == 65
    assert source.synthetic


def test_a_cone_stands_in_the_middle_of_its_terrain(tmp_path: Path) -> None:
    terrain = {**FLAT, "kind": "cone", "row": 1000, "height": 3.0, "radius": 9.0}
    source = parse_scenario({"terrain": terrain}).terrain.source(tmp_path)
    posts = source.posts(0, np.arange(1000, 1065), np.arange(65))
    assert posts.argmax() == 32 * 65 + 32


def test_files_are_found_from_the_scenario_s_folder(tmp_path: Path) -> None:
    heights = np.arange(20.0).reshape(4, 5)
    np.save(tmp_path / "ground.npy", heights)
    terrain = {"kind": "dem", "files": ["ground.npy"], "reading": {"spacing": 2.0}}
    source = parse_scenario({"terrain": terrain}).terrain.source(tmp_path)
    assert (source.grid.rows, source.grid.cols, source.grid.spacing) == (4, 5, 2.0)
    assert not source.synthetic
    # Files run from the north.
    posts = source.posts(0, np.arange(4), np.arange(5))
    np.testing.assert_array_equal(posts, heights[::-1] * 100_000)


def test_how_files_are_read_is_checked_like_the_rest() -> None:
    bad = {"kind": "dem", "files": ["a.tif"], "reading": {"spacin": 3}}
    with pytest.raises(InputError, match=r"terrain\.reading\.spacin is unknown: .*spacing"):
        parse_scenario({"terrain": bad})
    bad["reading"] = {"spacing": -3}
    with pytest.raises(InputError, match=r"terrain\.reading: spacing must be positive"):
        parse_scenario({"terrain": bad})


def test_a_large_file_is_sent_through_a_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("terrasim.scenario.terrain.MOST_POSTS", 10)
    np.save(tmp_path / "ground.npy", np.zeros((4, 5)))
    terrain = {"kind": "dem", "files": ["ground.npy"], "reading": {"spacing": 2.0}}
    with pytest.raises(InputError, match="make a store of it with terrasim import"):
        parse_scenario({"terrain": terrain}).terrain.source(tmp_path)


def test_a_mirrored_source_is_resampled_then_refined_then_reflected(tmp_path: Path) -> None:
    terrain = {
        **FLAT,
        "kind": "sine",
        "amplitude": 2.0,
        "wavelength": 16.0,
        "rows": 60,
        "refine": {"factor": 2},
        "mirror": {"rows": 1_000_001, "cols": 9, "exponent": 5},
    }
    source = parse_scenario({"terrain": terrain}).terrain.source(tmp_path)
    assert (source.grid.rows, source.grid.cols) == (1_000_001, 9)
    words = source.synthetic
    assert words.index("resampled") < words.index("fractal detail") < words.index("mirrored")


def test_scattered_stamps_keep_their_shape_and_stay_in_their_region() -> None:
    sizes = {"size": [3.0, 25.0], "time_s": [0.5, 1.5], "rim_height": 0.04}
    scenario = parse_scenario(table(stamps=[], scatter=[SCATTER | sizes]))
    found = timed_stamps(scenario)
    assert len(found) == 30
    for time_s, stamp in found:
        assert 0.5 <= time_s <= 1.5
        assert abs(stamp.x) <= 50.0
        assert abs(stamp.y) <= 25.0
        radius = stamp.reach / 3.0
        assert 3.0 <= radius <= 25.0
        assert -stamp.bounds.lowest == pytest.approx(0.2 * radius)
        assert stamp.bounds.highest == pytest.approx(0.04 * radius)


def test_a_seed_gives_the_same_stamps_and_another_gives_others() -> None:
    first = timed_stamps(parse_scenario(table()))
    again = timed_stamps(parse_scenario(table()))
    other = timed_stamps(parse_scenario(table(run={"duration_s": 2.0, "seed": 1})))
    assert first == again
    assert first[1:] != other[1:]


def test_a_group_draws_the_same_whatever_else_there_is() -> None:
    alone = timed_stamps(parse_scenario(table(stamps=[], balls=[])))
    among = timed_stamps(parse_scenario(table(scatter=[SCATTER, SCATTER])))
    assert among[1:31] == alone
    assert among[31:] != alone


def test_stamps_come_before_the_first_step_at_or_after_their_time() -> None:
    times = [0.0, 0.01, 0.0101, 0.07, 2.0]
    stamps = [CRATER | {"time_s": time, "x": float(i)} for i, time in enumerate(times)]
    run = {"duration_s": 2.0, "dt_s": 0.01}
    scenario = parse_scenario(table(stamps=stamps, scatter=[], run=run))
    found = {event.step: [stamp.x for stamp in event.stamps] for event in schedule(scenario)}
    # 0.07 is seven steps of 0.01, though 0.07 / 0.01 is more than 7.
    assert found == {0: [0.0], 1: [1.0], 2: [2.0], 7: [3.0], 200: [4.0]}
    halved = {event.step: event.time_s for event in schedule(scenario, 2)}
    assert list(halved) == [0, 2, 4, 14, 400]


def test_settings_are_listed_as_the_file_would_write_them() -> None:
    listed = dict(flat_settings(scenario_settings(parse_scenario(table()))))
    assert listed["terrain.refine.factor"] == 4
    assert listed["stamps[1].radius"] == 3.0
    assert listed["balls[1].radius"] == [0.2, 0.5]
