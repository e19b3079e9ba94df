"""A volume and its place in the world: values in z,y,x, with spacing, unit and affine."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from curvafit.priors.bounds import quoted
from curvafit.volumes.formats.base import ScanError, normalise_unit

__all__ = ["Field", "ScanError", "positive_triple"]


@dataclass(frozen=True, eq=False)
class Field:
    """A volume and its place in the world.

    Parameters
    ----------
    values
        Array (Z, Y, X), in the file's own type.
    spacing
        Voxel edges along (z, y, x), in `unit`.
    unit
        `"voxel"` (unknown), `"nm"`, `"um"`, `"mm"` or `"m"`.
    affine
        4x4 map from voxel index (x, y, z, 1) to position in `unit`, NIfTI's convention; its columns are as long as
        the spacing. None where the file has none.
    source
        Where it came from.
    notes
        Sentences on what was assumed while reading.

    Raises
    ------
    ValueError
        If values are not a 3D array, spacing is not 3 positive numbers or the unit has no known name.
    """

    values: np.ndarray
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    unit: str = "voxel"
    affine: np.ndarray | None = None
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if np.ndim(self.values) != 3:
            raise ScanError(f"expected a 3D volume, got an array of shape {np.shape(self.values)}")
        spacing = positive_triple(self.spacing)
        unit, factor = normalise_unit(self.unit)
        object.__setattr__(self, "values", np.asarray(self.values))
        object.__setattr__(self, "spacing", tuple(h * factor for h in spacing))
        object.__setattr__(self, "unit", unit)
        if self.affine is not None:
            affine = np.array(self.affine, dtype=np.float64)
            if affine.shape != (4, 4):
                raise ScanError(f"expected an affine of shape (4, 4), got {affine.shape}")
            affine[:3] *= factor
            object.__setattr__(self, "affine", affine)

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.values.shape  # type: ignore[return-value]


def positive_triple(spacing: object) -> tuple[float, float, float]:
    """Return a spacing as three numbers, one number counting for all axes.

    Raises
    ------
    ScanError
        If it is not one or three positive numbers.
    """
    try:
        triple = (float(spacing),) * 3 if isinstance(spacing, (int, float)) else tuple(float(h) for h in spacing)  # type: ignore[union-attr]
    except (TypeError, ValueError, OverflowError):
        triple = ()
    if len(triple) != 3 or any(not math.isfinite(h) or h <= 0 for h in triple):
        raise ScanError(f"expected a spacing of 3 positive numbers (z, y, x), got {quoted(spacing)}")
    return triple  # type: ignore[return-value]
