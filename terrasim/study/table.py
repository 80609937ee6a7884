"""Rows of a study as a Parquet file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from terrasim.errors import RunError

TABLE = "study.parquet"


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write one row a variant and repeat, one column a knob and measure.

    Raises:
        RunError: If the file cannot be written.
    """
    import pyarrow as pa
    from pyarrow import parquet

    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: _column([row.get(name) for row in rows]) for name in names}
    growing = path.with_name(f".{path.name}")
    try:
        parquet.write_table(pa.table(columns), growing)
        growing.replace(path)
    except (OSError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())
        raise RunError(f"{path}: the table cannot be written ({reason[:200]})") from None


def _column(values: list[Any]) -> list[Any]:
    """Values of one kind: numbers as numbers of one type, anything mixed as text."""
    kinds = {type(one) for one in values if one is not None}
    if kinds == {int, float}:
        return [None if one is None else float(one) for one in values]
    if len(kinds) <= 1 and list not in kinds:
        return values
    return [one if isinstance(one, str | None) else json.dumps(one) for one in values]
