"""What ``terrasim study`` prints for people."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from terrasim.study.study_file import shown


def print_study(record: dict[str, Any], console: Console | None = None) -> None:
    """Variants with the medians of their measures, and the orders."""
    console = console or Console()
    _line(console, f"{record['name']}: {record['folder']}")
    knobs, names = list(record["variants"][0]["knobs"]), list(record["measures"])
    table = Table(title="Variants", title_justify="left")
    for head in ("", *knobs):
        table.add_column(Text(head), overflow="fold")
    for name in names:
        unit = record["measures"][name]["unit"]
        table.add_column(Text(f"{name} [{unit}]" if unit else name), justify="right")
    fronts = {i for numbers in record["pareto"].values() for i in numbers}
    for number, one in enumerate(record["variants"], 1):
        values = [one[name] and f"{one[name]['median']:.4g}" for name in names]
        cells = [f"{number}{' *' if number in fronts else ''}"]
        cells += [shown(one["knobs"][knob]) for knob in knobs]
        table.add_row(*(Text(str(cell or "-")) for cell in [*cells, *values]))
    _whole(console, table)
    _line(console, "medians of the repeats; * is on a Pareto front")
    for one in record["orders"]:
        others = f" at {one['others']}" if one["others"] else ""
        _line(console, f"{one['measure']} in {one['knob']}{others}: {one['text']}")
    for number, one in enumerate(record["variants"], 1):
        if one["status"] != "done":
            _line(console, f"variant {number} was {one['status']}: {one['reason']}")
    for name in record["files"]:
        _line(console, f"  {record['folder']}/{name}")


def print_expectations(record: dict[str, Any], console: Console | None = None) -> None:
    """Scenarios with what they were to come to, and whether they did."""
    console = console or Console()
    table = Table(title=f"Scenarios of {record['name']}", title_justify="left")
    for head in ("scenario", "expected", "held", "what happened"):
        table.add_column(head, overflow="fold")
    for one in record["scenarios"]:
        held = Text("yes", "green") if one["held"] else Text("NO", "bold red")
        table.add_row(Text(one["name"]), Text(one["expected"]), held, Text(one["happened"]))
    console.print(table)
    held = sum(one["held"] for one in record["scenarios"])
    _line(console, f"{held} of {len(record['scenarios'])} held")


def _whole(console: Console, table: Table) -> None:
    """Print a table as wide as its figures, so that none is cut off."""
    needed = Measurement.get(console, console.options.update(max_width=400), table).maximum
    console.width = max(console.width, needed)
    console.print(table)


def _line(console: Console, text: str) -> None:
    console.print(text, markup=False, emoji=False, highlight=False, soft_wrap=True)
