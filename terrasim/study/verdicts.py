"""What a study comes to: an order for every series of steps, and the Pareto front."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from terrasim.study.measures import ACCURACY
from terrasim.study.orders import fit_order, pareto, step_of
from terrasim.study.runs import DONE
from terrasim.study.settings import Study
from terrasim.study.study_file import label

COST = "run_time"


def drawn(study: Study) -> list[str]:
    """Measures that are drawn against run time."""
    return [name for name in study.measure if name in ACCURACY]


def step_knobs(study: Study) -> list[str]:
    """Knobs that are a step or a spacing, and have at least two values."""
    return [
        name
        for name, values in study.vary.items()
        if len(values) > 1 and all(step_of(name, value) is not None for value in values)
    ]


def series(study: Study, variants: list[dict[str, Any]], knob: str) -> dict[str, list[int]]:
    """Numbers of variants that differ in one knob alone, by what the others are set to."""
    found: dict[str, list[int]] = {}
    for number, one in enumerate(variants):
        others = {name: value for name, value in one["knobs"].items() if name != knob}
        # In a zip all knobs go together: there is one series.
        rest = label(others) if study.combine == "product" else ""
        found.setdefault(rest, []).append(number)
    return found


def median(one: dict[str, Any], measure: str) -> float | None:
    """A measure of a variant; None if it has none."""
    if one["status"] != DONE or one.get(measure) is None:
        return None
    return float(one[measure]["median"])


def find_orders(study: Study, variants: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Fitted orders, ready for JSON."""
    found = []
    for measure in drawn(study):
        for knob in step_knobs(study):
            for rest, numbers in series(study, variants, knob).items():
                steps = [step_of(knob, variants[i]["knobs"][knob]) or 0.0 for i in numbers]
                order = fit_order(steps, [median(variants[i], measure) for i in numbers])
                if order is not None:
                    found.append(
                        {
                            "measure": measure,
                            "knob": knob,
                            "others": rest,
                            **asdict(order),
                            "text": order.text,
                        }
                    )
    return found


def find_pareto(study: Study, variants: list[dict[str, Any]]) -> dict[str, list[int]]:
    """Numbers, from 1, of the variants on the front of each measure, cheapest first."""
    costs = [median(one, COST) for one in variants]
    return {
        measure: [i + 1 for i in pareto(costs, [median(one, measure) for one in variants])]
        for measure in drawn(study)
    }
