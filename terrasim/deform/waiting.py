"""Stamps that wait, made in as few calls as they fit into."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

from terrasim.deform.operations import Stamping
from terrasim.deform.perform import check
from terrasim.errors import InputError
from terrasim.terrain import Terrain


def together(terrain: Terrain, waiting: Sequence[Stamping]) -> Iterator[Stamping]:
    """Stamps that only add, those of one anchor that follow each other as one operation.

    Each was taken by itself; all of them may be too many and wide for one call, and are halved
    then.
    """
    for _, group in groupby(waiting, key=lambda one: one.anchor):
        yield from _fitting(terrain, list(group))


def _fitting(terrain: Terrain, waiting: list[Stamping]) -> Iterator[Stamping]:
    if len(waiting) == 1:
        yield waiting[0]
        return
    whole = Stamping(tuple(s for one in waiting for s in one.stamps), waiting[0].anchor)
    try:
        check(terrain, whole)
    except InputError:
        half = len(waiting) // 2
        yield from _fitting(terrain, waiting[:half])
        yield from _fitting(terrain, waiting[half:])
    else:
        yield whole
