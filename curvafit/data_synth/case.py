"""One case of a training set: an image, the shape that it shows on the image's own voxels, and how both were made."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch

from curvafit.core.checks import LONGEST, SHORTEST, as_tuple, check_float, check_int, check_seed, check_type, quoted
from curvafit.core.schema import encode
from curvafit.data_synth.composition import Composition, Layers
from curvafit.data_synth.imaging.image import field_shape, image, label_voxels, regrid
from curvafit.data_synth.imaging.modality import Imaging, Modality
from curvafit.data_synth.sources import ShapeSource, decode_source
from curvafit.priors.kernels.threads import one_thread

#: Shapes that are tried for a case until one is seen on the image's voxels, which may be coarse.
TRIES = 8
#: The most voxels of a shape; and the least along each edge of a grown one, or along the longest edge of a crop.
MOST, FEWEST = 10**9, 4
#: What may help where a class is not seen: of one structure, of several.
_MENDS = ("take more voxels", "take more voxels, a thinner wall, or laws that fill less")
#: Least and greatest calibre.
CALIBRES = (1e-3, 1e3)


class Case(NamedTuple):
    """An image, the phase field of what it shows and its labels, (Z, Y, X) on one grid of `spacing`.

    The field is that of all classes together. Labels are uint8: 0 outside, 1, 2, … in the classes. ε is in spacing's
    unit; `record` says how the case was made, in JSON's types.
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
    every case draws its own; `composition` is what a case shows of the source's shapes.
    """

    source: ShapeSource
    modality: Modality
    shape: tuple[int, int, int]
    voxel: float
    seed: int = 0
    calibres: tuple[float, float] = (1.0, 1.0)
    composition: Composition = field(default_factory=Composition)

    def __post_init__(self) -> None:
        check_type(self.modality, Modality, "a Modality")
        if not callable(getattr(self.source, "shape", None)):
            raise ValueError(f"the source must be a source of shapes, got {quoted(self.source)}")
        object.__setattr__(self, "shape", check_shape(self.shape))
        voxel = check_float(self.voxel, "a shape's voxel of positive length", SHORTEST, LONGEST)
        object.__setattr__(self, "voxel", voxel)
        object.__setattr__(self, "seed", check_seed(self.seed))
        object.__setattr__(self, "calibres", check_calibres(self.calibres))
        check_type(self.composition, Composition, "a Composition")
        self.composition.names(self.source)
        self.composition.check_wall(self._voxels[1], self.modality.base.unit)
        for voxel in self._voxels:
            check_crop(self.source.edge, self.shape, voxel, self.modality, self.composition.margin(self.source, voxel))

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the names of the labels' classes 1, 2, …"""
        return self.composition.names(self.source)

    @property
    def largest(self) -> tuple[int, int, int]:
        """Return the most voxels (z, y, x) that a shape can have: those at the least calibre."""
        return field_shape(self.shape, self._voxels[0], self.modality.base)

    @property
    def _voxels(self) -> tuple[float, float]:
        """The shortest and the longest edge that a shape's voxels can have."""
        low, high = self.calibres
        least, most = self.source.scales_between
        return self.voxel * low * least, self.voxel * high * most

    def case(self, index: int) -> Case:
        """Make case number `index`, on one thread; ValueError where a class is not seen on the image's voxels."""
        for_shape, for_imaging, for_image = np.random.SeedSequence(self.seed, spawn_key=(index,)).spawn(3)
        imaging = self.modality.draw(_draw_number(for_imaging))
        rng = np.random.default_rng(for_shape)
        voxel = draw_voxel(self.voxel, self.calibres, rng) * self.source.scale(index)
        voxels, names = field_shape(self.shape, voxel, imaging), self.classes
        seed = _draw_number(for_image)
        with one_thread():
            for _ in range(TRIES):
                layers = self.composition.draw(self.source, voxels, voxel, index, rng)
                levels = self.composition.choose_levels(len(names))
                parts = image_and_labels(layers, voxel, imaging, seed, self.shape, levels)
                grey, sampled, labels = (part.numpy() for part in parts)
                counts = np.bincount(labels.ravel(), minlength=len(names) + 1)
                if sampled.min() <= 0 < sampled.max() and counts.all():
                    break
            else:
                edges = " x ".join(map(str, self.shape))
                missing = "structure" if counts.all() else ("background", *names)[int(counts.argmin())]
                raise ValueError(f"{TRIES} shapes showed no {missing} on {edges} voxels: {_MENDS[len(names) > 1]}")
        record = {"index": index, "source": layers.origins, "imaging": imaging.as_dict(), "image_seed": seed}
        shares = (counts[1:] / labels.size).tolist()
        record |= {"voxel": voxel, "volume_fraction": float((sampled > 0).mean()), "class_fractions": shares}
        ceiling = imaging.detector.ceiling
        kind = np.uint16 if ceiling is not None and ceiling <= np.iinfo(np.uint16).max else np.float32
        epsilon = layers.epsilon * voxel
        return Case(grey.astype(kind), sampled, labels, imaging.spacing, imaging.unit, epsilon, record)

    def as_dict(self) -> dict[str, Any]:
        """Return all of the recipe in JSON's types."""
        parts = {"source": self.source.as_dict(), "composition": self.composition.as_dict()}
        return encode(vars(self) | parts)

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Recipe:
        """Return the recipe that `as_dict` wrote."""
        source, modality = decode_source(content["source"]), Modality.from_dict(content["modality"])
        shown = Composition.from_dict(content["composition"])
        numbers = (content[name] for name in ("shape", "voxel", "seed", "calibres"))
        return Recipe(source, modality, *numbers, composition=shown)


def image_and_labels(
    layers: Layers,
    voxel: float,
    imaging: Imaging,
    seed: int,
    shape: Sequence[int],
    levels: Sequence[float],
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the image of some classes, and on its voxels the field of the whole and the labels, all of `shape`.

    `voxel` is the edge of the fields' voxels. See `imaging.image` for the levels, and `label_voxels`.
    """
    z, y, x = shape  # a field of whole voxels may give a few voxels more
    grey = image(layers.values, voxel, imaging, seed, layers.epsilon, levels)
    whole = regrid(layers.whole, voxel, imaging)
    labels = label_voxels(layers.values, whole, voxel, imaging, layers.epsilon)
    grey, whole, labels = (part[:z, :y, :x].contiguous() for part in (grey, whole, labels))
    return grey, whole, labels


def check_shape(shape: Sequence[int]) -> tuple[int, int, int]:
    """Return the voxels (z, y, x) of an image as whole numbers above 0, or raise ValueError."""
    words, edges = "3 whole numbers of voxels above 0 (z, y, x)", as_tuple(shape, "3 whole numbers of voxels")
    z, y, x = (check_int(n, words, 1, MOST, of=edges) for n in (edges if len(edges) == 3 else (None,) * 3))
    return z, y, x


def draw_voxel(voxel: float, calibres: Sequence[float], rng: np.random.Generator) -> float:
    """Draw the edge of a shape's voxel: `voxel` times a factor between the calibres, even in the logarithm.

    Equal calibres use no random number.
    """
    low, high = calibres
    return voxel * (low if low == high else math.exp(rng.uniform(math.log(low), math.log(high))))


def check_calibres(calibres: Sequence[float]) -> tuple[float, float]:
    """Return calibres as two positive factors, the lower first, or raise ValueError."""
    words, pair = "calibres as two positive factors, the lower first", as_tuple(calibres, "two factors")
    low, high = (check_float(n, words, *CALIBRES, of=pair) for n in (pair if len(pair) == 2 else (None, None)))
    if low > high:
        raise ValueError(f"expected {words}, got {quoted(pair)}")
    return low, high


def check_crop(longest: float, shape: Sequence[int], voxel: float, modality: Modality, margin: int = 0) -> None:
    """Raise ValueError where images of `shape`, with a margin of voxels around their shapes, need shapes that are too
    small, too large, or longer than `longest`."""
    need = tuple(n + 2 * margin for n in field_shape(shape, voxel, modality.base))
    images, crops = " x ".join(map(str, shape)), " x ".join(map(str, need))
    if not 1 < math.prod(shape) <= MOST:
        raise ValueError(f"images must have 2 to {MOST:.0e} voxels, got {images}")
    if (min if longest == math.inf else max)(need) < FEWEST or math.prod(need) > MOST:
        raise ValueError(
            f"shapes must have from {FEWEST} voxels along an edge to {MOST:.0e} in all, but images of {images} voxels "
            f"need {crops}: is a voxel of {voxel:g} {modality.base.unit} meant?"
        )
    if max(need) > longest:
        raise ValueError(
            f"the stored shapes have {longest} voxels along an edge, but images of {images} voxels of {modality.name} "
            f"need {crops}: take smaller images, or build a store with a larger --shape"
        )


def _draw_number(words: np.random.SeedSequence) -> int:
    """Return a whole number below 2³², the first of a sequence."""
    return int(words.generate_state(1)[0])
