"""What scans tell of their laws, as numbers of a study: where it is known, and where it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from found import lattice

from curvafit.inference.candidates import Misfit
from curvafit.inference.infer import Inference, infer
from curvafit.scan.measure import Measures, measure
from curvafit.studies.compare import compare
from curvafit.studies.scans import add_combinations
from curvafit.volumes.field import Field

MASK = Field((lattice(56, 28, 5.0) > 0).astype(np.uint8), (0.02,) * 3, "mm")


@pytest.fixture(scope="module")
def both() -> tuple[Measures, Inference]:
    return measure(MASK), infer(MASK, fast=True)


def believed(inference: Inference, p: float) -> Inference:
    return replace(inference, fit=replace(inference.fit, misfit=Misfit(p, {}, "nothing")))


def told(measures: Measures, inference: Inference) -> np.ndarray:
    rows = add_combinations(measures, inference).quantities[-6:]
    return np.array([[each.value, each.half] for each in rows])


def test_combinations_are_those_of_the_fit(both: tuple[Measures, Inference]) -> None:
    measures, inference = both
    found = told(measures, believed(inference, 0.5))
    assert sorted(found[:, 0]) == pytest.approx(sorted(each.median for each in inference.fit.combinations))
    # A 95 % interval is wider than the fit's 90 % one.
    assert found[:, 1].sum() > sum(np.ptp(each.interval) / 2 for each in inference.fit.combinations)


def test_of_a_scan_that_no_law_makes_nothing_is_told(both: tuple[Measures, Inference]) -> None:
    measures, inference = both
    assert np.isnan(told(measures, believed(inference, 0.01))).all()
    noise = infer(Field((np.random.default_rng(0).random((32, 32, 32)) > 0.7).astype(np.uint8)), fast=True)
    assert np.isnan(told(measures, noise)).all()


def test_of_the_background_nothing_is_told() -> None:
    mostly = replace(MASK, values=1 - MASK.values)
    assert np.isnan(told(measure(mostly), infer(mostly, fast=True))).all()


def test_a_study_has_them_beside_its_numbers() -> None:
    series = [replace(MASK, values=np.roll(MASK.values, k, 0)) for k in range(3)]
    assert [each.symbol for each in compare(series, by=range(3), laws=True).numbers][-6:] == [
        f"L{k}" for k in range(1, 7)
    ]
    with pytest.raises(ValueError, match="measured already"):
        compare([measure(each) for each in series], by=range(3), laws=True)
