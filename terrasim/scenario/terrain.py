"""The terrain of a scenario: which source, finer by invented detail, larger by reflection."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, create_model

from terrasim.dem.import_options import ImportOptions
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.scenario.settings import (
    AsDataclass,
    OneOf,
    Settings,
    fields_of,
    given,
    kind_field,
    names_of,
)
from terrasim.sources.analytic import Cone, Flat, Plane, Sine
from terrasim.sources.array_source import ArraySource
from terrasim.sources.fractal import Fractal
from terrasim.sources.mirror import Mirrored
from terrasim.sources.refine import Refined
from terrasim.sources.source import Source

MOST_POSTS = 1 << 26
"""Posts of files that a run reads into memory; larger terrains go through a store."""

FORMULAS: dict[str, type[Flat] | type[Plane] | type[Sine] | type[Cone] | type[Fractal]] = {
    "flat": Flat,
    "plane": Plane,
    "sine": Sine,
    "cone": Cone,
    "fractal": Fractal,
}
"""Terrains of one formula by the name that scenario files give them."""


class Refine(Settings):
    """Seeded fractal detail between a source's posts, which stay as they are."""

    factor: int
    """New posts to one of the source, a power of two from 2 on."""
    relief: float = Refined.relief
    """Amplitude of the first octave in parts of the source's spacing, 0 to 1."""
    roughness: float = Refined.roughness
    """Height of an octave relative to the one before, above 0 and at most 1."""
    seed: int = Refined.seed
    """Which of the possible details, 0 to 2^63 - 1."""


class Mirror(Settings):
    """A larger terrain by reflection at the edges; comes after refinement."""

    rows: int
    """Number of posts along y."""
    cols: int
    """Number of posts along x."""
    row: int = 0
    """Index of the first row of posts, counted from the source's first."""
    col: int = 0
    """Index of the first column of posts, counted from the source's first."""
    exponent: int | None = None
    """A source of other than 2^k + 1 posts is resampled to that before it is refined; by default
    k fits best."""


class Ground(Settings):
    """Where heights come from."""

    kind: str
    """Which kind of source."""
    refine: Refine | None = None
    """Invented detail between the source's posts."""
    mirror: Mirror | None = None
    """Reflection to a larger terrain."""

    def own_source(self, folder: Path) -> Source:
        """The source without detail and reflection; paths are relative to ``folder``."""
        raise NotImplementedError

    def source(self, folder: Path) -> Source:
        """The whole source.

        Raises:
            InputError: If it cannot be made.
        """
        source = self.own_source(folder)
        if self.mirror is not None:
            from terrasim.sources.resample import resample_power_of_two

            # Before refinement, which keeps a power of two plus one.
            source = resample_power_of_two(source, self.mirror.exponent)
        if self.refine is not None:
            source = Refined(source, **given(self.refine))
        if self.mirror is not None:
            mirror = self.mirror
            source = Mirrored(source, mirror.rows, mirror.cols, mirror.row, mirror.col)
        return source


class StoreGround(Ground):
    """A store that ``terrasim import`` made."""

    kind: Literal["store"]
    """A store."""
    path: str
    """The store's file, relative to the scenario's folder."""

    def own_source(self, folder: Path) -> Source:
        """Open the store."""
        from terrasim.store.store import open_store

        return open_store(folder / self.path)


class DemGround(Ground):
    """Files of heights, read into memory."""

    kind: Literal["dem"]
    """Georeferenced rasters, or one image or array."""
    files: Annotated[tuple[str, ...], Field(min_length=1)]
    """The files, relative to the scenario's folder."""
    reading: Annotated[ImportOptions, AsDataclass()] = ImportOptions()
    """How they are to be read."""

    def own_source(self, folder: Path) -> Source:
        """Read the files."""
        from terrasim.dem.imports import open_input

        paths = [folder / name for name in self.files]
        return in_memory(open_input(paths, self.reading, scan=False), str(paths[0]))


class SampleGround(Ground):
    """Real elevation that comes with a library."""

    kind: Literal["sample"]
    """A sample of matplotlib's."""
    name: str = "jacksboro_fault_dem"
    """Its name."""
    spacing: Annotated[float, Field(gt=0.0)] | None = None
    """Distance between posts [m]; 90 by default, that of its 3 arc-seconds."""

    def own_source(self, folder: Path) -> Source:
        """Resample it to metres."""
        del folder
        from terrasim.dem.sample_dem import sample_dem

        return in_memory(sample_dem(self.name, self.spacing), self.name)


class FormulaGround(Ground):
    """A terrain of one formula."""

    def own_source(self, folder: Path) -> Source:
        """Place the formula on its grid."""
        del folder
        kind = FORMULAS[self.kind]
        grid = Grid(**given(self, names_of(Grid)))
        own = given(self, names_of(kind) - _PLACE)
        return kind(grid=grid, **own, **_reference(kind, grid))


_PLACE = frozenset({"grid", "row", "col"})


def _reference(kind: type, grid: Grid) -> dict[str, int]:
    """The post that a formula is measured from: the first, for a cone the middle."""
    if not {"row", "col"} <= names_of(kind):
        return {}
    if kind is Cone:
        return {"row": grid.row + grid.rows // 2, "col": grid.col + grid.cols // 2}
    return {"row": grid.row, "col": grid.col}


def _formula_model(name: str, kind: type) -> type[FormulaGround]:
    fields: dict[str, Any] = {
        **fields_of(Grid, skip=frozenset({"crs"})),
        **fields_of(kind, skip=_PLACE),
    }
    return create_model(
        f"{kind.__name__}Ground",
        __base__=FormulaGround,
        __doc__=kind.__doc__,
        kind=kind_field(name),
        **fields,
    )


GROUNDS: tuple[type[Ground], ...] = (
    StoreGround,
    DemGround,
    SampleGround,
    *(_formula_model(name, kind) for name, kind in FORMULAS.items()),
)
"""Every kind of terrain."""

AnyGround = Annotated[Ground, OneOf(GROUNDS)]


def in_memory(rows: Any, name: str) -> ArraySource:
    """Heights that are streamed, as an array.

    Raises:
        InputError: If they are too many.
    """
    grid: Grid = rows.grid
    if grid.rows * grid.cols > MOST_POSTS:
        raise InputError(
            f"{name}: {grid.rows} x {grid.cols} posts are more than the {MOST_POSTS} that a run "
            'reads into memory; make a store of it with terrasim import and use kind = "store"'
        )
    return ArraySource(rows.read_rows(0, grid.rows), grid)
