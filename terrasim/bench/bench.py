"""``terrasim bench``: speed as ratios measured in one run.

Every row compares a figure with another of the same run on the same machine: a memory copy of the
same bytes, a straightforward NumPy version, a serial numba loop, or a bar the figure has to keep.
CPU rows are CPU time of the calling thread, because a shared machine gives less than it shows.
"""

from __future__ import annotations

import json
import platform
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from terrasim.errors import InputError


@dataclass(frozen=True)
class Row:
    """One measured figure."""

    name: str
    """What was measured."""
    value: float
    """The figure."""
    unit: str
    """Its unit."""
    compared_with: str = ""
    """What ``ratio`` compares with; empty if with nothing."""
    ratio: float | None = None
    """The figure over the one it is compared with."""


Measure = Callable[[str], list[Row]]
"""Measures on a device, given by name."""

BENCHES: dict[str, str] = {
    "flight": "terrasim.bench.flights",
    "queries": "terrasim.bench.queries",
    "layout": "terrasim.bench.layout",
    "rays": "terrasim.bench.rays",
    "balls": "terrasim.bench.balls",
    "stamps": "terrasim.bench.stamps",
    "edits": "terrasim.bench.edits",
    "pressure": "terrasim.bench.pressure",
    "beside": "terrasim.bench.beside",
}
"""Name of each bench and the module whose ``measure`` does it.

The flight comes first because it also reports the largest size of the process.
"""


def bench(
    names: Sequence[str] = (), *, device: str = "cpu", tell: Callable[[str], None] | None = None
) -> dict[str, Any]:
    """Measure.

    Args:
        names: Benches to run; all of them if empty.
        device: Warp device.
        tell: Called with the name of each bench as it begins.

    Returns:
        ``{"device": ..., "rows": [{"name", "value", "unit", "compared_with", "ratio"}]}``.

    Raises:
        InputError: If there is no such bench or device.
    """
    from terrasim.terrain import open_device

    unknown = [name for name in names if name not in BENCHES]
    if unknown:
        raise InputError(f"no bench {unknown[0]!r}: there are {', '.join(BENCHES)}")
    opened = open_device(device)
    rows: list[Row] = []
    for name in names or BENCHES:
        if tell is not None:
            tell(name)
        measure: Measure = import_module(BENCHES[name]).measure
        rows += measure(device)
    return {"device": device_name(opened), "rows": [asdict(row) for row in rows]}


def device_name(device: Any) -> str:
    """What the device calls itself; for the CPU the processor's model."""
    if device.is_cuda:
        return str(device.name)
    info = Path("/proc/cpuinfo")
    if info.exists():
        found = re.search(r"model name\s*:\s*(.+)", info.read_text())
        if found:
            return found.group(1).strip()
    return platform.processor() or platform.machine()


def save(result: dict[str, Any], folder: Path) -> Path:
    """Write a result as ``<device>.json``; rows of other benches in that file stay.

    Returns:
        The file.
    """
    slug = re.sub(r"[^a-z0-9]+", "-", str(result["device"]).lower()).strip("-")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{slug}.json"
    rows = {row["name"]: row for row in result["rows"]}
    if path.exists():
        kept = json.loads(path.read_text())["rows"]
        rows = {row["name"]: row for row in kept} | rows
    whole = {**result, "python": platform.python_version(), "rows": list(rows.values())}
    path.write_text(json.dumps(whole, indent=1) + "\n")
    return path


def table(result: dict[str, Any]) -> str:
    """A result as lines of text for a person."""
    lines = [f"device: {result['device']}"]
    for row in result["rows"]:
        ratio = "" if row["ratio"] is None else f"{row['ratio']:8.2f} x {row['compared_with']}"
        lines.append(f"{row['name']:<52} {row['value']:>10.4g} {row['unit']:<19}{ratio}")
    return "\n".join(lines)


def numba_missing() -> bool:
    """Whether the comparison with numba must be left out; says so."""
    try:
        import_module("numba")
    except ImportError:
        print("terrasim: numba is not installed: its comparison is left out", file=sys.stderr)
        return True
    return False
