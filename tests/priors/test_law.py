"""One meaning of a law: a preset or its name, a fit or its file, and bare coefficients say the same everywhere."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from found import made_fit, made_inference

from curvafit.inference.infer import Inference
from curvafit.priors import PRESETS, Coefficients, CurvaturePrior, Law, Texture, preset, read_fit, texture_of
from curvafit.priors.law import textures_of

TUBES = PRESETS["tubes"]


@pytest.fixture
def fit_path(tmp_path):
    path = tmp_path / "fit.json"
    path.write_text(made_fit().to_json(), encoding="utf-8")
    return path


@pytest.mark.parametrize("law", ["tubes", TUBES, preset("tubes")])
def test_a_preset_is_its_coefficients_and_mass_in_working_units(law: Law) -> None:
    texture = texture_of(law)
    assert (texture.coefficients, texture.mass) == (TUBES.coefficients, TUBES.mass)
    assert texture.origin.startswith("preset") and (texture.epsilon, texture.unit) == (None, None)
    assert texture.in_unit("mm", 0.04) == TUBES.coefficients.in_unit(0.01 / 0.04)


def test_bare_coefficients_stay_as_they_are() -> None:
    law = Coefficients(1, 2, 3, 4, 5, 6)
    assert texture_of(law) == Texture(law, None, "coefficients", working=False)
    assert texture_of(law).in_unit("um", 7.0) == law


def test_a_fit_is_what_is_read_from_its_file(fit_path) -> None:
    assert made_fit().to_prior() == read_fit(fit_path)


def test_a_fit_its_file_its_prior_and_its_inference_are_one_law(fit_path) -> None:
    prior = read_fit(fit_path)
    stated: list[Law] = [fit_path, str(fit_path), prior, made_fit(), made_inference()]
    for texture in map(texture_of, stated):
        assert (texture.coefficients, texture.mass) == (prior.coefficients, prior.mass)
        assert (texture.epsilon, texture.unit) == (prior.epsilon, prior.unit)
        assert texture.in_unit(None, 3.0) == texture.in_unit(prior.unit, 5.0) == prior.physical
    assert texture_of(fit_path).origin == f"prior {fit_path}"


def test_an_inference_is_the_law_of_its_fit() -> None:
    nothing = dict.fromkeys(field.name for field in dataclasses.fields(Inference))
    inference = Inference(**nothing | {"fit": made_fit()})  # type: ignore[arg-type]
    assert texture_of(inference) == texture_of(made_fit())


def test_a_fit_in_a_file_of_another_name_is_read(fit_path) -> None:
    other = fit_path.rename(fit_path.with_name("bone"))
    assert texture_of(str(other)).prior == read_fit(other)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        ("tube", r"expected a preset among .*, or a fit\.json, got 'tube'"),
        ("x" * 5000, "expected a preset among"),
        (7, r"expected a law \(Coefficients, a preset or its name, a fit.json or a fit\), got 7"),
        (None, "expected a law"),
    ],
)
def test_what_states_no_law_is_refused(law, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        texture_of(law)


def test_a_fit_that_is_not_there_is_missed(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match=r"expected a fit\.json, found no file"):
        texture_of(str(tmp_path / "fit.json"))


def test_a_fit_without_a_law_is_refused_with_its_verdict(tmp_path) -> None:
    none = dataclasses.replace(made_fit(chosen=None), status="No law: the scan is noise.")
    path = none.save(tmp_path / "fit.json")
    for law in (path, none, dataclasses.replace(made_inference(), fit=none)):
        with pytest.raises(ValueError, match=r"^expected a fit.*with a law, got .*: No law: the scan is noise\.$"):
            texture_of(law)


def test_units_that_cannot_be_compared_are_refused() -> None:
    fit = dataclasses.replace(made_fit(), length_unit="voxel")
    with pytest.raises(ValueError, match="expected two units among nm, um, mm, m, got mm and the fit's voxel"):
        texture_of(fit).in_unit("mm", 1.0)


def test_coefficients_that_vary_have_no_unit_to_go_to() -> None:
    with pytest.raises(ValueError, match="expected coefficients that are numbers, got coefficients that vary in space"):
        texture_of(Coefficients(torch.ones(4, 4, 4), 0, 1)).in_unit("mm", 1.0)


def test_a_law_with_a_mass_is_a_point_of_seven_numbers() -> None:
    assert texture_of("tubes").point == (*TUBES.coefficients, TUBES.mass)
    with pytest.raises(ValueError, match="expected a preset or a fit, which have a mass, got coefficients"):
        texture_of(TUBES.coefficients).point  # noqa: B018


def test_several_laws_are_several_textures(fit_path) -> None:
    prior = read_fit(fit_path)
    assert [texture.mass for texture in textures_of(["tubes", fit_path, TUBES])] == [TUBES.mass, prior.mass, TUBES.mass]
    for law in ("tubes", TUBES, prior, TUBES.coefficients):  # a preset and a prior are tuples, but one law
        assert textures_of(law) == (texture_of(law),)


@pytest.mark.parametrize("law", ["tubes", TUBES, TUBES.coefficients.in_unit(0.01)])
def test_the_training_loss_takes_every_law(law: Law) -> None:
    (own,) = CurvaturePrior(law).coefficients
    assert tuple(own) == pytest.approx(tuple(TUBES.coefficients.in_unit(0.01)))
