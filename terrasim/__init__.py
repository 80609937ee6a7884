"""terrasim: the ground under robots and vehicles.

One surface from disk to GPU: open a terrain from a source, ask it for heights and rays, deform it,
let things roll on it. Heavy libraries are imported only by what needs them.
"""

from importlib.metadata import PackageNotFoundError, version

from terrasim.array_source import ArraySource
from terrasim.errors import InputError, RunError
from terrasim.grid import Block, Grid
from terrasim.query import Sample, SurfaceSample, sample, sample_all
from terrasim.terrain import Terrain

try:
    __version__ = version("terrasim")
except PackageNotFoundError:  # a checkout that was never installed
    __version__ = "0"

__all__ = [
    "ArraySource",
    "Block",
    "Grid",
    "InputError",
    "RunError",
    "Sample",
    "SurfaceSample",
    "Terrain",
    "__version__",
    "sample",
    "sample_all",
]
