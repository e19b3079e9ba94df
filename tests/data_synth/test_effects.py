"""Effects of images against their statistics; random ones by their seed alone."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from exact import Cylinder, Plane, Sphere, centres
from kornia.filters import filter3d, get_gaussian_kernel1d
from scipy import ndimage, stats
from torch import Tensor

from curvafit.data_synth.imaging import effects
from curvafit.data_synth.imaging.effects import poisson_quantile
from curvafit.data_synth.imaging.maths import uniform
from curvafit.priors.grid import Grid
from curvafit.priors.profile import optimal_profile

N = 40
GRID = Grid((N, N, N), (1.0, 1.0, 1.0))
MIDDLE = (N / 2, N / 2, N / 2)


def field(shape) -> Tensor:
    return optimal_profile(shape.distance(centres(GRID)), effects.EPSILON)


def flat(value: float, *shape: int) -> Tensor:
    return torch.full(shape or GRID.shape, value, dtype=torch.float64)


TUBE = field(Cylinder(5.0, (1, 0.3, 0.2), MIDDLE))
FULL = effects.occupancy(TUBE)

#: Each random function of seeds, with strong parameters.
RANDOM: dict[str, Callable[[Tensor, int], Tensor]] = {
    "texture": lambda v, seed: effects.texture(v, 1.0, 0.4, 3.0, seed, "background"),
    "bias": lambda v, seed: effects.bias(v, 1.0, 0.4, 20.0, seed),
    "stripes": lambda v, seed: effects.stripes(v, 1.0, 0.2, 2.0, seed),
    "rings": lambda v, seed: effects.rings(v, 1.0, 0.2, 1.5, seed),
    "dropout": lambda v, seed: effects.dropout(v, 1.0, 0.3, 6.0, 0.9, seed),
    "clutter": lambda v, seed: effects.clutter(v, 1.0, 1e-3, 1.5, seed),
    "poisson": lambda v, seed: effects.poisson(20 * v, seed, 0.7),
    "few photons": lambda v, seed: effects.poisson(v, seed),
    "gaussian noise": lambda v, seed: effects.gaussian_noise(v, 2.0, seed),
    "rician": lambda v, seed: effects.rician(v, 2.0, seed),
}


@pytest.mark.parametrize("name", RANDOM)
def test_the_seed_alone_decides(name: str) -> None:
    alone, again, differently = (RANDOM[name](FULL, seed) for seed in (7, 7, 8))
    assert alone.shape == (N, N, N)
    assert torch.equal(alone, again) and not torch.equal(alone, differently)


# ---- optics ----------------------------------------------------------------------------------------------------------


def test_occupancy_holds_the_volume() -> None:
    """Too large, by the curvature that a ramp over the distance leaves out: about 1 / 4R² of it, in voxels."""
    for radius in (4.3, 8.0):
        volume = float(effects.occupancy(field(Sphere(radius, MIDDLE))).sum())
        assert 0 < volume / (4 / 3 * math.pi * radius**3) - 1 < 0.5 / radius**2


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 1, 1), (1, 1, 1), (3, 2, 1)])
def test_occupancy_of_a_plane(normal: tuple[float, float, float]) -> None:
    """Against the mean over 10³ points of every voxel, themselves off by a layer of points."""
    plane, side = Plane(normal, (5.2, 5.2, 5.2)), 10
    fine = Grid((10 * side,) * 3, (0.1,) * 3)
    inside = (plane.distance(centres(fine)) > 0).double().reshape(side, 10, side, 10, side, 10).mean((1, 3, 5))
    u = optimal_profile(plane.distance(centres(Grid((side,) * 3, (1.0,) * 3))), effects.EPSILON)
    error = (effects.occupancy(u) - inside).abs().max()
    assert error < (0.051 if normal == (0, 0, 1) else 0.1)


@pytest.mark.parametrize("length", [0.1, 2.0, 5.0])
def test_texture(length: float) -> None:
    """Mean 1, the deviation; the logarithm's correlation one length away is e^-½, two away e^-2."""
    factor = torch.cat([effects.texture(flat(0), (2, 1, 1), 0.3, length, seed, "background") for seed in range(8)])
    assert float(factor.amin()) > 0
    assert float(factor.mean()) == pytest.approx(1, abs=0.01 + 0.006 * length)
    assert float(factor.std()) == pytest.approx(0.3, rel=0.06)
    log = factor.log() - factor.log().mean()
    for lags in (1, 2):
        k = round(lags * length)
        if k:
            found = (log[..., k:] * log[..., :-k]).mean() / log.square().mean()
            assert float(found) == pytest.approx(math.exp(-(lags**2) / 2), abs=0.05)
    along_z = (log[2:] * log[:-2]).mean() / log.square().mean()  # two voxels of two
    assert float(along_z) == pytest.approx(math.exp(-8 / length**2), abs=0.06)


def moments(image: Tensor, spacing: tuple[float, float, float]) -> list[float]:
    """Standard deviations (z, y, x) of a distribution of light."""
    weight = image / image.sum()
    points = centres(Grid(tuple(weight.shape), spacing))
    mean = (weight[..., None] * points).sum((0, 1, 2))
    return (weight[..., None] * (points - mean) ** 2).sum((0, 1, 2)).sqrt().tolist()


def test_blur_has_its_widths() -> None:
    point = flat(0)
    point[N // 2, N // 2, N // 2] = 1
    spacing, widths = (2.0, 1.0, 0.5), (4.0, 1.5, 1.0)
    seen = effects.blur(point, spacing, widths)
    assert float(seen.sum()) == pytest.approx(1)
    assert moments(seen, spacing) == pytest.approx(widths, rel=2e-3)


def test_blur_is_kornias_within() -> None:
    image = torch.rand((N, N, N), generator=torch.Generator().manual_seed(0))
    kernel, expected = get_gaussian_kernel1d(11, 1.4), image[None, None]
    for shape in ((1, 11, 1, 1), (1, 1, 11, 1), (1, 1, 1, 11)):
        expected = filter3d(expected, kernel.reshape(shape))
    inner = (slice(7, -7),) * 3
    torch.testing.assert_close(effects.blur(image, 1.0, 1.4)[inner], expected[0, 0][inner], rtol=0, atol=1e-5)


def test_blur_keeps_a_uniform_image_to_its_faces() -> None:
    torch.testing.assert_close(effects.blur(flat(3), 1.0, (3, 2, 1)), flat(3))
    deep = effects.blur_with_depth(flat(3), 1.0, (3, 2, 0), 0.05, 0.02)
    torch.testing.assert_close(deep[:, 3, 5], 3 * torch.exp(-0.02 * (torch.arange(N) + 0.5)).double())


def test_blur_with_depth_widens_as_it_says() -> None:
    for z in (6, 20, 33):
        line = flat(0, N, 60, 60)
        line[z, 30, 30] = 1
        seen = effects.blur_with_depth(line, (2.0, 1.0, 1.0), (0.0, 1.2, 0.8), 0.03)
        _, y, x = moments(seen, (2.0, 1.0, 1.0))
        wider = 1 + 0.03 * 2 * (z + 0.5)
        assert (y, x) == pytest.approx((1.2 * wider, 0.8 * wider), rel=0.01)


def test_slices_are_means_over_their_thickness() -> None:
    steps = torch.linspace(0, 1, 12, dtype=torch.float64)[:, None, None].expand(12, 4, 4) ** 2
    thick = effects.sample(steps, 1.0, (3, 1, 1), (3, 0, 0))
    torch.testing.assert_close(thick, steps.reshape(4, 3, 4, 4).mean(1))
    points = effects.sample(steps, 1.0, (3, 1, 1))
    torch.testing.assert_close(points, steps[1::3])
    overlapping = effects.sample(steps, 1.0, (2, 1, 1), (4, 0, 0))
    torch.testing.assert_close(overlapping[1:-1], torch.stack([steps[k - 1 : k + 3].mean(0) for k in (2, 4, 6, 8)]))
    torch.testing.assert_close(overlapping[0], steps[:3].mean(0))


def test_sampling_between_voxels_is_linear() -> None:
    ramp = torch.arange(10, dtype=torch.float64)[None, None].expand(4, 4, 10)
    finer = effects.sample(ramp, 1.0, (1.0, 1.0, 0.4))
    assert finer.shape == (4, 4, 25)
    expected = (0.4 * (torch.arange(25) + 0.5) - 0.5).clamp(0, 9).double()
    torch.testing.assert_close(finer[0, 0], expected)


# ---- noise -----------------------------------------------------------------------------------------------------------


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
        counts = effects.poisson_gaussian(flat(photons), gain, read, offset, 5, width)
        assert float(counts.mean()) == pytest.approx(
            offset + gain * photons, abs=0.05 * (1 + width * 8) * (1 + photons**0.5)
        )
        assert float(counts.var()) == pytest.approx(gain * (gain * photons) + read**2, rel=0.02 * (1 + 3 * width))


def test_grain_of_the_noise() -> None:
    noise = effects.gaussian_noise(flat(0, 60, 60, 60), 5.0, 1, (0, 1.0, 1.0))
    assert float(noise.std()) == pytest.approx(5, rel=0.02)
    assert float((noise[..., 1:] * noise[..., :-1]).mean() / 25) == pytest.approx(math.exp(-1 / 4), abs=0.02)
    assert float((noise[1:] * noise[:-1]).mean() / 25) == pytest.approx(0, abs=0.02)


@pytest.mark.parametrize("signal", [0.0, 1.0, 3.0, 10.0])
def test_rician_moments(signal: float) -> None:
    σ = 2.0
    seen = effects.rician(flat(signal * σ, 60, 60, 60), σ, 2)
    law = stats.rice(signal, scale=σ)
    assert float(seen.mean()) == pytest.approx(law.mean(), abs=0.02)
    assert float(seen.var()) == pytest.approx(law.var(), rel=0.02)
    assert float(seen.square().mean()) == pytest.approx((signal * σ) ** 2 + 2 * σ**2, rel=0.01)


def test_digitised() -> None:
    values = torch.tensor([-3.0, 0.4, 7.6, 300.0]).reshape(1, 1, 4)
    assert effects.digitise(values, 255).flatten().tolist() == [0, 0, 8, 255]


# ---- artefacts -------------------------------------------------------------------------------------------------------

EMPTY = torch.zeros((N, N, N), dtype=torch.float64)
THIN = effects.occupancy(field(Cylinder(4.0, (1, 0.2, 0.1), (20, 20, 20))))


def test_bias_has_its_range_and_is_smooth() -> None:
    for seed in (1, 2, 3):
        factor = effects.bias(EMPTY, 1.0, 0.3, 25.0, seed)
        assert float(factor.amin()) == pytest.approx(0.7) and float(factor.amax()) == pytest.approx(1.3)
        assert float(factor.diff(dim=-1).abs().max()) < 0.08


def test_stripes() -> None:
    """Constant along x but for rounding. A value is two sums in an order that the processor's matrix product
    chooses, over 46 nodes whose products come to some 7 strengths: off by 46 · 7 · 0.1 eps, two of them by twice that.
    """
    factor = effects.stripes(EMPTY, (1.0, 1.0, 1.0), 0.1, 1.0, 4)
    assert float(factor.diff(dim=-1).abs().max()) <= 2 * N * torch.finfo(factor.dtype).eps
    profile = factor[..., 0]
    assert float(profile.mean()) == pytest.approx(1, abs=0.02) and float(profile.std()) == pytest.approx(0.1, rel=0.1)
    off = profile - 1
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
        ring = (radius > low) & (radius < low + 0.1)
        around = term[:, ring]
        assert around.shape[1] > 5
        assert float(around.std(1).mean()) < 0.3 * float(term[:, radius < 12].std())
    neighbours = (term[1:] * term[:-1]).mean() / term.square().mean()
    assert abs(float(neighbours)) < 0.1


def test_dropout_takes_its_share() -> None:
    for share in (0.0, 0.25, 1.0):
        left = effects.dropout(THIN, 1.0, share, 8.0, 0.8, 6)
        inside = THIN >= 0.5
        assert float((left[inside] < 0.6).double().mean()) == pytest.approx(share, abs=2 / int(inside.sum()))
        assert float(left.amin()) >= 0.2 - 1e-6 and float(left.amax()) <= 1
    assert effects.dropout(THIN, 1.0, 0.0, 8.0, 0.8, 6).unique().tolist() == [1]


def test_dropout_fades_whole_stretches_of_a_thin_tube() -> None:
    left = effects.dropout(THIN, 1.0, 0.3, 10.0, 1.0, 2)
    core = THIN == 1
    across = torch.stack([left[z][core[z]].std() for z in range(N)]).mean()
    along = torch.stack([left[z][core[z]].mean() for z in range(N)]).std()
    assert float(across) < 0.5 * float(along)


def test_clutter_is_outside_and_as_dense() -> None:
    density = 4e-4
    terms = [effects.clutter(THIN, 1.0, density, 1.0, seed) for seed in range(12)]
    assert all(float(term[THIN == 1].abs().max()) == 0 and float(term.amin()) >= 0 for term in terms)
    assert all(float(term.amax()) <= 1 for term in terms)
    counts = [ndimage.label(term.numpy() > 0.3)[1] for term in terms]
    expected = 12 * density * N**3
    assert sum(counts) == pytest.approx(expected, abs=4 * expected**0.5)
    widths = sum(float(effects.clutter(EMPTY, 1.0, density, 1.0, seed).sum()) for seed in range(12)) / expected
    assert widths == pytest.approx(0.75 * (2 * math.pi) ** 1.5, rel=0.25)


def test_nothing_is_left_of_specks_that_have_no_room() -> None:
    assert float(effects.clutter(torch.ones_like(THIN), 1.0, 1e-3, 1.0, 1).abs().max()) == 0
