"""Pictures: the renderer against exact silhouettes and shades, limits of diagrams, files."""

import dataclasses
import math
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import torch

import curvafit
from curvafit.core.runtime import Pictured
from curvafit.drawing import plot
from curvafit.drawing.rendering import render, view
from curvafit.generation import Schedule, generate
from curvafit.geometry.diagrams import Diagram
from curvafit.volumes.volume import Volume


def test_a_diagram_shows_itself() -> None:
    """Its unit is its own; an empty one is a line without a picture."""
    some = Diagram(np.array([[2.0, 1.0], [3.0, -4.0]]), np.array([1.0, 0.5]), unit="1/um")
    assert repr(some) == "Diagram(2 points, area 1.5, κ from -4 to 3 in 1/um)"
    assert some.plot().axes[0].get_xlabel() == "κ₁ (1/µm)"
    assert "<img src=" in some._repr_html_()
    none = Diagram(np.zeros((0, 2)), np.zeros(0))
    assert none._repr_html_() == "<code>Diagram(no points, in 1/working unit)</code>"
    with pytest.raises(ValueError, match="area"):
        none.plot()


def ball(shape: tuple[int, int, int], radius: float, spacing: tuple[float, float, float] = (1, 1, 1)) -> np.ndarray:
    """radius - distance from the box's centre, in units of `spacing`."""
    axes = [(np.arange(n) - (n - 1) / 2) * h for n, h in zip(shape, spacing, strict=True)]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    return (radius - np.sqrt(z**2 + y**2 + x**2)).astype(np.float32)


def cover(picture: np.ndarray) -> float:
    """Pixels covered."""
    return picture[..., 3].sum() / 255


def test_a_ball_covers_its_disc_and_is_lit_from_the_upper_left() -> None:
    picture, camera = render(ball((40, 40, 40), 12), width=200)
    pixel = 2 * camera.half[0] / 200
    assert cover(picture) * pixel**2 == pytest.approx(math.pi * 12**2, rel=0.01)
    rows, columns = np.nonzero(picture[..., 3])
    assert rows.mean() == pytest.approx((picture.shape[0] - 1) / 2, abs=0.5)
    assert columns.mean() == pytest.approx(99.5, abs=0.5)
    brightness = picture[..., :3].mean(axis=-1)
    middle, reach = picture.shape[0] // 2, round(7 / pixel)
    assert brightness[middle - reach, 100 - reach] > brightness[middle + reach, 100 + reach] + 40


@pytest.mark.parametrize(
    ("shape", "spacing", "azimuth", "elevation"),
    [
        ((30, 34, 38), (1.0, 1.0, 1.0), 0, 90), ((30, 34, 38), (1.0, 1.0, 1.0), 200, -50),
        ((30, 34, 38), (1.0, 1.0, 1.0), -45, 35.26), ((20, 40, 40), (2.0, 1.0, 1.0), 32, 24),
    ],
)  # fmt: skip
def test_a_ball_is_a_disc_from_everywhere(shape: Any, spacing: Any, azimuth: float, elevation: float) -> None:
    """Also along an axis, from behind and below, along the diagonal, and in a flat box of long voxels."""
    u = ball(shape, 12, spacing)
    picture, camera = render(u, spacing=spacing, width=160, azimuth=azimuth, elevation=elevation)
    assert camera.box == pytest.approx((np.array(shape) - 1) * spacing)
    assert cover(picture) * (2 * camera.half[0] / 160) ** 2 == pytest.approx(math.pi * 12**2, rel=0.02)


def shaded(z0: float, y0: float, x0: float) -> float:
    """The brightness amid a plate seen from straight above, x to the right and y up, with a ball over it."""
    z, y, x = np.meshgrid(*(np.arange(48.0),) * 3, indexing="ij")
    plate = np.minimum(4.0 - np.abs(z - 8), 9.0 - np.maximum(np.abs(y - 24), np.abs(x - 24)))
    over = 7.0 - np.sqrt((z - z0) ** 2 + (y - y0) ** 2 + (x - x0) ** 2)
    picture, _ = render(np.maximum(plate, over), width=96, azimuth=0, elevation=90)
    centre = picture[44:52, 44:52]
    assert (centre[..., 3] == 255).all()
    return float(centre[..., :3].mean())


@pytest.mark.parametrize("coarse", [128, 24])
def test_a_ball_between_a_plate_and_the_light_shades_it(monkeypatch: pytest.MonkeyPatch, coarse: int) -> None:
    """The light comes from the upper left; on a grid of its own, too, where the volume is large."""
    monkeypatch.setattr(import_module("curvafit.drawing.rendering"), "COARSE", coarse)
    assert shaded(30, 24 + 20, 24 - 12.6) < shaded(30, 24 - 20, 24 + 12.6) - 15


def test_cut_faces_are_capped_in_another_colour() -> None:
    solid, _ = render(np.ones((16, 16, 16)), width=120)
    camera = view((16, 16, 16))
    areas = np.abs(camera.frame[2]) * 15**2
    pixel = 2 * camera.half[0] / 120
    assert cover(solid) * pixel**2 == pytest.approx(areas.sum(), rel=0.01)
    rounded, _ = render(ball((16, 16, 16), 6), width=120)
    warmth = [p[p[..., 3] == 255][:, 0].mean() / p[p[..., 3] == 255][:, 2].mean() for p in (solid, rounded)]
    assert warmth[0] > warmth[1] + 0.15


def test_the_nearer_of_two_balls_hides_the_other() -> None:
    camera = view((48, 48, 48))
    towards = camera.frame[2]
    index = np.stack(np.meshgrid(*(np.arange(48) - 23.5,) * 3, indexing="ij"), axis=-1)
    near, far = (np.linalg.norm(index - sign * 14 * towards, axis=-1) for sign in (1, -1))
    both, _ = render(np.maximum(5 - near, 5 - far), width=120)
    one, _ = render(5 - near, width=120)
    assert cover(both) == pytest.approx(cover(one), rel=0.01)


def test_corners_of_the_box_fall_inside_the_picture() -> None:
    camera = view((10, 30, 20), (3.0, 1.0, 1.0))
    places = camera.project(np.array(list(np.ndindex(2, 2, 2)), dtype=float))
    assert places.min() >= 0 and places.max() <= 1
    assert np.ptp(places, axis=0) == pytest.approx((1 / 1.02, 1 / 1.02))
    assert np.linalg.det(camera.frame[:, ::-1]) == pytest.approx(1)  # right, up, towards in x, y, z: not mirrored


@pytest.mark.parametrize(
    ("volume", "said"),
    [(np.zeros((8, 8)), "3 axes"), (np.zeros((8, 3, 8)), "at least 4"), (np.full((8, 8, 8), np.nan), "finite")],
)
def test_what_cannot_be_drawn_is_refused(volume: np.ndarray, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        render(volume)


def test_shared_limits_hold_both_curvatures_and_leave_out_a_thin_tail() -> None:
    first = Diagram(np.array([[1.0, -2.0], [3.0, 0.0], [900.0, -900.0]]), np.array([1.0, 1.0, 1e-6]))
    second = Diagram(np.array([[5.0, 5.0]]), np.array([1.0]))
    low, high = plot.shared_limits([first, second])
    assert low < -2 and high > 5 and high - low < 10


def test_a_diagram_puts_its_mass_where_the_curvatures_are() -> None:
    point = Diagram(np.array([[20.0, -10.0]]), np.array([3.0]))
    figure = plot.diagram_figure(point, limits=(-40.0, 40.0))
    axes = figure.axes[0]
    mesh = axes.collections[0]
    shares = np.ma.filled(mesh.get_array(), 0.0).reshape(72, 72)
    row, column = np.unravel_index(shares.argmax(), shares.shape)
    centre = np.linspace(-40, 40, 73)[:-1] + 40 / 72
    assert centre[column] == pytest.approx(20, abs=1) and centre[row] == pytest.approx(-10, abs=1)
    diagonal = [line for line in axes.lines if line.get_color() == plot.DIAGONAL]
    assert len(diagonal) == 1 and np.array_equal(*diagonal[0].get_data())


def test_pictures_are_written_whole_or_not_at_all(tmp_path: Path) -> None:
    made = plot.write_picture(plot.surface_figure(ball((12, 12, 12), 4) > 0, width=160), tmp_path / "ball.png")
    assert matplotlib.image.imread(made).shape[:2] == (160, 160)
    two = plot.gallery_figure({"one": ball((12, 12, 12), 4), "two": ball((12, 12, 12), 3)}, width=320)
    plot.write_picture(two, tmp_path / "two.png")
    assert matplotlib.image.imread(tmp_path / "two.png").shape[1] == 320
    with pytest.raises(ValueError, match="finite"):
        plot.write_picture(plot.surface_figure(np.full((8, 8, 8), np.inf)), tmp_path / "no.png")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.png", "two.png"]


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 45.0])
def test_rays_along_the_boxs_sides_stay_in_it(azimuth: float) -> None:
    """Where a step of a ray is longer than a voxel, its last place may lie beyond the box."""
    z, y = np.ogrid[-12:12, -12:12]
    rod = np.repeat((9.0 - np.sqrt(z**2 + y**2))[..., None], 64, axis=2)
    picture, _ = render(rod, width=20, azimuth=azimuth)
    assert picture.min() < picture.max()


def test_a_corner_plot_has_a_histogram_of_each_and_a_picture_of_each_pair() -> None:
    draws = np.random.default_rng(0).uniform(0.1, 0.9, (50, 3)) * [1, 10, 100]
    limits = [(0.0, 1.0), (0.0, 10.0), (0.0, 100.0)]
    figure = plot.corner_figure(draws, ("a", "b", "c"), limits, {"truth": np.array([0.5, 5.0, 50.0])})
    places = [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]
    assert len(figure.axes) == len(places)
    for axes, (row, column) in zip(figure.axes, places, strict=True):
        assert axes.get_xlim() == limits[column]
        assert axes.get_xlabel() == ("abc"[column] if row == 2 else "")
        assert axes.get_ylabel() == ("abc"[row] if column == 0 < row else "")
        (mark,) = axes.lines
        if row == column:
            assert sum(bar.get_height() for bar in axes.patches) == 50
            assert list(mark.get_xdata()) == [50 / 10 ** (2 - row)] * 2
        else:
            assert axes.get_ylim() == limits[row]
            assert np.array_equal(np.asarray(axes.collections[0].get_offsets()), draws[:, (column, row)])
            assert (*mark.get_xdata(), *mark.get_ydata()) == (50 / 10 ** (2 - column), 50 / 10 ** (2 - row))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["truth"]
    assert len(plot.corner_figure(draws[:, :1], ("a",), limits[:1], {}).axes) == 1


def test_the_three_middle_slices_are_drawn_in_proportion() -> None:
    values = np.arange(5 * 6 * 7, dtype=np.float32).reshape(5, 6, 7)
    figure = Volume(values, (3.0, 2.0, 1.0), "um").plot()
    for axes, plane in zip(figure.axes, (values[2], values[:, 3], values[:, :, 3]), strict=True):
        assert np.array_equal(axes.images[0].get_array(), plane)
    assert [axes.get_aspect() for axes in figure.axes] == [2.0, 3.0, 1.5]
    assert [axes.get_title()[:5] for axes in figure.axes] == ["z = 2", "y = 3", "x = 3"]


def test_every_type_with_a_picture_has_a_function_that_draws_it() -> None:
    for name, place in curvafit._FIGURES.items():
        module, _, function = place.partition(":")
        assert callable(getattr(import_module(module), function))
        assert issubclass(getattr(curvafit, name), Pictured)
    kinds = (getattr(curvafit, name) for name in curvafit.__all__)
    pictured = {kind.__name__ for kind in kinds if isinstance(kind, type) and issubclass(kind, Pictured)}
    assert pictured == set(curvafit._FIGURES)


def test_a_picture_of_a_shape_and_none_of_what_is_not_finite() -> None:
    flow = generate("tubes", grid=16, schedule=Schedule("brief", 60, 1e-2, 1e-3, "constant"))
    sphere = 5 - (torch.stack(torch.meshgrid(*[torch.arange(16.0) - 8] * 3, indexing="ij")) ** 2).sum(0).sqrt()
    assert dataclasses.replace(flow, field=sphere).plot(width=64).axes
    shown = dataclasses.replace(flow, field=sphere)._repr_html_()
    assert re.search(r'<img src="data:image/png;base64,[\w+/=]{100,}" width="320"', shown)
    broken = dataclasses.replace(flow, field=torch.full((16, 16, 16), torch.nan))
    with pytest.raises(ValueError, match="finite"):
        broken.plot()
    assert "<img" not in broken._repr_html_() and "16 x 16 x 16" in broken._repr_html_()
