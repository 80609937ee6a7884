"""Knobs: settings of a scenario by their path, such as ``run.dt_s`` or ``balls[1].radius``."""

from __future__ import annotations

import copy
import re
from typing import Any

from terrasim.errors import InputError

Table = dict[str, Any]

_PART = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)(?:\[(\d+)\])?")
_NOT_VARIED = frozenset({"name", "description", "study", "expect"})


def flat_knobs(value: Any) -> Any:
    """Knobs by their whole path, also where the file wrote tables in tables."""
    if not isinstance(value, dict):
        return value
    found: Table = {}
    for name, one in value.items():
        if isinstance(one, dict):
            found |= {f"{name}.{rest}": last for rest, last in flat_knobs(one).items()}
        else:
            found[name] = one
    return found


def turned(table: Table, knobs: Table) -> Table:
    """A scenario's tables with knobs at other values; the tables given stay as they are.

    Raises:
        InputError: If a path is none, or names an entry that there is not.
    """
    made = copy.deepcopy(table)
    for path, value in knobs.items():
        _turn(made, path, value)
    return made


def _turn(table: Table, path: str, value: Any) -> None:
    *above, (last, entry) = _parts(path)
    places: list[Any] = [table]
    for name, number in above:
        places = [below for place in places for below in _below(place, name, number, path)]
    for place in places:
        if entry is None:
            place[last] = value
        else:
            _entries(place, last, entry, path)[entry - 1] = value


def _parts(path: str) -> list[tuple[str, int | None]]:
    found = [_PART.fullmatch(part) for part in path.split(".")]
    parts = [(one[1], int(one[2]) if one[2] else None) for one in found if one]
    if len(parts) < len(found):
        raise InputError(
            f"{path!r} is no path of a setting: write it as run.dt_s or balls[1].radius"
        )
    if parts[0][0] in _NOT_VARIED:
        raise InputError(f"{path!r} cannot be varied: nothing depends on it")
    for name, number in parts:
        if number == 0:
            raise InputError(f"{path!r}: entries are counted from 1, so {name}[1] is the first")
    return parts


def _below(place: Any, name: str, number: int | None, path: str) -> list[Any]:
    if number is not None:
        return [_entries(place, name, number, path)[number - 1]]
    below = place.setdefault(name, {})
    below = below if isinstance(below, list) else [below]
    if not below or not all(isinstance(one, dict) for one in below):
        raise InputError(f"{path!r}: {name} holds no settings of its own")
    return below


def _entries(place: Any, name: str, number: int, path: str) -> list[Any]:
    entries = place.get(name, [])
    if not isinstance(entries, list) or len(entries) < number:
        count = len(entries) if isinstance(entries, list) else 0
        raise InputError(f"{path!r}: there is no {name}[{number}]: the scenario has {count}")
    return entries
