"""The report: one file that needs nothing else and says what matters in words."""

from __future__ import annotations

import copy
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from terrasim.output.report import _MEANING, report_html
from terrasim.output.report_table import bytes_text, metres_text, number_text
from terrasim.scenario.run import run_scenario
from terrasim.scenario.scenario import parse_scenario

REGION = {"size_x": 30.0, "size_y": 30.0}
VOID = {"meta", "img", "br", "link", "input", "hr"}


class Reader(HTMLParser):
    """Takes a page apart and checks that its elements close in order."""

    def __init__(self) -> None:
        """Begin outside of everything."""
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.text: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Go in."""
        if tag not in VOID:
            self.open.append(tag)
        self.links += [str(value) for name, value in attrs if name in {"src", "href"}]
        assert tag != "script"

    def handle_endtag(self, tag: str) -> None:
        """Go out."""
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Keep what is read by people."""
        if not self.open or self.open[-1] != "style":
            self.text.append(data)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], str]:
    """A small run's record and report."""
    out = tmp_path_factory.mktemp("report") / "out"
    scenario = parse_scenario(
        {
            "name": "small",
            "description": "Balls & <craters>.",
            "terrain": {
                "kind": "fractal", "rows": 129, "cols": 129, "spacing": 0.5, "amplitude": 2.0,
                "wavelength": 32, "octaves": 4,
            },
            "stamps": [{"kind": "crater", "x": 0.0, "y": 0.0, "radius": 5.0, "depth": 1.0}],
            "balls": [{"count": 20, "region": REGION, "radius": 0.3}],
            "samples": [{"count": 5, "region": REGION}],
            "run": {"duration_s": 0.2},
            "output": {"picture": True},
        }
    )  # fmt: skip
    record = run_scenario(scenario, out.parent, out)
    return record, (out / "report.html").read_text(encoding="utf-8")


def read(page: str) -> tuple[str, list[str]]:
    """Text and links of a page that is well formed."""
    reader = Reader()
    reader.feed(page)
    reader.close()
    assert reader.open == []
    return " ".join(" ".join(reader.text).split()), reader.links


def test_a_report_needs_no_other_file_and_no_network(made: tuple[dict[str, Any], str]) -> None:
    _, page = made
    _, links = read(page)
    assert len(links) == 1
    assert links[0].startswith("data:image/png;base64,")
    for outside in ("http://", "https://", "@import", "url("):
        assert outside not in page


def test_it_says_all_that_is_asked_of_it(made: tuple[dict[str, Any], str]) -> None:
    record, page = made
    text, _ = read(page)
    for heading in (
        "How wrong it is", "What it cost", "Balls", "What the ground lost and gained",
        "Heights asked for", "What it needed", "What the cache did", "Settings",
        "Files, versions, hashes",
    ):  # fmt: skip
        assert heading in text
    for error in record["errors"]:
        assert error["name"] in text
        assert error["note"] in text
    for stage in record["timings"]["stages"]:
        assert stage["name"] in text
    for name in record["plan"]["left_out"]:
        assert name in text
    assert "left out" in text
    assert record["hashes"]["heights"] in text
    assert set(record["balls"]) <= set(_MEANING)
    assert "run.duration_s" in text


def test_synthetic_heights_are_said_to_be_so(made: tuple[dict[str, Any], str]) -> None:
    record, page = made
    text, _ = read(page)
    assert "Synthetic heights." in text
    assert text.count(record["synthetic"]) >= 2
    real = copy.deepcopy(record)
    real["synthetic"] = ""
    text, _ = read(report_html(real, []))
    assert "ynthetic" not in text


def test_words_of_the_scenario_are_no_markup(made: tuple[dict[str, Any], str]) -> None:
    _, page = made
    assert "Balls &amp; &lt;craters&gt;." in page
    assert "<craters>" not in page


def test_a_run_without_anything_has_a_report_too(tmp_path: Path) -> None:
    terrain = {"kind": "flat", "rows": 9, "cols": 9, "spacing": 1.0}
    out = tmp_path / "out"
    run_scenario(parse_scenario({"terrain": terrain}), tmp_path, out)
    text, links = read((out / "report.html").read_text(encoding="utf-8"))
    assert links == []
    assert "does not apply" in text


@pytest.mark.parametrize(
    ("metres", "text"),
    [
        (0.0, "0 m"), (2.5e-5, "25 µm"), (0.0042, "4.2 mm"), (1.5, "1.5 m"), (12_345.0, "12.3 km"),
    ],
)  # fmt: skip
def test_lengths_have_the_unit_that_suits_them(metres: float, text: str) -> None:
    assert metres_text(metres) == text


def test_figures_are_short_and_grouped() -> None:
    assert number_text(1_234_567) == "1,234,567"
    assert number_text(0.123456) == "0.1235"
    assert number_text(None) == ""
    assert bytes_text(64 << 20) == '<span title="67,108,864 bytes">64.00 MiB</span>'
    assert ">12 B<" in bytes_text(12)
