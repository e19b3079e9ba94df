"""What in a scan is structure: the kind of the scan, its threshold, its sign."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu

from curvafit.core.checks import SEEDS, check_choice, check_float, check_int
from curvafit.volumes.scan import Field, ScanError, load

__all__ = ["Kind", "Level", "check_options", "find_level", "is_noise", "region_of_interest"]

Kind = Literal["field", "mask", "image"]

#: Median third difference of neighbours from which values are noisy; fields rounded to 1/100 reach 0.02.
_NOISE = 0.045
#: Offsets in scan voxels, beyond the reach of smoothing, and the correlation that noise stays below there.
_LAGS, _UNCORRELATED = (4, 5, 6, 7, 8), 0.06


@dataclass(frozen=True, eq=False)
class Level:
    """A scan whose structure is where `values` (float32) > 0, and the grey level that was subtracted."""

    kind: Kind
    values: np.ndarray
    threshold: float | None
    note: str

    @property
    def mask(self) -> np.ndarray:
        return self.values > 0


def find_level(
    field: Field,
    *,
    kind: Literal["auto", "field", "mask", "image"] = "auto",
    threshold: Literal["otsu"] | float = "otsu",
    dark: bool = False,
    region: np.ndarray | None = None,
    periodic: bool = False,
    extremes: tuple[float, float] | None = None,
) -> Level:
    """Find the structure of a scan; the parameters are as in `prepare.prepare`.

    `extremes` are the lowest and highest value of the whole that `field` is a part of: they tell a mask's two values.

    Raises
    ------
    ScanError
        If the kind or threshold fits nothing in the scan, or a phase is empty.
    """
    if kind not in ("auto", "field", "mask", "image"):
        raise ScanError(f"expected kind auto, field, mask or image, got {kind!r}")
    values = field.values
    lowest, highest = (values.min(), values.max()) if extremes is None else extremes
    two = bool(np.all((values == lowest) | (values == highest)))
    kind = _guess_kind(values, threshold, two) if kind == "auto" else kind
    if kind == "field":
        level = _field_level(values, dark)
    elif kind == "mask":
        level = _mask_level(values, dark, lowest, highest, two)
    else:
        level = _image_level(field, threshold, dark, region, periodic)
    counted = level.mask if region is None else level.mask[region]
    if not counted.any():
        raise ScanError("expected a structure in the scan, got none: every voxel is background")
    if counted.all():
        raise ScanError("expected background in the scan, got none: every voxel is structure")
    return level


def check_options(kind: str, threshold: float | str, label: int | None) -> None:
    """Raise ValueError where what tells the structure is no such thing, or counts for nothing beside another option."""
    check_choice(kind, ("auto", "field", "mask", "image"), "kind auto, field, mask or image")
    otsu = isinstance(threshold, str) and threshold == "otsu"
    level = "otsu" if otsu else check_float(threshold, "a threshold that is a number or 'otsu'")
    if label is not None:
        check_int(label, "a label that is a whole number", -SEEDS, SEEDS)
        if kind in ("field", "image") or level != "otsu":
            raise ValueError("expected a label, which tells the structure, without a kind or a threshold, got both")
    if kind in ("field", "mask") and level != "otsu":
        raise ValueError(f"expected a threshold beside grey levels, got kind {kind}")


def region_of_interest(roi: Field | np.ndarray | str | os.PathLike[str] | None, field: Field) -> np.ndarray | None:
    """Return where the scan counts: a mask of its shape, or None for everywhere.

    Raises
    ------
    ScanError
        If the mask is empty or of another shape.
    """
    if roi is None:
        return None
    loaded = roi if isinstance(roi, Field | np.ndarray) else load(roi)
    region = np.asarray(loaded.values if isinstance(loaded, Field) else loaded) != 0
    if region.shape != field.shape:
        raise ScanError(f"expected a region of interest of the scan's shape {field.shape}, got {region.shape}")
    if not region.any():
        raise ScanError("expected a region of interest with voxels in it, got an empty one")
    return region


def is_noise(mask: np.ndarray) -> bool:
    """Return whether voxels a few apart have nothing to do with each other, along each axis."""
    share = float(mask.mean())
    variance = share * (1 - share)
    for axis in range(3):
        for lag in _LAGS:
            if mask.shape[axis] <= 2 * lag:
                continue
            lines = np.moveaxis(mask, axis, 0)
            both = float(np.count_nonzero(lines[lag:] & lines[:-lag])) / lines[lag:].size
            ends = float(lines[lag:].mean()) * float(lines[:-lag].mean())
            if abs(both - ends) > _UNCORRELATED * variance:
                return False
    return True


def _guess_kind(values: np.ndarray, threshold: Literal["otsu"] | float, two: bool) -> Kind:
    """Guess the kind: two values are a mask; floats from about -1 to about 1, without noise and mostly far from 0, are
    a phase field; anything else is an image."""
    if two:
        return "mask"
    lowest, highest = values.min(), values.max()
    if values.dtype.kind == "f" and threshold == "otsu" and -2 <= lowest <= -0.7 and 0.3 <= highest <= 2:
        jitter = float(np.median(np.abs(np.diff(values, 3, axis=2)))) if values.shape[2] > 3 else 0.0
        if jitter < _NOISE and np.count_nonzero(np.abs(values) > 0.35) > 0.6 * values.size:
            return "field"
    return "image"


def _field_level(values: np.ndarray, dark: bool) -> Level:
    note = f"Taken for a phase field: values {values.min():.3g} to {values.max():.3g}."
    return Level("field", (-values if dark else values).astype(np.float32), None, note)


def _mask_level(values: np.ndarray, dark: bool, lowest: float, highest: float, two: bool) -> Level:
    if two:
        note = f"Taken for a mask of the values {float(lowest):g} and {float(highest):g}."
        return _signed(values == highest, dark, note)
    return _signed(values > 0, dark, "Taken for a mask: the structure is where it is positive.")


def _signed(mask: np.ndarray, dark: bool, note: str) -> Level:
    return Level("mask", np.where(mask != dark, np.float32(1), np.float32(-1)), None, note)


def _between_phases(values: np.ndarray) -> float:
    """Return the middle of the means of the two phases that Otsu's threshold splits: his threshold, but for phases of
    sharp levels, which any threshold between them splits alike, and of which his is the lowest.
    """
    high = values > threshold_otsu(values)
    return float(values[high].mean(dtype=np.float64) + values[~high].mean(dtype=np.float64)) / 2


def _image_level(
    field: Field, threshold: Literal["otsu"] | float, dark: bool, region: np.ndarray | None, periodic: bool
) -> Level:
    """Return the grey levels smoothed by one voxel of the finest axis, minus the threshold; Otsu's is that of the raw
    levels.

    Smoothing lowers thin structures' grey: their own threshold would then sink and make them fat.
    """
    finest = min(field.spacing)
    width = [finest / h for h in field.spacing]
    mode = "wrap" if periodic else "nearest"
    smooth = ndimage.gaussian_filter(field.values.astype(np.float32), width, mode=mode, truncate=3.0)
    counted, raw = (smooth, field.values) if region is None else (smooth[region], field.values[region])
    try:
        level = _between_phases(raw) if threshold == "otsu" else float(threshold)
    except ValueError:
        raise ScanError(f"expected a threshold that is a number or 'otsu', got {threshold!r}") from None
    lowest, highest = float(counted.min()), float(counted.max())
    if not lowest < level < highest:
        levels = f"{lowest:.4g} to {highest:.4g}"
        raise ScanError(f"expected a threshold within the smoothed scan's {levels}, got {level:.4g}")
    how = "Otsu's" if threshold == "otsu" else "the given"
    side = "dark" if dark else "bright"
    note = f"Smoothed by one voxel, split at {how} threshold of {level:.4g}: the {side} phase is the structure."
    return Level("image", (level - smooth) if dark else (smooth - level), level, note)
