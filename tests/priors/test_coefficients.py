"""The ways to state a polynomial, and its laws."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import PRESETS, Law, preset, preset_name

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


@given(
    b=st.tuples(finite, finite, finite, finite, finite, finite, finite),
    κ1=st.floats(-10, 10),
    κ2=st.floats(-10, 10),
)
def test_b_form_is_the_same_polynomial(b: tuple[float, ...], κ1: float, κ2: float) -> None:
    h2, H0, k1, α, κ10, β, κ20 = b
    direct = h2 * (κ1 + κ2 - H0) ** 2 + k1 * κ1 * κ2 + α * (κ1 - κ10) ** 2 + β * (κ2 - κ20) ** 2
    size = abs(h2) * (20 + abs(H0)) ** 2 + 100 * abs(k1) + (abs(α) + abs(β)) * 60**2 + 1
    if h2 + α > 0 and h2 + β > 0:
        assert Coefficients.from_b(*b).polynomial(κ1, κ2) == pytest.approx(direct, abs=1e-12 * size)
    else:
        with pytest.warns(UserWarning, match="bounded"):
            Coefficients.from_b(*b)


@given(κ1=finite, κ2=finite)
def test_helfrich_and_willmore(κ1: float, κ2: float) -> None:
    H, K = κ1 + κ2, κ1 * κ2
    helfrich = Coefficients.helfrich(bending=3.0, gaussian=-1.5, spontaneous=7.0)
    assert helfrich.polynomial(κ1, κ2) == pytest.approx(1.5 * (H - 7) ** 2 - 1.5 * K, abs=1e-9)
    assert Coefficients.willmore().polynomial(κ1, κ2) == pytest.approx(H**2, abs=1e-9)
    assert list(Coefficients.willmore()) == list(Coefficients.helfrich(2.0))


@given(a=coefficients, κ1=finite, κ2=finite, unit=st.floats(0.01, 100))
def test_change_of_length_unit(a: Coefficients, κ1: float, κ2: float, unit: float) -> None:
    """κ is multiplied by the unit, areas divided by its square: p dA is one number."""
    size = sum(abs(v) for v in a) * (1 + abs(κ1) + abs(κ2)) ** 2
    assert a.in_unit(unit).polynomial(κ1 * unit, κ2 * unit) / unit**2 == pytest.approx(
        a.polynomial(κ1, κ2), abs=1e-12 * size
    )
    assert list(a.in_unit(unit).in_unit(1 / unit)) == pytest.approx(list(a), rel=1e-12)


@given(a=coefficients, κ1=finite, κ2=finite)
def test_mirror_swaps_inside_and_outside(a: Coefficients, κ1: float, κ2: float) -> None:
    assert a.mirror().polynomial(-κ2, -κ1) == pytest.approx(a.polynomial(κ1, κ2), rel=1e-12, abs=1e-9)
    assert list(a.mirror().mirror()) == list(a)


@given(a=coefficients, factor=st.floats(0.1, 10))
def test_scaled(a: Coefficients, factor: float) -> None:
    assert a.scale(factor).polynomial(1.0, -2.0) == pytest.approx(
        factor * a.polynomial(1.0, -2.0), abs=1e-9 * factor * (1 + sum(map(abs, a)))
    )


def test_presets_are_the_published_values() -> None:
    tubes = preset("tubes")
    assert (list(tubes.coefficients), tubes.mass) == ([1, 2, 6, -40, -40, 400], -0.6)
    assert preset("bilinear-tubes").coefficients.a10 == -100
    assert all(-1 < shape.mass < 0 and shape.source for shape in PRESETS.values())
    with pytest.raises(ValueError, match="preset"):
        preset("tube")


@pytest.mark.parametrize("text", ["bilinear-tubes", "Bilinear_Tubes", "BILINEAR TUBES", " bilinear tubes "])
def test_a_preset_is_known_by_any_spelling_of_its_name(text: str) -> None:
    assert preset(text) is PRESETS["bilinear-tubes"]
    assert Law.of(text).origin == "preset bilinear-tubes"


def test_every_name_of_a_preset_spells_that_preset() -> None:
    assert [preset_name(name.upper().replace("-", "_")) for name in PRESETS] == list(PRESETS)
    assert [preset_name(text) for text in ("bilineartubes", "", None, 3)] == [None] * 4


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
    stacked = Coefficients(1, 2, 3, a00=a00).tensor()
    assert stacked.shape == (6, 5)
    stacked[5].sum().backward()
    torch.testing.assert_close(a00.grad, torch.ones(5))


def test_domain_and_bad_values() -> None:
    with pytest.warns(UserWarning, match="a02"):
        Coefficients(1, 0, -1)
    with pytest.raises(ValueError, match="a11"):
        Coefficients(1, math.nan, 1)
    with pytest.raises(ValueError, match="unit"):
        Coefficients(1, 0, 1).in_unit(0)
