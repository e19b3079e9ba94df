"""The main job on a small shape of our own, end to end, and the laws that its result must obey."""

from __future__ import annotations

import dataclasses
import importlib
import json
from importlib import import_module

import numpy as np
import pytest
import torch

from curvafit.generation.flow import generate
from curvafit.geometry.diagram import diagram
from curvafit.geometry.transport import wasserstein
from curvafit.inference.infer import Inference, infer
from curvafit.inference.measure import scan_diagram
from curvafit.inference.prepare import prepare
from curvafit.priors.coefficients import preset
from curvafit.priors.fit_file import read_fit
from curvafit.priors.fit_schema import FORMAT
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.volumes.scan import Field
from tests.exact import Gyroid, centres

GRID = Grid((44, 44, 44))


@pytest.fixture(scope="module")
def tubes() -> np.ndarray:
    shape = preset("tubes")
    return generate(shape.coefficients, shape.mass, GRID, seed=5).field.numpy()


@pytest.fixture(scope="module")
def found(tubes: np.ndarray) -> Inference:
    """With fewer starts and steps than a user's: every stage is passed, none polished."""
    scan = Field((tubes > 0).astype(np.uint8), (2.0, 2.0, 2.0), "um", source="tubes")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importlib.import_module("curvafit.inference.infer"), "STARTS", 2)
        patch.setattr(import_module("curvafit.inference.fixed_point"), "FIRST_STEPS", 1)
        patch.setattr(import_module("curvafit.inference.fixed_point"), "LAST_STEPS", 2)
        return infer(scan, kind="mask", periodic=True, seed=3)


@pytest.mark.slow
def test_a_mask_is_taken_to_parameters_and_back(found: Inference) -> None:
    fit = found.fit
    assert fit.kind == "mask" and fit.family == "tubes"
    assert fit.chosen in ("match", "fit") and fit.status.endswith(".")
    assert fit.coefficients.a20 == pytest.approx(1.0)
    assert float(fit.coefficients.a02) > 0 and -1 < fit.mass < 1
    distances = [fit.distances[name] for name in ("match", "fit") if fit.distances[name] is not None]
    assert min(distances) < 6
    assert [match.distance for match in fit.matches] == sorted(match.distance for match in fit.matches)
    assert found.best is not None and found.best.shape == GRID.shape


@pytest.mark.slow
def test_physical_numbers_are_the_working_ones_in_another_unit(found: Inference) -> None:
    fit = found.fit
    assert fit.scale == (1.0, 1.0, 1.0) and fit.working_voxel == pytest.approx(2.0)
    λ = fit.working_voxel / 0.01
    assert fit.epsilon_physical == pytest.approx(4.0)
    assert fit.coefficients_physical.a11 == pytest.approx(float(fit.coefficients.a11))
    assert fit.coefficients_physical.a10 == pytest.approx(float(fit.coefficients.a10) / λ)
    assert fit.coefficients_physical.a00 == pytest.approx(float(fit.coefficients.a00) / λ**2)


@pytest.mark.slow
def test_fit_json_holds_what_the_generator_needs(found: Inference, tmp_path) -> None:
    path = tmp_path / "fit.json"
    path.write_text(found.fit.to_json())
    content = json.loads(path.read_text())
    assert content["format"] == FORMAT
    assert set(content) >= {
        "coefficients", "mass", "scale", "length_unit", "coefficients_physical", "epsilon_physical", "matches",
        "distances", "status", "provenance",
    }  # fmt: skip
    assert set(content["distances"]) == {"match", "fit", "seed_noise"}
    assert content["provenance"]["seed"] == 3 and content["length_unit"] == "um"
    kept = content["diagram"]
    assert kept["seen_as"] == "mask" and sum(kept["share"]) == pytest.approx(1, abs=1e-4)
    assert len(kept["kappa1"]) == len(kept["share"]) and path.read_text().count("\n") < 200
    prior, fit = read_fit(path), found.fit
    assert tuple(prior.coefficients) == pytest.approx(tuple(fit.coefficients))
    assert tuple(prior.physical) == pytest.approx(tuple(fit.coefficients_physical))
    assert (prior.mass, prior.epsilon) == pytest.approx((fit.mass, fit.epsilon_physical))
    assert (prior.working_voxel, prior.unit) == (fit.working_voxel, fit.length_unit)


def test_read_fit_refuses_what_is_no_fit(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match=r"expected a fit\.json, found no file"):
        read_fit(tmp_path / "none.json")
    path = tmp_path / "fit.json"
    for text in ("{", "[]", "{}", '{"format": "curvafit-fit-1"}'):
        path.write_text(text)
        with pytest.raises(ValueError, match="expected a fit.json written by"):
            read_fit(path)
    path.write_text('{"format": "curvafit-fit-0"}')
    with pytest.raises(ValueError, match="expected a fit.json of format"):
        read_fit(path)


def test_tiles_measure_what_the_whole_box_measures(tubes: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    scan = Field(np.tile(tubes, (1, 1, 4))[:, :, :160], (1.0, 1.0, 1.0), "um")
    prepared = prepare(scan, kind="field")
    assert prepared.phase.shape == (44, 44, 160)
    tiled = scan_diagram(prepared)
    grid = Grid((44, 44, 160), prepared.grid.spacing, "replicate")
    whole = diagram(torch.from_numpy(prepared.phase), grid, WORKING_EPSILON)
    assert tiled.area == pytest.approx(whole.area, rel=1e-6)
    np.testing.assert_allclose(tiled.mean(), whole.mean(), rtol=1e-6, atol=1e-6)
    direction = rng.normal(size=2)
    for share in (0.1, 0.5, 0.9):
        assert _quantile(tiled, direction, share) == pytest.approx(
            _quantile(whole, direction, share), rel=1e-3, abs=0.05
        )


def test_a_region_of_interest_hides_the_surface_that_it_cuts() -> None:
    inside = Gyroid(0.22).distance(centres(Grid((44, 44, 44)))).numpy() > 0
    scan = Field(inside.astype(np.uint8), (1.0, 1.0, 1.0), "um")
    z, y, x = np.indices(scan.values.shape) - 21.5
    region = z**2 + y**2 + x**2 < 20**2
    prepared = prepare(scan, kind="mask", roi=region)
    measured = scan_diagram(prepared)
    assert prepared.roi is not None
    bare = scan_diagram(dataclasses.replace(prepared, roi=None))
    assert 0.3 * bare.area < measured.area < 0.9 * bare.area
    whole = prepare(scan, kind="mask")  # the same ball of the uncut shape
    beyond = (whole.grid.shape[0] - prepared.grid.shape[0]) // 2
    kept = scan_diagram(dataclasses.replace(whole, roi=np.pad(prepared.roi, beyond)))
    assert measured.area == pytest.approx(kept.area, rel=0.02)
    near, far = wasserstein(measured, kept), wasserstein(bare, kept)
    assert 2 * near < far, (near, far)


def _quantile(measured, direction: np.ndarray, share: float) -> float:
    values = measured.points @ direction
    order = np.argsort(values)
    cumulated = np.cumsum(measured.weights[order]) / measured.area
    return float(values[order][np.searchsorted(cumulated, share)])
