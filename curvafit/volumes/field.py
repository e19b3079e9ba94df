"""A volume and its place in the world: values in z,y,x, with spacing, unit and affine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from curvafit.core.checks import SEEDS, check_int, quoted
from curvafit.core.pictures import Pictured
from curvafit.core.runtime import one_line
from curvafit.core.units import format_sampling, parse_unit
from curvafit.volumes.formats.base import ScanError
from curvafit.volumes.formats.part import Crop, parse_box, resolve_box


@dataclass(frozen=True, repr=False, eq=False)
class Field(Pictured):
    """A volume and its place in the world: values with spacing, unit and affine.

    Raises ScanError where values are not a 3D array of real numbers or the spacing is not 3 positive numbers.

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
        Where the volume came from: the path of its file.
    notes
        Sentences on what was assumed while reading.
    """

    values: np.ndarray
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    unit: str = "voxel"
    affine: np.ndarray | None = None
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if np.ndim(self.values) != 3:
            raise ScanError(f"a volume must be 3D, got an array of shape {np.shape(self.values)}")
        if (kind := np.asarray(self.values).dtype).kind not in "biuf":
            raise ScanError(f"a volume must hold real numbers, got values of type {kind}")
        spacing = positive_triple(self.spacing)
        unit, factor = parse_unit(self.unit)
        object.__setattr__(self, "values", np.asarray(self.values))
        object.__setattr__(self, "spacing", tuple(h * factor for h in spacing))
        object.__setattr__(self, "unit", unit)
        if self.affine is not None:
            affine = np.array(self.affine, dtype=np.float64)
            if affine.shape != (4, 4):
                raise ScanError(f"an affine must have the shape (4, 4), got {affine.shape}")
            affine[:3] *= factor
            object.__setattr__(self, "affine", affine)

    def __repr__(self) -> str:
        extent = f" from {self.values.min():.4g} to {self.values.max():.4g}" if self.values.size else ""
        source = f", from {self.source}" if self.source else ""
        size = format_sampling(self.shape, self.spacing, self.unit)
        return one_line(f"Field({size}, {self.values.dtype}{extent}{source})")

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.values.shape  # type: ignore[return-value]

    def crop(self, crop: Crop) -> Field:
        """Return a box of voxels, whose affine says where the box lies in the volume.

        `crop` is `"z0:z1,y0:y1,x0:x1"` or three slices, counted as Python does: `":,10:,-64:"` is all of z, y from
        voxel 10 on and the last 64 of x. A crop that is no box, or leaves the volume, is a ScanError.
        """
        box = resolve_box(parse_box(crop), self.shape, self.source or "the volume")
        return replace(self, values=self.values[box]).move_origin([edge.start for edge in box])

    def label(self, label: int) -> Field:
        """Return the mask of the voxels with this value; none or all of them are a ScanError."""
        label = check_int(label, "a label that is a whole number", -SEEDS, 2 * SEEDS - 1)
        mask = round_labels(self.values) == label
        if mask.all() or not mask.any():
            values = np.unique(self.values)
            listed = ", ".join(map(str, values[:12].tolist())) + (", …" if len(values) > 12 else "")
            fault = "is the only label" if mask.any() else "is no label"
            raise ScanError(f"label {label} {fault} of the scan, which has {listed}")
        return replace(self, values=mask, notes=(*self.notes, f"The structure is label {label}."))

    def move_origin(self, start: Sequence[float]) -> Field:
        """Return the field with its first voxel placed where its voxel `start` (z, y, x) is."""
        affine = np.diag([*self.spacing[::-1], 1.0]) if self.affine is None else self.affine.copy()
        affine[:3, 3] += affine[:3, :3] @ np.array(start[::-1], dtype=np.float64)
        ends = (f"{first}:{first + n}" for first, n in zip(start, self.shape, strict=True))
        return replace(self, affine=affine, notes=(*self.notes, f"Voxels {', '.join(ends)} (z, y, x) are used."))


def round_labels(values: np.ndarray) -> np.ndarray:
    """Return floats within 1e-3 of whole numbers, as resampled labels are, as whole ones; all else as it is."""
    whole = np.rint(values) if values.dtype.kind == "f" else values
    return whole if whole is values or np.allclose(values, whole, rtol=0, atol=1e-3) else values


def positive_triple(spacing: object) -> tuple[float, float, float]:
    """Return one or three positive numbers as three, or raise ScanError."""
    try:
        triple = (float(spacing),) * 3 if isinstance(spacing, (int, float)) else tuple(float(h) for h in spacing)  # type: ignore[union-attr]
    except (TypeError, ValueError, OverflowError):
        triple = ()
    if len(triple) != 3 or any(not math.isfinite(h) or h <= 0 for h in triple):
        raise ScanError(f"spacing must be 3 positive numbers (z, y, x), got {quoted(spacing)}")
    return triple  # type: ignore[return-value]
