"""What an image shows: one structure, several in front of one another, or a wall around a lumen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from curvafit.core.checks import LONGEST, SHORTEST, as_tuple, check_float
from curvafit.data_synth.labels import field_distance
from curvafit.data_synth.sources import Generated, ShapeSource
from curvafit.priors.grid import Grid

#: The brightest that a class can be, as a multiple of the structure's contrast.
BRIGHTEST = 100.0
#: The most classes of a set.
MOST_CLASSES = 200


class Layers(NamedTuple):
    """Phase fields (C, Z, Y, X) of classes 1 to C, the first in front; that of the whole, of all together (Z, Y, X);
    their ε in voxels; and the shapes' origins."""

    values: Tensor
    whole: Tensor
    epsilon: float
    origins: list[dict[str, Any]]

    @classmethod
    def of(cls, field: Tensor, epsilon: float, origins: list[dict[str, Any]]) -> Layers:
        """Return one class."""
        return cls(field[None], field, epsilon, origins)


@dataclass(frozen=True)
class Composition:
    """What a case shows: one structure by default.

    Attributes
    ----------
    classes
        Every case shows a shape of each law, in front of those of later laws; the classes of the labels.
    wall
        Thickness of a wall along the surface of the shape, inside it, in the modality's unit: the labels' class 1; what
        the wall encloses is class 2, the lumen.
    levels
        Light of each class: 0 is as dark as the background, 1 as bright as the structure. By default 1, the lumen 0.
    """

    classes: bool = False
    wall: float | None = None
    levels: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if self.wall is not None:
            wall = check_float(self.wall, "a wall of positive thickness", SHORTEST, LONGEST)
            object.__setattr__(self, "wall", wall)
        if self.classes and self.wall is not None:
            raise ValueError("give either classes or a wall, not both")
        if self.levels is not None:
            levels = as_tuple(self.levels, "a level of each class")
            checked = tuple(check_float(n, f"levels from 0 to {BRIGHTEST:g}", 0, BRIGHTEST, of=levels) for n in levels)
            object.__setattr__(self, "levels", checked)

    def names(self, source: ShapeSource) -> tuple[str, ...]:
        """Return the names of the classes, 1, 2, …; ValueError where the source or the levels do not fit."""
        names: tuple[str, ...] = ("structure",) if self.wall is None else ("wall", "lumen")
        if self.classes:
            if not isinstance(source, Generated) or not 2 <= len(source.names) <= MOST_CLASSES:
                raise ValueError(f"classes need from 2 to {MOST_CLASSES} laws to grow shapes of, one for each class")
            alike = len(set(source.names)) < len(source.names)
            names = tuple(f"{name} {k}" if alike else name for k, name in enumerate(source.names, 1))
        if self.levels is not None and len(self.levels) != len(names):
            raise ValueError(f"give a level for each of {', '.join(names)}, got {len(self.levels)} levels")
        return names

    def choose_levels(self, count: int) -> tuple[float, ...]:
        """Return the light of each of `count` classes."""
        return self.levels or ((1.0,) * count if self.wall is None else (1.0, 0.0))

    def draw(
        self, source: ShapeSource, voxels: Sequence[int], voxel: float, index: int, rng: np.random.Generator
    ) -> Layers:
        """Return the classes of case `index` on voxels of the edge `voxel`, which is in the wall's unit."""
        if self.classes:
            shapes = [source.shape(voxels, k, rng) for k in range(len(self.names(source)))]
            values = torch.from_numpy(np.stack([shape.values for shape in shapes]))
            return Layers(values, values.amax(0), shapes[0].epsilon, [shape.origin for shape in shapes])
        margin = self.margin(source, voxel)
        shape = source.shape([n + 2 * margin for n in voxels], index, rng)
        u, origin = torch.from_numpy(shape.values), shape.origin | ({"margin": margin} if margin else {})
        if self.wall is None:
            return Layers.of(u, shape.epsilon, [origin])
        shell = shell_of(u, shape.epsilon, self.wall / voxel, periodic=source.edge == math.inf)
        inner = (..., *(slice(margin, margin + n) for n in voxels))
        return Layers(shell[inner], u[inner], shape.epsilon, [origin])

    def margin(self, source: ShapeSource, voxel: float) -> int:
        """Return by how many voxels a crop is larger on every side: walls of surfaces outside reach into it."""
        return 0 if self.wall is None or source.edge == math.inf else math.ceil(self.wall / voxel) + 2

    def check_wall(self, voxel: float, unit: str) -> None:
        """Raise ValueError where a wall is thinner than a shape's voxel."""
        if self.wall is not None and self.wall < voxel:
            raise ValueError(f"a wall must be at least a shape's voxel thick, {voxel:g} {unit}, got {self.wall:g}")

    def as_dict(self) -> dict[str, Any]:
        """Return the composition in JSON's types."""
        return asdict(self) | {"levels": None if self.levels is None else list(self.levels)}

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Composition:
        """Return the composition that `as_dict` wrote, maybe with a `blend` of 0."""
        if content.get("blend"):
            raise ValueError("it blends textures, which curvafit does not do: it cannot be continued, begin another")
        return Composition(**{name: value for name, value in content.items() if name != "blend"})


def shell_of(field: Tensor, epsilon: float, thickness: float, *, periodic: bool = False) -> Tensor:
    """Return the phase fields (2, Z, Y, X) of a wall inside the surface of a shape, and of what it encloses.

    All are in voxels, of the shape's profile. Where the shape is thinner than two walls, the wall fills it.
    """
    grid = Grid(tuple(field.shape), (1.0,) * 3, "periodic" if periodic else "replicate")  # type: ignore[arg-type]
    depth = torch.from_numpy(field_distance(field, grid, epsilon))
    distances = torch.stack([torch.minimum(depth, thickness - depth), depth - thickness])
    return torch.tanh(distances / (math.sqrt(2) * epsilon)).to(field.dtype)
