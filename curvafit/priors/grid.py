"""The sampling grid that travels with every field, and array shapes in signatures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from curvafit.core.checks import check_choice, check_int, check_positive

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
else:
    try:
        from jaxtyping import Bool, Float
    except ImportError:  # a bare training environment: array shapes in signatures are then inert names

        class Float:
            def __class_getitem__(cls, item: Any) -> Any:
                return item[0]

        Bool = Float

Boundary = Literal["periodic", "replicate"]

#: Length of a voxel's edge in working units; the published parameters are all stated at this sampling.
WORKING_SPACING = 0.01
#: Interface parameter ε of the published parameters in working units (two voxels).
WORKING_EPSILON = 0.02
#: The most voxels of an axis: the greatest signed 64-bit number.
MOST = 2**63 - 1


@dataclass(frozen=True)
class Grid:
    """A box of voxels: the number of voxels, their edges, and the boundary condition.

    Parameters
    ----------
    shape
        Voxels along (z, y, x), each at least 4; a number means a cube.
    spacing
        Voxel edges along (z, y, x), in one length unit, from 1e-12 to 1e12; a number means cubic voxels.
    boundary
        `"periodic"`: the box repeats. `"replicate"`: the field continues as a mirror image beyond each face
        (for stencils that reach one voxel this is edge replication, i.e. ∇u·n = 0).

    Raises ValueError where the shape or the spacing is not three numbers in range, or the boundary has another name.
    """

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float] = (WORKING_SPACING, WORKING_SPACING, WORKING_SPACING)
    boundary: Boundary = "periodic"

    def __post_init__(self) -> None:
        counts, edges = "a shape of 3 whole numbers, each at least 4", "a spacing of 3 positive numbers (z, y, x)"
        shape = tuple(check_int(n, counts, 4, MOST, of=self.shape) for n in _triple(self.shape))
        spacing = tuple(check_positive(h, edges, of=self.spacing) for h in _triple(self.spacing))
        check_choice(self.boundary, ("periodic", "replicate"), "boundary 'periodic' or 'replicate'")
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "spacing", spacing)

    @classmethod
    def trusted(cls, shape: tuple[int, ...], spacing: tuple[float, ...], boundary: Boundary) -> Grid:
        """Make a grid without checks: of numbers that were checked, or of a compiler's symbols, which cannot be."""
        grid = object.__new__(cls)
        for name, value in (("shape", shape), ("spacing", spacing), ("boundary", boundary)):
            object.__setattr__(grid, name, value)
        return grid

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
        """Length of the box's longest side, in spacing's unit."""
        return max(n * h for n, h in zip(self.shape, self.spacing, strict=True))

    @property
    def periodic(self) -> bool:
        """Whether the box repeats."""
        return self.boundary == "periodic"


def _triple(value: Any) -> tuple:
    """Return three values, or a single one three times; else three None, which the checks of numbers then refuse."""
    single = isinstance(value, str) or not hasattr(value, "__iter__") or getattr(value, "shape", None) == ()
    try:
        values = (value,) * 3 if single else tuple(value)
    except TypeError:
        values = ()
    return values if len(values) == 3 else (None,) * 3
