"""The sampling grid that travels with every field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Boundary = Literal["periodic", "replicate"]

#: Metres in each unit of length that files name, small to large.
METRES = {"nm": 1e-9, "um": 1e-6, "mm": 1e-3, "m": 1.0}
#: Length of a voxel's edge in working units; the published parameters are all stated at this sampling.
WORKING_SPACING = 0.01
#: Interface parameter ε in working units (two voxels), likewise.
WORKING_EPSILON = 0.02


@dataclass(frozen=True)
class Grid:
    """A box of voxels: how many, how large, and what lies beyond the box.

    Parameters
    ----------
    shape
        Voxels along (z, y, x); each at least 4.
    spacing
        Voxel edges along (z, y, x), in one length unit; a number means a cube.
    boundary
        `"periodic"`: the box repeats. `"replicate"`: the field continues as its mirror image in each face
        (for stencils that reach one voxel this is edge replication, i.e. ∇u·n = 0).

    Raises
    ------
    ValueError
        If a shape or spacing is not three positive numbers or the boundary has another name.
    """

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float] = (WORKING_SPACING, WORKING_SPACING, WORKING_SPACING)
    boundary: Boundary = "periodic"

    def __post_init__(self) -> None:
        shape = _triple(self.shape, "shape")
        spacing = _triple(self.spacing, "spacing")
        if any(int(n) != n or n < 4 for n in shape):
            raise ValueError(f"expected a shape of 3 whole numbers, each at least 4, got {tuple(self.shape)}")
        if any(not math.isfinite(h) or h <= 0 for h in spacing):
            raise ValueError(f"expected a spacing of 3 positive numbers (z, y, x), got {tuple(spacing)}")
        if self.boundary not in ("periodic", "replicate"):
            raise ValueError(f"expected boundary 'periodic' or 'replicate', got {self.boundary!r}")
        object.__setattr__(self, "shape", tuple(int(n) for n in shape))
        object.__setattr__(self, "spacing", tuple(float(h) for h in spacing))

    @property
    def voxel_volume(self) -> float:
        """Volume of one voxel, in spacing's unit cubed."""
        return math.prod(self.spacing)

    @property
    def volume(self) -> float:
        """Volume |Ω| of the box, in spacing's unit cubed."""
        return self.voxel_volume * math.prod(self.shape)

    @property
    def periodic(self) -> bool:
        return self.boundary == "periodic"


def _triple(value: object, name: str) -> tuple:
    if isinstance(value, (int, float)):
        return (value,) * 3
    try:
        triple = tuple(value)  # type: ignore[arg-type]
    except TypeError:
        triple = ()
    if len(triple) != 3:
        raise ValueError(f"expected {name} as 3 numbers (z, y, x) or one, got {value!r}")
    return triple
