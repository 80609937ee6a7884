"""Tables, bars and figures of a report, as HTML."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from html import escape
from typing import Any

from terrasim.scenario.descriptions import descriptions

Cells = Sequence[str]


def table(heads: Cells, rows: Iterable[Cells], *, numbers: Collection[int] = ()) -> str:
    """A table; cells are HTML already.

    Args:
        heads: Titles of the columns.
        rows: Cells of each row.
        numbers: Columns that hold numbers.
    """

    def line(cells: Cells, tag: str) -> str:
        made = (
            f"<{tag}{' class=number' if i in numbers else ''}>{cell}</{tag}>"
            for i, cell in enumerate(cells)
        )
        return f"<tr>{''.join(made)}</tr>"

    body = "\n".join(line(row, "td") for row in rows)
    head = line([escape(head) for head in heads], "th")
    return f'<div class="wide"><table><thead>{head}</thead><tbody>\n{body}\n</tbody></table></div>'


def bar_rows(rows: Sequence[tuple[str, float, int]], whole: float) -> str:
    """Times as bars.

    Args:
        rows: Name, seconds and how often.
        whole: Seconds that fill the width.
    """
    cells = []
    for name, seconds, times in rows:
        part = 100.0 * seconds / whole if whole > 0.0 else 0.0
        bar = f'<span class="bar"><span style="width:{part:.2f}%"></span></span>'
        often = f"{times:,} times" if times > 1 else "once"
        cells.append((escape(name), bar, f"{seconds:.3f} s", f"{part:.1f} %", often))
    return table(("stage", "", "wall", "part", "how often"), cells, numbers=(2, 3, 4))


def explained(values: Mapping[str, Any], kind: type) -> str:
    """Numbers of a dataclass with what it says of them."""
    rows = [
        (escape(name.replace("_", " ")), number_text(values[name]), escape(" ".join(text.split())))
        for name, text in descriptions(kind).items()
    ]
    return table(("counted", "", "meaning"), rows, numbers=(1,))


def bytes_text(count: int) -> str:
    """Bytes with a unit, and exactly."""
    size, unit = float(count), "B"
    for larger in ("KiB", "MiB", "GiB", "TiB"):
        if size < 1024.0:
            break
        size, unit = size / 1024.0, larger
    short = f"{size:.0f} B" if unit == "B" else f"{size:.2f} {unit}"
    return f'<span title="{count:,} bytes">{short}</span>'


def metres_text(value: float) -> str:
    """A length in the unit that suits it."""
    if value == 0.0:
        return "0 m"
    for unit, size in (("km", 1e3), ("m", 1.0), ("mm", 1e-3)):
        if abs(value) >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value * 1e6:.3g} µm"


def number_text(value: float | str | None) -> str:
    """A number for a table."""
    if value is None:
        return ""
    if isinstance(value, str):
        return escape(value)
    if isinstance(value, int):
        return f"{value:,}"
    if not math.isfinite(value):
        return str(value)
    return f"{value:,.4g}" if abs(value) < 1e4 else f"{value:,.0f}"
