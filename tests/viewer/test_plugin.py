"""The plugin in a real napari, driven by its own buttons: xvfb-run -a python -m pytest -W ignore tests/viewer."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from curvafit.segmentation.trials import dice

napari = pytest.importorskip("napari")
pytest.importorskip("qtpy.QtWidgets", exc_type=ImportError)

from qtpy.QtCore import Qt  # noqa: E402
from qtpy.QtTest import QTest  # noqa: E402
from qtpy.QtWidgets import QApplication  # noqa: E402

from curvafit.napari.complete import Complete  # noqa: E402
from curvafit.napari.generate import Generate, annotated_tubes  # noqa: E402
from curvafit.napari.layers import field_of_layer  # noqa: E402
from curvafit.napari.measure import Measure  # noqa: E402
from curvafit.volumes import ScanError  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
PLACE = {"scale": (0.5, 0.25, 0.25), "units": ("micrometer",) * 3, "translate": (10, 20, 30)}


@pytest.fixture
def viewer() -> Iterator[Any]:
    viewer = napari.Viewer(show=False)
    yield viewer
    viewer.close()


def docked(viewer: Any, kind: type) -> Any:
    widget = kind(viewer)
    viewer.window.add_dock_widget(widget)
    return widget


def wait(done: Callable[[], bool], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end
        QApplication.processEvents()
        time.sleep(0.01)


def click(button: Any) -> None:
    QTest.mouseClick(button.native, Qt.MouseButton.LeftButton)


def run(widget: Any) -> str:
    """Press the button, wait for the end, and return what the widget says."""
    click(widget.run_button)
    wait(lambda: widget.run_button.enabled)
    return widget.status.value


def rods(shape: tuple[int, int, int] = (33, 40, 44)) -> np.ndarray:
    """Two rods along z with the labels 3 and 7."""
    z, y, x = np.mgrid[: shape[0], : shape[1], : shape[2]]
    labels = np.where(np.hypot(y - 12 + 3 * np.sin(z / 6), x - 12) < 5, 3, 0)
    return np.where(np.hypot(y - 28, x - 30 + 3 * np.cos(z / 6)) < 6, 7, labels)


def sparse(every: int = 8) -> np.ndarray:
    """The rods on every so many slices."""
    some = np.zeros_like(rods())
    some[::every] = rods()[::every]
    return some


def test_labels_are_completed_and_it_can_be_undone(viewer: Any) -> None:
    truth, some = rods(), sparse()
    layer = viewer.add_labels(some.copy(), name="cells", **PLACE)
    widget = docked(viewer, Complete)
    assert "filled by the network" in run(widget)
    for label in (3, 7):
        assert dice(layer.data == label, truth == label) > 0.9
    np.testing.assert_array_equal(layer.data[::8], truth[::8])
    doubt = viewer.layers["doubt of cells"]
    np.testing.assert_allclose(doubt.scale, PLACE["scale"])
    np.testing.assert_allclose(doubt.translate, PLACE["translate"])
    assert str(doubt.units[0]) == "micrometer" and doubt.data.max() <= 1 and not doubt.data[::8].any()
    layer.undo()
    np.testing.assert_array_equal(layer.data, some)
    layer.redo()
    assert dice(layer.data == 3, truth == 3) > 0.9


def test_slices_are_suggested_and_a_button_goes_there(viewer: Any) -> None:
    truth = rods()
    some = np.zeros_like(truth)
    some[[0, 4, 8, 32]] = truth[[0, 4, 8, 32]]
    layer = viewer.add_labels(some, name="cells", **PLACE)
    layer.selected_label = 7
    widget = docked(viewer, Complete)
    widget.which.value, widget.suggest.value = "the selected label", 2
    run(widget)
    assert dice(layer.data == 7, truth == 7) > 0.8
    np.testing.assert_array_equal(layer.data == 3, some == 3)  # the other label is left alone
    frames = viewer.layers["suggested slices of cells"]
    buttons = list(widget.suggestions)
    slices = [int(button.text.split()[1]) for button in buttons]
    assert len(slices) == 2 and all(8 < k < 32 for k in slices)  # the largest gap
    assert [float(frame[0, 0]) for frame in frames.data] == slices
    click(buttons[1])
    assert viewer.dims.current_step[0] == slices[1]
    run(widget)
    assert [each.name for each in viewer.layers].count("doubt of cells") == 1  # in the place of the former


def test_empty_slices_next_in_the_rhythm_are_known_and_said(viewer: Any) -> None:
    """Labels of 64 bits on every fourth slice from 12 to 20, and three slices to draw next."""
    great, truth = 2**63 + 5, rods()
    drawn = np.isin(np.arange(33), [12, 16, 20])[:, None, None] & (truth > 0)
    some = np.where(drawn, truth.astype(np.uint64) + np.uint64(2**63), np.uint64(0))
    layer = viewer.add_labels(some.copy(), name="cells", **PLACE)
    widget = docked(viewer, Complete)
    told = run(widget)
    assert "5 of 17 slices known" in told and "Slices 8, 24" in told and "rightly empty" in told
    assert not layer.data[:9].any() and not layer.data[24:].any() and len(widget.suggestions) == 3
    assert np.array_equal(layer.data[16], some[16]) and set(np.unique(layer.data)) == {0, great - 2, great + 2}
    layer.data[14] = some[16]
    assert "6 of 17 slices known" in run(widget)


def test_a_correction_is_known_at_the_next_fill(viewer: Any) -> None:
    truth = rods()
    layer = viewer.add_labels(sparse(16), name="cells", **PLACE)
    widget = docked(viewer, Complete)
    assert "3 of 33 slices known" in run(widget)
    layer.data[8] = truth[8]
    assert "4 of 33 slices known" in run(widget)
    np.testing.assert_array_equal(layer.data[[0, 8, 16, 32]], truth[[0, 8, 16, 32]])
    layer.data[20] = truth[20]
    widget.known.value = "4"  # besides what was drawn and corrected
    assert "6 of 33 slices known" in run(widget)
    np.testing.assert_array_equal(layer.data[20], truth[20])
    widget.known.value = "only 0::16"
    assert "3 of 33 slices known" in run(widget)


def test_what_was_drawn_stays_where_other_slices_are_named(viewer: Any) -> None:
    some = sparse()
    layer = viewer.add_labels(some.copy(), name="cells", **PLACE)
    widget = docked(viewer, Complete)
    widget.known.value = "0,8,12"
    assert "6 of 33 slices known" in run(widget)
    np.testing.assert_array_equal(layer.data[::8], some[::8])
    assert not layer.data[12].any()  # named, and empty


def test_a_full_layer_is_filled_anew_between_the_slices_that_are_named_alone(viewer: Any) -> None:
    truth = rods()
    layer = viewer.add_labels(truth.copy(), name="cells")
    widget = docked(viewer, Complete)
    assert "only 0::8" in run(widget)
    widget.known.value = "only 0::8"
    assert "5 of 33 slices known" in run(widget)
    np.testing.assert_array_equal(layer.data[::8], truth[::8])


def test_one_label_after_all_of_them_is_filled_from_what_was_drawn(viewer: Any) -> None:
    layer = viewer.add_labels(sparse(), name="cells", **PLACE)
    widget = docked(viewer, Complete)
    run(widget)
    widget.which.value = "the selected label"
    for label in (3, 7):
        layer.selected_label = label
        assert "5 of 33 slices known" in run(widget)


def test_after_undo_other_drawings_count(viewer: Any) -> None:
    truth = rods()
    layer = viewer.add_labels(sparse(16), name="cells", **PLACE)
    widget = docked(viewer, Complete)
    run(widget)
    layer.undo()
    layer.data[24] = truth[24]
    assert "4 of 33 slices known" in run(widget)
    layer.undo()
    assert "4 of 33 slices known" in run(widget)


def test_undo_reaches_through_a_fill_that_changed_nothing(viewer: Any) -> None:
    layer = viewer.add_labels(sparse(), name="cells", **PLACE)
    widget = docked(viewer, Complete)
    run(widget)
    done = layer.data.copy()
    run(widget)
    np.testing.assert_array_equal(layer.data, done)
    layer.undo()
    assert "5 of 33 slices known" in run(widget)


def test_redo_is_no_drawing(viewer: Any) -> None:
    layer = viewer.add_labels(sparse(), name="cells", **PLACE)
    widget = docked(viewer, Complete)
    run(widget)
    layer.undo()
    widget.known.value = "99"
    assert "known slices" in run(widget)
    layer.redo()
    widget.known.value = ""
    assert "5 of 33 slices known" in run(widget)


def test_what_only_left_out_is_not_known_later(viewer: Any) -> None:
    truth = rods()
    layer = viewer.add_labels(sparse(), name="cells", **PLACE)
    widget = docked(viewer, Complete)
    run(widget)
    layer.data[4] = truth[4]
    assert "6 of 33 slices known" in run(widget)
    widget.known.value = "only 0::16"
    run(widget)
    widget.known.value = ""
    assert "3 of 33 slices known" in run(widget)


def test_a_small_correction_of_a_small_fill_is_one(viewer: Any) -> None:
    layer = viewer.add_labels(sparse(16), name="cells", **PLACE)
    widget = docked(viewer, Complete)
    run(widget)
    before = layer.data.copy()
    layer.data[8] = rods()[8]
    run(widget)
    layer.data[9] = before[9]  # as it was, and nothing else
    assert "5 of 33 slices known" in run(widget)


def test_other_data_forget_what_was_filled(viewer: Any) -> None:
    layer = viewer.add_labels(sparse(), name="cells")
    widget = docked(viewer, Complete)
    run(widget)
    layer.data = sparse(4)
    assert "9 of 33 slices known" in run(widget)
    layer.data = sparse(16)[:17]
    assert "2 of 17 slices known" in run(widget)


def test_the_label_that_was_filled_is_the_one_to_correct_with(viewer: Any) -> None:
    layer = viewer.add_labels(np.where(sparse() == 3, 255, 0), name="cells")
    layer.selected_label = 1
    run(docked(viewer, Complete))
    assert layer.selected_label == 255


def test_what_is_painted_meanwhile_stays(viewer: Any) -> None:
    truth = rods()
    layer = viewer.add_labels(sparse(), name="cells", **PLACE)
    widget = docked(viewer, Complete)
    click(widget.run_button)
    layer.data[3, :4, :4] = 7
    wait(lambda: widget.run_button.enabled)
    assert (layer.data[3, :4, :4] == 7).all() and dice(layer.data == 3, truth == 3) > 0.9
    click(widget.run_button)
    viewer.layers.remove(layer)
    wait(lambda: widget.run_button.enabled)
    assert "gone" in widget.status.value and layer not in viewer.layers


def test_labels_on_slices_of_their_own_are_filled_one_after_the_other(viewer: Any) -> None:
    truth, some = rods(), np.zeros_like(rods())
    some[::8] = np.where(truth[::8] == 3, 3, 0)
    some[4::8] = np.where(truth[4::8] == 7, 7, 0)
    layer = viewer.add_labels(some, name="cells", **PLACE)
    widget = docked(viewer, Complete)
    for text in ("", "16"):
        widget.known.value = text
        assert "one after the other" in run(widget)
    widget.known.value = ""
    widget.which.value = "the selected label"
    for label in (3, 7):
        layer.selected_label = label
        run(widget)
    assert dice(layer.data == 3, truth == 3) > 0.9 and dice(layer.data == 7, truth == 7) > 0.85
    layer.selected_label = 3
    layer.data[20] = np.where(truth[20] == 3, 3, np.where(layer.data[20] == 3, 0, layer.data[20]))
    assert "6 of 33 slices known" in run(widget)  # five drawn, and the corrected one


def test_an_image_and_another_axis(viewer: Any) -> None:
    truth = np.moveaxis(rods(), 0, 2)
    some = np.zeros_like(truth)
    some[:, :, ::8] = truth[:, :, ::8]
    place = {"scale": (0.25, 0.25, 0.5), "units": ("micrometer",) * 3}
    grey = (60 + 80 * (truth > 0) + 15 * np.random.default_rng(0).standard_normal(truth.shape)).astype(np.float32)
    viewer.add_image(grey, name="scan", **place)
    layer = viewer.add_labels(some, name="cells", **place)
    widget = docked(viewer, Complete)
    widget.image.value, widget.axis.value, widget.known.value = viewer.layers["scan"], "x", "0::8"
    assert "image" in run(widget)
    assert dice(layer.data > 0, truth > 0) > 0.93


def test_work_stops_where_it_is_told_to(viewer: Any) -> None:
    widget = docked(viewer, Generate)
    widget.edge.value, widget.steps.value = 64, 20000
    click(widget.run_button)
    assert not widget.run_button.enabled
    wait(lambda: "Growing" in widget.status.value)
    click(widget.stop_button)
    wait(lambda: widget.run_button.enabled, 30)
    assert widget.status.value == "Stopped." and not len(viewer.layers)


def test_a_texture_is_grown_at_its_scale_and_measured(viewer: Any, tmp_path: Any) -> None:
    widget = docked(viewer, Generate)
    widget.edge.value, widget.steps.value, widget.spacing.value, widget.unit.value = 40, 300, 0.5, "um"
    widget.phase.value = True
    run(widget)
    layer = viewer.layers["tubes, seed 0"]
    field = field_of_layer(layer)
    assert field.shape == (40, 40, 40) and field.spacing == (0.5,) * 3 and field.unit == "um"
    assert np.array_equal(viewer.layers["phase field of tubes, seed 0"].data > 0, layer.data > 0)
    gauge = docked(viewer, Measure)
    gauge.layer.value, gauge.file.value = layer, tmp_path / "tubes.csv"
    assert "tubes.csv written" in run(gauge)
    rows = dict(zip(gauge.table.row_headers, gauge.table.data.to_list(), strict=True))
    assert 3 < float(rows["Tb.Th (µm)"][0]) < 7 and gauge.canvas is not None
    assert "thickness" in (tmp_path / "tubes.csv").read_text()
    gauge.file.value = tmp_path / "mine.csv"
    gauge.file.value.write_text("mine")
    assert "not free" in run(gauge) and gauge.file.value.read_text() == "mine"


def test_each_label_has_its_row_and_its_numbers_beneath_the_mouse(viewer: Any) -> None:
    layer = viewer.add_labels(rods(), name="cells", **PLACE)
    gauge = docked(viewer, Measure)
    run(gauge)
    assert [int(each) for each in gauge.table.row_headers] == [3, 7] and [each.part[1] for each in gauge.measures] == [
        3,
        7,
    ]
    voxels = layer.features.set_index("index")["V (µm³)"] / (0.5 * 0.25 * 0.25)
    assert voxels.to_dict() == pytest.approx({k: np.count_nonzero(rods() == k) for k in (3, 7)})


@pytest.mark.parametrize(
    ("data", "options", "words"),
    [
        (np.ones((8, 8), int), {}, "three axes"),
        (np.ones((3, 8, 8, 8), int), {}, "three axes"),
        (np.zeros((8, 8, 8), int), {}, "slices with labels"),
        (np.ones((8, 8, 8), int), {"units": ("pixel", "micrometer", "micrometer")}, "kind of unit"),
        (np.ones((8, 8, 8), int), {"units": ("second",) * 3}, "unit second"),
        (np.ones((8, 8, 8), int), {}, "slice without labels lies between"),
    ],
)
def test_what_is_no_volume_is_said_in_a_sentence(viewer: Any, data: np.ndarray, options: dict, words: str) -> None:
    viewer.add_labels(data, name="cells", **options)
    widget = docked(viewer, Complete)
    assert words in run(widget) and len(viewer.layers) == 1


def test_layers_that_cannot_be_edited_or_measured_are_said(viewer: Any) -> None:
    from dask.array import from_array

    viewer.add_labels(from_array(sparse()), name="cells")
    assert "no NumPy array" in run(docked(viewer, Complete))
    gauge = docked(viewer, Measure)
    assert "complete the layer first" in run(gauge)
    viewer.layers.clear()
    image = viewer.add_image(np.where(rods() == 3, np.nan, 1.0), name="scan")
    gauge.reset_choices()
    gauge.layer.value = image
    assert "not" in run(gauge) and "finite" in gauge.status.value


@pytest.mark.parametrize("text", ["a", "0,99", "1:2:3:4", "-1", "5:2", "only", "only 3", "0::8 only", "8,only 16"])
def test_slices_that_are_none_are_said(viewer: Any, text: str) -> None:
    viewer.add_labels(rods(), name="cells")
    widget = docked(viewer, Complete)
    widget.known.value = text
    assert "known slices" in run(widget)


def test_no_layer_is_said(viewer: Any) -> None:
    for kind in (Complete, Measure):
        assert "got none" in run(docked(viewer, kind))


def test_colours_and_other_units() -> None:
    from napari.layers import Image

    with pytest.raises(ScanError, match="colours"):
        field_of_layer(Image(np.zeros((8, 8, 8, 3), np.uint8), rgb=True))
    field = field_of_layer(Image(np.zeros((1, 8, 9, 10)), scale=(1, 2, 300, 300), units=("s", "um", "nm", "nm")))
    assert field.shape == (8, 9, 10) and field.unit == "nm" and field.spacing == pytest.approx((2000, 300, 300))


def test_the_manifest_names_what_is_there(viewer: Any) -> None:
    from npe2 import PluginManager

    manager = PluginManager.instance()
    manager.discover()
    names = {each.display_name for each in manager.get_manifest("curvafit").contributions.widgets}
    assert names == {"Complete", "Measure", "Generate"}
    for name in names:
        viewer.window.add_plugin_dock_widget("curvafit", name)
    viewer.open_sample("curvafit", "tubes")
    assert [each.name for each in viewer.layers] == ["tubes", "every 8th slice", "all of them"]
    assert annotated_tubes()[1][0][1].sum() == 0
