"""The page of a study: what it cost to be how exact, in pictures, words and tables."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from terrasim.output.report_page import Fact, figure, notice, page
from terrasim.output.report_table import metres_text, number_text, table
from terrasim.scenario.scenario import flat_settings
from terrasim.study.folder import write_text
from terrasim.study.orders import FLAT
from terrasim.study.plots import draw
from terrasim.study.runs import DONE
from terrasim.study.settings import Study
from terrasim.study.study_file import shown
from terrasim.study.verdicts import COST, drawn, median

REPORT = "report.html"
MOST_DRAWN = 4
"""Measures that get a picture; the page must stay one that is read."""

Record = dict[str, Any]


def write_study_report(folder: Path, record: Record) -> None:
    """Write ``report.html``.

    Raises:
        RunError: If it cannot be written.
    """
    write_text(folder / REPORT, study_html(record))


def study_html(record: Record) -> str:
    """The page as text."""
    study = Study.model_validate(record["study"])
    # What is the same everywhere is said in words.
    shown_measures = [name for name in drawn(study) if len(_values(record, name)) > 1]
    shown_measures = shown_measures[:MOST_DRAWN]
    pictures = [
        figure(draw(study, record, name), f"{name} against run time", _caption(record, name))
        for name in shown_measures
    ]
    return page(
        f"Study of {record['name']}",
        record["description"],
        facts=_facts(record, shown_measures),
        notices=_notices(record),
        pictures=pictures,
        sections=(
            ("says", "What it says", _words(record, shown_measures)),
            ("variants", "Variants", _variants(record)),
            ("apart", "Start and compilation, kept apart", _apart(record)),
            ("varied", "What was varied and measured", _varied(record, study)),
            ("machine", "Made with", _machine(record)),
        ),
        version=record["terrasim"],
    )


def _facts(record: Record, measures: list[str]) -> list[Fact]:
    variants = record["variants"]
    done = [one for one in variants if one["status"] == DONE]
    repeats = variants[0]["repeats"]
    facts = [
        (
            "variants",
            str(len(variants)),
            f"run {repeats} times each" if repeats > 1 else "run once",
        ),
        ("took", f"{record['wall_s']:.0f} s", f"{record['kept']} runs kept from before"),
    ]
    if len(done) < len(variants):
        facts.append(("not done", str(len(variants) - len(done)), "refused, stopped or failed"))
    orders = [one for one in record["orders"] if one["order"] >= FLAT]
    if orders:
        first = orders[0]
        facts.append(("order", f"{first['order']:.2f}", f"{first['measure']} in {first['knob']}"))
    for name in measures[:2]:
        best = min(one[name]["median"] for one in done if one[name] is not None)
        facts.append((f"least {name.replace('_', ' ')}", _value(record, name, best), "of all"))
    return facts


def _notices(record: Record) -> str:
    found = [
        notice(
            f"Variant {number} was {one['status']}.",
            f"{one['label']}: {one['reason']}",
        )
        for number, one in enumerate(record["variants"], 1)
        if one["status"] != DONE
    ]
    found += [
        notice(f"Variant {number} does not repeat.", "Its repeats came to different ends.")
        for number, one in enumerate(record["variants"], 1)
        if one["status"] == DONE and not one["repeatable"]
    ]
    return "\n".join(found)


def _caption(record: Record, name: str) -> str:
    told = f"{name.replace('_', ' ')}: {record['measures'][name]['meaning']}"
    if name.startswith("error"):
        told += f". The reference is {record['reference']}"
    return (
        f"{told}. Numbers are those of the variants in the table; lines across a point run from "
        "the fastest to the slowest repeat. Nothing is both cheaper and more exact than a point "
        "on the Pareto front (red)."
    )


def _words(record: Record, measures: list[str]) -> str:
    """Sentences that a person can act on."""
    said = []
    for name in measures:
        front = [record["variants"][i - 1] for i in record["pareto"][name]]
        if front:
            cheap, exact = front[0], front[-1]
            said.append(
                f"<strong>{escape(name)}</strong>: cheapest is {_told(record, cheap, name)}"
                + (
                    f"; most exact is {_told(record, exact, name)}."
                    if exact is not cheap
                    else ", and nothing is more exact."
                )
            )
    rows = [
        (
            escape(one["measure"]),
            f"<code>{escape(one['knob'])}</code>",
            escape(one["others"]) or "all",
            escape(one["text"]),
        )
        for one in record["orders"]
    ]
    for name in record["pareto"]:
        values = _values(record, name)
        if len(values) == 1:
            told = _value(record, name, values.pop())
            said.append(f"<strong>{escape(name)}</strong>: {told} in every variant.")
    text = "".join(f"<p>{one}</p>" for one in said)
    if rows:
        text += table(("measure", "step", "others at", "fitted"), rows)
    return text


def _values(record: Record, name: str) -> set[float]:
    """What a measure comes to over all variants; the same up to rounding counts once."""
    values = [median(one, name) for one in record["variants"]]
    return {float(f"{value:.6g}") for value in values if value is not None}


def _told(record: Record, one: Record, name: str) -> str:
    return (
        f"<code>{escape(one['label'])}</code> with {_value(record, name, one[name]['median'])} in "
        f"{one[COST]['median']:.3g} s"
    )


def _value(record: Record, name: str, value: float) -> str:
    unit = record["measures"][name]["unit"]
    if unit == "m":
        return metres_text(value)
    return f"{value:.3g} {unit}".strip()


def _variants(record: Record) -> str:
    knobs = list(record["variants"][0]["knobs"])
    names = list(record["measures"])
    fronts = {i for numbers in record["pareto"].values() for i in numbers}
    rows = [
        (
            f"{number}{' *' if number in fronts else ''}",
            *(escape(shown(one["knobs"][knob])) for knob in knobs),
            *(_cell(one, name) for name in names),
        )
        for number, one in enumerate(record["variants"], 1)
    ]
    heads = ["", *knobs]
    heads += [_head(record, name) for name in names]
    lead = "<p>Medians of the repeats. A star marks a variant on a Pareto front.</p>"
    return lead + table(heads, rows, numbers=range(len(heads)))


def _head(record: Record, name: str) -> str:
    unit = record["measures"][name]["unit"]
    return name.replace("_", " ") + (f" [{unit}]" if unit else "")


def _cell(one: Record, name: str) -> str:
    if one["status"] != DONE:
        return f'<span class="off">{escape(one["status"])}</span>'
    if one[name] is None:
        return '<span class="off">none</span>'
    value = one[name]["median"]
    whole = float(value).is_integer() and abs(value) < 1e15
    return number_text(int(value)) if whole else f"{value:.4g}"


def _apart(record: Record) -> str:
    rows = []
    for number, one in enumerate(record["variants"], 1):
        if one["status"] != DONE:
            continue
        first, modules, start = (
            one["first_step_s"], one["modules_compiled"], one["start_up_s"],
        )  # fmt: skip
        rows.append(
            (
                str(number),
                escape(one["label"]),
                f"{start['median']:.2f} s",
                f"{first['lowest']:.2f} s",
                f"{first['highest']:.2f} s",
                str(int(modules["highest"])),
            )
        )
    lead = (
        "<p>Each repeat ran in a process of its own: once to be looked at, then once more to be "
        "timed. What it took to start, and to the end of the first step of the first pass, where "
        "kernels are compiled or loaded and caches are cold, is in no other figure of this page."
        "</p>"
    )
    heads = ("", "variant", "start", "first step, least", "most", "modules compiled")
    return lead + table(heads, rows, numbers=(2, 3, 4, 5)) if rows else ""


def _varied(record: Record, study: Study) -> str:
    knobs = [
        (f"<code>{escape(name)}</code>", escape(", ".join(shown(one) for one in values)))
        for name, values in study.vary.items()
    ]
    measures = [
        (escape(name.replace("_", " ")), escape(one["unit"]), escape(one["meaning"]))
        for name, one in record["measures"].items()
    ]
    how = "every value with every other" if study.combine == "product" else "value by value"
    reference = f"<p>Errors are taken against {escape(record['reference'])}.</p>"
    settings = [
        (f"<code>{escape(path)}</code>", escape(str(value)))
        for path, value in flat_settings(record["settings"])
    ]
    return (
        f"<p>Combined {how}.</p>"
        + table(("knob", "values"), knobs)
        + (reference if record["reference"] else "")
        + table(("measure", "unit", "what it is"), measures)
        + "<details><summary>The scenario's own settings, defaults included</summary>"
        + table(("setting", "value"), settings)
        + "</details>"
    )


def _machine(record: Record) -> str:
    rows = [(escape(name), escape(str(value))) for name, value in record["machine"].items()]
    rows.append(("terrasim", f"<code>{escape(record['code'])}</code>"))
    listed = ", ".join(f"<code>{escape(name)}</code>" for name in record["files"])
    return f"<p>This folder: {listed}.</p>" + table(("made with", ""), rows)
