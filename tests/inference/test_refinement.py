"""What pins the parameters down, and what does not."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import nibabel
import numpy as np
import pytest
import torch
from emulated import BOX, linear, reading, row
from shapes import grown

from curvafit.inference.drift import deblur, drift, halo_of
from curvafit.inference.emulator import best_parameters
from curvafit.inference.stationarity import stationarity
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.law import preset
from curvafit.priors.profile import phase_field
from curvafit.priors.stencils import gaussian_blur

GRID = Grid((32, 32, 32))


@pytest.fixture(scope="module")
def mask_phase() -> torch.Tensor:
    return phase_field(grown("tubes", 32) > 0, GRID, WORKING_EPSILON)


@pytest.mark.slow
def test_the_authors_sponge_gives_its_coefficients_back(data) -> None:
    (path,) = (data / "gallery").glob("sponge coeffs*.nii.gz")
    field = torch.from_numpy(np.asarray(nibabel.load(path).dataobj, dtype=np.float32))
    found = stationarity(field, Grid((100, 100, 100)), WORKING_EPSILON, starts=[Coefficients(1, 0, 1)])
    truth = preset("sponge")
    for name in ("a11", "a02", "a10", "a01"):
        assert getattr(found.coefficients, name) == pytest.approx(getattr(truth.coefficients, name), rel=0.05)
    assert found.mass == pytest.approx(truth.mass, abs=1e-4)
    assert found.name == "stationarity" and found.coefficients.a20 == 1


def test_the_right_parameters_leave_a_mask_where_it_is(mask_phase: torch.Tensor) -> None:
    """Of six seeds the interface moves by 0.25 to 0.71 voxels, by 0.08 to 0.26 of what the wrong ones move it."""
    truth, wrong = (drift(mask_phase, GRID, WORKING_EPSILON, preset(name).coefficients) for name in ("tubes", "sponge"))
    assert truth is not None and wrong is not None
    assert truth < 1
    assert truth < 0.7 * wrong


def test_only_the_direction_of_a_counts(mask_phase: torch.Tensor) -> None:
    shape = preset("tubes").coefficients
    weak, strong = (drift(mask_phase, GRID, WORKING_EPSILON, shape.scale(c)) for c in (0.5, 2))
    assert weak == pytest.approx(strong, abs=1e-6)


def test_sharpening_undoes_most_of_the_blur(mask_phase: torch.Tensor) -> None:
    blurred = gaussian_blur(mask_phase, GRID, WORKING_EPSILON)
    kept = gaussian_blur(deblur(mask_phase, GRID, WORKING_EPSILON), GRID, WORKING_EPSILON)
    assert (kept - mask_phase).abs().mean() < 0.35 * (blurred - mask_phase).abs().mean()
    assert float(kept.double().mean()) == pytest.approx(float(mask_phase.double().mean()), abs=1e-5)


def test_the_halo_of_a_crop_is_held() -> None:
    frozen = halo_of(Grid((32, 32, 32), boundary="replicate"))
    assert frozen is not None
    assert bool(frozen[0].all()) and not bool(frozen[16, 16, 16])


@pytest.mark.slow
def test_a_fit_in_float64_leaves_jax_as_it_is() -> None:
    """As other threads see it while fits run, two at once, and afterwards."""
    import jax
    import jax.numpy as jnp

    before, at = jax.config.jax_enable_x64, BOX.mean(1)
    with ThreadPoolExecutor(3) as pool:
        fits = [
            pool.submit(best_parameters, linear(), reading(row(at[None])[0]), np.tile(at, (8, 1))) for _ in range(2)
        ]
        seen = {pool.submit(lambda: jax.config.jax_enable_x64).result() for _ in range(20)}
        ends = [fit.result() for fit in fits]
    assert seen == {before} and jax.config.jax_enable_x64 == before
    assert jnp.ones(1).dtype == (jnp.float64 if before else jnp.float32)
    for end, _ in ends:
        assert end == pytest.approx(at, abs=1e-4 * np.ptp(BOX))


def test_a_law_without_a20_has_a_budget(mask_phase: torch.Tensor) -> None:
    """The gauge is a02 then: over a20 the coefficients would be beyond what a flow computes."""
    law = Coefficients(1e-9, 1.0, 1.0, -20.0, 0.0, 100.0)
    assert np.isfinite(drift(mask_phase, GRID, WORKING_EPSILON, law) or np.nan)


def test_a_crop_without_an_inside_has_no_drift() -> None:
    """All of it would be the halo that is held."""
    grid = Grid((16, 24, 24), boundary="replicate")
    assert drift(torch.ones(grid.shape), grid, WORKING_EPSILON, preset("tubes").coefficients) is None
