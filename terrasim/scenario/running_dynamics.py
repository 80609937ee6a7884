"""The deformations of a run that change over time, from step to step."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from terrasim.deform.dynamics import Dynamic, advance_dynamics, end_dynamics
from terrasim.deform.edits import edits_of
from terrasim.deform.growth import Growth, RunningGrowth
from terrasim.deform.ledger import Ledger
from terrasim.deform.patch import Patch
from terrasim.deform.shock import RunningShock, Shock
from terrasim.deform.target import target_of
from terrasim.grid import Span
from terrasim.output.footprint import Footprint
from terrasim.output.stage_tiles import stamp_boxes
from terrasim.scenario.dynamics import DynamicSettings
from terrasim.scenario.plan import frame_steps
from terrasim.scenario.simulation import Setup
from terrasim.terrain import Terrain


@dataclass
class _Entry:
    """One of the scenario's, and how far it is."""

    settings: DynamicSettings
    """What the file says."""
    what: Shock | Growth
    """What it does."""
    first: int
    """The step at which it begins."""
    dynamic: Dynamic
    """It itself."""
    ledger: Ledger
    """What it did to the ground."""
    ended: bool = False
    """Whether its end has come."""

    @property
    def footprint(self) -> Footprint:
        """Where it is."""
        return self.what.stamp if isinstance(self.what, Growth) else self.what


class RunningDynamics:
    """All that changes the ground over time."""

    def __init__(self, terrain: Terrain, setup: Setup) -> None:
        """Prepare all of them; the ground changes when they begin."""
        scenario, anchor = setup.scenario, setup.anchor
        self._dt_s = setup.dt_s
        self._frames = frozenset(step * setup.finer for step in frame_steps(scenario))
        self._entries: list[_Entry] = []
        self._unseen: list[Footprint] = []
        self._anchor, self._spacing = anchor, terrain.grid.spacing
        for one in scenario.dynamics:
            what = one.deformation(setup.images)
            target = target_of(terrain, detail=one.detail)
            how: dict[str, Any] = {"device": terrain.device, "threads": terrain.threads}
            dynamic: Dynamic
            if isinstance(what, Shock):
                dynamic = RunningShock(what, target, anchor, **how)
            else:
                dynamic = RunningGrowth(what, target, anchor, **how)
            # A time that is a whole number of steps up to rounding is that step.
            first = math.ceil(one.time_s / scenario.run.dt_s - 1e-9) * setup.finer
            self._entries.append(_Entry(one, what, first, dynamic, Ledger()))

    @property
    def footprints(self) -> list[Footprint]:
        """Where they are."""
        return [one.footprint for one in self._entries]

    @property
    def boxes(self) -> list[Span]:
        """Level-0 posts that they may change, half-open."""
        return stamp_boxes(self.footprints, self._anchor, self._spacing)

    def go_on(self, terrain: Terrain, step: int) -> tuple[Ledger, list[Span]]:
        """Let those that have begun go on to the time of a step; each ends when its time is over.

        Returns:
            What happened to the posts, and where since the last frame that is shown; that is
            nowhere between frames.
        """
        ledger = Ledger()
        for one in self._entries:
            if one.ended or step < one.first:
                continue
            dt_s = self._dt_s if step > one.first else 0.0
            done = advance_dynamics(terrain, [one.dynamic], dt_s, put=_put)
            if one.dynamic.done:
                one.ended = True
                done += end_dynamics(terrain, [one.dynamic], one.settings.end, put=_put)
            one.ledger += done
            ledger += done
            self._unseen.append(one.footprint)
        if not self._unseen or step not in self._frames:
            return ledger, []
        seen, self._unseen = self._unseen, []
        return ledger, stamp_boxes(seen, self._anchor, self._spacing)

    def summary(self) -> list[dict[str, Any]]:
        """What became of each, ready for JSON."""
        return [
            {
                **one.dynamic.summary(),
                "end": one.settings.end if one.ended else None,
                "ledger": {**asdict(one.ledger), "net": one.ledger.net},
                "net_m3": one.ledger.volume(self._spacing),
                **_wave_error(one.dynamic),
            }
            for one in self._entries
        ]


def _put(terrain: Terrain, patch: Patch) -> Ledger:
    """Through the terrain's operations, so that its journal holds it."""
    return edits_of(terrain).commit(patch).ledger


def _wave_error(dynamic: Dynamic) -> dict[str, float]:
    """What posts and steps may have made of a wave: run again on every second post, twice the step.

    The scheme is of second order, so the finer run is wrong by a third of the difference. Waves
    that edges reflected differ more: the coarse rectangle is up to a spacing wider.
    """
    if not isinstance(dynamic, RunningShock) or not dynamic.wave.steps:
        return {}
    begun = time.perf_counter()
    apart = np.abs(dynamic.coarse().displacement - dynamic.displacement[::2, ::2]) / 3.0
    return {
        "error_m": float(apart.max()),
        "typical_error_m": float(np.median(apart)),
        "error_cost_s": time.perf_counter() - begun,
    }
