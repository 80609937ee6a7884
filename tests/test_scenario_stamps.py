"""Stamps in scenario files: every kind, its fields its schema, images beside the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrasim.deform.apply import apply
from terrasim.deform.stamps import REGISTRY, HeightImage, Stamp, Texture
from terrasim.errors import InputError
from terrasim.scenario.images import ImageFile, read_images
from terrasim.scenario.plan import make_plan
from terrasim.scenario.run import run_scenario
from terrasim.scenario.scenario import Scenario, parse_scenario, scenario_schema
from terrasim.scenario.schedule import image_files, timed_stamps
from terrasim.terrain import Terrain

FLAT = {"kind": "flat", "rows": 65, "cols": 65, "spacing": 1.0, "height": 2.0}
LINE = [[0, 0], [9.0, 3.5]]
WINDOW = {"size_x": 6.0, "size_y": 4, "fade": 1.0}
HILL = np.sin(np.linspace(0.0, np.pi, 5))[:, None] * np.ones((5, 3))
SHAPES: dict[str, dict[str, Any]] = {
    "gaussian": {"amplitude": -1.0, "sigma": 2},
    "crater": {"radius": 3.0, "depth": 1.0, "balanced": True},
    "cone": {"radius": 3.0, "height": 1.0, "detail": False},
    "paraboloid": {"radius": 3.0, "height": 1.0, "mode": "dig", "z": 1},
    "spherical_cap": {"radius": 3.0, "height": 1.0, "mode": "fill", "z": 2.5},
    "half_cosine": {"radius": 3.0, "height": 1.0, "mode": "replace", "z": 2.5},
    "trench": {"points": LINE, "width": 2.0, "depth": 0.5, "section": "box", "side": 0.25},
    "berm": {"points": LINE, "width": 2.0, "height": 0.5, "section": "round", "ends": "flat"},
    "flatten": {**WINDOW, "z": 3.0, "turn_deg": 30.0, "slope_x": 0.1},
    "noise": {**WINDOW, "amplitude": 0.3, "wavelength": 2.0, "seed": 7, "octaves": 3},
    "texture": {"image": {"path": "hill.npy"}, "size_x": 8.0, "size_y": 6.0, "scale": 0.5},
}


def scenario(name: str, **more: Any) -> Scenario:
    stamp = {"kind": name, "x": 4.0, "y": -3, **SHAPES[name], **more}
    return parse_scenario({"terrain": FLAT, "stamps": [stamp]})


def made(scene: Scenario, folder: Path) -> list[Stamp]:
    images = read_images(image_files(scene), folder)
    return [stamp for _, stamp in timed_stamps(scene, images)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    np.save(tmp_path / "hill.npy", HILL)
    return tmp_path


@pytest.mark.parametrize("name", list(REGISTRY))
def test_every_stamp_is_made_from_a_file(name: str, folder: Path) -> None:
    """The same as from Python."""
    given = dict(SHAPES[name])
    if name == "texture":
        given["image"] = HeightImage(HILL)
    expected = REGISTRY[name](x=4.0, y=-3.0, **given)
    assert made(scenario(name), folder) == [expected]


@pytest.mark.parametrize("name", list(REGISTRY))
def test_every_stamp_is_scattered_in_all_sizes(name: str, folder: Path) -> None:
    """Its lengths grow, all else stays."""
    group = {"kind": name, "count": 20, "size": [0.5, 2.0], **SHAPES[name]}
    group["region"] = {"size_x": 30.0, "size_y": 20.0}
    found = made(parse_scenario({"terrain": FLAT, "scatter": [group]}), folder)
    assert len({(one.x, one.y) for one in found}) == 20
    first = found[0]
    for one in found:
        factor = getattr(one, one.lengths[0]) or one.size_x  # type: ignore[attr-defined]
        factor /= getattr(first, first.lengths[0]) or first.size_x  # type: ignore[attr-defined]
        back = replace(one.scaled(1.0 / factor), x=first.x, y=first.y)
        np.testing.assert_allclose(back.extent, first.extent, rtol=1e-9)
        assert (back.mode, back.z, back.kind) == (first.mode, first.z, first.kind)
    assert len({one.extent for one in found}) == 20


def test_shapes_of_all_stamps_stand_in_the_schema() -> None:
    """With what their fields mean and which words they take."""
    models = scenario_schema()["$defs"]
    for kind in REGISTRY.values():
        placed, scattered = models[f"{kind.__name__}Placed"], models[f"{kind.__name__}Scattered"]
        assert set(placed["properties"]["mode"]["enum"]) >= {"add", "blend"}
        assert {"x", "y", "time_s", "detail", "z"} <= set(placed["properties"])
        assert not {"x", "y"} & set(scattered["properties"])
    assert models["TrenchPlaced"]["properties"]["section"]["enum"] == ["v", "box", "round"]
    assert set(models["ImageFile"]["properties"]) == {"path", "channel", "alpha"}


@pytest.mark.parametrize(
    ("name", "field", "value", "said"),
    [
        ("gaussian", "mode", "carve", "stamps[1].mode must be 'add', 'dig', 'fill', 'replace' or"),
        ("gaussian", "z", 3.0, "stamps[1]: gaussian: z must be left out for mode add"),
        ("gaussian", "sigma", -2.0, "stamps[1]: gaussian: sigma must lie between"),
        ("gaussian", "sigma", float("nan"), "stamps[1].sigma must be a finite number, got nan"),
        ("gaussian", "detail", 1, "stamps[1].detail must be a valid boolean, got 1"),
        ("crater", "rim_height", 0.1, "crater: rim_height must be left out of a balanced crater"),
        ("paraboloid", "z", None, "stamps[1]: paraboloid: z must be given for mode dig"),
        ("trench", "points", [[0, 0]], "stamps[1]: trench: points must hold 2 to 1000000 places"),
        ("trench", "points", [[0, 0], [1]], "stamps[1].points[2][2] is missing: add it"),
        ("trench", "points", [[0, 0], [1, "a"]], "stamps[1].points[2][2] must be a valid number"),
        ("trench", "points", 3, "stamps[1].points must be a valid"),
        ("trench", "section", "u", "stamps[1].section must be 'v', 'box' or 'round', got 'u'"),
        ("flatten", "radius", 2.0, "flatten: size_x must be left out beside radius, got 6.0"),
        ("flatten", "mode", "add", "flatten: mode must be blend or dig or fill or replace"),
        ("noise", "octaves", 2.5, "stamps[1].octaves must be a valid integer"),
        ("noise", "octaves", 99, "noise: octaves must lie between 1 and 16, got 99"),
        ("texture", "image", "hill.npy", "stamps[1].image must be a table, got 'hill.npy'"),
        ("texture", "image", {}, "stamps[1].image.path is missing: add it"),
        ("texture", "image", {"path": ""}, "stamps[1].image.path must"),
        ("texture", "image", {"path": "a", "band": 1}, "stamps[1].image.band is unknown: "),
        ("texture", "image", {"path": "a", "channel": 0}, "stamps[1].image.channel must be great"),
        ("texture", "size_x", 0.0, "stamps[1]: texture: size_x must lie between"),
    ],
)
def test_a_bad_field_is_named_with_its_rule(name: str, field: str, value: Any, said: str) -> None:
    with pytest.raises(InputError) as error:
        scenario(name, **{field: value})
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_an_image_is_read_once_and_from_the_scenarios_folder(folder: Path) -> None:
    stamps = [{"kind": "texture", "x": i, "y": 0, **SHAPES["texture"]} for i in range(3)]
    scene = parse_scenario({"terrain": FLAT, "stamps": stamps})
    found = made(scene, folder)
    assert all(isinstance(one, Texture) for one in found)
    assert len({id(one.image) for one in found if isinstance(one, Texture)}) == 1
    assert image_files(scene) == [ImageFile(path="hill.npy")] * 3


def test_an_image_that_cannot_be_read_is_refused_before_a_run_begins(tmp_path: Path) -> None:
    """Nothing is left of it."""
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"texture: image .*hill\.npy: no such file"):
        run_scenario(scenario("texture"), tmp_path, out)
    np.save(tmp_path / "hill.npy", np.full((5, 3), 1e6))
    with pytest.raises(InputError, match="texture: scale must keep the image's heights within"):
        run_scenario(scenario("texture"), tmp_path, out)
    assert not out.exists()


def test_only_an_image_to_decode_brings_the_image_library(tmp_path: Path) -> None:
    def modules(name: str, **more: Any) -> tuple[str, ...]:
        scene = scenario(name, **more)
        return make_plan(scene, scene.terrain.source(tmp_path)).modules

    assert "OpenImageIO" not in modules("crater")
    assert "OpenImageIO" not in modules("texture")
    assert "OpenImageIO" in modules("texture", image={"path": "a.PNG"})


def test_a_run_makes_them_all(folder: Path) -> None:
    """One after another; its ledger is what a terrain's is that gets the same stamps."""
    stamps = [
        {"kind": name, "x": 6.0 * i - 30, "y": 0.0, **shape}
        for i, (name, shape) in enumerate(SHAPES.items())
    ]
    scene = parse_scenario({"terrain": FLAT, "stamps": stamps, "output": {"picture": True}})
    record = run_scenario(scene, folder, folder / "out")
    assert (folder / "out" / "picture.png").exists()
    with Terrain(scene.terrain.source(folder)) as terrain:
        ledger = apply(terrain, made(scene, folder), anchor=(32, 32))
    assert record["ledger"]["added"] == ledger.added > 0
    assert record["ledger"]["removed"] == ledger.removed > 0
