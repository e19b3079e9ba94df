"""The network that fills gaps: what it must not depend on, what it keeps, and its file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from annotated import EDGES, known, leaning, stirred

import curvafit.segmentation.filler as room
from curvafit.segmentation.filler import FAR, REACH, Filler, Gaps, Raster, Taught, fill, interpolate, plane_thickness
from curvafit.segmentation.slices import Slices, plane_distances
from curvafit.segmentation.trials import dice

STIRRED = Taught(stirred(), np.array([[4.0, 16.0], [1.0, 1.5]]), {}, 0.0)


def test_background_around_a_structure_tiles_and_a_unit_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    mask, taught = leaning(37, 7), STIRRED
    whole = fill(known(mask), taught)
    wide = np.pad(mask, ((0, 0), (200, 200), (200, 200)))
    assert np.abs(fill(known(wide), taught)[:, 200:-200, 200:-200] - whole).max() < 1e-5
    np.testing.assert_allclose(fill(known(mask, spacing=(0.3,) * 3), taught), whole, atol=1e-4)
    monkeypatch.setattr(room, "TILE", 12)
    assert np.abs(fill(known(mask), taught) - whole).max() < 1e-5


def test_no_pixel_sees_further_than_the_reach_nor_needs_a_border_that_is_only_seen() -> None:
    filler, distances = STIRRED.filler, torch.randn(1, 4, 120, 120, generator=torch.Generator().manual_seed(0))
    gaps = Gaps(distances, torch.ones(1), torch.zeros(1, 3, 120, 120))
    moved = distances.clone()
    moved[..., 60, 60] += 3
    with torch.no_grad():
        change = (filler(replace(gaps, distances=moved)) - filler(gaps)).abs().amax((0, 1))
    rows, columns = torch.nonzero(change, as_tuple=True)
    assert max(int((each - 60).abs().max()) for each in (rows, columns)) <= REACH
    with torch.no_grad():
        torch.testing.assert_close(filler(gaps, 16), filler(gaps)[..., 16:-16, 16:-16], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("spacing", [EDGES, (4.0, 1.0, 1.0), (1.0, 2.0, 1.0)])
def test_known_slices_are_kept(spacing: tuple[float, float, float]) -> None:
    mask = leaning(37, 7)
    found = fill(known(mask, spacing=spacing), STIRRED)
    assert found.dtype == np.float32 and found.shape == mask.shape
    assert np.array_equal(found[::6] > 0, mask[::6])


def test_an_untaught_filler_is_the_cubic_interpolation() -> None:
    """Its last layers are zero: log-odds are the slope times distances in pixels, in pixels of any size."""
    mask = leaning(37, 7)
    taught = Taught(Filler().eval(), np.array([[4.0, 16.0], [1.0, 1.0]]), {}, 0.0)
    slices = known(mask)
    distances = torch.from_numpy(plane_distances(slices.inside, EDGES[1:], FAR)[1:5].clip(-FAR, FAR)).float()
    _, cubic = interpolate(distances[None], torch.arange(1, 6) / 6)
    np.testing.assert_allclose(fill(slices, taught)[13:18], room.SLOPE * cubic[0].numpy(), atol=1e-4)


def test_the_cubic_goes_through_parabolas() -> None:
    t = torch.arange(1, 8) / 8
    nodes = torch.tensor([-1.0, 0.0, 1.0, 2.0])
    linear, cubic = interpolate((3 * nodes**2 - nodes + 2)[None, :, None, None], t)
    torch.testing.assert_close(cubic[0, :, 0, 0], 3 * t**2 - t + 2)
    torch.testing.assert_close(linear[0, :, 0, 0], 2 + 2 * t)


def test_the_thickness_of_strips_is_their_width() -> None:
    plane = ((np.arange(60) + 14) % 20 < 8)[:, None] & np.ones((60, 40), bool)
    assert plane_thickness(plane[None], (1.0, 1.0)) == pytest.approx(8, rel=0.1)
    assert plane_thickness(plane[None], (0.5, 0.5)) == pytest.approx(4, rel=0.1)
    assert np.isinf(plane_thickness(np.zeros((1, 4, 4), bool), (1.0, 1.0)))


@pytest.mark.parametrize("factor", [1, 3, 8])
def test_slices_come_back_from_any_pixels(factor: int) -> None:
    """Distances of a disc, in pixels some voxels wide, are those of the disc."""
    n = 32 * factor
    disc = np.hypot(*(np.mgrid[:n, :n] - n / 2 + 0.5)) < n / 4
    slices = Slices(np.stack([disc, disc]), (0, 4), 5, (1.0, 1.0, 1.0))
    raster = Raster.of(slices)
    inner = raster.distances(disc)[REACH:-REACH, REACH:-REACH]
    assert inner.shape == raster.size and raster.pixel >= 1
    back = raster.to_slices(inner[None])[0] * raster.pixel
    exact = n / 4 - np.hypot(*(np.mgrid[:n, :n] - n / 2 + 0.5))
    near = np.abs(exact) < 4
    assert np.abs(back - exact)[near].max() < 1.2 * raster.pixel


def test_a_filler_comes_back_from_its_file(tmp_path: Path) -> None:
    taught = replace(STIRRED, card={"seed": 3}, error=0.02)
    taught.save(tmp_path / "filler.npz")
    other = Taught.load(tmp_path / "filler.npz")
    assert other.card == {"seed": 3} and other.error == 0.02 and other.temperature(10.0) == taught.temperature(10.0)
    assert np.array_equal(fill(known(leaning()), other), fill(known(leaning()), taught))


@pytest.mark.parametrize("shape", ["leaning", "branch", "end"])
def test_the_packaged_filler_knows_tubes(shape: str) -> None:
    """A tube that leans, forks or ends: of straight ones a spline knows all, and the network nearly all."""
    z, y, x = np.mgrid[:33, :64, :64].astype(float)
    away = {
        "leaning": np.hypot(y - 32, x - 16 - 1.0 * z),
        "branch": np.minimum(np.hypot(y - 32, x - 32 - 0.7 * z), np.hypot(y - 32, x - 32 + 0.7 * z)),
        "end": np.sqrt((y - 32) ** 2 + (x - 32) ** 2 + np.maximum(z - 12, 0) ** 2),
    }[shape]
    mask = away < 5
    slices = known(mask, 8)
    between = [n for n in range(33) if n % 8]
    gain = {way: dice(slices.level(way)[between] > 0, mask[between]) for way in ("spline", "linear", "nearest")}
    assert dice(fill(slices, Taught.load())[between] > 0, mask[between]) > max(gain.values()) - 0.02
