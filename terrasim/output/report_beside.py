"""Balls here and in MuJoCo, as rows and as tables of a report."""

from __future__ import annotations

from html import escape

from terrasim.engines.comparison import Comparison, Spread
from terrasim.output.report_table import Cells, metres_text, table


def difference_rows(comparison: Comparison) -> list[tuple[str, str, str, str, str]]:
    """What differs, its median, nine in ten, its largest, and over how many balls."""
    rows = []
    for name, values, unit in (
        ("time of first contact", comparison.late_s * 1e3, "ms"),
        ("place of first contact", comparison.touch_m, "m"),
        ("place at rest, across", comparison.rest_m, "m"),
        ("height at rest", comparison.rest_high_m, "m"),
    ):
        spread = Spread.of(values)
        sizes = (spread.median, spread.most, spread.largest)
        told = [f"{size:.3g} ms" if unit == "ms" else metres_text(size) for size in sizes]
        rows.append((name, *(told if spread.count else [""] * 3), f"{spread.count:,}"))
    return [(row[0], row[1], row[2], row[3], row[4]) for row in rows]


def engine_rows(comparison: Comparison) -> list[tuple[str, str, str]]:
    """What each engine's balls did and cost: its name, here, in MuJoCo."""
    ours, theirs = comparison.ours, comparison.theirs
    outside = {"buried", "dropped through"}
    rows = [
        (name + (": outside its valid range" if name in outside else ""), f"{here:,}", f"{there:,}")
        for name, (here, there) in comparison.counts().items()
    ]
    clock = "CPU time" if ours.cpu else "time"
    return [
        *rows,
        (f"{clock} of a ball and step", f"{ours.step_us:.3g} µs", f"{theirs.step_us:.3g} µs"),
        ("that, over ours", "1", f"{comparison.cost_ratio:.3g}"),
        (f"{clock} before the first step", f"{ours.setup_s:.3g} s", f"{theirs.setup_s:.3g} s"),
    ]


def beside(comparison: Comparison) -> str:
    """Both tables, under a line that says what was dropped on what; HTML."""
    drop = comparison.drop
    turns = "not turning" if drop.rolling is None else f"rolling friction {drop.rolling:g}"
    said = (
        f"{drop.count:,} balls let go at rest on {drop.rows:,} x {drop.cols:,} posts of "
        f"{drop.spacing:g} m over {drop.range:.3g} m of height, {drop.duration:g} s in steps of "
        f"{drop.dt * 1e3:g} ms; restitution {drop.restitution:g}, friction {drop.friction:g}, "
        f"{turns}. MuJoCo {comparison.version}."
    )
    heads: Cells = ("difference", "median", "9 of 10 within", "largest", "balls")
    apart = table(
        heads, [_escaped(row) for row in difference_rows(comparison)], numbers=(1, 2, 3, 4)
    )
    each = table(
        ("", "here", "MuJoCo"), [_escaped(row) for row in engine_rows(comparison)], numbers=(1, 2)
    )
    return f"<p>{escape(said)}</p>\n{apart}\n{each}"


def _escaped(row: Cells) -> list[str]:
    return [escape(cell) for cell in row]
