"""What must hold of a stamp's fields; every error names stamp, field, rule and value."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from types import UnionType
from typing import Any, Literal, NoReturn, get_args, get_origin, get_type_hints

from terrasim.counts import COUNT_M, MAX_COUNT
from terrasim.errors import InputError

TALLEST = MAX_COUNT * COUNT_M
"""Largest height that a stamp may add or remove [m]."""
NARROWEST = 1e-6
"""Smallest size of a stamp [m]."""
WIDEST = 1e9
"""Largest size of a stamp [m]."""
_LONGEST_VALUE = 60


def refuse(stamp: str, field: str, rule: str, value: object) -> NoReturn:
    """Say what a field must do and does not.

    Raises:
        InputError: Always.
    """
    shown = " ".join(str(value).split())
    if len(shown) > _LONGEST_VALUE:
        shown = shown[: _LONGEST_VALUE - 3] + "..."
    raise InputError(f"{stamp}: {field} must {rule}, got {shown}")


def check_fields(stamp: object, name: str) -> None:
    """Hold each field against its type: finite numbers, whole numbers, flags, one of some words.

    Whole numbers where others may stand become those. Fields of other types are left to the stamp.

    Raises:
        InputError: If one does not fit.
    """
    own: Any = type(stamp)
    for field, kind in types_of(own).items():
        value = getattr(stamp, field)
        if kind is float:
            object.__setattr__(stamp, field, finite(value, name, field))
        elif kind is int:
            if not isinstance(value, int) or isinstance(value, bool):
                refuse(name, field, "be a whole number", value)
        elif kind is bool:
            if not isinstance(value, bool):
                refuse(name, field, "be true or false", value)
        elif get_origin(kind) is Literal:
            allowed = get_args(kind)
            if not isinstance(value, str) or value not in allowed:
                refuse(name, field, f"be {' or '.join(allowed)}", repr(value))
        elif isinstance(kind, UnionType) and float in get_args(kind) and value is not None:
            object.__setattr__(stamp, field, finite(value, name, field))


@cache
def types_of(kind: Any) -> Mapping[str, Any]:
    """Type of each field of a dataclass."""
    hints = get_type_hints(kind)
    return {one.name: hints[one.name] for one in fields(kind)}


def finite(value: object, stamp: str, field: str) -> float:
    """A finite number as a float.

    Raises:
        InputError: If it is none.
    """
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isfinite(number):
            return number
    refuse(stamp, field, "be a finite number", value)


def check_size(value: float, stamp: str, field: str) -> None:
    """Refuse a length that is no size of a stamp."""
    if not NARROWEST <= value <= WIDEST:
        refuse(stamp, field, f"lie between {NARROWEST:g} and {WIDEST:g} m", value)


def check_height(value: float, stamp: str, field: str) -> None:
    """Refuse a height beyond the range of heights."""
    if abs(value) > TALLEST:
        refuse(stamp, field, f"stay within {TALLEST:.0f} m", value)


def check_not_negative(value: float, stamp: str, field: str) -> None:
    """Refuse a length below 0."""
    if value < 0.0:
        refuse(stamp, field, "be at least 0 m", value)
