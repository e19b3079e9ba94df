"""Effects of images against their statistics; random ones by their seed alone."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from exact import Cylinder, Plane, Sphere, centres, profile
from scipy import ndimage, stats
from torch import Tensor

from curvafit.data_synth.imaging import effects
from curvafit.data_synth.imaging.effects import poisson_quantile, uniform
from curvafit.priors.grid import Grid

N = 40
GRID = Grid((N, N, N), (1.0, 1.0, 1.0))
MIDDLE = (N / 2, N / 2, N / 2)
EMPTY = torch.zeros((N, N, N), dtype=torch.float64)


def field(shape, grid: Grid = GRID) -> Tensor:
    return profile(shape, centres(grid), effects.EPSILON)


FULL = effects.occupancy(field(Cylinder(5.0, (1, 0.3, 0.2), MIDDLE)))
THIN = effects.occupancy(field(Cylinder(4.0, (1, 0.2, 0.1), MIDDLE)))

#: Each random function of seeds, with strong parameters.
RANDOM: dict[str, Callable[[Tensor, int], Tensor]] = {
    "texture": lambda v, seed: effects.texture(v, 1.0, 0.4, 3.0, seed, "background"),
    "bias": lambda v, seed: effects.bias(v, 1.0, 0.4, 20.0, seed),
    "stripes": lambda v, seed: effects.stripes(v, 1.0, 0.2, 2.0, seed),
    "rings": lambda v, seed: effects.rings(v, 1.0, 0.2, 1.5, seed),
    "dropout": lambda v, seed: effects.dropout(v, 1.0, 0.3, 6.0, 0.9, seed),
    "clutter": lambda v, seed: effects.clutter(v, 1.0, 1e-3, 1.5, seed),
    "poisson": lambda v, seed: effects.poisson_gaussian(20 * v, 1, 0, 0, seed, 0.7),
    "few photons": lambda v, seed: effects.poisson_gaussian(v, 1, 0, 0, seed),
    "gaussian noise": lambda v, seed: effects.gaussian_noise(v, 2.0, seed),
    "rician": lambda v, seed: effects.rician(v, 2.0, seed),
}


@pytest.mark.parametrize("name", RANDOM)
def test_the_seed_alone_decides(name: str) -> None:
    alone, again, differently = (RANDOM[name](FULL, seed) for seed in (7, 7, 8))
    assert alone.shape == (N, N, N)
    assert torch.equal(alone, again) and not torch.equal(alone, differently)


def test_occupancy_holds_the_volume() -> None:
    """Too large, by the curvature that a ramp over the distance leaves out: about 1 / 4R² of it, in voxels."""
    for radius in (4.3, 8.0):
        volume = float(effects.occupancy(field(Sphere(radius, MIDDLE))).sum())
        assert 0 < volume / (4 / 3 * math.pi * radius**3) - 1 < 0.5 / radius**2


@pytest.mark.parametrize(("normal", "most"), [((0, 0, 1), 0.051), ((0, 1, 1), 0.1), ((1, 1, 1), 0.1), ((3, 2, 1), 0.1)])
def test_occupancy_of_a_plane(normal: tuple[float, float, float], most: float) -> None:
    """Against the mean over 10³ points of every voxel, themselves off by a layer of points."""
    plane = Plane(normal, (5.2,) * 3)
    fine = plane.distance(centres(Grid((100, 100, 100), (0.1,) * 3))) > 0
    inside = fine.double().reshape(10, 10, 10, 10, 10, 10).mean((1, 3, 5))
    assert (effects.occupancy(field(plane, Grid((10, 10, 10), (1.0,) * 3))) - inside).abs().max() < most


@pytest.mark.parametrize("length", [0.1, 2.0, 5.0])
def test_texture(length: float) -> None:
    """Mean 1, the deviation; the logarithm's correlation one length away is e^-½, two away e^-2."""
    factor = torch.cat([effects.texture(EMPTY, (2, 1, 1), 0.3, length, seed, "background") for seed in range(8)])
    assert float(factor.amin()) > 0
    assert float(factor.mean()) == pytest.approx(1, abs=0.01 + 0.006 * length)
    assert float(factor.std()) == pytest.approx(0.3, rel=0.06)
    log = factor.log() - factor.log().mean()
    for k, lags in ((round(lags * length), lags) for lags in (1, 2) if length > 1):
        found = (log[..., k:] * log[..., :-k]).mean() / log.square().mean()
        assert float(found) == pytest.approx(math.exp(-(lags**2) / 2), abs=0.05)
    along_z = (log[2:] * log[:-2]).mean() / log.square().mean()  # two voxels of two
    assert float(along_z) == pytest.approx(math.exp(-8 / length**2), abs=0.06)


def moments(image: Tensor, spacing: tuple[float, float, float]) -> list[float]:
    """Standard deviations (z, y, x) of a distribution of light."""
    weight, points = image / image.sum(), centres(Grid(tuple(image.shape), spacing))
    mean = (weight[..., None] * points).sum((0, 1, 2))
    return (weight[..., None] * (points - mean) ** 2).sum((0, 1, 2)).sqrt().tolist()


def test_blur_has_its_widths_and_is_scipys_within() -> None:
    point, spacing, widths = EMPTY.clone(), (2.0, 1.0, 0.5), (4.0, 1.5, 1.0)
    point[N // 2, N // 2, N // 2] = 1
    seen = effects.blur(point, spacing, widths)
    assert float(seen.sum()) == pytest.approx(1)
    assert moments(seen, spacing) == pytest.approx(widths, rel=2e-3)
    image = torch.rand((N, N, N), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected, inner = ndimage.gaussian_filter(image.numpy(), 1.4, radius=5), (slice(7, -7),) * 3
    np.testing.assert_allclose(effects.blur(image, 1.0, 1.4)[inner], expected[inner], rtol=0, atol=1e-5)


def test_blur_keeps_a_uniform_image_to_its_faces_and_widens_with_depth() -> None:
    torch.testing.assert_close(effects.blur(EMPTY + 3, 1.0, (3, 2, 1)), EMPTY + 3)
    deep = effects.blur(EMPTY + 3, 1.0, (3, 2, 0), 0.05, 0.02)
    torch.testing.assert_close(deep[:, 3, 5], 3 * torch.exp(-0.02 * (torch.arange(N) + 0.5)).double())
    for z in (6, 20, 33):
        line, wider = torch.zeros(N, 60, 60, dtype=torch.float64), 1 + 0.03 * 2 * (z + 0.5)
        line[z, 30, 30] = 1
        _, y, x = moments(effects.blur(line, (2.0, 1.0, 1.0), (0.0, 1.2, 0.8), 0.03), (2.0, 1.0, 1.0))
        assert (y, x) == pytest.approx((1.2 * wider, 0.8 * wider), rel=0.01)


def test_slices_are_means_over_their_thickness_and_linear_between_voxels() -> None:
    steps = torch.linspace(0, 1, 12, dtype=torch.float64)[:, None, None].expand(12, 4, 4) ** 2
    thick = effects.sample(steps, 1.0, (3, 1, 1), (3, 0, 0))
    torch.testing.assert_close(thick, steps.reshape(4, 3, 4, 4).mean(1))
    torch.testing.assert_close(effects.sample(steps, 1.0, (3, 1, 1)), steps[1::3])
    overlapping = effects.sample(steps, 1.0, (2, 1, 1), (4, 0, 0))
    torch.testing.assert_close(overlapping[1:-1], torch.stack([steps[k - 1 : k + 3].mean(0) for k in (2, 4, 6, 8)]))
    torch.testing.assert_close(overlapping[0], steps[:3].mean(0))
    ramp = torch.arange(10, dtype=torch.float64)[None, None].expand(4, 4, 10)
    finer = effects.sample(ramp, 1.0, (1.0, 1.0, 0.4))
    torch.testing.assert_close(finer[0, 0], (0.4 * (torch.arange(25) + 0.5) - 0.5).clamp(0, 9).double())


@pytest.mark.parametrize("mean", [0.05, 0.7, 1.99, 2.01, 3.5, 9.0, 60.0, 2000.0])
def test_poisson_quantiles_are_poissons(mean: float) -> None:
    share = (np.arange(50_000) + 0.5) / 50_000
    z = torch.from_numpy(stats.norm.ppf(share))
    found = poisson_quantile(torch.full_like(z, mean), z).numpy()
    off = np.abs(found - stats.poisson.ppf(share, mean))
    assert off.max() <= 1 and (off > 0).mean() < (1e-5 if mean < 2 else 5e-3)
    assert found.mean() == pytest.approx(mean, rel=2e-3) and found.var() == pytest.approx(mean, rel=2e-3)


@pytest.mark.parametrize("width", [0.0, 0.8])
def test_variance_is_a_line_over_the_mean(width: float) -> None:
    gain, read, offset = 3.0, 4.0, 100.0
    for photons in (0.0, 1.0, 5.0, 40.0, 300.0):
        counts, close = effects.poisson_gaussian(EMPTY + photons, gain, read, offset, 5, width), 0.05 * (1 + width * 8)
        assert float(counts.mean()) == pytest.approx(offset + gain * photons, abs=close * (1 + photons**0.5))
        assert float(counts.var()) == pytest.approx(gain * (gain * photons) + read**2, rel=0.02 * (1 + 3 * width))


@pytest.mark.parametrize("signal", [0.0, 1.0, 3.0, 10.0])
def test_rician_moments(signal: float) -> None:
    seen = effects.rician(torch.full((60, 60, 60), 2 * signal, dtype=torch.float64), 2.0, 2)
    law = stats.rice(signal, scale=2.0)
    assert float(seen.mean()) == pytest.approx(law.mean(), abs=0.02)
    assert float(seen.var()) == pytest.approx(law.var(), rel=0.02)
    assert float(seen.square().mean()) == pytest.approx((2 * signal) ** 2 + 2 * 2.0**2, rel=0.01)


def test_bias_has_its_range_and_is_smooth() -> None:
    """Bias, grain and stripes, which are constant along x but for rounding.

    A value is two sums in an order that the processor's matrix product chooses, over 46 nodes whose products come to
    some 7 strengths: off by 46 · 7 · 0.1 eps, two of them by twice that.
    """
    for seed in (1, 2, 3):
        factor = effects.bias(EMPTY, 1.0, 0.3, 25.0, seed)
        assert float(factor.amin()) == pytest.approx(0.7) and float(factor.amax()) == pytest.approx(1.3)
        assert float(factor.diff(dim=-1).abs().max()) < 0.08
    noise = effects.gaussian_noise(torch.zeros(60, 60, 60), 5.0, 1, (0, 1.0, 1.0))
    assert float(noise.std()) == pytest.approx(5, rel=0.02)
    assert float((noise[..., 1:] * noise[..., :-1]).mean() / 25) == pytest.approx(math.exp(-1 / 4), abs=0.02)
    assert float((noise[1:] * noise[:-1]).mean() / 25) == pytest.approx(0, abs=0.02)
    factor = effects.stripes(EMPTY, (1.0, 1.0, 1.0), 0.1, 1.0, 4)
    assert float(factor.diff(dim=-1).abs().max()) <= 2 * N * torch.finfo(factor.dtype).eps
    off = factor[..., 0] - 1
    assert float(off.mean()) == pytest.approx(0, abs=0.02) and float(off.std()) == pytest.approx(0.1, rel=0.1)
    assert float((off[..., 1:] * off[..., :-1]).mean() / 0.01) == pytest.approx(math.exp(-0.5), abs=0.12)
    assert float(effects.stripes(EMPTY, 1.0, 3.0, 1.0, 4).amin()) == 0


def test_rings() -> None:
    spacing, seed = (1.0, 0.5, 0.5), 33
    centre = [(2 * share - 0.5) * N * 0.5 for share in uniform(2, seed, "ring centre", EMPTY).tolist()]
    assert all(0 < at < 20 for at in centre)
    term = effects.rings(EMPTY, spacing, 0.2, 1.0, seed)
    assert float(term.std()) == pytest.approx(0.2, rel=0.15) and float(term.mean()) == pytest.approx(0, abs=0.02)
    y, x = (0.5 * (torch.arange(N) + 0.5) - at for at in centre)
    radius = torch.hypot(y[:, None], x)
    for low in (3.0, 6.0, 9.0):
        around = term[:, (radius > low) & (radius < low + 0.1)]
        assert around.shape[1] > 5
        assert float(around.std(1).mean()) < 0.3 * float(term[:, radius < 12].std())
    assert abs(float((term[1:] * term[:-1]).mean() / term.square().mean())) < 0.1


def test_dropout_takes_its_share_and_fades_whole_stretches_of_a_thin_tube() -> None:
    inside, core = THIN >= 0.5, THIN == 1
    for share in (0.0, 0.25, 1.0):
        left = effects.dropout(THIN, 1.0, share, 8.0, 0.8, 6)
        assert float((left[inside] < 0.6).double().mean()) == pytest.approx(share, abs=2 / int(inside.sum()))
        assert float(left.amin()) >= 0.2 - 1e-6 and float(left.amax()) <= 1
        assert share or left.unique().tolist() == [1]
    left = effects.dropout(THIN, 1.0, 0.3, 10.0, 1.0, 2)
    across = torch.stack([left[z][core[z]].std() for z in range(N)]).mean()
    along = torch.stack([left[z][core[z]].mean() for z in range(N)]).std()
    assert float(across) < 0.5 * float(along)


def test_clutter_is_outside_and_as_dense() -> None:
    density, seeds = 4e-4, range(12)
    terms = [effects.clutter(THIN, 1.0, density, 1.0, seed) for seed in seeds]
    assert all(float(term[THIN == 1].abs().max()) == 0 for term in terms)
    assert all(0 <= float(term.amin()) <= float(term.amax()) <= 1 for term in terms)
    expected = 12 * density * N**3
    counts = sum(ndimage.label(term.numpy() > 0.3)[1] for term in terms)
    assert counts == pytest.approx(expected, abs=4 * expected**0.5)
    widths = sum(float(effects.clutter(EMPTY, 1.0, density, 1.0, seed).sum()) for seed in seeds) / expected
    assert widths == pytest.approx(0.75 * (2 * math.pi) ** 1.5, rel=0.25)
    assert float(effects.clutter(torch.ones_like(THIN), 1.0, 1e-3, 1.0, 1).abs().max()) == 0  # there is no room
