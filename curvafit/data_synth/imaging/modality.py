"""Kinds of image: what all images of a kind have in common, and the intervals that the rest is drawn from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from curvafit.core.checks import LONGEST, SHORTEST, check_float
from curvafit.data_synth.imaging.parameters import Imaging
from curvafit.data_synth.imaging.randomness import seeds_of


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
        By the name of a parameter, as `optics.blur`: low and high, numbers or three of them that move together. Drawn
        evenly in the logarithm where both ends are above zero, else evenly.

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
        check_float(self.voxel, "a shape's voxel of positive length", SHORTEST, LONGEST)
        ranges = {
            name: tuple(self.base.assign({name: end})[name] for end in ends) for name, ends in self.ranges.items()
        }
        for name, (low, high) in ranges.items():
            if np.any(np.asarray(low) > np.asarray(high)):
                raise ValueError(f"expected a range of {name} from low to high, got {low} to {high}")
        object.__setattr__(self, "ranges", ranges)

    def draw(self, seed: int) -> Imaging:
        """Return one image's parameters; the seed and a parameter's name alone decide what is drawn for it."""
        (seed,) = seeds_of([seed], 1)
        drawn = {}
        for name, (low, high) in self.ranges.items():
            key = tuple(name.encode())
            share = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key)).random()
            drawn[name] = _between(low, high, share)
        return self.base.assign(drawn)

    def as_dict(self) -> dict[str, Any]:
        """Return all of the modality in JSON's types."""
        ends = {name: [np.asarray(end).tolist() for end in pair] for name, pair in self.ranges.items()}
        head = {"name": self.name, "about": self.about, "voxel": self.voxel}
        return head | {"base": self.base.as_dict(), "ranges": ends}

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Modality:
        """Return the modality that `as_dict` wrote."""
        base = Imaging.from_dict(content["base"])
        return Modality(content["name"], content["about"], content["voxel"], base, content["ranges"])


def _between(low: Any, high: Any, share: float) -> Any:
    a, b = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    positive = bool(np.all(a > 0) and np.all(b > 0))
    value = np.exp(np.log(a) + share * (np.log(b) - np.log(a))) if positive else a + share * (b - a)
    return tuple(value.tolist()) if value.ndim else float(value)
