"""Training pairs without end: random crops of generated shapes, turned and imaged on demand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from curvafit.core.checks import LONGEST, SHORTEST, as_tuple, check_choice, check_float, check_int, check_seed
from curvafit.data_synth.case import Composition, check_calibres, check_crop, check_shape, draw_voxel
from curvafit.data_synth.imaging.image import field_shape
from curvafit.data_synth.imaging.modality import Modality, modality
from curvafit.data_synth.sources import Generated, Pool, Stored, choose_voxel
from curvafit.priors.law import LAW_TYPES, LawLike
from curvafit.volumes.formats.nifti import affine_in_file
from curvafit.volumes.volume import Volume

#: Percentiles that `percentile` makes 0 and 1.
PERCENTILES = (0.5, 99.5)


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
        (coefficients, presets, `fit.json`s, fits), of which `shapes` shapes are generated when first wanted, each once
        for all workers and epochs, into a temporary folder.
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
    ) -> None:
        kinds = [modalities] if isinstance(modalities, (str, Modality)) else list(modalities)
        self.modalities = [modality(kind) if isinstance(kind, str) else kind for kind in kinds]
        self.size = check_shape((size,) * 3 if isinstance(size, (int, Real)) else size)
        self.length, self.seed, self.transform = int(length), check_seed(seed), transform
        self.calibres = check_calibres(calibres)
        sources: list[Any] = [source] if isinstance(source, LAW_TYPES) else list(as_tuple(source, "laws or stores"))
        if not (sources and self.modalities):
            raise ValueError(f"give a source and a modality, got {len(sources)} and {len(self.modalities)}")
        if self.length < 1:
            raise ValueError(f"length must be above 0, got {self.length}")
        if not callable(normalise) and normalise is not None:
            names = f"a normalisation among {', '.join(NORMALISATIONS)}, a function or None"
            check_choice(normalise, NORMALISATIONS, names)
            normalise = NORMALISATIONS[normalise]
        self.normalise = normalise
        paths = [Path(each) for each in sources if isinstance(each, (str, PathLike))]
        stores = len(paths) == len(sources) and all(path.is_dir() or path.suffix == ".zarr" for path in paths)
        edge = None if voxel is None else check_float(voxel, "a shape's voxel of positive length", SHORTEST, LONGEST)
        self.voxels = [edge or choose_voxel([] if stores else sources, kind) for kind in self.modalities]
        thinnest = [(kind, edge * self.calibres[0]) for kind, edge in zip(self.modalities, self.voxels, strict=True)]
        if stores:
            if volume_fraction is not None:
                raise ValueError("volume_fraction applies to laws only; the source is a store of shapes")
            self.source = Stored(tuple(paths))
        else:
            generated = Generated.of(sources, volume_fraction)
            check_int(shapes, "a pool of at least 1 shape", 1, 4096)
            largest = max(max(field_shape(self.size, voxel, kind.base)) for kind, voxel in thinnest)
            self.source = Pool(generated, max(shapes, len(generated.points)), 8 * -(-largest // 8))
        for kind, voxel in thinnest:
            check_crop(self.source.edge, self.size, voxel, kind)
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    def __repr__(self) -> str:
        kinds, size = ", ".join(kind.name for kind in self.modalities), " x ".join(map(str, self.size))
        return f"TextureDataset({self.source.about}; {kinds}; {size} voxels; {self.length} samples an epoch)"

    def __len__(self) -> int:
        """Return the number of samples that this rank gives in an epoch."""
        return self.length // self._rank()[1]

    def __getstate__(self) -> dict[str, Any]:
        """Return the state with the rank, since a spawned worker is not in the group."""
        return self.__dict__ | {"_group_rank": self._rank()}

    def _rank(self) -> tuple[int, int]:
        """Return the rank of this process, or of the one that spawned it, and the group's size."""
        group = torch.distributed
        grouped = group.is_available() and group.is_initialized()
        live = (group.get_rank(), group.get_world_size()) if grouped else (0, 1)
        return self.__dict__.get("_group_rank", live) if live == (0, 1) and get_worker_info() else live

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
        words = np.random.SeedSequence(self.seed, spawn_key=(number,))
        rng, (for_imaging, for_image) = np.random.default_rng(words), map(int, words.generate_state(2))
        turn = int(rng.integers(len(self.modalities)))
        kind = self.modalities[turn]
        imaging, voxel = kind.draw(for_imaging), draw_voxel(self.voxels[turn], self.calibres, rng)
        case = Composition().show(self.source, self.size, voxel, imaging, for_image, 0, rng)  # type: ignore[arg-type]
        image = torch.from_numpy(case.image)[None].float()
        image = image if self.normalise is None else self.normalise(image)
        record = {"number": number, "modality": kind.name} | case.record
        return Sample(image, torch.from_numpy(case.labels)[None], imaging.spacing, record)


def as_dict(sample: Sample) -> dict[str, Tensor]:
    """Return `image` and `label` as a dictionary, of which a `DataLoader` makes batches."""
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
    """Return an image whose percentiles `PERCENTILES` are 0 and 1, cut beyond."""
    low, high = np.percentile(image.numpy(), PERCENTILES)
    return ((image - low) / max(high - low, 1e-8)).clamp_(0, 1)


#: Normalisations of an image (1, Z, Y, X), by name.
NORMALISATIONS: dict[str, Callable[[Tensor], Tensor]] = {"zscore": zscore, "percentile": percentile}
