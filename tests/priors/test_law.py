"""One law, however it is stated; the ways to state a polynomial, and its laws."""

import dataclasses
import json
import re
from pathlib import Path

import pytest
import torch
from found import broken, made_fit, made_inference
from hypothesis import given
from hypothesis import strategies as st

from curvafit.inference.inference import Inference
from curvafit.priors import PRESETS, Coefficients, CurvaturePrior, Law, LawLike, preset, read_laws
from curvafit.priors.law import preset_name

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
    assert law.point == (*TUBES.coefficients, TUBES.mass)


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
    other = fit_path.rename(fit_path.with_name("bone"))  # whatever it is called
    assert Law.of(str(other)) == fit.to_law()


@pytest.mark.parametrize(
    ("law", "word"),
    [
        (lambda: TUBES.epsilon_physical, "fit"),
        (lambda: Law.of(dataclasses.replace(made_fit(), length_unit="voxel")).in_unit("mm", 1.0), "units"),
        (lambda: Law.of(Coefficients(torch.ones(4, 4, 4), 0, 1)).in_unit("mm", 1.0), "vary"),
        (lambda: Law.of(TUBES.coefficients).point, "mass"),
    ],
)
def test_what_states_no_law_is_refused(law, word) -> None:
    with pytest.raises(ValueError, match=word):
        law()


def test_a_fit_without_a_law_is_refused_with_its_verdict(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no file"):
        Law.of(str(tmp_path / "fit.json"))
    none = dataclasses.replace(made_fit(chosen=None), status="No law: the scan is noise.")
    path = none.save(tmp_path / "fit.json")
    for stated in (path, none, dataclasses.replace(made_inference(), fit=none)):
        with pytest.raises(ValueError, match="the scan is noise"):
            Law.of(stated)


def test_a_law_needs_little_of_the_file(tmp_path: Path) -> None:
    """What it needs is checked and named."""
    content = json.loads(made_fit().to_json())
    needed = ("format", "coefficients", "mass", "coefficients_physical", "epsilon_physical", "working_voxel")
    path = tmp_path / "fit.json"
    path.write_text(json.dumps({name: content[name] for name in (*needed, "length_unit")}), encoding="utf-8-sig")
    assert Law.load(path) == dataclasses.replace(made_fit().to_law(), volume_fraction=None)
    named = {"mass": "1", "working_voxel": "[0.01]", "coefficients.a02": None, "morphometry.volume_fraction": "2"}
    for text, word in (("[]", "infer"), ("{}", "infer"), *((broken(*each), each[0]) for each in named.items())):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=word):
            Law.load(path)


def test_a_text_that_is_no_law_is_met_with_what_may_be_meant(fit_path: Path) -> None:
    for text, meant in (("tube", "tubes"), (str(fit_path.parent), str(fit_path))):
        with pytest.raises(ValueError, match=re.escape(f"did you mean {meant}?")):
            Law.of(text)
    with pytest.raises(ValueError, match="bilayers"):
        Law.of("nothing of the kind")


def test_several_laws_are_read_in_order(fit_path: Path) -> None:
    masses = [law.mass for law in read_laws(["tubes", fit_path, TUBES])]
    assert masses == [TUBES.mass, made_fit().mass, TUBES.mass]
    for stated in ("tubes", TUBES, fit_path, TUBES.coefficients):
        assert read_laws(stated) == (Law.of(stated),)


@pytest.mark.parametrize("stated", ["tubes", TUBES, TUBES.coefficients.in_unit(0.01)])
def test_the_training_loss_takes_every_law(stated: LawLike) -> None:
    own = CurvaturePrior(stated).coefficients
    assert tuple(own) == pytest.approx(tuple(TUBES.coefficients.in_unit(0.01)))


# ---- polynomials -----------------------------------------------------------------------------------------------------


finite = st.floats(-50, 50, allow_subnormal=False)
positive = st.floats(0.1, 50)
coefficients = st.builds(Coefficients, positive, finite, positive, finite, finite, finite)
#: Rows of the paper's two tables: (h2, H0, k1, α, κ1⁰, β, κ2⁰).
B_FORMS = {
    "bilinear-layers": (1, 0, 0, 1, 0, 1, 0),
    "bilinear-spheres": (1, 2 / 0.08, 0, 1, 1 / 0.08, 1, 1 / 0.08),
    "bilinear-tubes": (1, 1 / 0.04, 0, 1, 1 / 0.04, 10, 0),
    "bilinear-sponges": (1, 5, 0.8, 0, 0, 1, 0),
    "spatial-1": (1, 0, 0, 1, 0, 1, 0),
    "spatial-2": (1, 20, 0, 0, 0, 5, 0),
    "spatial-3": (1, 25, 0, 1, 12.5, 1, 12.5),
    "spatial-4": (1, 45, 0, 1, 45, 10, 0),
}


@pytest.mark.parametrize("name", B_FORMS)
def test_table_rows_by_both_their_columns(name: str) -> None:
    assert list(Coefficients.from_b(*B_FORMS[name])) == pytest.approx(list(preset(name).coefficients), rel=1e-12)


@given(b=st.tuples(*[finite] * 7), κ1=st.floats(-10, 10), κ2=st.floats(-10, 10))
def test_b_form_is_the_same_polynomial(b: tuple[float, ...], κ1: float, κ2: float) -> None:
    h2, H0, k1, α, κ10, β, κ20 = b
    direct = h2 * (κ1 + κ2 - H0) ** 2 + k1 * κ1 * κ2 + α * (κ1 - κ10) ** 2 + β * (κ2 - κ20) ** 2
    size = abs(h2) * (20 + abs(H0)) ** 2 + 100 * abs(k1) + (abs(α) + abs(β)) * 60**2 + 1
    if h2 + α > 0 and h2 + β > 0:
        assert Coefficients.from_b(*b).polynomial(κ1, κ2) == pytest.approx(direct, abs=1e-12 * size)
    else:
        with pytest.warns(UserWarning, match="bounded"):
            Coefficients.from_b(*b)


@given(a=coefficients, κ1=finite, κ2=finite, unit=st.floats(0.01, 100))
def test_laws_of_the_polynomial(a: Coefficients, κ1: float, κ2: float, unit: float) -> None:
    """Helfrich and Willmore are their formulas; p dA is one number in any unit of length; inside and outside change
    places with (κ1, κ2) ↦ (-κ2, -κ1); a factor is a factor."""
    p, size = a.polynomial(κ1, κ2), sum(map(abs, a)) * (1 + abs(κ1) + abs(κ2)) ** 2
    H, K = κ1 + κ2, κ1 * κ2
    helfrich = Coefficients.helfrich(bending=3.0, gaussian=-1.5, spontaneous=7.0)
    assert helfrich.polynomial(κ1, κ2) == pytest.approx(1.5 * (H - 7) ** 2 - 1.5 * K, abs=1e-9)
    assert Coefficients.willmore().polynomial(κ1, κ2) == pytest.approx(H**2, abs=1e-9)
    assert list(Coefficients.willmore()) == list(Coefficients.helfrich(2.0))
    assert a.in_unit(unit).polynomial(κ1 * unit, κ2 * unit) / unit**2 == pytest.approx(p, abs=1e-12 * size)
    assert list(a.in_unit(unit).in_unit(1 / unit)) == pytest.approx(list(a), rel=1e-12)
    assert a.mirror().polynomial(-κ2, -κ1) == pytest.approx(p, rel=1e-12, abs=1e-9)
    assert list(a.mirror().mirror()) == list(a)
    assert a.scale(unit).polynomial(κ1, κ2) == pytest.approx(unit * p, abs=1e-12 * unit * size)


def test_presets_are_the_published_values() -> None:
    tubes = preset("tubes")
    assert (list(tubes.coefficients), tubes.mass) == ([1, 2, 6, -40, -40, 400], -0.6)
    assert preset("bilinear-tubes").coefficients.a10 == -100
    assert all(-1 < shape.mass < 0 and shape.source for shape in PRESETS.values())


def test_every_name_of_a_preset_spells_that_preset() -> None:
    assert [preset_name(name.upper().replace("-", "_")) for name in PRESETS] == list(PRESETS)
    assert [preset_name(text) for text in ("bilineartubes", "", None, 3)] == [None] * 4
    for text in ("bilinear-tubes", "Bilinear_Tubes", "BILINEAR TUBES", " bilinear tubes "):
        assert preset(text) is PRESETS["bilinear-tubes"]
        assert Law.of(text).origin == "preset bilinear-tubes"


def test_presets_against_the_gallerys_file_names(data) -> None:
    folder = data / "gallery"
    if not folder.is_dir():
        pytest.skip(f"needs the gallery in {data}")
    for path in folder.glob("*.nii.gz"):
        name, rest = path.name.removesuffix(".nii.gz").split(" coeffs [")
        values, mass = rest.split("] m ")
        published = preset(name.replace(" ", "-"))
        assert list(published.coefficients) == [float(v) for v in values.split()], name
        assert published.mass == float(mass), name


def test_tensors_that_vary_in_space_keep_their_gradients() -> None:
    a00 = torch.linspace(0, 1, 5, requires_grad=True)
    [*Coefficients(1, 2, 3, a00=a00).in_unit(1.0)][5].sum().backward()
    torch.testing.assert_close(a00.grad, torch.ones(5))


def test_what_is_not_bounded_is_said() -> None:
    with pytest.warns(UserWarning, match="a02"):
        Coefficients(1, 0, -1)
