"""Where the shapes of a training set come from: parameters, from which each is generated, or a store of fields."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from curvafit.core.checks import as_tuple
from curvafit.core.units import METRES, convert_length
from curvafit.data_synth.design import PARAMETERS, Design
from curvafit.data_synth.draws import one_thread
from curvafit.data_synth.imaging.modality import Modality
from curvafit.data_synth.moves import any_crop
from curvafit.data_synth.store import Store, open_store
from curvafit.generation.flow import generate
from curvafit.generation.fraction import first_mass
from curvafit.generation.schedule import SCHEDULES, Schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.generation.viability import well_formed
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Grid
from curvafit.priors.law import Law, LawLike, read_laws

#: Seeds that a shape gets to become well-formed.
TRIES = 8
#: Crops that are looked at for one with both structure and background.
CROPS = 32
#: Names of schedules in the records of version 0.1, which held no more of them, and the names today.
_NAMES_0_1 = {"fast": "cosine", "paper": "paper"}
#: The types of one law or one store.

_Crop = TypeVar("_Crop", bound=tuple[Any, ...])


class PhaseField(NamedTuple):
    """A phase field, float32 (Z, Y, X); its ε in voxels; and its origin, in JSON's types."""

    values: np.ndarray
    epsilon: float
    origin: dict[str, Any]


class ShapeSource(Protocol):
    """An endless source of shapes, each decided by the random numbers that it is given."""

    @property
    def within(self) -> float:
        """Return the most voxels that a shape can have along an edge."""
        ...

    def shape(self, voxels: Sequence[int], index: int, rng: np.random.Generator) -> PhaseField:
        """Return shape number `index` of so many voxels (z, y, x)."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """Return the source in JSON's types, for a set's record; `source_of` reads it."""
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
    schedule: str | Schedule = "fast"
    fraction: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", as_tuple(self.names, "names"))
        if len(self.names) != len(as_tuple(self.points, "points")):
            raise ValueError(f"expected a name for each of {len(self.points)} points, got {len(self.names)}")
        if self.fraction is not None:
            first_mass(self.fraction)
        object.__setattr__(self, "schedule", named_schedule(self.schedule))
        object.__setattr__(self, "points", Design("list", points=self.points).points)

    @property
    def within(self) -> float:
        """Return infinity: a shape is grown as large as it is wanted."""
        return math.inf

    def shape(self, voxels: Sequence[int], index: int, rng: np.random.Generator) -> PhaseField:
        """Return a well-formed shape, of the first of some seeds that gives one.

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
                    schedule=self.schedule,
                    reject_early=True,
                )
            if well_formed(flow.viability):
                point = dict(zip(PARAMETERS, (*six, flow.mass), strict=True))
                grown = {"seed": seed, "schedule": flow.schedule.as_dict(), "status": flow.status}
                origin = {"name": self.names[turn], "parameters": point, **grown}
                return PhaseField(flow.field.numpy(), WORKING_EPSILON / WORKING_SPACING, origin)
            status = flow.status
        raise ValueError(
            f"expected {self.names[turn]} to grow from one of {TRIES} seeds, got none: {status}; "
            "try another volume fraction or law"
        )

    @staticmethod
    def of(laws: Iterable[LawLike], fraction: float | None = None) -> Generated:
        """Return the source of the shapes of one law or several.

        Parameters
        ----------
        fraction
            As above; by default the volume fraction of the scan, where the laws are fits and agree on it.

        Raises
        ------
        FileNotFoundError, ValueError
            If a law cannot be read (`Law.of`), or states neither a mass nor a volume fraction.
        """
        stated = tuple(laws)
        textures = read_laws(stated)
        shares = {each.volume_fraction for each in textures}
        if fraction is None and len(shares) == 1:
            (fraction,) = shares
        points = tuple(_point(each, fraction) for each in textures)
        names = (
            Path(law).name if isinstance(law, (str, PathLike)) else texture.origin
            for law, texture in zip(stated, textures, strict=True)
        )
        return Generated(points, tuple(names), fraction=fraction)

    def as_dict(self) -> dict[str, Any]:
        return {
            "kind": "generated",
            "names": list(self.names),
            "points": [list(point) for point in self.points],
            "schedule": named_schedule(self.schedule).as_dict(),
            "fraction": self.fraction,
        }


@dataclass(frozen=True)
class Stored:
    """Random crops of the well-formed shapes of one or more stores, turned at random.

    Parameters
    ----------
    draws
        How many well-formed shapes there are, in all: by default as many as there are now. A store that has grown since
        is another source.
    rotate
        Whether crops are turned by any rotation, besides the symmetries of the cube.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no store, or one has no well-formed shape.
    """

    paths: tuple[Path, ...]
    draws: int | None = None
    rotate: bool = False

    def __post_init__(self) -> None:
        if self.draws is None:
            object.__setattr__(self, "draws", len(_formed(self.paths)))

    def shape(self, voxels: Sequence[int], index: int, rng: np.random.Generator) -> PhaseField:
        """Return a crop of any of the stores' shapes that shows both structure and background.

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

        def crop() -> tuple[np.ndarray, dict[str, Any], Store, int]:
            store, draw = draws[int(rng.integers(len(draws)))]
            return *any_crop(store.field(draw), voxels, rng, self.rotate), store, draw

        field, move, store, draw = _two_phases(crop, voxels)
        record, settings = store.record(draw), store.settings
        point = dict(zip(PARAMETERS, (*map(float, record.coefficients), record.mass), strict=True))
        origin = {"name": f"{store.path.name} {draw}", "parameters": point, "seed": record.seed, **move}
        return PhaseField(field, settings.epsilon / settings.spacing[0], origin)

    def as_dict(self) -> dict[str, Any]:
        return {
            "kind": "stored",
            "paths": [str(path) for path in self.paths],
            "draws": self.draws,
            "rotate": self.rotate,
        }

    @property
    def about(self) -> str:
        """Return the source in a few words."""
        return f"{self.draws} shapes of {', '.join(path.name for path in self.paths)}"

    @property
    def within(self) -> int:
        """Return the least edge of the stores' shapes, in voxels: what a crop must be within."""
        return min(min(store.settings.shape) for store, _ in _formed(self.paths))


@dataclass(frozen=True)
class Pool:
    """Random crops, turned at random, of a few shapes that each process generates once, when they are first wanted.

    Parameters
    ----------
    count
        Shapes in the pool.
    within
        Voxels along each edge of the shapes.
    rotate
        As of `Stored`.
    """

    generated: Generated
    count: int
    within: int
    rotate: bool = False

    @property
    def about(self) -> str:
        """Return the source in a few words."""
        return f"{self.count} shapes of {', '.join(self.generated.names)}"

    def shape(self, voxels: Sequence[int], index: int, rng: np.random.Generator) -> PhaseField:
        """Return a crop of any of the pool's shapes that shows both structure and background.

        Raises
        ------
        ValueError
            If it is larger than these, a shape cannot be had, or many crops show only one.
        """

        def crop() -> tuple[np.ndarray, dict[str, Any], PhaseField]:
            whole = _pooled(self.generated, int(rng.integers(self.count)), self.within)
            return *any_crop(whole.values, voxels, rng, self.rotate), whole

        values, move, whole = _two_phases(crop, voxels)
        return PhaseField(values, whole.epsilon, whole.origin | move)


def source_of(content: dict[str, Any]) -> ShapeSource:
    """Return the source that `ShapeSource.as_dict` wrote."""
    if content["kind"] == "stored":
        return Stored(tuple(map(Path, content["paths"])), content["draws"], content["rotate"])
    plan = content["schedule"]
    plan = SCHEDULES[_NAMES_0_1[plan]] if isinstance(plan, str) else Schedule(**plan)
    return Generated(tuple(map(tuple, content["points"])), tuple(content["names"]), plan, content["fraction"])


def voxel_of(laws: Iterable[LawLike], kind: Modality) -> float:
    """Return the edge of a shape's voxel in a modality's unit: that of a law that is a fit, else the modality's own.

    A fit in voxels tells no edge of images in a unit of length.

    Raises
    ------
    FileNotFoundError, ValueError
        If a law cannot be read (`Law.of`), or the laws are several fits of different edges.
    """
    unit = kind.base.unit
    fits = [(law.working_voxel, law.length_unit) for law in read_laws(laws) if law.working_voxel and law.length_unit]
    edges = {convert_length(voxel, own, unit) for voxel, own in fits if own in METRES or own == unit}
    if len(edges) > 1:
        raise ValueError(f"expected fits of one voxel's edge, or a voxel beside them, got edges of {sorted(edges)}")
    return edges.pop() if edges else kind.voxel


def _point(texture: Law, fraction: float | None) -> tuple[float, ...]:
    """Return the seven numbers of a law; a mass that it does not state is that of the volume fraction."""
    if texture.mass is None and fraction is not None:
        return replace(texture, mass=first_mass(fraction)).point
    return texture.point


def _two_phases(crop: Callable[[], _Crop], voxels: Sequence[int]) -> _Crop:
    """Return the first crop that shows both structure and background."""
    for _ in range(CROPS):
        parts = crop()
        if parts[0].min() < 0 < parts[0].max():
            return parts
    edges = " x ".join(map(str, voxels))
    raise ValueError(f"expected structure and background in crops of {edges} voxels, got one {CROPS} times")


@lru_cache(maxsize=256)
def _pooled(generated: Generated, number: int, edge: int) -> PhaseField:
    return generated.shape((edge,) * 3, number, np.random.default_rng(number))


@lru_cache(maxsize=16)
def _formed(paths: tuple[Path, ...]) -> list[tuple[Store, int]]:
    """Return the well-formed draws of some stores, each with its store."""
    draws = []
    for store in map(open_store, paths):
        formed = [(store, index) for index in store.indices() if well_formed(store.record(index).viability)]
        if not formed:
            raise ValueError(f"expected a store with well-formed shapes, got none in {store.path}")
        draws += formed
    return draws
