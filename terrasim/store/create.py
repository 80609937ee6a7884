"""A store of a terrain that is a formula: nothing but its name, whatever the terrain's size."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrasim.counts import HOLE
from terrasim.sources.source import Source
from terrasim.store.build import require_place, retire
from terrasim.store.formula import describe_formula, fingerprint, source_of
from terrasim.store.store_file import BUILDING, writing
from terrasim.store.store_writer import StoreWriter
from terrasim.store.unfinished import unfinished


def create_store(
    path: str | Path, source: Source | Mapping[str, Any], *, replace: bool = False
) -> None:
    """Make a store of a terrain without importing it: blocks come from the formula.

    Args:
        path: The store to make. Nothing is there before it is complete.
        source: A flat, plane, sine, cone or fractal terrain, refined and mirrored or not; or the
            same as :func:`terrasim.store.formula.describe_formula` describes it.
        replace: Put the new store in the place of one that is there.

    Raises:
        InputError: If the terrain is not made of formulas alone, nothing may be written at
            ``path``, or there is something already.
        RunError: If the disk is full, or another process uses the same store.
    """
    path = Path(path)
    made = source_of(dict(source)) if isinstance(source, Mapping) else source
    formula = describe_formula(made)
    require_place(path, replace)
    named = {"formula": formula, "fingerprint": fingerprint(made)}
    with unfinished(path, BUILDING) as growing:
        with writing(path), StoreWriter(growing) as writer:
            writer.finish(made.grid, made.synthetic, formula, _summary(made), formula=named)
        if path.exists():
            retire(path)


def _summary(source: Source) -> dict[str, Any]:
    """What is known without looking at all of it."""
    spans = [source.grid.blocks(level) for level in range(source.grid.levels)]
    counts = [(one.row1 - one.row0) * (one.col1 - one.col0) for one in spans]
    return {
        "blocks": sum(counts),
        "blobs": 0,
        "holes": 0,
        "lowest": HOLE,
        "highest": HOLE,
        "levels": [{"blocks": count} for count in counts],
    }
