"""The report of a run: one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from terrasim.cache.counters import Counters
from terrasim.errors import RunError
from terrasim.output.report_ground import (
    dynamics_html,
    ledger_html,
    relaxation_html,
    store_html,
)
from terrasim.output.report_page import Fact, figure, notice, page
from terrasim.output.report_table import (
    bar_rows,
    bytes_text,
    explained,
    metres_text,
    number_text,
    table,
)
from terrasim.scenario.scenario import flat_settings

REPORT = "report.html"
PICTURES = "*.png"

Record = dict[str, Any]


def write_report(folder: Path, record: Record) -> None:
    """Write ``report.html`` beside the pictures it shows.

    Args:
        folder: The run's folder; PNG files in it are shown.
        record: The run's record.

    Raises:
        RunError: If it cannot be written.
    """
    pictures = [(path.name, path.read_bytes()) for path in sorted(folder.glob(PICTURES))]
    try:
        (folder / REPORT).write_text(report_html(record, pictures), encoding="utf-8")
    except OSError as error:
        raise RunError(f"{REPORT} cannot be written ({error.strerror}); make room") from None


def report_html(record: Record, pictures: Sequence[tuple[str, bytes]]) -> str:
    """The report as text.

    Args:
        record: The run's record.
        pictures: Names and contents of PNG files.
    """
    return page(
        record["name"],
        record["description"],
        facts=_facts(record),
        notices=_synthetic(record) + _not_repeatable(record),
        pictures=[_picture(name, content, record) for name, content in pictures],
        sections=[(name, title, make(record)) for name, title, make in _SECTIONS],
        version=str(record["terrasim"]),
    )


def _facts(record: Record) -> list[Fact]:
    """The figures that come first."""
    grid = record["plan"]["grid"]
    facts = [
        ("simulated", f"{record['simulated_s']:g} s", f"{record['steps']} steps"),
        ("took", f"{record['timings']['wall_s']:.1f} s", f"on {record['device']}"),
        (
            "terrain",
            f"{grid['rows']:,} x {grid['cols']:,}",
            f"posts, {grid['spacing']:.4g} m apart",
        ),
    ]
    if record["balls"]:
        facts.append(("balls", f"{record['balls']['count']:,}", "let go"))
    if record["ledger"]["posts"]:
        facts.append(("deformed", f"{record['ledger']['posts']:,}", "posts"))
    worst = [one for one in record["errors"] if one["metres"] is not None]
    if worst:
        largest = max(worst, key=lambda one: one["metres"])
        facts.append(("largest error", metres_text(largest["metres"]), largest["name"]))
    return facts


def _synthetic(record: Record) -> str:
    if not record["synthetic"]:
        return ""
    return notice(
        "Synthetic heights.",
        f"Part of this ground is invented: {record['synthetic']}. It is not measured and must not "
        "be used as if it were.",
    )


def _not_repeatable(record: Record) -> str:
    if record["repeatable"]:
        return ""
    return notice(
        "Not repeatable.",
        "This run did not wait for ground that came late "
        f"({record['counters']['late']:,} times): another run may differ.",
    )


def _picture(name: str, content: bytes, record: Record) -> str:
    caption = (
        "Light from the north-west. The red frame marks the next picture to the right."
        if record["simulated_s"] or record["ledger"]["posts"]
        else "Light from the north-west."
    )
    if record["synthetic"]:
        caption += f" Heights are partly synthetic: {record['synthetic']}."
    return figure(content, f"{name}: hillshade of the terrain", caption)


def _errors(record: Record) -> str:
    rows = [
        (
            escape(one["name"]),
            "does not apply" if one["metres"] is None else metres_text(one["metres"]),
            "" if one["typical_m"] is None else metres_text(one["typical_m"]),
            f"{one['cost_s']:.2f} s",
            escape(one["note"]),
        )
        for one in record["errors"]
    ]
    lead = "<p>Each way in which this run can be wrong, in metres, and what it cost to know.</p>"
    heads = ("error", "largest", "median", "cost", "how it was found")
    return lead + table(heads, rows, numbers=(1, 2, 3))


def _timing(record: Record) -> str:
    timings = record["timings"]
    stages = [(one["name"], one["wall_s"], one["times"]) for one in timings["stages"]]
    rest = timings["wall_s"] - sum(wall for _, wall, _ in stages)
    stages.append(("everything else", max(rest, 0.0), 1))
    lead = f"<p>Wall time by stage; {timings['wall_s']:.2f} s in all.</p>"
    return lead + bar_rows(stages, timings["wall_s"])


def _plan(record: Record) -> str:
    plan = record["plan"]
    parts = [
        (
            escape(part["name"]),
            "yes" if part["used"] else '<span class="off">left out</span>',
            escape(part["why"]),
            escape(", ".join([*part["modules"], *part["kernels"]]) if part["used"] else ""),
        )
        for part in plan["parts"]
    ]
    buffers = [
        (escape(one["name"]), escape(one["part"]), one["place"], bytes_text(one["bytes"]))
        for one in plan["buffers"]
    ]
    memory = record["memory"]
    counted = memory["counted_device_bytes"]
    said = f"<p>Planned on the device: {bytes_text(memory['planned_device_bytes'])}"
    if counted:
        said += f"; Warp's allocator counted {bytes_text(counted)} at the end of the run"
    left = ", ".join(plan["left_out"]) or "nothing"
    return (
        f"<p>What was left out was not imported, compiled or allocated: {escape(left)}.</p>"
        + table(("part", "used", "why", "imports and kernels"), parts)
        + table(("buffer", "part", "place", "size"), buffers, numbers=(3,))
        + f"{said}.</p>"
    )


def _counters(record: Record) -> str:
    return explained(record["counters"], Counters)


def _balls(record: Record) -> str:
    rows = [
        (
            escape(name.replace("_m_s", " [m/s]").replace("_m", " [m]").replace("_", " ")),
            number_text(value),
            escape(_MEANING.get(name, "")),
        )
        for name, value in record["balls"].items()
    ]
    return table(("counted", "", "meaning"), rows, numbers=(1,)) if rows else ""


_MEANING = {
    "count": "Balls let go.",
    "impacts": "Times a ball struck the ground.",
    "projected": "Times a ball was lifted out of the ground: an edge it did not clear, or ground "
    "that rose under it.",
    "held": "Steps in which a ball met too many events and stood still for the rest.",
    "off": "Steps that took a ball beyond the terrain's edge, where the edge's height goes on.",
    "hole": "Steps that took a ball over a hole, where nothing holds it.",
    "coarse": "Steps in which a coarser level stood in for the finest.",
    "coarse_error_m": "Largest error bound of such a level.",
    "at_rest": "Balls slower than 1 mm/s at the end.",
    "fastest_m_s": "Speed of the fastest ball at the end.",
    "sub_steps": "Steps made because one was over a fifth of the springs' explicit limit.",
    "made_implicit": "Steps taken implicitly because of that limit.",
    "explicit_limit_s": "Step at which the first spring would be unstable, taken explicitly.",
    "asleep": "Balls that sleep at the end.",
    "struck": "Impacts of two balls.",
    "crowded": "Times a ball had more neighbours than it looks at.",
    "fast": "Times a ball moved by more than its radius in a step: it may have passed another.",
}


def _samples(record: Record) -> str:
    rows = [tuple(number_text(one[key]) for key in _SAMPLE_KEYS) for one in record["samples"]]
    heads = [key.replace("_m", " [m]").replace("_", " ") for key in _SAMPLE_KEYS]
    return table(heads, rows, numbers=range(len(heads))) if rows else ""


def _settings(record: Record) -> str:
    rows = [
        (f"<code>{escape(path)}</code>", escape(str(value)))
        for path, value in flat_settings(record["settings"])
    ]
    return "<details><summary>All settings, defaults included</summary>" + (
        table(("setting", "value"), rows) + "</details>"
    )


def _made_with(record: Record) -> str:
    rows = [(escape(name), escape(str(value))) for name, value in record["versions"].items()]
    rows += [(escape(name), escape(str(value))) for name, value in record["machine"].items()]
    rows += [
        (f"hash of {escape(name)}", f"<code>{escape(value)}</code>")
        for name, value in record["hashes"].items()
    ]
    rows.append(("seed", str(record["seed"])))
    listed = ", ".join(f"<code>{escape(name)}</code>" for name in record["files"])
    return (
        f"<p>This folder: {listed}. Two runs with the same hashes came to the same ground and the "
        "same balls, to the bit.</p>" + table(("made with", ""), rows)
    )


_SAMPLE_KEYS = ("count", "level", "lowest_m", "mean_m", "highest_m", "without_ground")
_SECTIONS: Iterable[tuple[str, str, Callable[[Record], str]]] = (
    ("errors", "How wrong it is", _errors),
    ("timing", "What it cost", _timing),
    ("balls", "Balls", _balls),
    ("ledger", "What the ground lost and gained", ledger_html),
    ("dynamics", "What changed over time", dynamics_html),
    ("relaxation", "How it slumped", relaxation_html),
    ("store", "What keeps it", store_html),
    ("samples", "Heights asked for", _samples),
    ("plan", "What it needed", _plan),
    ("counters", "What the cache did", _counters),
    ("settings", "Settings", _settings),
    ("made-with", "Files, versions, hashes", _made_with),
)
