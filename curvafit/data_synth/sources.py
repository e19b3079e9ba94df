"""Sources of shapes for training sets: grown from laws, or cropped from stores."""

from __future__ import annotations

import math
import sys
import tempfile
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from multiprocessing.util import get_temp_dir
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from curvafit.core.checks import as_tuple, check_int
from curvafit.core.runtime import Progress, silent
from curvafit.core.units import METRES, convert_length
from curvafit.data_synth.design import PARAMETERS, Design
from curvafit.data_synth.imaging.modality import Modality
from curvafit.data_synth.store import find_well_formed
from curvafit.generation.flow import generate
from curvafit.generation.loop import first_mass
from curvafit.generation.result import is_well_formed
from curvafit.generation.schedule import Schedule, choose_schedule
from curvafit.generation.schedule import schedule as named_schedule
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Grid
from curvafit.priors.kernels.threads import map_threads, one_thread
from curvafit.priors.law import LawLike, read_laws

#: Seeds that are tried for a well-formed shape, and crops that are tried for one with both structure and background.
TRIES, CROPS = 8, 32
#: Rotations and reflections of the cube: orders of the three axes times their directions.
SYMMETRIES = 48


class PhaseField(NamedTuple):
    """A phase field, float32 (Z, Y, X); its ε in voxels; and its origin, in JSON's types."""

    values: np.ndarray
    epsilon: float
    origin: dict[str, Any]


@dataclass(frozen=True)
class Generated:
    """Shapes grown from points of seven numbers (`PARAMETERS`, working units), in turn; each point has a name.

    Shapes fill a `fraction` of the volume if one is given, else have the points' masses; the status in their `origin`
    says where the fraction is missed.
    """

    points: tuple[tuple[float, ...], ...]
    names: tuple[str, ...]
    schedule: str | Schedule = "fast"
    fraction: float | None = None
    edge = math.inf  # a shape is grown to any size

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", as_tuple(self.names, "names"))
        if len(self.names) != len(as_tuple(self.points, "points")):
            raise ValueError(f"each of {len(self.points)} points needs a name, got {len(self.names)} names")
        if self.fraction is not None:
            first_mass(self.fraction)
        object.__setattr__(self, "schedule", named_schedule(self.schedule))
        object.__setattr__(self, "points", Design("list", points=self.points).points)

    def shape(self, voxels: Sequence[int], index: int, rng: np.random.Generator) -> PhaseField:
        """Return a well-formed shape, from the first of some seeds that gives one; ValueError where none does."""
        choice = index % len(self.points)
        name, (*strengths, mass) = self.names[choice], self.points[choice]
        mass = mass if self.fraction is None else None
        grid, status = Grid(tuple(voxels)), ""  # type: ignore[arg-type]
        options = {"volume_fraction": self.fraction, "schedule": self.schedule, "reject_early": True}
        for _ in range(TRIES):
            seed = int(rng.integers(2**32))
            with one_thread():
                flow = generate(Coefficients(*strengths), mass, grid, seed=seed, **options)
            if is_well_formed(flow.viability):
                point = dict(zip(PARAMETERS, (*strengths, flow.mass), strict=True))
                origin = {"name": name, "parameters": point, "seed": seed}
                origin |= {"schedule": flow.schedule.as_dict(), "status": flow.status}
                return PhaseField(flow.field.numpy(), WORKING_EPSILON / WORKING_SPACING, origin)
            status = flow.status
        raise ValueError(f"{name} grew from none of {TRIES} seeds ({status}): try another volume fraction or law")

    @staticmethod
    def of(laws: Iterable[LawLike], fraction: float | None = None) -> Generated:
        """Return the source of the shapes of one law or several.

        By default the fraction is that of the scan, where the laws are fits and agree on it. The schedule is the laws'.
        """
        sources = tuple(laws)
        parsed = read_laws(sources)
        for doubt in filter(None, (law.doubt for law in parsed)):
            warnings.warn(doubt, stacklevel=2)
        fractions = {law.volume_fraction for law in parsed}
        if fraction is None and len(fractions) == 1:
            (fraction,) = fractions
        if fraction is not None:
            parsed = [replace(law, mass=first_mass(fraction)) if law.mass is None else law for law in parsed]
        names = (
            Path(source).name if isinstance(source, (str, PathLike)) else law.origin
            for source, law in zip(sources, parsed, strict=True)
        )
        return Generated(tuple(law.point for law in parsed), tuple(names), choose_schedule(parsed), fraction)

    def as_dict(self) -> dict[str, Any]:
        """Return the source in JSON's types, for a set's record; `decode_source` reads it."""
        content = {"kind": "generated", "names": list(self.names), "points": list(map(list, self.points))}
        return content | {"schedule": named_schedule(self.schedule).as_dict(), "fraction": self.fraction}


class CropSource(ABC):
    """Random crops of shapes, under the symmetries of the cube."""

    @abstractmethod
    def choose(self, rng: np.random.Generator) -> PhaseField:
        """Return any of the shapes, whole."""

    def shape(self, voxels: Sequence[int], index: int, rng: np.random.Generator) -> PhaseField:
        """Return a crop of any of the shapes that shows both structure and background; ValueError where none does."""
        for _ in range(CROPS):
            whole = self.choose(rng)
            crop, record = random_crop(whole.values, voxels, rng)
            if crop.min() < 0 < crop.max():
                return PhaseField(crop, whole.epsilon, whole.origin | record)
        edges = " x ".join(map(str, voxels))
        raise ValueError(f"{CROPS} crops of {edges} voxels show no structure, or nothing else: take larger ones")


@dataclass(frozen=True)
class Stored(CropSource):
    """Crops of the well-formed shapes of one or more stores.

    `draws` is the number of well-formed shapes in all stores, counted by default; a store that has grown is refused.
    """

    paths: tuple[Path, ...]
    draws: int | None = None

    def __post_init__(self) -> None:
        if self.draws is None:
            object.__setattr__(self, "draws", len(find_well_formed(self.paths)))

    def choose(self, rng: np.random.Generator) -> PhaseField:
        """Return any of the stores' shapes."""
        draws = find_well_formed(self.paths)
        if len(draws) != self.draws:
            raise ValueError(f"the stores had {self.draws} well-formed shapes and grew to {len(draws)}: begin anew")
        store, draw = draws[int(rng.integers(len(draws)))]
        record, settings = store.record(draw), store.settings
        point = dict(zip(PARAMETERS, (*map(float, record.coefficients), record.mass), strict=True))
        origin = {"name": f"{store.path.name} {draw}", "parameters": point, "seed": record.seed}
        return PhaseField(store.field(draw), settings.epsilon / settings.spacing[0], origin)

    def as_dict(self) -> dict[str, Any]:
        """Return the source in JSON's types, for a set's record; `decode_source` reads it."""
        return {"kind": "stored", "paths": list(map(str, self.paths)), "draws": self.draws}

    @property
    def edge(self) -> int:
        """Return the least edge of the stores' shapes, in voxels; no crop may be longer."""
        return min(min(store.settings.shape) for store, _ in find_well_formed(self.paths))


@dataclass(frozen=True)
class Pool(CropSource):
    """Crops of `count` shapes with `edge` voxels along each axis, at least one of a law.

    `grow` makes them. They are files in a temporary folder of the process that grew them, which deletes it at its end;
    its workers read them there.
    """

    generated: Generated
    count: int
    edge: int = sys.maxsize
    shapes: tuple[tuple[Path, float, dict[str, Any]], ...] = ()

    def __post_init__(self) -> None:
        count = check_int(self.count, "a pool of at least 1 shape", 1, 4096)
        object.__setattr__(self, "count", max(count, len(self.generated.points)))

    def grow(self, edge: int, progress: Progress = silent) -> Pool:
        """Return the pool with its shapes, which grow side by side; ValueError where a law gives none."""
        folder = Path(tempfile.mkdtemp(prefix="shapes-", dir=get_temp_dir()))

        def keep(number: int) -> tuple[Path, float, dict[str, Any]]:
            grown = self.generated.shape((edge,) * 3, number, np.random.default_rng(number))
            np.save(path := folder / f"{number}.npy", grown.values)
            return path, grown.epsilon, grown.origin

        shapes = []
        for shape in map_threads(keep, range(self.count)):
            shapes.append(shape)
            progress(f"{len(shapes)} of {self.count} shapes grown", len(shapes) / self.count)
        return replace(self, edge=edge, shapes=tuple(shapes))

    def choose(self, rng: np.random.Generator) -> PhaseField:
        """Return any of the pool's shapes."""
        path, epsilon, origin = self.shapes[int(rng.integers(self.count))]
        return PhaseField(np.asarray(np.load(path, mmap_mode="r")), epsilon, origin)


#: Endless shapes for a set: `shape(voxels, index, rng)` depends on its arguments alone; no side is longer than `edge`.
ShapeSource = Generated | Stored


def decode_source(content: dict[str, Any]) -> ShapeSource:
    """Return the source that `as_dict` wrote."""
    if content["kind"] == "stored":
        return Stored(tuple(map(Path, content["paths"])), content["draws"])
    points, plan = tuple(map(tuple, content["points"])), Schedule(**content["schedule"])
    return Generated(points, tuple(content["names"]), plan, content["fraction"])


def choose_voxel(laws: Iterable[LawLike], kind: Modality) -> float:
    """Return the voxel edge, in the modality's unit, that the fitted laws agree on, or else the modality's default.

    A fit whose lengths are in voxels has no edge in a unit of length and is passed over. Fits that differ: ValueError.
    """
    unit = kind.base.unit
    fits = [(law.working_voxel, law.length_unit) for law in read_laws(laws) if law.working_voxel and law.length_unit]
    edges = {convert_length(voxel, fit_unit, unit) for voxel, fit_unit in fits if fit_unit in (*METRES, unit)}
    if len(edges) > 1:
        raise ValueError(f"the fits' voxels have edges of {sorted(edges)}: give one voxel")
    return edges.pop() if edges else kind.voxel


def apply_symmetry(values: np.ndarray, symmetry: int) -> np.ndarray:
    """Return a view of a volume (…, Z, Y, X) under one of the cube's symmetries, 0 to 47; 0 leaves it as it is."""
    order, flips = divmod(symmetry, 8)  # of 6 orders of the axes; a bit for each axis to flip
    permuted = np.moveaxis(values, list(permutations((-3, -2, -1)))[order], (-3, -2, -1))
    return np.flip(permuted, tuple(axis - 3 for axis in range(3) if flips >> axis & 1))


def crop_periodic(values: np.ndarray, corner: Sequence[int], shape: Sequence[int]) -> np.ndarray:
    """Return the crop of a periodic volume (Z, Y, X) that begins at a corner; it continues across the faces."""
    axes = zip(corner, shape, values.shape, strict=True)
    return values[np.ix_(*(np.arange(start, start + length) % period for start, length, period in axes))]


def random_crop(
    values: np.ndarray, shape: Sequence[int], rng: np.random.Generator
) -> tuple[np.ndarray, dict[str, Any]]:
    """Return a crop of a periodic volume under a random symmetry of the cube, and how it was made."""
    symmetry = int(rng.integers(SYMMETRIES))
    oriented = apply_symmetry(values, symmetry)
    if any(length > period for length, period in zip(shape, oriented.shape, strict=True)):
        raise ValueError(f"the crop must be within the shape's {oriented.shape} voxels, got {tuple(shape)}")
    corner = [int(rng.integers(period)) for period in oriented.shape]
    return np.ascontiguousarray(crop_periodic(oriented, corner, shape)), {"symmetry": symmetry, "corner": corner}
