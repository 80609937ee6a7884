"""How the ground of a scenario changes and lasts: finer detail, slumping, a store."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from terrasim.scenario.settings import Settings

STORE = "ground.store"
"""Name of the store in a run's folder."""


class DetailSettings(Settings):
    """A finer grid over the terrain, present only where something changed it."""

    factor: Annotated[int, Field(ge=2, le=4096)]
    """Cells of detail along the side of a cell of the terrain."""
    bytes: Annotated[int, Field(ge=1)] = 64 << 20
    """Bytes of detail held on the device; a block takes 262,144."""


class RelaxationSettings(Settings):
    """Ground that is steeper than its angle of repose slumps, where stamps woke it."""

    angle_deg: Annotated[float, Field(gt=0.0, le=89.0)]
    """Angle of repose [degrees]."""
    iterations: Annotated[int, Field(ge=1, le=100_000)] = 32
    """Most iterations in a step."""
    detail: bool = False
    """Whether the detail's posts slump instead of the terrain's own."""


class StoreSettings(Settings):
    """The ground is kept in a store in the run's folder: ``ground.store``."""

    reopen_s: tuple[Annotated[float, Field(gt=0.0)], ...] = ()
    """Times at which it is closed and opened again [s]."""
    snapshots_s: tuple[Annotated[float, Field(ge=0.0)], ...] = ()
    """Times at which its state gets a name, ``snapshot-1`` and so on [s]."""
