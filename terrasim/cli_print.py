"""What commands print for people."""

from __future__ import annotations

import json
import sys
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text


def show_result(result: dict[str, Any], as_json: bool, show: Any) -> None:
    """Print a result: as one JSON object, or by a function for people."""
    if as_json:
        # One write, so that a reader never sees half of it.
        text = json.dumps(result, indent=2, allow_nan=False, default=str)
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    else:
        show(result)


def print_tree(values: dict[str, Any], console: Console | None = None) -> None:
    """Nested values, one a line."""
    console = console or Console()
    for path, value in _leaves(values, ""):
        line = f"{path}: {value}"
        console.print(line, markup=False, emoji=False, highlight=False, soft_wrap=True)


def print_rows(name: str, rows: list[dict[str, Any]], console: Console | None = None) -> None:
    """Rows that say the same things, as a table; what none of them says is left out."""
    console = console or Console()
    heads = (
        [key for key in rows[0] if any(row[key] not in {None, ""} for row in rows)] if rows else []
    )
    if not heads:
        console.print(f"no {name}", markup=False)
        return
    table = Table(title=name, title_justify="left")
    for head in heads:
        # Names are to be typed again: they are folded, never cut off.
        table.add_column(head, overflow="fold")
    for row in rows:
        # As text, or rich makes an emoji of the x in job:x:1.
        table.add_row(*(Text("" if row[key] is None else str(row[key])) for key in heads))
    console.print(table)


def print_plan(plan: dict[str, Any], console: Console | None = None) -> None:
    """A plan as tables."""
    console = console or Console()
    grid = plan["grid"]
    console.print(
        f"{plan['scenario']} on {plan['device']}: {grid['rows']} x {grid['cols']} posts, "
        f"{grid['spacing']:g} m apart; {plan['steps']} steps",
        markup=False,
    )
    if plan["synthetic"]:
        console.print(f"synthetic: {plan['synthetic']}", markup=False)
    parts = Table("part", "used", "why", "imports", "kernels", title="Parts", title_justify="left")
    for part in plan["parts"]:
        parts.add_row(
            part["name"],
            "yes" if part["used"] else "left out",
            part["why"],
            ", ".join(part["modules"]) if part["used"] else "",
            ", ".join(_short(name) for name in part["kernels"]) if part["used"] else "",
        )
    console.print(parts, markup=False)
    buffers = Table("buffer", "part", "place", title="Buffers", title_justify="left")
    buffers.add_column("bytes", justify="right")
    for buffer in plan["buffers"]:
        buffers.add_row(buffer["name"], buffer["part"], buffer["place"], f"{buffer['bytes']:,}")
    buffers.add_section()
    buffers.add_row("all on the device", "", "", f"{plan['device_bytes']:,}")
    buffers.add_row("all on the host", "", "", f"{plan['host_bytes']:,}")
    console.print(buffers)


def print_run(record: dict[str, Any], console: Console | None = None) -> None:
    """A run in a few lines."""
    console = console or Console()
    console.print(f"{record['name']}: {record['folder']}", markup=False, soft_wrap=True)
    stages = Table("stage", title="Timing", title_justify="left")
    stages.add_column("wall \\[s]", justify="right")
    for stage in record["timings"]["stages"]:
        stages.add_row(stage["name"], f"{stage['wall_s']:.3f}")
    stages.add_section()
    stages.add_row("all", f"{record['timings']['wall_s']:.3f}")
    console.print(stages)
    errors = Table("error", title="How wrong it is", title_justify="left")
    errors.add_column("largest \\[m]", justify="right")
    errors.add_column("median \\[m]", justify="right")
    errors.add_column("cost \\[s]", justify="right")
    for error in record["errors"]:
        values = [error["metres"], error["typical_m"]]
        shown = ["-" if value is None else f"{value:.3g}" for value in values]
        errors.add_row(error["name"], *shown, f"{error['cost_s']:.3f}")
    console.print(errors)
    for name in record["files"]:
        console.print(f"  {record['folder']}/{name}", markup=False, soft_wrap=True)


def _leaves(values: Any, path: str) -> list[tuple[str, Any]]:
    if isinstance(values, dict):
        items = values.items()
    elif isinstance(values, list) and any(isinstance(one, dict) for one in values):
        items = {f"[{i}]": one for i, one in enumerate(values)}.items()
    else:
        return [(path, values)]
    found = []
    for key, value in items:
        name = f"{path}{key}" if str(key).startswith("[") or not path else f"{path}.{key}"
        found += _leaves(value, name)
    return found


def _short(module: str) -> str:
    return module.removeprefix("terrasim.")
