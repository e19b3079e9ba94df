"""What pins the parameters down, and what does not."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from importlib import import_module

import nibabel
import numpy as np
import pytest
import torch

from curvafit.core.runtime import Terminated
from curvafit.generation.flow import generate
from curvafit.generation.schedule import schedule
from curvafit.inference.fixed_point import ShortFlow, _minimiser, _parameters, fixed_point, sharpened
from curvafit.inference.stationarity import stationarity
from curvafit.priors.coefficients import Coefficients, preset
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.profile import phase_field
from curvafit.priors.stencils import gaussian_blur

GRID = Grid((40, 40, 40))


@pytest.fixture(scope="module")
def tubes() -> torch.Tensor:
    shape = preset("tubes")
    return generate(shape.coefficients, shape.mass, GRID, seed=1, schedule=schedule("cosine", steps=500)).field


@pytest.fixture(scope="module")
def mask_phase(tubes: torch.Tensor) -> torch.Tensor:
    return phase_field(tubes > 0, GRID, WORKING_EPSILON)


@pytest.mark.slow
def test_the_authors_sponge_gives_its_coefficients_back(data) -> None:
    (path,) = (data / "gallery").glob("sponge coeffs*.nii.gz")
    field = torch.from_numpy(np.asarray(nibabel.load(path).dataobj, dtype=np.float32))
    found = stationarity(field, Grid((100, 100, 100)), WORKING_EPSILON, starts=[Coefficients(1, 0, 1)])
    truth = preset("sponge")
    for name in ("a11", "a02", "a10", "a01"):
        assert getattr(found.coefficients, name) == pytest.approx(getattr(truth.coefficients, name), rel=0.05)
    assert found.mass == pytest.approx(truth.mass, abs=1e-4)
    assert found.method == "stationarity" and found.coefficients.a20 == 1


def test_the_right_parameters_leave_a_mask_where_it_is(mask_phase: torch.Tensor) -> None:
    """Of six seeds the interface moves by 0.25 to 0.71 voxels, by 0.08 to 0.26 of what the wrong ones move it."""
    flow = ShortFlow(mask_phase, GRID, WORKING_EPSILON, preset("tubes").coefficients)
    truth = np.linalg.norm(flow.residual(_parameters(preset("tubes").coefficients)))
    wrong = np.linalg.norm(flow.residual(_parameters(preset("sponge").coefficients)))
    assert truth < 1
    assert truth < 0.7 * wrong


def test_only_the_direction_of_a_counts(mask_phase: torch.Tensor) -> None:
    shape = preset("tubes").coefficients
    weak, strong = (ShortFlow(mask_phase, GRID, WORKING_EPSILON, shape.scaled(c)) for c in (0.5, 2))
    np.testing.assert_allclose(weak.residual(_parameters(shape)), strong.residual(_parameters(shape)), atol=1e-6)


@pytest.mark.slow
def test_the_fixed_point_fit_improves_on_its_start(mask_phase: torch.Tensor, monkeypatch) -> None:
    """Already in few steps, from a law that moves the surface far: of three seeds to .3 to .7 of its residual."""
    monkeypatch.setattr(import_module("curvafit.inference.fixed_point"), "FIRST_STEPS", 1)
    monkeypatch.setattr(import_module("curvafit.inference.fixed_point"), "LAST_STEPS", 2)
    start = preset("sponge").coefficients
    flow = ShortFlow(mask_phase, GRID, WORKING_EPSILON, start)
    before = np.linalg.norm(flow.residual(_parameters(start)))
    told: list[float] = []
    found = fixed_point(
        mask_phase, GRID, WORKING_EPSILON, starts=[start], progress=lambda text, share: told.append(share)
    )
    assert found.residual < 0.9 * before
    assert found.coefficients.a20 == 1 and found.coefficients.a02 > 0
    assert len(told) == found.evaluations and told == sorted(told)
    assert found.mass == pytest.approx(float(mask_phase.mean()), abs=1e-6)
    assert all(value >= 0 for value in found.uncertainty.values())


def test_sharpening_undoes_most_of_the_blur(mask_phase: torch.Tensor) -> None:
    blurred = gaussian_blur(mask_phase, GRID, WORKING_EPSILON)
    kept = gaussian_blur(sharpened(mask_phase, GRID, WORKING_EPSILON), GRID, WORKING_EPSILON)
    assert (kept - mask_phase).abs().mean() < 0.35 * (blurred - mask_phase).abs().mean()
    assert float(kept.double().mean()) == pytest.approx(float(mask_phase.double().mean()), abs=1e-5)


def test_the_halo_of_a_crop_is_held(mask_phase: torch.Tensor) -> None:
    crop = mask_phase[:32, :32, :32].contiguous()
    flow = ShortFlow(crop, Grid((32, 32, 32), boundary="replicate"), WORKING_EPSILON, preset("tubes").coefficients)
    assert flow._frozen is not None
    assert bool(flow._frozen[0].all()) and not bool(flow._frozen[16, 16, 16])


def test_no_start_is_refused(mask_phase: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="expected at least one start"):
        fixed_point(mask_phase, GRID, WORKING_EPSILON, starts=[])


class Bowl:
    """In ShortFlow's place: a bowl, which notes where it was asked and what precision another thread has meanwhile."""

    size = 5

    def __init__(self) -> None:
        self.asked: list[np.ndarray] = []
        self.precisions: set[bool] = set()

    def residual(self, free: np.ndarray) -> np.ndarray:
        import jax

        self.asked.append(free)
        with ThreadPoolExecutor(1) as elsewhere:
            self.precisions.add(elsewhere.submit(lambda: jax.config.jax_enable_x64).result())
        return (free - 0.3).astype(np.float32)

    def jacobian(self, free: np.ndarray) -> np.ndarray:
        return np.eye(self.size)


def test_a_fit_in_float64_leaves_jax_as_it_is() -> None:
    """As other threads see it while the fit runs, and afterwards, though two fits run at once."""
    import jax
    import jax.numpy as jnp

    before, bowls, starts = jax.config.jax_enable_x64, (Bowl(), Bowl()), (0.1, 0.7)
    with ThreadPoolExecutor(2) as pool:
        ends = list(pool.map(lambda bowl, start: _minimiser(bowl)(np.full(5, start), 20), bowls, starts))  # type: ignore[arg-type]
    assert jax.config.jax_enable_x64 == before
    assert jnp.ones(1).dtype == (jnp.float64 if before else jnp.float32)
    for bowl, end, start in zip(bowls, ends, starts, strict=True):
        assert bowl.precisions == {before}
        assert np.array_equal(bowl.asked[0], np.full(5, start))
        np.testing.assert_allclose(end.free, 0.3, rtol=0, atol=1e-4)


def test_an_interrupt_amid_the_fit_is_not_told_as_an_error_of_jax(monkeypatch: pytest.MonkeyPatch) -> None:
    bowl = Bowl()

    def stop(free: np.ndarray) -> np.ndarray:
        if len(bowl.asked) == 2:
            raise Terminated(15)
        return Bowl.residual(bowl, free)

    monkeypatch.setattr(bowl, "residual", stop)
    with pytest.raises(Terminated):
        _minimiser(bowl)(np.full(5, 0.1), 20)  # type: ignore[arg-type]


def test_a_crop_without_an_inside_is_one_sentence() -> None:
    """All of it would be the halo that is held."""
    start = [preset("tubes").coefficients]
    with pytest.raises(ValueError, match="expected a structure that spans more than 18 working voxels along each axis"):
        fixed_point(torch.ones((16, 24, 24)), Grid((16, 24, 24), boundary="replicate"), WORKING_EPSILON, starts=start)
