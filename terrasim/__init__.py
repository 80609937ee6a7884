"""terrasim: the ground under robots and vehicles.

One surface from disk to GPU: open a terrain from a source, ask it for heights and rays, deform it,
let things roll on it. Heavy libraries are imported only by what needs them.
"""

from importlib.metadata import PackageNotFoundError, version

from terrasim.balls.balls import Balls, step
from terrasim.cache.agent import Agent
from terrasim.cache.needs import Boxes, Disc
from terrasim.deform.commit import apply, relax, undo
from terrasim.deform.ledger import Ledger
from terrasim.deform.relaxation import Rect
from terrasim.deform.stamps import (
    Berm,
    ConeStamp,
    Crater,
    Flatten,
    Gaussian,
    HalfCosine,
    HeightImage,
    Noise,
    Paraboloid,
    SphericalCap,
    Stamp,
    Texture,
    Trench,
)
from terrasim.errors import InputError, RunError
from terrasim.grid import Block, Grid
from terrasim.open_terrain import open_terrain
from terrasim.query import Sample, SurfaceSample, sample, sample_all
from terrasim.raycast import RayHits, raycast
from terrasim.sources.analytic import Cone, Flat, Plane, Sine
from terrasim.sources.array_source import ArraySource
from terrasim.sources.fractal import Fractal
from terrasim.sources.mirror import Mirrored
from terrasim.sources.refine import Refined
from terrasim.sources.resample import resample_power_of_two
from terrasim.sources.source import Source
from terrasim.store.store import open_store
from terrasim.terrain import Terrain

try:
    __version__ = version("terrasim")
except PackageNotFoundError:  # a checkout that was never installed
    __version__ = "0"

__all__ = [
    "Agent",
    "ArraySource",
    "Balls",
    "Berm",
    "Block",
    "Boxes",
    "Cone",
    "ConeStamp",
    "Crater",
    "Disc",
    "Flat",
    "Flatten",
    "Fractal",
    "Gaussian",
    "Grid",
    "HalfCosine",
    "HeightImage",
    "InputError",
    "Ledger",
    "Mirrored",
    "Noise",
    "Paraboloid",
    "Plane",
    "RayHits",
    "Rect",
    "Refined",
    "RunError",
    "Sample",
    "Sine",
    "Source",
    "SphericalCap",
    "Stamp",
    "SurfaceSample",
    "Terrain",
    "Texture",
    "Trench",
    "__version__",
    "apply",
    "open_store",
    "open_terrain",
    "raycast",
    "relax",
    "resample_power_of_two",
    "sample",
    "sample_all",
    "step",
    "undo",
]
