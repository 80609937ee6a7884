"""Terrains that a store names instead of holding: the formula and its numbers, in the meta rows.

Only what changed is stored then, so a terrain of a million posts a side costs nothing to make. A
hash of a few heights tells when another version of a formula no longer gives the same ground.
"""

from __future__ import annotations

from dataclasses import asdict, fields
from hashlib import blake2b
from typing import Any

import numpy as np

from terrasim.errors import InputError, RunError
from terrasim.grid import Grid
from terrasim.sources.analytic import Cone, Flat, Plane, Sine
from terrasim.sources.fractal import Fractal
from terrasim.sources.mirror import Mirrored
from terrasim.sources.refine import Refined
from terrasim.sources.source import Source

_KINDS: dict[str, type[Any]] = {
    "flat": Flat,
    "plane": Plane,
    "sine": Sine,
    "cone": Cone,
    "fractal": Fractal,
    "refined": Refined,
    "mirrored": Mirrored,
}
_DEPTH = 8
_PROBES = 16


def describe_formula(source: Source) -> dict[str, Any]:
    """A source as JSON holds it.

    Raises:
        InputError: If it is not made of formulas alone.
    """
    names = {kind: name for name, kind in _KINDS.items()}
    name = names.get(type(source))
    if name is None:
        raise InputError(
            f"a store names only terrains of {', '.join(_KINDS)}, got {type(source).__name__}; "
            "import anything else with terrasim import"
        )
    said: dict[str, Any] = {"kind": name}
    for field in fields(source):  # type: ignore[arg-type]
        value = getattr(source, field.name)
        if field.name == "source":
            value = describe_formula(value)
        said[field.name] = asdict(value) if isinstance(value, Grid) else value
    return said


def source_of(said: dict[str, Any], depth: int = 0) -> Source:
    """The source that a description speaks of.

    Args:
        said: What ``describe_formula`` returned.
        depth: How many sources it is inside of.

    Raises:
        InputError: If it speaks of none.
    """
    rest = dict(said)
    kind = _KINDS.get(rest.pop("kind", ""))
    if kind is None or depth > _DEPTH:
        raise InputError(f"kind must be one of {', '.join(_KINDS)}, got {said.get('kind')!r}")
    try:
        if "source" in rest:
            rest["source"] = source_of(rest["source"], depth + 1)
        if "grid" in rest:
            rest["grid"] = Grid(**rest["grid"])
        made: Source = kind(**rest)
    except TypeError as error:
        raise InputError(f"a terrain of kind {said['kind']} has other fields: {error}") from None
    return made


def fingerprint(source: Source) -> str:
    """A hash of heights all over the terrain."""
    grid = source.grid
    rows = grid.row + np.linspace(0, grid.rows - 1, _PROBES).astype(np.int64)
    cols = grid.col + np.linspace(0, grid.cols - 1, _PROBES).astype(np.int64)
    counts = np.ascontiguousarray(source.posts(0, rows, cols))
    return blake2b(counts.data, digest_size=16).hexdigest()


def same_source(said: dict[str, Any]) -> Source:
    """The source that a store named, if it still gives the heights it gave then.

    Args:
        said: Its ``formula`` and ``fingerprint``.

    Raises:
        RunError: If it does not.
    """
    source = source_of(said["formula"])
    if fingerprint(source) != said["fingerprint"]:
        raise RunError(
            f"the terrain of kind {said['formula']['kind']} has other heights in this release than "
            "when the store was made; use the release that made it"
        )
    return source
