"""Error against run time and against the step, as pictures."""

from __future__ import annotations

import io
import math
from typing import Any

from terrasim.study.measures import MEASURES
from terrasim.study.orders import step_name, step_of
from terrasim.study.settings import Study
from terrasim.study.verdicts import COST, median, series, step_knobs

INK, SOFT, LINE, FRONT = "#26241f", "#6d685d", "#e2ddd0", "#b3261e"
COLOURS = ("#9a5b2b", "#2f6f8f", "#5d7a2e", "#7a4a8c", "#b08900", "#4a4a4a", "#c2557a", "#2b8a78")
MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")
MOST_NAMED = 16
"""Points that are named beside them."""


def draw(study: Study, record: dict[str, Any], measure: str) -> bytes:
    """A picture of one measure against run time, and against the step where one is varied.

    Args:
        study: The study.
        record: Its record.
        measure: What is drawn upward.

    Returns:
        A PNG file.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    knobs = step_knobs(study)
    figure = Figure(figsize=(11.0, 4.8), layout="constrained", facecolor="white")
    axes = figure.subplots(1, 2 if knobs else 1, squeeze=False)[0]
    variants = record["variants"]
    values = [median(one, measure) for one in variants]
    floor = _floor(values)
    knob = knobs[0] if knobs else ""
    groups = series(study, variants, knob)
    if not knobs and len(groups) == len(variants):
        # Nothing to join: each variant stands for itself.
        groups = {"": list(range(len(variants)))}
    _against_cost(axes[0], record, measure, groups, floor)
    if knobs:
        _against_step(axes[1], record, measure, knob, groups, floor)
    for one in axes:
        _dress(one, measure, floor if any(value == 0.0 for value in values) else 0.0)
    made = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(made, format="png", metadata={"Software": None})
    return made.getvalue()


def _floor(values: list[float | None]) -> float:
    """Where an error of nothing is drawn: a decade below the smallest."""
    known = [one for one in values if one]
    return 10.0 ** (math.floor(math.log10(min(known))) - 1) if known else 1e-16


def _against_cost(
    axes: Any, record: dict[str, Any], measure: str, groups: dict[str, list[int]], floor: float
) -> None:
    variants = record["variants"]
    front = [i - 1 for i in record["pareto"][measure]]
    for index, (rest, numbers) in enumerate(groups.items()):
        known = [i for i in numbers if median(variants[i], measure) is not None]
        if not known:
            continue
        x = [variants[i][COST]["median"] for i in known]
        y = [max(median(variants[i], measure) or 0.0, floor) for i in known]
        spread = [
            [at - variants[i][COST]["lowest"] for i, at in zip(known, x, strict=True)],
            [variants[i][COST]["highest"] - at for i, at in zip(known, x, strict=True)],
        ]
        style = _style(index)
        joined = "-" if len(groups) < len(variants) and len(numbers) > 1 else "none"
        axes.errorbar(
            x, y, xerr=spread, linestyle=joined, elinewidth=0.8, label=rest or None, **style
        )
    if front:
        x = [variants[i][COST]["median"] for i in front]
        y = [max(median(variants[i], measure) or 0.0, floor) for i in front]
        axes.plot(x, y, drawstyle="steps-post", color=FRONT, linewidth=1.0, linestyle=(0, (4, 2)))
        axes.plot(
            x, y, "o", markersize=12, markerfacecolor="none", markeredgecolor=FRONT,
            label="Pareto front",
        )  # fmt: skip
    if len(variants) <= MOST_NAMED:
        for number, one in enumerate(variants, 1):
            value = median(one, measure)
            if value is not None:
                place = (one[COST]["median"], max(value, floor))
                axes.annotate(
                    str(number), place, xytext=(7, 6), textcoords="offset points", fontsize=8,
                    color=SOFT,
                )  # fmt: skip
    axes.set_xlabel("run time [s]")
    axes.set_title("against run time", color=INK, fontsize=11)
    _legend(axes)


def _against_step(
    axes: Any,
    record: dict[str, Any],
    measure: str,
    knob: str,
    groups: dict[str, list[int]],
    floor: float,
) -> None:
    variants = record["variants"]
    fits = {
        one["others"]: one
        for one in record["orders"]
        if one["measure"] == measure and one["knob"] == knob
    }
    for index, (rest, numbers) in enumerate(groups.items()):
        points = [
            (step, max(value, floor))
            for i in numbers
            if (step := step_of(knob, variants[i]["knobs"][knob])) is not None
            and (value := median(variants[i], measure)) is not None
        ]
        if not points:
            continue
        x, y = zip(*sorted(points), strict=True)
        style, fit = _style(index), fits.get(rest)
        told = ": ".join(filter(None, [rest, fit["text"] if fit else ""]))
        axes.plot(x, y, linestyle="none", label=told, **style)
        if fit:
            ends = [min(x), max(x)]
            line = [fit["size"] * end ** fit["order"] for end in ends]
            axes.plot(ends, line, color=style["color"], linewidth=1.0, linestyle="--")
    axes.set_xlabel(step_name(knob))
    axes.set_title(f"against {knob}, with fitted orders", color=INK, fontsize=11)
    _legend(axes)


def _style(index: int) -> dict[str, Any]:
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": MARKS[index % len(MARKS)],
        "markersize": 6,
        "linewidth": 1.2,
    }


def _legend(axes: Any) -> None:
    if axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize=8, frameon=False)


def _dress(axes: Any, measure: str, zero: float) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    unit = MEASURES[measure].unit
    name = measure.replace("_", " ")
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        # Over a few decades more than the powers of ten can be told, over many they crowd.
        short = math.log10(high / low) < 2.5
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if short else (1.0,)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.set_ylabel(f"{name} [{unit}]" if unit else name)
    axes.grid(True, which="major", color=LINE, linewidth=0.8)
    axes.tick_params(colors=SOFT, labelsize=8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if zero:
        axes.axhline(zero, color=SOFT, linewidth=0.8, linestyle=":")
        axes.text(
            0.99, zero, "exactly 0", transform=axes.get_yaxis_transform(), fontsize=8, color=SOFT,
            ha="right", va="bottom",
        )  # fmt: skip
