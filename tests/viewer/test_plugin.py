"""The plugin in a real napari, driven by its own buttons: xvfb-run -a python -m pytest -W ignore tests/viewer."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from curvafit.core.runtime import Progress
from curvafit.segmentation.trials import dice

napari = pytest.importorskip("napari")
pytest.importorskip("qtpy.QtWidgets", exc_type=ImportError)

from qtpy.QtCore import Qt  # noqa: E402
from qtpy.QtTest import QTest  # noqa: E402
from qtpy.QtWidgets import QApplication  # noqa: E402

from curvafit.napari.complete import Complete  # noqa: E402
from curvafit.napari.widgets import Dock, Measure, annotated_tubes, field_of_layer  # noqa: E402
from curvafit.volumes import ScanError  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
PLACE = {"scale": (0.5, 0.25, 0.25), "units": ("micrometer",) * 3, "translate": (10, 20, 30)}
Z, Y, X = np.mgrid[:33, :40, :44]
#: Two rods along z with the labels 3 and 7.
RODS = np.where(np.hypot(Y - 12 + 3 * np.sin(Z / 6), X - 12) < 5, 3, 0)
RODS = np.where(np.hypot(Y - 28, X - 30 + 3 * np.cos(Z / 6)) < 6, 7, RODS)


@pytest.fixture
def viewer() -> Iterator[Any]:
    viewer = napari.Viewer(show=False)
    yield viewer
    viewer.close()


def docked(viewer: Any, kind: type) -> Any:
    widget = kind(viewer)
    viewer.window.add_dock_widget(widget)
    return widget


def completing(viewer: Any, labels: np.ndarray) -> tuple[Any, Any]:
    """A layer of labels and the widget that completes it."""
    layer = viewer.add_labels(labels.copy(), name="cells", **PLACE)
    return layer, docked(viewer, Complete)


def wait(done: Callable[[], bool], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end
        QApplication.processEvents()
        time.sleep(0.01)


def click(button: Any) -> None:
    QTest.mouseClick(button.native, Qt.MouseButton.LeftButton)


def run(widget: Any, known: str | None = None) -> str:
    """Press the button, wait for the end, and return what the widget says."""
    if known is not None:
        widget.known.value = known
    click(widget.run_button)
    wait(lambda: widget.run_button.enabled)
    return widget.status.value


def sparse(every: int | list[int] = 8, labels: np.ndarray = RODS) -> np.ndarray:
    """Labels on every so many slices, or on those that are listed."""
    slices = slice(None, None, every) if isinstance(every, int) else every
    some = np.zeros_like(labels)
    some[slices] = labels[slices]
    return some


def test_labels_are_completed_in_a_layer_of_their_own(viewer: Any) -> None:
    some = sparse()
    layer, widget = completing(viewer, some)
    assert "filled by the network" in run(widget)
    np.testing.assert_array_equal(layer.data, some)
    filled, doubt = viewer.layers["filled cells"], viewer.layers["doubt of cells"]
    for label in (3, 7):
        assert dice(filled.data == label, label == RODS) > 0.9
    np.testing.assert_array_equal(filled.data[::8], RODS[::8])
    for each in (filled, doubt):
        np.testing.assert_allclose((each.scale, each.translate), (PLACE["scale"], PLACE["translate"]))
        assert str(each.units[0]) == "micrometer"
    assert doubt.data.max() <= 1 and not doubt.data[::8].any()
    run(widget)
    names = [each.name for each in viewer.layers]
    assert sorted(names) == ["cells", "doubt of cells", "filled cells", "suggested slices of cells"]  # the latest alone


def test_slices_are_suggested_and_a_button_goes_there_with_what_was_filled(viewer: Any) -> None:
    some = sparse([0, 4, 8, 32])
    layer, widget = completing(viewer, some)
    widget.suggest.value = 2
    run(widget)
    buttons, filled = list(widget.suggestions), viewer.layers["filled cells"].data.copy()
    slices = [int(button.text.split()[1]) for button in buttons]
    assert len(slices) == 2 and all(8 < k < 32 for k in slices)  # the largest gap
    assert [float(frame[0, 0]) for frame in viewer.layers["suggested slices of cells"].data] == slices
    click(buttons[1])
    assert viewer.dims.current_step[0] == slices[1]
    np.testing.assert_array_equal(layer.data[slices[1]], filled[slices[1]])
    layer.undo()
    np.testing.assert_array_equal(layer.data, some)
    layer.data[slices[0]] = RODS[slices[0]]
    click(buttons[0])
    np.testing.assert_array_equal(layer.data[slices[0]], RODS[slices[0]])  # what is drawn stays
    assert "5 of 33 slices known" in run(widget)


def test_empty_slices_next_in_the_rhythm_are_known_and_said(viewer: Any) -> None:
    """Labels of 64 bits on every fourth slice from 12 to 20, and three slices to draw next."""
    great = 2**63 + 5
    wide = np.where(RODS > 0, RODS.astype(np.uint64) + np.uint64(2**63), np.uint64(0))
    some = sparse([12, 16, 20], wide)
    _, widget = completing(viewer, some)
    told, filled = run(widget), viewer.layers["filled cells"].data
    assert "5 of 17 slices known" in told and "8, 24" in told and "rightly empty" in told
    assert not filled[:9].any() and not filled[24:].any() and len(widget.suggestions) == 3
    assert np.array_equal(filled[16], some[16]) and set(np.unique(filled)) == {0, great - 2, great + 2}


def test_slices_that_are_named_are_known_alone(viewer: Any) -> None:
    layer, widget = completing(viewer, RODS)
    assert "3 of 33 slices known" in run(widget, "0::16")
    assert "5 of 33 slices known" in run(widget, "0, 8,16:33:8")
    np.testing.assert_array_equal(layer.data, RODS)
    assert dice(viewer.layers["filled cells"].data == 3, RODS == 3) > 0.9


def test_a_layer_that_is_removed_meanwhile_is_said(viewer: Any) -> None:
    layer, widget = completing(viewer, sparse())
    click(widget.run_button)
    viewer.layers.remove(layer)
    wait(lambda: widget.run_button.enabled)
    assert "gone" in widget.status.value and not len(viewer.layers)


class Endless(Dock):
    """A widget whose work ends only where it is stopped."""

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer, [], "Begin")

    def prepare(self) -> Callable[[Progress], None]:
        def work(progress: Progress) -> None:
            while True:
                progress("working", 0.5)
                time.sleep(0.01)

        return work

    def show_result(self, result: None) -> str:
        return "Done."


def test_work_ends_where_it_is_stopped(viewer: Any) -> None:
    widget = docked(viewer, Endless)
    click(widget.run_button)
    assert not widget.run_button.enabled
    wait(lambda: "Working" in widget.status.value)
    click(widget.stop_button)
    wait(lambda: widget.run_button.enabled, 30)
    assert widget.status.value == "Stopped."


def test_labels_on_slices_of_their_own_are_filled_one_after_the_other(viewer: Any) -> None:
    some = sparse(8, np.where(RODS == 3, 3, 0))
    some[4::8] = np.where(RODS[4::8] == 7, 7, 0)
    layer, widget = completing(viewer, some)
    assert "one after the other" in run(widget)
    widget.which.value = "the selected label"
    for label, least in ((3, 0.9), (7, 0.85)):
        layer.selected_label = label
        run(widget)
        filled = viewer.layers[f"filled cells, label {label}"].data
        assert dice(filled == label, label == RODS) > least and set(np.unique(filled)) == {0, label}
    layer.selected_label = 5
    assert "label 5" in run(widget)


def test_an_image_and_another_axis(viewer: Any) -> None:
    truth, some = (np.moveaxis(each, 0, 2) for each in (RODS, sparse()))
    place = {"scale": (0.25, 0.25, 0.5), "units": ("micrometer",) * 3}
    grey = (60 + 80 * (truth > 0) + 15 * np.random.default_rng(0).standard_normal(truth.shape)).astype(np.float32)
    viewer.add_image(grey, name="scan", **place)
    viewer.add_labels(some, name="cells", **place)
    widget = docked(viewer, Complete)
    widget.image.value, widget.axis.value = viewer.layers["scan"], "x"
    assert "image" in run(widget, "0::8")
    assert dice(viewer.layers["filled cells"].data > 0, truth > 0) > 0.93


def test_a_structure_is_measured_at_its_scale(viewer: Any, tmp_path: Any) -> None:
    """And each label has its row, and its numbers beneath the mouse."""
    layer = viewer.add_labels((RODS == 3).astype(np.uint8), name="rod", scale=(0.5,) * 3, units=("micrometer",) * 3)
    field = field_of_layer(layer)
    assert field.shape == RODS.shape and field.spacing == (0.5,) * 3 and field.unit == "um"
    gauge = docked(viewer, Measure)
    gauge.layer.value, gauge.file.value = layer, tmp_path / "rod.csv"
    assert "rod.csv written" in run(gauge)
    rows = dict(zip(gauge.table.row_headers, gauge.table.data.to_list(), strict=True))
    assert 4 < float(rows["Tb.Th (µm)"][0]) < 6 and gauge.canvas is not None
    assert "thickness" in (tmp_path / "rod.csv").read_text()
    gauge.file.value = tmp_path / "mine.csv"
    gauge.file.value.write_text("mine")
    assert "not free" in run(gauge) and gauge.file.value.read_text() == "mine"
    layer, gauge = viewer.add_labels(RODS, name="cells", **PLACE), docked(viewer, Measure)
    run(gauge)
    assert [int(each) for each in gauge.table.row_headers] == [each.part[1] for each in gauge.measures] == [3, 7]
    voxels = layer.features.set_index("index")["V (µm³)"] / (0.5 * 0.25 * 0.25)
    assert voxels.to_dict() == pytest.approx({k: np.count_nonzero(k == RODS) for k in (3, 7)})


ONES = np.ones((8, 8, 8), int)


@pytest.mark.parametrize(
    ("data", "options", "known", "words"),
    [
        (ONES[0], {}, "", "three axes"), (np.ones((3, 8, 8, 8), int), {}, "", "three axes"),
        (0 * ONES, {}, "", "slices must have labels"),
        (ONES, {"units": ("pixel", "micrometer", "micrometer")}, "", "kind of unit"),
        (ONES, {"units": ("second",) * 3}, "", "unit second"), (ONES, {}, "", "slice without labels lies between"),
        (None, {}, "", "got none"),
        *((RODS, {}, text, "known slices") for text in ("a", "0,99", "1:2:3:4", "-1")),
        *((RODS, {}, text, "must be known") for text in ("5:2", "8", ",")),
    ],
)  # fmt: skip
def test_what_cannot_be_completed_is_said_in_a_sentence(viewer: Any, data, options, known, words) -> None:
    if data is not None:
        viewer.add_labels(data, name="cells", **options)
    assert words in run(docked(viewer, Complete), known) and len(viewer.layers) == (data is not None)


def test_layers_that_cannot_be_edited_or_measured_are_said(viewer: Any) -> None:
    from dask.array import from_array
    from napari.layers import Image

    gauge = docked(viewer, Measure)
    assert "got none" in run(gauge)
    viewer.add_labels(from_array(sparse()), name="cells")
    assert "no NumPy array" in run(docked(viewer, Complete))
    assert "complete the layer first" in run(gauge)
    viewer.layers.clear()
    image = viewer.add_image(np.where(RODS == 3, np.nan, 1.0), name="scan")
    gauge.reset_choices()
    gauge.layer.value = image
    assert "not" in run(gauge) and "finite" in gauge.status.value
    with pytest.raises(ScanError, match="colours"):
        field_of_layer(Image(np.zeros((8, 8, 8, 3), np.uint8), rgb=True))
    field = field_of_layer(Image(np.zeros((1, 8, 9, 10)), scale=(1, 2, 300, 300), units=("s", "um", "nm", "nm")))
    assert field.shape == (8, 9, 10) and field.unit == "nm" and field.spacing == pytest.approx((2000, 300, 300))


def test_the_manifest_names_what_is_there(viewer: Any) -> None:
    from npe2 import PluginManager

    manager = PluginManager.instance()
    manager.discover()
    names = {each.display_name for each in manager.get_manifest("curvafit").contributions.widgets}
    assert names == {"Complete", "Measure"}
    for name in names:
        viewer.window.add_plugin_dock_widget("curvafit", name)
    viewer.open_sample("curvafit", "tubes")
    assert [each.name for each in viewer.layers] == ["tubes", "every 8th slice", "all of them"]
    assert annotated_tubes()[1][0][1].sum() == 0
