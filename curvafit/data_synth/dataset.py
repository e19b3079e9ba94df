"""Cases of a training set, each an image with exact labels: by a recipe, or without end for a network's training."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from curvafit.core.checks import (
    as_tuple,
    check_choice,
    check_float,
    check_int,
    check_positive,
    check_seed,
    check_type,
    quoted,
)
from curvafit.core.runtime import Progress, show_share
from curvafit.core.schema import decode, encode
from curvafit.data_synth.imaging.modality import Imaging, Modality, field_shape, image, label_voxels, modality, regrid
from curvafit.data_synth.sources import Generated, Pool, ShapeSource, Stored, choose_voxel, decode_source
from curvafit.priors.kernels.threads import one_thread
from curvafit.priors.law import LAW_TYPES, LawLike
from curvafit.volumes.formats.nifti import affine_in_file
from curvafit.volumes.volume import Volume

#: Shapes that are tried for a case until one is seen on the image's voxels, which may be coarse.
TRIES = 8
#: The most voxels of a shape; and the least along each edge of a grown one, or along the longest edge of a crop.
MOST, FEWEST = 10**9, 4
#: Percentiles that `percentile` makes 0 and 1.
PERCENTILES = (0.5, 99.5)


class Case(NamedTuple):
    """An image, the phase field of what it shows and its labels, (Z, Y, X) on one grid of `spacing`.

    Labels are uint8: 0 outside, 1 in the structure. ε is in spacing's unit; `record` says how the case was made, in
    JSON's types.
    """

    image: np.ndarray
    field: np.ndarray
    labels: np.ndarray
    spacing: tuple[float, float, float]
    unit: str
    epsilon: float
    record: dict[str, Any]


@dataclass(frozen=True)
class Recipe:
    """The recipe of all cases of a set: case i depends on the recipe and i alone.

    `shape` is the voxels (z, y, x) of the images; `voxel` is the edge of a shape's voxels in the modality's unit, which
    sets how thick structures are in the images; `calibres` are the least and the greatest factor of it, between which
    every case draws its own.
    """

    source: ShapeSource
    modality: Modality
    shape: tuple[int, int, int]
    voxel: float
    seed: int = 0
    calibres: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        check_type(self.modality, Modality, "a Modality")
        if not callable(getattr(self.source, "shape", None)):
            raise ValueError(f"the source must be a source of shapes, got {quoted(self.source)}")
        expected = "3 whole numbers of voxels above 0 (z, y, x)"
        shape = tuple(check_int(n, expected, 1, MOST, of=self.shape) for n in as_tuple(self.shape, expected, 3))
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "voxel", check_positive(self.voxel, "a shape's voxel of positive length"))
        object.__setattr__(self, "seed", check_seed(self.seed))
        expected = "calibres as two positive factors, the lower first"
        calibres = as_tuple(self.calibres, expected, 2)
        low, high = (check_float(n, expected, 1e-3, 1e3, of=calibres) for n in calibres)
        if low > high:
            raise ValueError(f"expected {expected}, got {quoted(calibres)}")
        object.__setattr__(self, "calibres", (low, high))
        for calibre in self.calibres:
            check_crop(self.source.edge, self.shape, self.voxel * calibre, self.modality)

    @property
    def largest(self) -> tuple[int, int, int]:
        """Return the most voxels (z, y, x) that a shape can have: those at the least calibre."""
        return field_shape(self.shape, self.voxel * self.calibres[0], self.modality.base)

    def case(self, index: int) -> Case:
        """Make case number `index`, on one thread; ValueError where the image's voxels show no structure."""
        sequences = np.random.SeedSequence(self.seed, spawn_key=(index,)).spawn(3)
        rng = np.random.default_rng(sequences[0])
        imaging_seed, image_seed = (int(sequence.generate_state(1)[0]) for sequence in sequences[1:])
        imaging = self.modality.draw(imaging_seed)
        low, high = self.calibres  # equal ones use no random number
        voxel = self.voxel * (low if low == high else math.exp(rng.uniform(math.log(low), math.log(high))))
        with one_thread():
            for _ in range(TRIES):
                case = _show(self.source, self.shape, voxel, imaging, image_seed, index, rng)
                share = float(case.labels.mean())
                if case.field.min() <= 0 < case.field.max() and 0 < share < 1:
                    break
            else:
                edges, missing = " x ".join(map(str, self.shape)), "structure" if share < 1 else "background"
                raise ValueError(f"{TRIES} shapes showed no {missing} on {edges} voxels: take more voxels")
        fractions = {"volume_fraction": float((case.field > 0).mean()), "label_fraction": share}
        grey = case.image.astype(np.uint16 if (imaging.detector.ceiling or math.inf) < 2**16 else np.float32)
        return case._replace(image=grey, record={"index": index} | case.record | fractions)

    def as_dict(self) -> dict[str, Any]:
        """Return all of the recipe in JSON's types."""
        return encode(vars(self) | {"source": self.source.as_dict()})

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Recipe:
        """Return the recipe that `as_dict` wrote."""
        source, modality = decode_source(content["source"]), decode(Modality, content["modality"])
        return Recipe(**{**content, "source": source, "modality": modality})


def _show(
    source: ShapeSource, shape: Sequence[int], voxel: float, imaging: Imaging, seed: int, index: int, rng: Any
) -> Case:
    """Return case `index` of `shape`, its image in real numbers; `voxel` is the edge of a shape's voxels."""
    grown = source.shape(field_shape(shape, voxel, imaging), index, rng)
    u = torch.from_numpy(grown.values)
    sampled = regrid(u, voxel, imaging)
    grey = image(u, voxel, imaging, seed, grown.epsilon)
    labels = label_voxels(u, sampled, voxel, imaging, grown.epsilon)
    z, y, x = shape  # a field of whole voxels may give a few voxels more
    grey, sampled, labels = (volume[:z, :y, :x].contiguous().numpy() for volume in (grey, sampled, labels))
    record = {"source": grown.origin, "imaging": encode(imaging), "image_seed": seed, "voxel": voxel}
    return Case(grey, sampled, labels, imaging.spacing, imaging.unit, grown.epsilon * voxel, record)


def check_crop(longest: float, shape: Sequence[int], voxel: float, modality: Modality) -> None:
    """Raise ValueError where images of `shape` need shapes that are too small, too large, or longer than `longest`,
    which is infinite for shapes that are grown to size."""
    crop = field_shape(shape, voxel, modality.base)
    images, crops = " x ".join(map(str, shape)), " x ".join(map(str, crop))
    if not 1 < math.prod(shape) <= MOST:
        raise ValueError(f"images must have 2 to {MOST:.0e} voxels, got {images}")
    edge = min(crop) if longest == math.inf else max(crop)  # a crop may be a single slice, a grown shape may not
    if edge < FEWEST or math.prod(crop) > MOST:
        raise ValueError(
            f"shapes must have from {FEWEST} voxels along an edge to {MOST:.0e} in all, but images of {images} voxels "
            f"need {crops}: is a voxel of {voxel:g} {modality.base.unit} meant?"
        )
    if max(crop) > longest:
        raise ValueError(
            f"the stored shapes have {longest} voxels along an edge, but images of {images} voxels of {modality.name} "
            f"need {crops}: take smaller images, or build a store with a larger --shape"
        )


# ---- samples without end ---------------------------------------------------------------------------------------------


class Sample(NamedTuple):
    """A training pair: image, float32, and label, uint8 (0, 1), both (1, Z, Y, X); the voxel's edges (z, y, x); and a
    record of how the pair was made, in JSON's types."""

    image: Tensor
    label: Tensor
    spacing: tuple[float, float, float]
    record: dict[str, Any]


class TextureDataset(IterableDataset):
    """Images with exact labels, cut from generated shapes and imaged on the fly; an epoch is `length` samples.

    Sample k depends on the arguments and k alone; epoch e is samples e·length, e·length + 1, … Each sample goes to one
    worker of a `DataLoader` and one rank of a `torch.distributed` group.

    Parameters
    ----------
    source
        Where shapes come from: folders of one or more stores of `curvafit atlas build`; or one or more laws
        (coefficients, presets, `fit.json`s, fits), of which `shapes` shapes are generated at once, for all workers and
        epochs, into a temporary folder that goes with the program.
    modalities
        The kinds of image, as `Modality` or by name, of which each sample draws one. Batches need one spacing.
    size
        Voxels (z, y, x) of an image, or one number for a cube.
    length
        Samples of an epoch, over all ranks.
    voxel
        Edge of a shape's voxels in the modalities' unit; by default the fits', else each modality's own.
    calibres
        Least and greatest factor of `voxel`; every sample draws its own in between.
    normalise
        `zscore` (mean 0, deviation 1), `percentile` (percentiles 0.5 and 99.5 become 0 and 1, values beyond are cut),
        or your own function of an image (1, Z, Y, X); by default images keep their counts.
    shapes, volume_fraction
        With laws: the number of shapes, which take turns among the laws, at least one of each; and the share of the
        volume that they fill, by default that of the law's mass or scan.
    transform
        A function of each `Sample`: `as_dict`, `as_monai`, or your own.
    progress
        Called with a sentence and the share of the shapes that are generated.
    """

    def __init__(
        self,
        source: LawLike | Sequence[LawLike],
        modalities: str | Modality | Sequence[str | Modality],
        size: int | Sequence[int],
        *,
        length: int = 1000,
        seed: int = 0,
        voxel: float | None = None,
        calibres: tuple[float, float] = (1.0, 1.0),
        normalise: str | Callable[[Tensor], Tensor] | None = None,
        shapes: int = 16,
        volume_fraction: float | None = None,
        transform: Callable[[Sample], Any] | None = None,
        progress: Progress = show_share,
    ) -> None:
        kinds = [modalities] if isinstance(modalities, (str, Modality)) else list(modalities)
        kinds = [modality(kind) if isinstance(kind, str) else kind for kind in kinds]
        sources: list[Any] = [source] if isinstance(source, LAW_TYPES) else list(as_tuple(source, "laws or stores"))
        if not (sources and kinds):
            raise ValueError(f"give a source and a modality, got {len(sources)} and {len(kinds)}")
        self.length, self.transform = int(length), transform
        if self.length < 1:
            raise ValueError(f"length must be above 0, got {self.length}")
        if not callable(normalise) and normalise is not None:
            names = f"a normalisation among {', '.join(NORMALISATIONS)}, a function or None"
            check_choice(normalise, NORMALISATIONS, names)
            normalise = NORMALISATIONS[normalise]
        self.normalise = normalise
        paths = tuple(Path(item) for item in sources if isinstance(item, (str, PathLike)))
        from_stores = len(paths) == len(sources) and all(path.is_dir() for path in paths)
        if from_stores and volume_fraction is not None:
            raise ValueError("volume_fraction applies to laws only; the source is a store of shapes")
        laws = [] if from_stores else sources
        origin = Stored(paths) if from_stores else Pool(Generated.of(laws, volume_fraction), shapes)
        edges = [choose_voxel(laws, kind) if voxel is None else voxel for kind in kinds]
        voxels = (size,) * 3 if isinstance(size, Real) else size
        #: One recipe for each modality.
        self.recipes = [
            Recipe(origin, kind, voxels, edge, seed, calibres)  # type: ignore[arg-type]
            for kind, edge in zip(kinds, edges, strict=True)
        ]
        if isinstance(origin, Pool):
            largest = max(max(recipe.largest) for recipe in self.recipes)
            grown = origin.grow(8 * math.ceil(largest / 8), progress)
            self.recipes = [replace(recipe, source=grown) for recipe in self.recipes]
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # with a loader's workers

    def __len__(self) -> int:
        """Return the number of samples that this rank gives in an epoch."""
        return self.length // self._rank()[1]

    def __getstate__(self) -> dict[str, Any]:
        """Return the state and the rank, since a spawned worker is not in the group."""
        return self.__dict__ | {"_group_rank": self._rank()}

    def _rank(self) -> tuple[int, int]:
        """Return the rank of this process, or of the one that spawned it, and the group's size."""
        group = torch.distributed
        grouped = group.is_available() and group.is_initialized()
        current = (group.get_rank(), group.get_world_size()) if grouped else (0, 1)
        return self.__dict__.get("_group_rank", current) if current == (0, 1) and get_worker_info() else current

    def set_epoch(self, epoch: int) -> None:
        """Set the next epoch, from 0, in persistent workers too."""
        self._epoch.fill_(epoch)

    def __iter__(self) -> Iterator[Any]:
        """Yield the samples of this worker and rank in the epoch."""
        (rank, ranks), worker = self._rank(), get_worker_info()
        first, step = (0, 1) if worker is None else (worker.id, worker.num_workers)
        start = int(self._epoch) * self.length
        for k in range(first, len(self), step):
            yield self[start + k * ranks + rank]

    def __getitem__(self, number: int) -> Any:
        """Return sample `number`, from 0."""
        sample = self.sample(number)
        return sample if self.transform is None else self.transform(sample)

    def sample(self, number: int) -> Sample:
        """Return sample `number`, from 0, before the transform."""
        rng = np.random.default_rng(np.random.SeedSequence(self.recipes[0].seed, spawn_key=(number,)))
        recipe = self.recipes[int(rng.integers(len(self.recipes)))]
        case = recipe.case(number)
        image = torch.from_numpy(case.image.astype(np.float32))[None]
        image = image if self.normalise is None else self.normalise(image)
        record = {"modality": recipe.modality.name} | case.record
        return Sample(image, torch.from_numpy(case.labels)[None], case.spacing, record)


def as_dict(sample: Sample) -> dict[str, Tensor]:
    """Return `image` and `label` as a dictionary, which a `DataLoader` can put into batches."""
    return {"image": sample.image, "label": sample.label}


def as_monai(sample: Sample) -> dict[str, Any]:
    """Return MONAI's dictionary: `image` and `label` as `MetaTensor` (1, X, Y, Z) with an affine.

    Axes, affine and its unit are those with which `LoadImaged` reads a case that `curvafit synth` wrote as NIfTI.
    """
    try:
        from monai.data.meta_tensor import MetaTensor
    except ImportError as error:
        raise ImportError("as_monai needs MONAI: pip install monai", name="monai") from error
    image, label = (values.permute(0, 3, 2, 1).contiguous() for values in (sample.image, sample.label))
    field = Volume(sample.image[0].numpy(), sample.spacing, sample.record["imaging"]["unit"])
    affine = torch.from_numpy(affine_in_file(field)).float().double()  # the digits that a file keeps
    return {name: MetaTensor(values, affine=affine) for name, values in (("image", image), ("label", label))}


def zscore(image: Tensor) -> Tensor:
    """Return an image of mean 0 and deviation 1."""
    return (image - image.mean()) / image.std().clamp_min(1e-8)


def percentile(image: Tensor) -> Tensor:
    """Return an image whose percentiles `PERCENTILES` are mapped to 0 and 1; values beyond are cut."""
    low, high = np.percentile(image.numpy(), PERCENTILES)
    return ((image - low) / max(high - low, 1e-8)).clamp_(0, 1)


#: Normalisations of an image (1, Z, Y, X), by name.
NORMALISATIONS: dict[str, Callable[[Tensor], Tensor]] = {"zscore": zscore, "percentile": percentile}
