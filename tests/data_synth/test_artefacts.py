"""Uneven light, stripes, rings, lost stain, clutter: ranges, amplitudes, geometry; and what is no volume."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from exact import Cylinder, centres
from scipy import ndimage
from torch import Tensor

from curvafit.data_synth.imaging import effects
from curvafit.priors.grid import Grid
from curvafit.priors.profile import optimal_profile

N = 40
GRID = Grid((N, N, N), (1.0, 1.0, 1.0))
EMPTY = torch.zeros((1, 1, N, N, N), dtype=torch.float64)
TUBE = optimal_profile(Cylinder(4.0, (1, 0.2, 0.1), (20, 20, 20)).distance(centres(GRID)), effects.EPSILON)[None, None]
FULL = effects.occupancy(TUBE)


def test_bias_has_its_range_and_is_smooth() -> None:
    factor = effects.bias(EMPTY.expand(3, 1, N, N, N), 1.0, 0.3, 25.0, [1, 2, 3])
    assert factor.amin((1, 2, 3, 4)).tolist() == pytest.approx([0.7] * 3)
    assert factor.amax((1, 2, 3, 4)).tolist() == pytest.approx([1.3] * 3)
    assert float(factor.diff(dim=-1).abs().max()) < 0.08


def test_stripes() -> None:
    """Constant along x but for rounding. A value is two sums in an order that the processor's matrix product
    chooses, over 46 nodes whose products come to some 7 strengths: off by 46 · 7 · 0.1 eps, two of them by twice that.
    """
    factor = effects.stripes(EMPTY, (1.0, 1.0, 1.0), 0.1, 1.0, [4])
    assert float(factor.diff(dim=-1).abs().max()) <= 2 * N * torch.finfo(factor.dtype).eps
    profile = factor[..., 0]
    assert float(profile.mean()) == pytest.approx(1, abs=0.02) and float(profile.std()) == pytest.approx(0.1, rel=0.1)
    off = profile - 1
    assert float((off[..., 1:] * off[..., :-1]).mean() / 0.01) == pytest.approx(math.exp(-0.5), abs=0.12)
    assert float(effects.stripes(EMPTY, 1.0, 3.0, 1.0, [4]).amin()) == 0


def test_rings() -> None:
    spacing, centre = (1.0, 0.5, 0.5), (11.0, 4.0)
    term = effects.rings(EMPTY, spacing, 0.2, 1.0, [3], centre)[0, 0]
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
        left = effects.dropout(FULL, 1.0, share, 8.0, 0.8, [6])
        inside = FULL >= 0.5
        assert float((left[inside] < 0.6).double().mean()) == pytest.approx(share, abs=2 / int(inside.sum()))
        assert float(left.amin()) >= 0.2 - 1e-6 and float(left.amax()) <= 1
    assert effects.dropout(FULL, 1.0, 0.0, 8.0, 0.8, [6]).unique().tolist() == [1]


def test_dropout_fades_whole_stretches_of_a_thin_tube() -> None:
    left = effects.dropout(FULL, 1.0, 0.3, 10.0, 1.0, [2])[0, 0]
    core = FULL[0, 0] == 1
    across = torch.stack([left[z][core[z]].std() for z in range(N)]).mean()
    along = torch.stack([left[z][core[z]].mean() for z in range(N)]).std()
    assert float(across) < 0.5 * float(along)


def test_clutter_is_outside_and_as_dense() -> None:
    density = 4e-4
    terms = [effects.clutter(FULL, 1.0, density, 1.0, [seed]) for seed in range(12)]
    assert all(float(term[FULL == 1].abs().max()) == 0 and float(term.amin()) >= 0 for term in terms)
    assert all(float(term.amax()) <= 1 for term in terms)
    counts = [ndimage.label(term[0, 0].numpy() > 0.3)[1] for term in terms]
    expected = 12 * density * N**3
    assert sum(counts) == pytest.approx(expected, abs=4 * expected**0.5)
    widths = sum(float(effects.clutter(EMPTY, 1.0, density, 1.0, [seed]).sum()) for seed in range(12)) / expected
    assert widths == pytest.approx(0.75 * (2 * math.pi) ** 1.5, rel=0.25)


def test_nothing_is_left_of_specks_that_have_no_room() -> None:
    assert float(effects.clutter(torch.ones_like(FULL), 1.0, 1e-3, 1.0, [1]).abs().max()) == 0


CHECKED: dict[str, Callable[[Tensor], Tensor]] = {
    "occupancy": effects.occupancy,
    "blur": lambda v: effects.blur(v, 1.0, 1.0),
    "blur with depth": lambda v: effects.blur_with_depth(v, 1.0, 1.0, 0.1),
    "sample": lambda v: effects.sample(v, 1.0, 2.0),
    "dropout": lambda v: effects.dropout(v, 1.0, 0.2, 3.0, 0.5, [1]),
    "clutter": lambda v: effects.clutter(v, 1.0, 1e-3, 1.0, [1]),
    "poisson": lambda v: effects.poisson(v, [1]),
    "gaussian noise": lambda v: effects.gaussian_noise(v, 1.0, [1]),
    "rician": lambda v: effects.rician(v, 1.0, [1]),
    "digitised": lambda v: effects.digitised(v, 9.0),
}


@pytest.mark.parametrize("name", CHECKED)
def test_what_is_no_volume_is_refused(name: str) -> None:
    broken = FULL.clone()
    broken[0, 0, 1, 2, 3] = math.nan
    for wrong, word in ((broken, "finite"), (FULL[0], "shape"), (FULL.long(), "floating")):
        with pytest.raises(ValueError, match=word):
            CHECKED[name](wrong)


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: effects.occupancy(FULL, 0.0), "ε"),
        (lambda: effects.texture(FULL, 1.0, -0.1, 3.0, [1]), "deviation"),
        (lambda: effects.blur(FULL, 1.0, (1, 2)), "blur"),
        (lambda: effects.blur_with_depth(FULL, 1.0, 1.0, -1.0), "growth"),
        (lambda: effects.sample(FULL, 1.0, (1, 0, 1)), "spacing"),
        (lambda: effects.poisson(FULL - 1, [1]), "photons"),
        (lambda: effects.poisson_gaussian(FULL, -1, 1, 0, [1]), "gain"),
        (lambda: effects.rician(FULL, math.nan, [1]), "nan"),
        (lambda: effects.digitised(FULL, 0), "ceiling"),
        (lambda: effects.bias(FULL, 1.0, 1.5, 3.0, [1]), "bias"),
        (lambda: effects.stripes(FULL, 1.0, 0.1, 0.0, [1]), "stripes"),
        (lambda: effects.rings(FULL, 1.0, 0.1, 0.0, [1]), "rings"),
        (lambda: effects.dropout(FULL, 1.0, 1.2, 3.0, 0.5, [1]), "share"),
        (lambda: effects.clutter(FULL, 1.0, -1.0, 1.0, [1]), "density"),
    ],
)
def test_bad_parameters_are_named(call: Callable[[], Tensor], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        call()
