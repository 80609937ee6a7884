"""What a store holds, in a few numbers."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from terrasim.counts import HOLE, to_metres
from terrasim.store.names import branches, snapshots
from terrasim.store.store import open_store


def info(path: str | Path) -> dict[str, Any]:
    """What a store holds, ready for JSON: placement, levels with their errors, size, provenance.

    Raises:
        InputError: As ``open_store``.
        StoreCorrupt: As ``open_store``.
        RunError: As ``open_store``.
    """
    with open_store(path) as store:
        grid, summary = store.grid, store.summary
    posts, size = grid.rows * grid.cols, Path(path).stat().st_size
    ground = summary["lowest"] != HOLE
    return {
        "store": str(path),
        **asdict(grid),
        "levels": summary["levels"],
        "lowest_m": float(to_metres(summary["lowest"], grid.datum)) if ground else None,
        "highest_m": float(to_metres(summary["highest"], grid.datum)) if ground else None,
        "posts": posts,
        "holes": summary["holes"],
        "blocks": summary["blocks"],
        "blobs": summary["blobs"],
        "bytes": size,
        "bytes_per_post": size / posts,
        "ratio": 4 * posts / size,
        "synthetic": store.synthetic,
        "provenance": store.provenance,
        "schema_version": store.schema_version,
        "detail_factor": store.detail_factor,
        "branches": [asdict(one) for one in branches(path).values()],
        "snapshots": [asdict(one) for one in snapshots(path).values()],
    }
