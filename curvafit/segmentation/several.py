"""Several structures between known slices: each with its law, and none where another is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curvafit.core.checks import SEEDS, check_int
from curvafit.core.runtime import Progress, part, silent
from curvafit.priors.loss import RESOLVED
from curvafit.priors.profile import optimal_profile
from curvafit.segmentation.completion import known_places, reconstruct
from curvafit.segmentation.example import slices_of
from curvafit.segmentation.known import labels
from curvafit.segmentation.result import Segmentation
from curvafit.segmentation.working import Law
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.source import Source, field_of

__all__ = ["labels_of", "reconstruct_labels"]

FORM = "labels that are whole numbers"


def reconstruct_labels(
    slices: Source,
    prior: Law | Mapping[int, Law],
    *,
    chosen: Sequence[int] | None = None,
    every: int | None = None,
    first: int = 0,
    known: Sequence[int] | None = None,
    axis: int = 0,
    example: Source | None = None,
    store: str | PathLike[str] | None = None,
    progress: Progress = silent,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    **options: Any,
) -> Segmentation:
    """Fill several structures between known slices, each as `reconstruct` does; where two claim a voxel, the one that
    is deeper there has it, by its phase field.

    Where every voxel of the known slices is labelled, so is every voxel of the volume: the least shallow has those that
    none claims. A label for which slices or example are too few is interpolated by the spline, and a note says why.

    Parameters
    ----------
    slices
        Labels of the whole volume's shape, whole numbers, 0 where there is nothing; only the known slices count.
    prior
        A law for all labels, or one for each.
    chosen
        The labels that are structures, by default all but 0; the others count as nothing.
    example
        Labels of another volume of the same kind, known whole: for each label, what has this value there.
    every, first, known, axis, store, progress, spacing, unit, options
        As in `reconstruct`, without `runs` and `suggest`.

    Returns
    -------
    Segmentation
        `labels` has the value of the structure at each voxel, `mask` where there is one, `phase` the greatest phase
        field; there are no coefficients. Its `status` says of each label what `reconstruct` says.

    Raises
    ------
    ValueError
        As `reconstruct`, if it refuses all labels; or if the known slices do not have a label, or none but 0.
    """
    volume = field_of(slices, spacing=spacing, unit=unit)
    places = known_places(volume.shape[axis], every, first, known)
    planes = np.moveaxis(volume.values, axis, 0)[places]
    numbers = labels_of(planes, chosen)
    laws = prior if isinstance(prior, Mapping) else dict.fromkeys(numbers, prior)
    if missing := [number for number in numbers if number not in laws]:
        raise ScanError(f"expected a law for each label, got none for {', '.join(map(str, missing))}")
    placed = {} if isinstance(example, Field) else {"spacing": spacing, "unit": unit}
    other = None if example is None else field_of(example, **placed)
    deepest = np.full(volume.shape, -np.inf, dtype=np.float32)
    owner = np.zeros(volume.shape, dtype=np.int64)
    parts: list[_Part] = []
    for count, number in enumerate(numbers):
        each = {
            "store": None if store is None else Path(store) / str(number),
            "progress": part(progress, count / len(numbers), (count + 1) / len(numbers)),
        }
        phase, one = _completed(volume, number, laws[number], places, axis, other, {**options, **each})
        owner = np.where(phase > deepest, number, owner)
        deepest = np.maximum(deepest, phase)
        parts.append(one)
    if all(one.refusal for one in parts):
        raise parts[0].refusal  # type: ignore[misc]
    inside = np.isin(planes, numbers)
    values = owner if inside.all() else np.where(deepest > 0, owner, 0)
    np.moveaxis(values, axis, 0)[places] = np.where(inside, planes, 0)
    values = values.astype(np.int32 if min(numbers) < 0 else np.min_scalar_type(max(numbers)))
    return Segmentation(
        mask=replace(volume, values=values != 0, notes=()),
        phase=replace(volume, values=deepest, notes=()),
        weight=None,
        coefficients=None,
        epsilon=next(one.epsilon for one in parts if not one.refusal),
        status="; ".join(f"label {number}: {one.status}" for number, one in zip(numbers, parts, strict=True)),
        notes=tuple(dict.fromkeys((*volume.notes, *(note for one in parts for note in one.notes)))),
        labels=replace(volume, values=values, notes=()),
    )


def labels_of(values: np.ndarray, chosen: Sequence[int] | None) -> list[int]:
    """Return the labels in known slices that are structures, ascending: those that are chosen, or all but 0.

    Raises
    ------
    ScanError
        If the values are grey levels, there is no such label, or 0 is one.
    """
    there = [int(value) for value in np.unique(labels(values, "known slices"))]
    numbers = (
        [each for each in there if each]
        if chosen is None
        else sorted({check_int(n, FORM, -SEEDS, SEEDS) for n in chosen})
    )
    listed = ", ".join(map(str, there[:12])) + (", …" if len(there) > 12 else "")
    if not numbers or 0 in numbers:
        raise ScanError(f"expected labels other than 0 in the known slices, got {'0' if numbers else listed}")
    if missing := [each for each in numbers if each not in there]:
        raise ScanError(f"expected labels of the known slices ({listed}), got {', '.join(map(str, missing))}")
    return numbers


@dataclass(frozen=True, eq=False)
class _Part:
    """A label's ε, what is said of it, and why it was not completed."""

    epsilon: float
    status: str
    notes: tuple[str, ...]
    refusal: ScanError | None = None


def _completed(
    volume: Field, number: int, law: Law, places: list[int], axis: int, example: Field | None, options: dict[str, Any]
) -> tuple[np.ndarray, _Part]:
    """Return a label's phase field, as `reconstruct` fills it, or interpolated where that refuses."""
    name, notes, shown = f"label {number}", (), None
    mask = replace(volume, values=volume.values == number, notes=())
    if example is not None and (example.values == number).any():
        shown = replace(example, values=example.values == number, notes=())
    elif example is not None:
        notes = (f"The example has no {name}: it is tried out on slices left out.",)
    try:
        found = reconstruct(mask, law, known=places, axis=axis, example=shown, **options)
    except ScanError as reason:
        between = slices_of(mask, places, axis)
        level = np.ascontiguousarray(np.moveaxis(between.level("spline"), 0, axis))
        phase = optimal_profile(torch.from_numpy(level), RESOLVED * min(volume.spacing)).numpy()
        return phase, _Part(0.0, "interpolated by a spline", (*notes, f"Of {name}: {reason}."), reason)
    return found.phase.values, _Part(found.epsilon, found.status, (*notes, *found.notes))
