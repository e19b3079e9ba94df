"""Kinds of image: what all images of a kind have in common, and the intervals that the rest is drawn from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from curvafit.data_synth.imaging.imaging import (
    TRIPLES,
    Imaging,
    field_shape,
    image,
    image_shape,
    known_fields,
    regrid,
    visible,
    visible_share,
)
from curvafit.data_synth.imaging.randomness import seeds_of
from curvafit.priors.bounds import LONGEST, SHORTEST, real

__all__ = ["Imaging", "Modality", "field_shape", "image", "image_shape", "regrid", "visible", "visible_share"]


@dataclass(frozen=True)
class Modality:
    """A kind of image: what all have in common, and the intervals that the rest is drawn from.

    Parameters
    ----------
    name, about
        What it is, and where its numbers come from.
    voxel
        Edge of a shape's voxels, in the unit of the imaging: it makes structures as thick as what is imaged so.
    base
        A typical image.
    ranges
        By field of `Imaging`: low and high, numbers or three of them that move together. Drawn evenly in the logarithm
        where both ends are above zero, else evenly.

    Raises
    ------
    ValueError
        If a range has no known name or its ends no place in an `Imaging`, or the voxel is not positive.
    """

    name: str
    about: str
    voxel: float
    base: Imaging
    ranges: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        real(self.voxel, "a shape's voxel of positive length", SHORTEST, LONGEST)
        known_fields(self.ranges, "a modality's ranges")
        for name, (low, high) in self.ranges.items():
            for end in (low, high):
                replace(self.base, **{name: end})
            if np.any(np.asarray(low) > np.asarray(high)):
                raise ValueError(f"expected a range of {name} from low to high, got {low} to {high}")

    def draw(self, seed: int) -> Imaging:
        """One image's parameters; each is drawn from (seed, its own name)."""
        (seed,) = seeds_of([seed], 1)
        drawn = {}
        for name, (low, high) in self.ranges.items():
            key = tuple(name.encode())
            share = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key)).random()
            drawn[name] = _between(low, high, share)
        return replace(self.base, **drawn)

    def as_dict(self) -> dict[str, Any]:
        """All fields in JSON's types."""
        ends = {name: [np.asarray(end).tolist() for end in pair] for name, pair in self.ranges.items()}
        kept = {name: getattr(self, name) for name in ("name", "about", "voxel")}
        return kept | {"base": self.base.as_dict(), "ranges": ends}

    @staticmethod
    def from_dict(kept: Mapping[str, Any]) -> Modality:
        """The inverse of `as_dict`."""
        ends: dict[str, tuple[Any, Any]] = {}
        for name, (low, high) in kept["ranges"].items():
            ends[name] = (tuple(low), tuple(high)) if name in TRIPLES else (low, high)
        return Modality(kept["name"], kept["about"], kept["voxel"], Imaging.from_dict(kept["base"]), ends)


def _between(low: Any, high: Any, share: float) -> Any:
    a, b = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    positive = bool(np.all(a > 0) and np.all(b > 0))
    value = np.exp(np.log(a) + share * (np.log(b) - np.log(a))) if positive else a + share * (b - a)
    return tuple(value.tolist()) if value.ndim else float(value)
