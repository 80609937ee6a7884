"""Importing what a plan names, before any thread is started.

USD's libraries take Python's lock while the dynamic loader's is held; a loader thread that holds
the first and wants the second, as NumPy's first call of ``backtrace`` does, would wait for ever.
"""

from __future__ import annotations

from importlib import import_module

from terrasim.scenario.plan import Plan

USED_BY_PART = {
    "picture": ("matplotlib.figure", "matplotlib.backends.backend_agg", "matplotlib.collections"),
    "usd": ("pxr.Gf", "pxr.Tf", "pxr.Usd", "pxr.UsdGeom", "pxr.UsdLux", "pxr.Vt"),
    "parquet": ("pyarrow", "pyarrow.parquet"),
}
"""Modules of the heavy libraries that a part of a run uses."""


def import_libraries(plan: Plan) -> None:
    """Import the heavy libraries of a plan's parts; those of the terrain its source brings."""
    for part in plan.parts:
        if part.used:
            for name in USED_BY_PART.get(part.name, ()):
                import_module(name)
