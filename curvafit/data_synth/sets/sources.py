"""Where the shapes of a training set come from: parameters, from which each is generated, or a store of fields."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from curvafit.data_synth.atlas.design import PARAMETERS, Design
from curvafit.data_synth.atlas.draws import one_thread
from curvafit.data_synth.atlas.store import Store, open_store
from curvafit.data_synth.sets.moves import any_crop
from curvafit.generation.flow import generate
from curvafit.generation.fraction import first_mass
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.generation.viability import well_formed
from curvafit.priors.bounds import several
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Grid

#: Seeds that a shape gets to become well-formed.
TRIES = 8
#: Crops that are looked at for one with both structure and background.
CROPS = 32


class Shape(NamedTuple):
    """A phase field, float32 (Z, Y, X); its ε in voxels; and what it was made of, in JSON's types."""

    field: np.ndarray
    epsilon: float
    origin: dict[str, Any]


class Source(Protocol):
    """Shapes without end, each of the random numbers it is given."""

    @property
    def within(self) -> float:
        """The most voxels that a shape can have along an edge."""
        ...

    def shape(self, voxels: Sequence[int], index: int, rng: np.random.Generator) -> Shape:
        """Shape number `index` of so many voxels (z, y, x)."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """What a set records; `source_of` reads it back."""
        ...


@dataclass(frozen=True)
class Generated:
    """Shapes generated at points of seven numbers (`PARAMETERS`, working units), in turn.

    Parameters
    ----------
    names
        What the points are called, one each.
    schedule
        Of the flow.
    fraction
        Share of the volume that shapes fill, instead of the points' masses, as near as `generate` gets: a shape's
        `origin` says where it is missed.

    Raises
    ------
    ValueError
        If there is no point, one is no parameters of a shape (`Design`), the names are not as many, the schedule is
        unknown, or the fraction is not within (0, 1).
    """

    points: tuple[tuple[float, ...], ...]
    names: tuple[str, ...]
    schedule: str = "fast"
    fraction: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", several(self.names, "names"))
        if len(self.names) != len(several(self.points, "points")):
            raise ValueError(f"expected a name for each of {len(self.points)} points, got {len(self.names)}")
        if self.fraction is not None:
            first_mass(self.fraction)
        named_schedule(self.schedule)
        object.__setattr__(self, "points", Design("list", points=self.points).points)

    @property
    def within(self) -> float:
        """A shape is grown as large as it is asked for."""
        return math.inf

    def shape(self, voxels: Sequence[int], index: int, rng: np.random.Generator) -> Shape:
        """A well-formed shape, of the first of some seeds that gives one.

        Raises
        ------
        ValueError
            If no seed gives one.
        """
        turn = index % len(self.points)
        *six, mass = self.points[turn]
        grid, status = Grid(tuple(voxels)), ""  # type: ignore[arg-type]
        for _ in range(TRIES):
            seed = int(rng.integers(2**32))
            with one_thread():
                flow = generate(
                    Coefficients(*six),
                    mass if self.fraction is None else None,
                    grid,
                    volume_fraction=self.fraction,
                    seed=seed,
                    schedule=named_schedule(self.schedule),
                    reject_early=True,
                )
            if well_formed(flow.viability):
                point = dict(zip(PARAMETERS, (*six, flow.mass), strict=True))
                grown = {"seed": seed, "schedule": self.schedule, "status": flow.status}
                origin = {"name": self.names[turn], "parameters": point, **grown}
                return Shape(flow.field.numpy(), WORKING_EPSILON / WORKING_SPACING, origin)
            status = flow.status
        raise ValueError(f"expected {self.names[turn]} to grow from one of {TRIES} seeds, got none: {status}")

    def as_dict(self) -> dict[str, Any]:
        return {
            "kind": "generated",
            "names": list(self.names),
            "points": [list(point) for point in self.points],
            "schedule": self.schedule,
            "fraction": self.fraction,
        }


@dataclass(frozen=True)
class Stored:
    """Random crops of the well-formed shapes of one or more stores, turned at random.

    Parameters
    ----------
    draws
        How many well-formed shapes there are, in all: by default those that are found. A store that has grown since is
        another source.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no store, or one has no well-formed shape.
    """

    paths: tuple[Path, ...]
    draws: int | None = None

    def __post_init__(self) -> None:
        if self.draws is None:
            object.__setattr__(self, "draws", len(_formed(self.paths)))

    def shape(self, voxels: Sequence[int], index: int, rng: np.random.Generator) -> Shape:
        """A crop of any of the stores' shapes that shows both structure and background.

        Raises
        ------
        ValueError
            If it is larger than these, the stores have grown, or many crops show only one.
        """
        draws = _formed(self.paths)
        if len(draws) != self.draws:
            raise ValueError(
                f"expected stores of {self.draws} well-formed shapes as before, got {len(draws)}: they grew"
            )
        for _ in range(CROPS):
            store, draw = draws[int(rng.integers(len(draws)))]
            field, moved = any_crop(store.field(draw), voxels, rng)
            if field.min() < 0 < field.max():
                break
        else:
            edges = " x ".join(map(str, voxels))
            raise ValueError(f"expected structure and background in crops of {edges} voxels, got one {CROPS} times")
        record, settings = store.record(draw), store.settings
        point = dict(zip(PARAMETERS, (*map(float, record.coefficients), record.mass), strict=True))
        origin = {"name": f"{store.path.name} {draw}", "parameters": point, "seed": record.seed, **moved}
        return Shape(field, settings.epsilon / settings.spacing[0], origin)

    def as_dict(self) -> dict[str, Any]:
        return {"kind": "stored", "paths": [str(path) for path in self.paths], "draws": self.draws}

    @property
    def within(self) -> int:
        """The least edge of the stores' shapes, in voxels: what a crop must be within."""
        return min(min(store.settings.shape) for store, _ in _formed(self.paths))


def source_of(kept: dict[str, Any]) -> Source:
    """The inverse of `Source.as_dict`."""
    if kept["kind"] == "stored":
        return Stored(tuple(map(Path, kept["paths"])), kept.get("draws"))
    return Generated(tuple(map(tuple, kept["points"])), tuple(kept["names"]), kept["schedule"], kept.get("fraction"))


@lru_cache(maxsize=16)
def _formed(paths: tuple[Path, ...]) -> list[tuple[Store, int]]:
    """The well-formed draws of some stores, each with its store."""
    found = []
    for store in map(open_store, paths):
        own = [(store, index) for index in store.indices() if well_formed(store.record(index).viability)]
        if not own:
            raise ValueError(f"expected a store with well-formed shapes, got none in {store.path}")
        found += own
    return found
