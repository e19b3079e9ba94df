"""The widget that fills a labels layer between annotated slices, and shows where it is unsure."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from magicgui.widgets import ComboBox, Container, LineEdit, PushButton, SpinBox, create_widget

from curvafit.core.runtime import Progress
from curvafit.napari.widgets import Dock, drop_layer, field_of_layer, list_layers, place_of_layer, put_layer
from curvafit.segmentation.known import check_shared, next_in_rhythm, note_empty
from curvafit.segmentation.labels import reconstruct_labels
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.result import Segmentation
from curvafit.segmentation.slices import index_labels, require_labels
from curvafit.segmentation.uncertainty import entropy
from curvafit.volumes.volume import ScanError, Volume

_ALL, _ONE = "all labels", "the selected label"


@dataclass(frozen=True)
class Task:
    """A labels layer to fill: its field, the labels, the axis across its slices, the known ones, and the rest."""

    layer: Any
    field: Volume
    numbers: Sequence[int]
    axis: int
    known: Sequence[int]
    notes: Sequence[str]
    image: Volume | None
    suggest: int


@dataclass(frozen=True)
class Filled:
    """What was known of a filled layer, its values before and after, and what was found."""

    task: Task
    before: np.ndarray
    after: np.ndarray
    found: Segmentation


@dataclass(frozen=True, eq=False)
class Fill:
    """One fill of a layer: which slices were known of which labels, and what was filled in. `where` are flat indices,
    in values of `shape`, of what was filled in: voxels that changed and, in slices that were not known, those of the
    labels and of earlier fills; `before` and `after` are the values there."""

    axis: int
    known: Sequence[int]
    numbers: Sequence[int]
    shape: tuple[int, ...]
    where: np.ndarray
    before: np.ndarray
    after: np.ndarray

    def stands(self, values: np.ndarray) -> bool:
        """Return whether more slices are as the fill left them than as they were before: else it was undone."""
        changed = self.before != self.after
        where, count = self.where[changed], self.shape[self.axis]
        slices, now = np.unravel_index(where, self.shape)[self.axis], values.flat[where]
        total = np.bincount(slices, minlength=count)
        alike = [
            np.count_nonzero((total > 0) & (np.bincount(slices[now == each[changed]], minlength=count) == total))
            for each in (self.before, self.after)
        ]
        return bool(alike[1] > 0 and alike[1] >= alike[0])


class Complete(Dock):
    """Fill a labels layer between annotated slices; it can be undone."""

    def __init__(self, napari_viewer: Any) -> None:
        self.annotated = create_widget(label="labels", annotation="napari.layers.Labels")
        self.image = ComboBox(label="image", choices=lambda _: list_layers(napari_viewer, "Image"), nullable=True)
        self.which = ComboBox(label="fill", choices=[_ALL, _ONE], value=_ALL)
        self.axis = ComboBox(label="across", choices=["z", "y", "x"], value="z", tooltip="The axis across the slices.")
        self.known = LineEdit(
            label="known slices",
            tooltip="Besides those that you drew on: 0,9,17, or every 8th from 0: 0::8. No others: only 0::8.",
        )
        self.suggest = SpinBox(label="suggest", value=3, min=0, max=20, tooltip="Slices to annotate next.")
        self.suggestions = Container(widgets=[], layout="horizontal", labels=False)
        choices = [self.annotated, self.image, self.which, self.axis, self.known, self.suggest]
        super().__init__(napari_viewer, choices, "Fill")
        self.append(self.suggestions)
        #: The fills of each layer that were not undone: what they wrote is not taken for drawn.
        self.fills: WeakKeyDictionary[Any, list[Fill]] = WeakKeyDictionary()

    def prepare(self) -> Callable[[Progress], Filled]:
        """Read the layers and what is known of them."""
        self.suggestions.clear()
        layer, axis = self.annotated.value, "zyx".index(self.axis.value)
        field = field_of_layer(layer, "a labels layer")
        if layer.multiscale or not isinstance(layer.data, np.ndarray):
            raise ScanError(f"expected labels that can be edited, got {layer.name}, which is no NumPy array")
        field = replace(field, array=np.array(field.values))
        values = np.moveaxis(field.values, axis, 0)
        numbers = [int(layer.selected_label)] if self.which.value == _ONE else np.unique(values[values != 0]).tolist()
        most = {"most": math.inf} if self.which.value == _ONE else {}
        require_labels(values, f"the labels layer {layer.name}", **most)
        if not index_labels(values, numbers).any():
            what = "labels" if self.which.value == _ALL else f"voxels of label {numbers[0]}"
            raise ScanError(f"expected slices with {what} in {layer.name}, got none")
        known, empty = self._list_known(layer, axis, field.values, numbers)
        image = None if self.image.value is None else field_of_layer(self.image.value)
        suggest = min(self.suggest.value, len(values) - len(known))
        return partial(_fill, Task(layer, field, numbers, axis, known, note_empty(empty), image, suggest))

    def _list_known(
        self, layer: Any, axis: int, values: np.ndarray, numbers: Sequence[int]
    ) -> tuple[list[int], list[int]]:
        """Return the slices that are named and, unless no others are wanted, those that somebody drew on; and which of
        them are taken for rightly empty: at a first fill for which none are named, those next in the rhythm."""
        named, alone = _parse_slices(self.known.value, values.shape[axis])
        if alone:
            return named, []
        fills = _standing(self.fills.get(layer, []), values)
        expected, filled = values.copy(), np.zeros(values.shape, dtype=bool)
        for fill in fills:
            expected.flat[fill.where], filled.flat[fill.where] = fill.after, True
        corrected = (values != expected) & ((index_labels(values, numbers) | index_labels(expected, numbers)) > 0)
        drawn = np.where(filled & (values == expected), 0, values)
        known = {*named, *_touched(corrected, axis), *_touched(index_labels(drawn, numbers) > 0, axis)}
        same = (fill.known for fill in reversed(fills) if fill.axis == axis and set(numbers) <= set(fill.numbers))
        before = set(next(same, ()))
        places = sorted(known | before)
        if len(places) < 2:
            raise ScanError(f"expected two or more slices with labels in {layer.name}, got {len(places)}")
        if np.diff(places).max() == 1:
            raise ScanError(
                f"no slice without labels lies between those of {layer.name}: name those to keep, as only 0::8"
            )
        if len(numbers) > 1 and (shared := [k for k in places if k not in named]):
            drawn, whole = (np.moveaxis(each, axis, 0) for each in (drawn, values))
            changed = _touched(corrected, axis)
            drawn[changed] = whole[changed]
            check_shared(drawn, shared, numbers)
        empty = [] if named or before else next_in_rhythm(places, values.shape[axis])
        return sorted([*places, *empty]), empty

    def show_result(self, result: Filled) -> str:
        """Write the labels, as one step to undo, the doubt as a layer, and the slices to annotate next."""
        task, found = result.task, result.found
        layer, (doubt_name, frames_name) = task.layer, _names(task.layer)
        if layer not in self.viewer.layers or layer.data.shape[-3:] != result.after.shape:
            return "The layer that was filled is gone."
        for name in (doubt_name, frames_name):
            drop_layer(self.viewer, name)
        now = layer.data.reshape(result.after.shape)
        after = np.where(now == result.before, result.after, now)  # what was painted meanwhile stays
        fills = _standing(self.fills.get(layer, []), result.before)
        self.fills[layer] = [*fills, _remember(result, now, after, fills)]
        new = after.astype(layer.data.dtype).reshape(layer.data.shape)
        where = np.nonzero(new != layer.data)
        if len(where[0]):
            layer.data_setitem(where, new[where])  # which napari can undo as one step
        if layer.selected_label not in task.numbers:
            layer.selected_label = task.numbers[0]  # the one to correct with
        assert found.uncertainty is not None
        doubt = entropy(found.uncertainty.probability.values).astype(np.float32) / np.float32(np.log(2))
        options = {"colormap": "inferno", "blending": "additive", "contrast_limits": (0.2, 1), "opacity": 0.6}
        put_layer(self.viewer, "image", doubt, doubt_name, **options, **place_of_layer(layer))
        self._mark_suggestions(task, found.uncertainty.suggestions)
        self.viewer.layers.selection.active = layer
        return " ".join((f"{found.status} (undo: Ctrl+Z in the labels layer).", *task.notes, *found.notes))

    def _mark_suggestions(self, task: Task, slices: Sequence[int]) -> None:
        """Frame the suggested slices in the viewer, and give each a button that goes there."""
        layer = task.layer
        frames = [_frame(layer.data.shape[-3:], task.axis, k) for k in slices]
        style = {"face_color": "transparent", "edge_color": "yellow", "edge_width": 0.5}
        if frames:
            place = place_of_layer(layer)
            put_layer(self.viewer, "shapes", frames, _names(layer)[1], shape_type="polygon", **style, **place)
        for k in slices:
            button = PushButton(text=f"slice {k}", tooltip="Go to this slice, to annotate it next.")
            button.changed.connect(partial(self._go_to, layer, task.axis, k))
            self.suggestions.append(button)

    def _go_to(self, layer: Any, axis: int, k: int) -> None:
        corner = np.zeros(layer.ndim)
        corner[layer.ndim - 3 + axis] = k
        place = layer.data_to_world(corner)
        dims = self.viewer.dims
        dims.set_point(dims.ndim - 3 + axis, place[layer.ndim - 3 + axis])


def _fill(task: Task, progress: Progress) -> Filled:
    """Fill one label, which takes no voxel of another, or several."""
    options: dict[str, Any] = {"known": task.known, "axis": task.axis, "image": task.image, "suggest": task.suggest}
    options["progress"] = progress
    values = task.field.values
    if len(task.numbers) > 1:
        found = reconstruct_labels(task.field, chosen=task.numbers, **options)
        assert found.labels is not None
        return Filled(task, values, found.labels.values, found)
    number = task.numbers[0]
    inside = replace(task.field, array=(values == number).astype(np.uint8))
    found, after = reconstruct(inside, **options), values.copy()
    after[values == number] = 0
    after[(after == 0) & found.mask.values] = number
    return Filled(task, values, after, found)


def _names(layer: Any) -> tuple[str, str]:
    """Return the names of the layers of a layer's doubt and of its suggested slices."""
    return f"doubt of {layer.name}", f"suggested slices of {layer.name}"


def _standing(fills: Sequence[Fill], values: np.ndarray) -> list[Fill]:
    """Return the fills of a layer that were not undone, given its values (Z, Y, X)."""
    alike = [fill for fill in fills if fill.shape == values.shape]
    count = len(alike)
    for k in range(len(alike) - 1, -1, -1):
        if (alike[k].before != alike[k].after).any():
            if alike[k].stands(values):
                break
            count = k
    return alike[:count]


def _remember(filled: Filled, before: np.ndarray, after: np.ndarray, fills: Sequence[Fill]) -> Fill:
    """Return a fill that changes values (Z, Y, X) from what was before; what was painted meanwhile is no part of it."""
    task, own = filled.task, index_labels(after, filled.task.numbers) > 0
    for fill in fills:
        own.flat[fill.where] = True
    own &= before == filled.before
    unknown = np.ones(after.shape[task.axis], dtype=bool)
    unknown[list(task.known)] = False
    shape = [-1 if axis == task.axis else 1 for axis in range(3)]
    where = np.flatnonzero((before != after) | (own & unknown.reshape(shape)))
    where = where.astype(np.int32 if after.size < 2**31 else np.int64)
    return Fill(task.axis, task.known, task.numbers, after.shape, where, before.flat[where], after.flat[where])


def _touched(voxels: np.ndarray, axis: int) -> list[int]:
    """Return the slices across an axis that have some of the voxels."""
    return np.flatnonzero(np.moveaxis(voxels, axis, 0).any((1, 2))).tolist()


def _parse_slices(text: str, count: int) -> tuple[list[int], bool]:
    """Return the numbers of slices in a text such as `0,9,17` or `0::8`, and whether it says `only` before them."""
    found: list[int] = []
    text = text.strip().lower()
    alone = text.startswith("only")
    try:
        for part in filter(None, text.removeprefix("only").replace(" ", "").split(",")):
            edges = [int(each) if each else None for each in part.split(":")]
            found += [edges[0]] if len(edges) == 1 else range(count)[slice(*edges)]  # type: ignore[list-item]
    except (ValueError, TypeError):
        found = [-1]
    if any(not 0 <= k < count for k in found) or len(set(found)) < (2 if alone else bool(text)):
        raise ScanError(f"expected known slices from 0 to {count - 1}, as 0,9,17 or 0::8 or only 0::8, got {text!r}")
    return sorted(set(found)), alone


def _frame(shape: tuple[int, ...], axis: int, k: int) -> np.ndarray:
    """Return the corners (4, 3) of a slice."""
    (a, b), corners = [each for each in range(3) if each != axis], np.zeros((4, 3))
    corners[:, axis] = k
    corners[[1, 2], a], corners[[2, 3], b] = shape[a] - 1, shape[b] - 1
    return corners
