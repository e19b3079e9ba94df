"""The sampling grid that travels with every field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from curvafit.priors.bounds import LONGEST, SHORTEST, named, real, whole

Boundary = Literal["periodic", "replicate"]

#: Length of a voxel's edge in working units; the published parameters are all stated at this sampling.
WORKING_SPACING = 0.01
#: Interface parameter ε in working units (two voxels), likewise.
WORKING_EPSILON = 0.02
#: Voxels that an axis may have: what a signed 64-bit number holds.
MOST = 2**63 - 1


@dataclass(frozen=True)
class Grid:
    """A box of voxels: how many, how large, and what lies beyond the box.

    Parameters
    ----------
    shape
        Voxels along (z, y, x), each at least 4; a number means a cube.
    spacing
        Voxel edges along (z, y, x), in one length unit, from 1e-12 to 1e12; a number means a cube.
    boundary
        `"periodic"`: the box repeats. `"replicate"`: the field continues as its mirror image in each face
        (for stencils that reach one voxel this is edge replication, i.e. ∇u·n = 0).

    Raises
    ------
    ValueError
        If a shape or spacing is not three numbers in range or the boundary has another name.
    """

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float] = (WORKING_SPACING, WORKING_SPACING, WORKING_SPACING)
    boundary: Boundary = "periodic"

    def __post_init__(self) -> None:
        said = "a shape of 3 whole numbers, each at least 4", "a spacing of 3 positive numbers (z, y, x)"
        shape = tuple(whole(n, said[0], 4, MOST, of=self.shape) for n in _triple(self.shape))
        spacing = tuple(real(h, said[1], SHORTEST, LONGEST, of=self.spacing) for h in _triple(self.spacing))
        named(self.boundary, ("periodic", "replicate"), "boundary 'periodic' or 'replicate'")
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "spacing", spacing)

    @property
    def voxel_volume(self) -> float:
        """Volume of one voxel, in spacing's unit cubed."""
        return math.prod(self.spacing)

    @property
    def volume(self) -> float:
        """Volume |Ω| of the box, in spacing's unit cubed."""
        return self.voxel_volume * math.prod(self.shape)

    @property
    def longest(self) -> float:
        """The box's longest side."""
        return max(n * h for n, h in zip(self.shape, self.spacing, strict=True))

    @property
    def periodic(self) -> bool:
        return self.boundary == "periodic"


def _triple(value: Any) -> tuple:
    """Three parts of three, or of one; none, where there are others."""
    single = isinstance(value, str) or not hasattr(value, "__iter__") or getattr(value, "shape", None) == ()
    try:
        parts = (value,) * 3 if single else tuple(value)
    except TypeError:
        parts = ()
    return parts if len(parts) == 3 else (None,) * 3
