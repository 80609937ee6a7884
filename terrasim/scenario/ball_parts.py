"""What balls need: kernels and arrays for what they are asked to do, and no others."""

from __future__ import annotations

from terrasim.scenario.plan import DEVICE, Buffer, Part
from terrasim.scenario.scenario import Scenario

CARRIED = "balls on moving ground"


def ball_parts(scenario: Scenario) -> list[Part]:
    """Parts of a plan, those that are left out too."""
    collision = scenario.collision
    count = sum(group.count for group in scenario.balls)
    some, detail = count > 0, scenario.detail is not None
    number = f"{count} ball{'' if count == 1 else 's'}"
    spins = some and spinning(scenario)
    return [
        Part(
            "balls",
            some,
            f"{number}, contact {collision.contact}, {collision.integrator}" if some else number,
            kernels=(_stepper(scenario),),
        ),
        Part(
            "springs",
            some and collision.sprung,
            f"collision.integrator = {collision.integrator!r}",
            kernels=("terrasim.kernels.balls_sprung",),
        ),
        Part(
            "spin",
            spins,
            "a group of balls has spin or rolling friction" if spins else "no balls with spin",
            kernels=("terrasim.kernels.balls_spin",),
        ),
        Part(
            "sleep",
            some and collision.sleep,
            f"collision.sleep = {str(collision.sleep).lower()}",
            kernels=("terrasim.kernels.ball_sleep", "terrasim.kernels.ball_order"),
        ),
        Part(
            "balls against balls",
            some and scenario.pairs is not None,
            "table [pairs]" if scenario.pairs is not None else "no table [pairs]",
            kernels=tuple(f"terrasim.kernels.ball_{one}" for one in ("grid", "near", "pairs")),
        ),
        Part(
            CARRIED,
            carries(scenario),
            "what changes over time throws and carries them",
            kernels=(
                "terrasim.kernels.rise",
                *(("terrasim.kernels.rise_detail",) if detail else ()),
            ),
        ),
    ]


def spinning(scenario: Scenario) -> bool:
    """Whether any balls spin; then all have arrays for it."""
    return any(one.spin is not None or one.rolling_friction for one in scenario.balls)


def weighed(scenario: Scenario) -> bool:
    """Whether any balls have a mass; then all have."""
    return any(one.mass is not None for one in scenario.balls)


def carries(scenario: Scenario) -> bool:
    """Whether balls are on ground that moves."""
    moves = bool(scenario.dynamics) or scenario.relaxation is not None
    return moves and bool(scenario.balls)


def state_buffers(scenario: Scenario) -> list[Buffer]:
    """Arrays with one entry a ball that are there all the time, or whenever ground moves."""
    from terrasim.balls.ball_bytes import (
        BALL_BYTES,
        MASS_BYTES,
        RISE_BYTES,
        SPIN_BYTES,
        SPRING_BYTES,
    )

    count = sum(group.count for group in scenario.balls)
    found = [Buffer(f"state of {count} balls", "balls", DEVICE, count * BALL_BYTES)]
    for asked, name, part, size in (
        (weighed(scenario), "mass of balls", "balls", MASS_BYTES),
        (scenario.collision.sprung, "springs of balls", "springs", SPRING_BYTES),
        (spinning(scenario), "spin and rolling friction", "spin", SPIN_BYTES),
        (carries(scenario), "rise of the ground under balls", CARRIED, RISE_BYTES),
    ):
        if asked:
            found.append(Buffer(name, part, DEVICE, count * size))
    return found


def _stepper(scenario: Scenario) -> str:
    """The module of the kernel that steps them."""
    if scenario.collision.sprung:
        return "terrasim.kernels.balls_sprung"
    if spinning(scenario):
        return "terrasim.kernels.balls_spin"
    return f"terrasim.kernels.balls{'' if scenario.detail is None else '_detail'}"
