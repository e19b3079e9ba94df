"""The middle slices that a Field, a Segmentation and a mask's picture show."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from curvafit import Field, segment
from curvafit.drawing.plot import section_figure

VALUES = np.arange(5 * 6 * 7, dtype=np.float32).reshape(5, 6, 7)


def images(figure: Figure) -> list[np.ndarray]:
    """What the axes show, in their order."""
    return [np.asarray(axes.images[0].get_array()) for axes in figure.axes]


def test_the_three_middle_slices_are_drawn_in_proportion() -> None:
    figure = Field(VALUES, (3.0, 2.0, 1.0), "um").plot()
    for shown, plane in zip(images(figure), (VALUES[2], VALUES[:, 3], VALUES[:, :, 3]), strict=True):
        assert np.array_equal(shown, plane)
    assert [axes.get_aspect() for axes in figure.axes] == [2.0, 3.0, 1.5]
    assert [axes.get_title()[:5] for axes in figure.axes] == ["z = 2", "y = 3", "x = 3"]


def test_a_segmentation_shows_its_outline() -> None:
    scan = np.where(np.indices((8, 9, 10)).sum(0) > 12, 1.0, 0.0).astype(np.float32)
    found = segment(scan, "tubes", steps=2)
    figure = found.plot()
    assert np.array_equal(images(figure)[0], found.phase.values[4])
    assert all(len(axes.collections) == 1 for axes in figure.axes)
    assert "<img" in found._repr_html_()


def test_each_row_has_its_values_and_its_outline() -> None:
    figure = section_figure({"one": (VALUES, None), "two": (VALUES, VALUES > 100)}, (1, 1, 1), "um")
    assert [figure.axes[k].get_ylabel() for k in (0, 3)] == ["one", "two"]
    assert [text.get_text() for text in figure.axes[3].texts] == ["2\xa0µm"]
    assert [len(axes.collections) for axes in figure.axes[:3]] == [0, 0, 0]
    assert sum(len(axes.collections) for axes in figure.axes[3:]) >= 1
