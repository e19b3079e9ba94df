"""Training pairs without end: random crops of generated shapes, turned, blended and imaged as they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from curvafit.data_synth.imaging.imaging import field_shape
from curvafit.data_synth.imaging.modality import Modality
from curvafit.data_synth.imaging.randomness import correlated
from curvafit.data_synth.sets.case import check_calibres, check_crop, drawn_voxel, imaged
from curvafit.data_synth.sets.sources import Stored

#: Length over which one texture gives way to another, as a share of the crop's longest edge.
BLEND_LENGTH = 0.5
#: How sharply: a standard normal field times this, through the logistic function, is the share of the first texture.
BLEND_STEEPNESS = 4.0


class Sample(NamedTuple):
    """A training pair: image float32 and label uint8 (0, 1), both (1, Z, Y, X), voxel edges (z, y, x), and how it was
    made, in JSON's types."""

    image: Tensor
    label: Tensor
    spacing: tuple[float, float, float]
    record: dict[str, Any]


class TextureDataset(IterableDataset):
    """Images with exact labels, cut from stores of shapes and imaged on the fly; an epoch is `length` samples.

    Sample k depends on the arguments and k alone; epoch e is samples e·length, e·length + 1, … Workers of a
    `DataLoader` and ranks of a `torch.distributed` group share them out: none is seen twice, none has another's random
    numbers.

    Parameters
    ----------
    stores
        Folders of one or more stores made by `curvafit atlas build`.
    modalities
        What images are like; each sample is of one of them at random. All of one spacing where samples go into batches.
    shape
        Voxels (z, y, x) of an image.
    length
        Samples of an epoch, over all ranks.
    blend
        Share of samples in which one texture gives way to another.
    calibres
        How much thinner and thicker than the voxel makes it a structure may be: every sample draws its own factor.
    voxel
        Edge of a shape's voxels in the modalities' unit; by default each modality's own.
    transform
        What to make of each `Sample`: `as_dict`, `as_monai`, `as_subject`, or your own function.

    Raises
    ------
    ValueError
        If there is no store, modality or well-formed shape, a crop would be larger than a shape, or a number is out of
        range.
    """

    def __init__(
        self,
        stores: str | Path | Sequence[str | Path],
        modalities: Modality | Sequence[Modality],
        shape: Sequence[int],
        *,
        length: int = 1000,
        seed: int = 0,
        blend: float = 0.2,
        voxel: float | None = None,
        calibres: tuple[float, float] = (1.0, 1.0),
        transform: Callable[[Sample], Any] | None = None,
    ) -> None:
        paths = [stores] if isinstance(stores, (str, Path)) else list(stores)
        self.modalities = [modalities] if isinstance(modalities, Modality) else list(modalities)
        self.source = Stored(tuple(map(Path, paths)))
        self.shape, self.length, self.seed, self.blend = tuple(map(int, shape)), int(length), int(seed), blend
        self.voxel, self.calibres, self.transform = voxel, calibres, transform
        self._check()
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    def __len__(self) -> int:
        """Samples of an epoch that this rank gives."""
        return self.length // self._rank()[1]

    def __getstate__(self) -> dict[str, Any]:
        """With the rank, which a spawned worker, outside the group, could not ask for."""
        return self.__dict__ | {"_told": self._rank()}

    def _rank(self) -> tuple[int, int]:
        found = _rank()
        return self.__dict__.get("_told", found) if found == (0, 1) and get_worker_info() else found

    def set_epoch(self, epoch: int) -> None:
        """Which epoch comes next, from 0; workers that stay alive see it too."""
        self._epoch.fill_(epoch)

    def __iter__(self) -> Iterator[Any]:
        """This worker's part of this rank's part of the epoch."""
        (rank, ranks), worker = self._rank(), get_worker_info()
        first, step = (0, 1) if worker is None else (worker.id, worker.num_workers)
        start = int(self._epoch) * self.length
        for k in range(first, len(self), step):
            yield self[start + k * ranks + rank]

    def __getitem__(self, number: int) -> Any:
        """Sample `number`, from 0."""
        sample = self.sample(number)
        return sample if self.transform is None else self.transform(sample)

    def sample(self, number: int) -> Sample:
        """Sample `number`, from 0, before the transform."""
        words = np.random.SeedSequence(self.seed, spawn_key=(number,))
        rng, (for_imaging, for_image, for_blend) = np.random.default_rng(words), map(int, words.generate_state(3))
        modality = self.modalities[int(rng.integers(len(self.modalities)))]
        imaging, voxel = modality.draw(for_imaging), drawn_voxel(self.voxel or modality.voxel, self.calibres, rng)
        voxels = field_shape(self.shape, voxel, imaging)
        u, epsilon, origin = self._shape(voxels, rng, for_blend)
        grey, _, mask = imaged(u, epsilon, voxel, imaging, for_image, self.shape)
        record = {"number": number, "source": origin, "modality": modality.name, "imaging": imaging.as_dict()}
        record |= {"image_seed": for_image, "voxel": voxel}
        return Sample(grey[None].float(), mask[None].to(torch.uint8), imaging.spacing, record)

    def _shape(
        self, voxels: Sequence[int], rng: np.random.Generator, seed: int
    ) -> tuple[Tensor, float, list[dict[str, Any]]]:
        """A phase field (Z, Y, X): a crop of one shape, or of two that share the volume."""
        blended = rng.random() < self.blend
        one, *more = (self.source.shape(voxels, 0, rng) for _ in range(1 + blended))
        u = torch.from_numpy(one.field)
        if more:
            length = BLEND_LENGTH * max(voxels)
            share = torch.sigmoid(BLEND_STEEPNESS * correlated(u[None, None], (length,) * 3, [seed], "blend"))[0, 0]
            u = share * u + (1 - share) * torch.from_numpy(more[0].field)
        return u, one.epsilon, [shape.origin for shape in (one, *more)]

    def _check(self) -> None:
        if not self.source.paths or not self.modalities:
            told = f"{len(self.source.paths)} and {len(self.modalities)}"
            raise ValueError(f"expected at least one store and one modality, got {told}")
        if len(self.shape) != 3 or min(self.shape) < 1 or self.length < 1 or not 0 <= self.blend <= 1:
            told = f"{self.shape}, {self.length}, {self.blend}"
            raise ValueError(f"expected 3 edges and a length above 0, and a blend in [0, 1], got {told}")
        check_calibres(self.calibres)
        for modality in self.modalities:
            check_crop(self.source, self.shape, (self.voxel or modality.voxel) * self.calibres[0], modality)


def as_dict(sample: Sample) -> dict[str, Tensor]:
    """`image` and `label`, what a `DataLoader` batches."""
    return {"image": sample.image, "label": sample.label}


def as_monai(sample: Sample) -> dict[str, Any]:
    """MONAI's dictionary: `image` and `label` as `MetaTensor` with an affine; array axes are z, y, x.

    Raises
    ------
    ImportError
        If MONAI is not installed.
    """
    try:
        from monai.data.meta_tensor import MetaTensor
    except ImportError as error:
        raise ImportError("expected MONAI: pip install monai", name="monai") from error
    affine = torch.diag(torch.tensor([*sample.spacing, 1.0], dtype=torch.float64))
    return {name: MetaTensor(values, affine=affine) for name, values in as_dict(sample).items()}


def as_subject(sample: Sample) -> Any:
    """A TorchIO `Subject` with `image` and `label`; its array axes are x, y, z.

    Raises
    ------
    ImportError
        If TorchIO is not installed.
    """
    try:
        import torchio  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError("expected TorchIO: pip install torchio", name="torchio") from error
    affine = np.diag([*sample.spacing[::-1], 1.0])
    image, label = (values.permute(0, 3, 2, 1).contiguous() for values in (sample.image, sample.label))
    return torchio.Subject(
        image=torchio.ScalarImage(tensor=image, affine=affine),
        label=torchio.LabelMap(tensor=label, affine=affine),
        record=sample.record,
    )


def _rank() -> tuple[int, int]:
    """This process's rank in `torch.distributed`'s group and the group's size; 0 of 1 without one."""
    group = torch.distributed
    if group.is_available() and group.is_initialized():
        return group.get_rank(), group.get_world_size()
    return 0, 1
