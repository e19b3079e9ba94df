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
from curvafit.segmentation.slices import LABELS, index_labels, require_labels
from curvafit.segmentation.uncertainty import entropy
from curvafit.volumes.volume import ScanError, Volume

_ALL, _ONE = "all labels", "the selected label"


@dataclass(frozen=True)
class Task:
    """A labels layer to fill: its values, the labels, the axis across its slices, the known slices, and options."""

    layer: Any
    field: Volume
    labels: Sequence[int]
    axis: int
    known: Sequence[int]
    notes: Sequence[str]
    image: Volume | None
    suggest: int


@dataclass(frozen=True)
class Filled:
    """The result of a task: the layer's values (Z, Y, X) before and after, and the segmentation they come from."""

    task: Task
    before: np.ndarray
    after: np.ndarray
    segmentation: Segmentation


@dataclass(frozen=True, eq=False)
class Fill:
    """The record of a fill: its labels, the slices known then, and the values of the filled voxels before and after.
    These are voxels that changed and, outside the known slices, those of the labels and of earlier fills; `indices` are
    flat, in values of `shape`."""

    axis: int
    known: Sequence[int]
    labels: Sequence[int]
    shape: tuple[int, ...]
    indices: np.ndarray
    before: np.ndarray
    after: np.ndarray

    def is_applied(self, values: np.ndarray) -> bool:
        """Return whether the fill was not undone: at least as many slices are as it left them as are as before it."""
        changed = self.before != self.after
        indices, count = self.indices[changed], self.shape[self.axis]
        slices = np.unravel_index(indices, self.shape)[self.axis]
        voxels = np.bincount(slices, minlength=count)

        def count_equal(state: np.ndarray) -> int:
            equal = np.bincount(slices[values.flat[indices] == state[changed]], minlength=count)
            return int(np.count_nonzero((voxels > 0) & (equal == voxels)))

        return 0 < count_equal(self.after) >= count_equal(self.before)


class Complete(Dock):
    """Fill a labels layer between annotated slices; it can be undone."""

    def __init__(self, napari_viewer: Any) -> None:
        self.annotated = create_widget(label="labels", annotation="napari.layers.Labels")
        self.image = ComboBox(label="image", choices=lambda _: list_layers(napari_viewer, "Image"), nullable=True)
        self.which = ComboBox(label="fill", choices=[_ALL, _ONE], value=_ALL)
        self.axis = ComboBox(label="across", choices=["z", "y", "x"], value="z", tooltip="The axis across the slices.")
        tooltip = "Besides those that you drew on: 0,9,17, or every 8th from 0: 0::8. No others: only 0::8."
        self.known = LineEdit(label="known slices", tooltip=tooltip)
        self.suggest = SpinBox(label="suggest", value=3, min=0, max=20, tooltip="Slices to annotate next.")
        self.suggestions = Container(widgets=[], layout="horizontal", labels=False)
        choices = [self.annotated, self.image, self.which, self.axis, self.known, self.suggest]
        super().__init__(napari_viewer, choices, "Fill")
        self.append(self.suggestions)
        #: The fills of each layer that were not undone: what they wrote does not count as drawn by the user.
        self.fills: WeakKeyDictionary[Any, list[Fill]] = WeakKeyDictionary()

    def prepare(self) -> Callable[[Progress], Filled]:
        """Read the choices, and return the function that fills the layer; raise ScanError where that cannot be done."""
        self.suggestions.clear()
        layer, axis = self.annotated.value, "zyx".index(self.axis.value)
        field = field_of_layer(layer, "a labels layer")
        if layer.multiscale or not isinstance(layer.data, np.ndarray):
            raise ScanError(f"expected labels that can be edited, got {layer.name}, which is no NumPy array")
        field = replace(field, array=np.array(field.values))  # a copy, as the user may paint meanwhile
        values, one = np.moveaxis(field.values, axis, 0), self.which.value == _ONE
        labels = [int(layer.selected_label)] if one else np.unique(values[values != 0]).tolist()
        # One label is filled by itself: then it does not matter how many others the layer has.
        require_labels(values, f"the labels layer {layer.name}", math.inf if one else LABELS)
        if not index_labels(values, labels).any():
            content = f"voxels of label {labels[0]}" if one else "labels"
            raise ScanError(f"expected slices with {content} in {layer.name}, got none")
        known, empty = self._list_known(layer, axis, field.values, labels)
        image = None if self.image.value is None else field_of_layer(self.image.value)
        suggest = min(self.suggest.value, len(values) - len(known))
        return partial(_fill, Task(layer, field, labels, axis, known, note_empty(empty), image, suggest))

    def _list_known(self, layer: Any, axis: int, values: np.ndarray, labels: list[int]) -> tuple[list[int], list[int]]:
        """Return the known slices, and those of them that are taken for empty.

        Known are the slices that are named and, without `only`, those that were drawn on or known to the last fill. If
        there are no named ones and no fill, the slices before and after an even rhythm of drawn ones count as empty.
        """
        name = layer.name
        named, only_named = _parse_slices(self.known.value, values.shape[axis])
        if only_named:
            return named, []
        fills = _list_applied(self.fills.get(layer, []), values)
        expected, filled = values.copy(), np.zeros(values.shape, dtype=bool)
        for fill in fills:
            expected.flat[fill.indices] = fill.after
            filled.flat[fill.indices] = True
        # What a fill wrote is not drawn, unless it was corrected since.
        corrected = (values != expected) & ((index_labels(values, labels) | index_labels(expected, labels)) > 0)
        drawn = np.where(filled & (values == expected), 0, values)
        known = {*named, *_slices_with(corrected, axis), *_slices_with(index_labels(drawn, labels) > 0, axis)}
        earlier = (fill.known for fill in reversed(fills) if fill.axis == axis and set(labels) <= set(fill.labels))
        last_known = next(earlier, ())
        slices = sorted(known.union(last_known))
        if len(slices) < 2:
            raise ScanError(f"expected two or more slices with labels in {name}, got {len(slices)}")
        if np.diff(slices).max() == 1:
            raise ScanError(f"no slice without labels lies between those of {name}: name those to keep, as only 0::8")
        if len(labels) > 1 and (shared := [k for k in slices if k not in named]):
            drawn = np.moveaxis(drawn, axis, 0)
            changed = _slices_with(corrected, axis)
            drawn[changed] = np.moveaxis(values, axis, 0)[changed]
            check_shared(drawn, shared, labels)
        empty = [] if named or last_known else next_in_rhythm(slices, values.shape[axis])
        return sorted([*slices, *empty]), empty

    def show_result(self, result: Filled) -> str:
        """Write the labels as one step to undo, show the uncertainty as a layer, and the slices to annotate next."""
        task, segmentation = result.task, result.segmentation
        layer, (doubt_name, frames_name) = task.layer, _names(task.layer)
        if layer not in self.viewer.layers or layer.data.shape[-3:] != result.after.shape:
            return "The layer that was filled is gone."
        for name in (doubt_name, frames_name):
            drop_layer(self.viewer, name)
        current = layer.data.reshape(result.after.shape)
        after = np.where(current == result.before, result.after, current)  # what was painted meanwhile stays
        fills = _list_applied(self.fills.get(layer, []), result.before)
        self.fills[layer] = [*fills, _remember(result, current, after, fills)]
        new = after.astype(layer.data.dtype).reshape(layer.data.shape)
        changed = np.nonzero(new != layer.data)
        if len(changed[0]):
            layer.data_setitem(changed, new[changed])  # which napari can undo as one step
        if layer.selected_label not in task.labels:
            layer.selected_label = task.labels[0]  # the one to correct with
        assert segmentation.uncertainty is not None
        doubt = entropy(segmentation.uncertainty.probability.values).astype(np.float32) / np.float32(np.log(2))
        options = {"colormap": "inferno", "blending": "additive", "contrast_limits": (0.2, 1), "opacity": 0.6}
        put_layer(self.viewer, "image", doubt, doubt_name, **options, **place_of_layer(layer))
        self._mark_suggestions(task, segmentation.uncertainty.suggestions)
        self.viewer.layers.selection.active = layer
        status = f"{segmentation.status} (undo: Ctrl+Z in the labels layer)."
        return " ".join((status, *task.notes, *segmentation.notes))

    def _mark_suggestions(self, task: Task, slices: Sequence[int]) -> None:
        """Frame the suggested slices in the viewer, and give each a button that goes there."""
        layer = task.layer
        frames = [_frame(layer.data.shape[-3:], task.axis, k) for k in slices]
        style = {"shape_type": "polygon", "face_color": "transparent", "edge_color": "yellow", "edge_width": 0.5}
        if frames:
            put_layer(self.viewer, "shapes", frames, _names(layer)[1], **style, **place_of_layer(layer))
        for k in slices:
            button = PushButton(text=f"slice {k}", tooltip="Go to this slice, to annotate it next.")
            button.changed.connect(partial(self._go_to, layer, task.axis, k))
            self.suggestions.append(button)

    def _go_to(self, layer: Any, axis: int, k: int) -> None:
        corner = np.zeros(layer.ndim)
        corner[layer.ndim - 3 + axis] = k
        position = layer.data_to_world(corner)
        dims = self.viewer.dims
        dims.set_point(dims.ndim - 3 + axis, position[layer.ndim - 3 + axis])


def _fill(task: Task, progress: Progress) -> Filled:
    """Fill several labels together, or one, which takes no voxel of another."""
    options: dict[str, Any] = {"known": task.known, "axis": task.axis, "image": task.image, "suggest": task.suggest}
    options["progress"] = progress
    values = task.field.values
    if len(task.labels) > 1:
        segmentation = reconstruct_labels(task.field, chosen=task.labels, **options)
        assert segmentation.labels is not None
        return Filled(task, values, segmentation.labels.values, segmentation)
    label = task.labels[0]
    segmentation = reconstruct(replace(task.field, array=(values == label).astype(np.uint8)), **options)
    after = values.copy()
    after[values == label] = 0
    after[(after == 0) & segmentation.mask.values] = label
    return Filled(task, values, after, segmentation)


def _names(layer: Any) -> tuple[str, str]:
    """Return the names of the two layers that belong to a labels layer: its uncertainty and its suggested slices."""
    return f"doubt of {layer.name}", f"suggested slices of {layer.name}"


def _list_applied(fills: Sequence[Fill], values: np.ndarray) -> list[Fill]:
    """Return the fills of a layer that were not undone, given its values (Z, Y, X)."""
    fills = [fill for fill in fills if fill.shape == values.shape]
    count = len(fills)
    # The last fill is undone first: before one that is applied, all are. One that changed nothing gives no evidence.
    for k in reversed(range(len(fills))):
        if (fills[k].before != fills[k].after).any():
            if fills[k].is_applied(values):
                break
            count = k
    return fills[:count]


def _remember(filled: Filled, before: np.ndarray, after: np.ndarray, fills: Sequence[Fill]) -> Fill:
    """Return the record of a fill that changes values (Z, Y, X) from `before` to `after`, without what users paint.

    Voxels that it leaves as they are belong to it too, where it or an earlier fill labels them, unless a user painted
    them while it was computed: then they differ from `filled.before`.
    """
    task = filled.task
    labelled = index_labels(after, task.labels) > 0
    for fill in fills:
        labelled.flat[fill.indices] = True
    labelled &= before == filled.before
    unknown = np.ones(after.shape[task.axis], dtype=bool)
    unknown[list(task.known)] = False
    shape = [-1 if axis == task.axis else 1 for axis in range(3)]
    indices = np.flatnonzero((before != after) | (labelled & unknown.reshape(shape)))
    indices = indices.astype(np.int32 if after.size < 2**31 else np.int64)
    return Fill(task.axis, task.known, task.labels, after.shape, indices, before.flat[indices], after.flat[indices])


def _slices_with(voxels: np.ndarray, axis: int) -> list[int]:
    """Return the indices of the slices across an axis in which some of the voxels (Z, Y, X) are true."""
    return np.flatnonzero(np.moveaxis(voxels, axis, 0).any((1, 2))).tolist()


def _parse_slices(text: str, count: int) -> tuple[list[int], bool]:
    """Return the slices in a text such as `0,9,17` or `0::8`, and whether it starts with `only`."""
    slices: list[int] = []
    text = text.strip().lower()
    only = text.startswith("only")
    try:
        for item in filter(None, text.removeprefix("only").replace(" ", "").split(",")):
            bounds = [int(bound) if bound else None for bound in item.split(":")]
            slices += [bounds[0]] if len(bounds) == 1 else range(count)[slice(*bounds)]  # type: ignore[list-item]
    except (ValueError, TypeError):
        slices = [-1]  # which is refused below
    if any(not 0 <= k < count for k in slices) or len(set(slices)) < (2 if only else bool(text)):
        raise ScanError(f"expected known slices from 0 to {count - 1}, as 0,9,17 or 0::8 or only 0::8, got {text!r}")
    return sorted(set(slices)), only


def _frame(shape: tuple[int, ...], axis: int, k: int) -> np.ndarray:
    """Return the corners (4, 3) of a slice."""
    a, b = (other for other in range(3) if other != axis)
    corners = np.zeros((4, 3))
    corners[:, axis] = k
    corners[[1, 2], a], corners[[2, 3], b] = shape[a] - 1, shape[b] - 1
    return corners
