"""One law, however it is stated: a preset or its name, a fit or its file, and bare coefficients say the same."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from broken_fits import broken
from found import made_fit, made_inference

from curvafit.inference.infer import Inference
from curvafit.priors import PRESETS, Coefficients, CurvaturePrior, Law, LawLike, preset, read_laws

TUBES = PRESETS["tubes"]


@pytest.fixture
def fit_path(tmp_path: Path) -> Path:
    return made_fit().save(tmp_path / "fit.json")


@pytest.mark.parametrize("stated", ["tubes", TUBES, preset("Tubes")])
def test_a_preset_is_its_coefficients_and_mass_in_working_units(stated: LawLike) -> None:
    law = Law.of(stated)
    assert (law.coefficients, law.mass, law.origin) == (TUBES.coefficients, TUBES.mass, "preset tubes")
    assert not law.fitted and law.working and law.source
    assert law.in_unit("mm", 0.04) == TUBES.coefficients.in_unit(0.01 / 0.04)
    with pytest.raises(ValueError, match="fit"):
        law.epsilon_physical  # noqa: B018


def test_bare_coefficients_stay_as_they_are() -> None:
    six = Coefficients(1, 2, 3, 4, 5, 6)
    law = Law.of(six)
    assert (law.coefficients, law.mass, law.working, law.origin) == (six, None, False, "coefficients")
    assert law.in_unit("um", 7.0) == six


def test_a_fit_its_file_and_its_inference_are_one_law(fit_path: Path) -> None:
    fit = made_fit()
    for law in map(Law.of, (fit_path, str(fit_path), fit, made_inference(), Law.load(fit_path))):
        assert law == fit.to_law()
        assert law.physical == fit.coefficients_physical and law.epsilon_physical == pytest.approx(fit.epsilon_physical)
        assert (law.working_voxel, law.length_unit) == (fit.working_voxel, fit.length_unit)
        assert law.in_unit(None) == law.in_unit("mm", 5.0) == law.physical
        assert tuple(law.in_unit("um")) == pytest.approx(tuple(law.physical.in_unit(1e-3)))
    assert Law.of(fit_path).origin == f"prior {fit_path}"
    nothing = dict.fromkeys(field.name for field in dataclasses.fields(Inference))
    assert Law.of(Inference(**nothing | {"fit": fit})) == fit.to_law()  # type: ignore[arg-type]


def test_a_fit_in_a_file_of_another_name_is_read(fit_path: Path) -> None:
    other = fit_path.rename(fit_path.with_name("bone"))
    assert Law.of(str(other)) == made_fit().to_law()


@pytest.mark.parametrize("stated", ["tube", "x" * 5000, 7, None])
def test_what_states_no_law_is_refused(stated) -> None:
    with pytest.raises(ValueError, match="preset"):
        Law.of(stated)


def test_a_fit_that_is_not_there_is_missed(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no file"):
        Law.of(str(tmp_path / "fit.json"))


def test_a_fit_without_a_law_is_refused_with_its_verdict(tmp_path: Path) -> None:
    none = dataclasses.replace(made_fit(chosen=None), status="No law: the scan is noise.")
    path = none.save(tmp_path / "fit.json")
    for stated in (path, none, dataclasses.replace(made_inference(), fit=none)):
        with pytest.raises(ValueError, match="the scan is noise"):
            Law.of(stated)


@pytest.mark.parametrize(
    ("where", "text"),
    [
        ("format", '"curvafit-fit-1"'),
        ("mass", "1"),
        ("mass", "true"),
        ("mass", None),
        ("mass", "NaN"),
        ("epsilon_physical", "0"),
        ("epsilon_physical", "1e999"),
        ("working_voxel", "[0.01]"),
        ("length_unit", '"furlong"'),
        ("coefficients", "[1, 2, 3, 4, 5, 6]"),
        ("coefficients.a02", None),
        ("coefficients_physical.a10", '"x"'),
        ("morphometry.volume_fraction", "2"),
        ("morphometry", "7"),
        ("provenance", '{"a": 1, "a": 2}'),
        ("provenance", "["),
    ],
)
def test_what_a_law_needs_is_checked_and_named(tmp_path: Path, where: str, text: str | None) -> None:
    path = tmp_path / "fit.json"
    path.write_text(broken(where, text), encoding="utf-8")
    with pytest.raises(ValueError, match=r"\A[^\n]*fit\.json[^\n]{1,600}\Z") as error:
        Law.load(path)
    assert where in str(error.value) or where in ("format", "provenance") or "1e999" in str(text) or text == "NaN"


def test_a_law_needs_little_of_the_file(tmp_path: Path) -> None:
    content = json.loads(made_fit().to_json())
    needed = ("format", "coefficients", "mass", "coefficients_physical", "epsilon_physical", "working_voxel")
    path = tmp_path / "fit.json"
    path.write_text(json.dumps({name: content[name] for name in (*needed, "length_unit")}), encoding="utf-8-sig")
    assert Law.load(path) == dataclasses.replace(made_fit().to_law(), volume_fraction=None)
    for text in ("[]", "7", "null", "{}"):
        path.write_text(text)
        with pytest.raises(ValueError, match="infer"):
            Law.load(path)


def test_units_that_cannot_be_compared_are_refused() -> None:
    fit = dataclasses.replace(made_fit(), length_unit="voxel")
    with pytest.raises(ValueError, match="units"):
        Law.of(fit).in_unit("mm", 1.0)


def test_coefficients_that_vary_have_no_unit_to_go_to() -> None:
    with pytest.raises(ValueError, match="vary"):
        Law.of(Coefficients(torch.ones(4, 4, 4), 0, 1)).in_unit("mm", 1.0)


def test_a_law_with_a_mass_is_a_point_of_seven_numbers() -> None:
    assert Law.of("tubes").point == (*TUBES.coefficients, TUBES.mass)
    with pytest.raises(ValueError, match="mass"):
        Law.of(TUBES.coefficients).point  # noqa: B018


def test_several_laws_are_read_in_order(fit_path: Path) -> None:
    masses = [law.mass for law in read_laws(["tubes", fit_path, TUBES])]
    assert masses == [TUBES.mass, made_fit().mass, TUBES.mass]
    for stated in ("tubes", TUBES, fit_path, TUBES.coefficients):
        assert read_laws(stated) == (Law.of(stated),)


@pytest.mark.parametrize("stated", ["tubes", TUBES, TUBES.coefficients.in_unit(0.01)])
def test_the_training_loss_takes_every_law(stated: LawLike) -> None:
    (own,) = CurvaturePrior(stated).coefficients
    assert tuple(own) == pytest.approx(tuple(TUBES.coefficients.in_unit(0.01)))
