"""The random law of Experiment 4: its intervals, its uniformity, one stream a draw."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest

from curvafit.data_synth.design import INTERVALS, Design, boxed

#: (a20 … a00, m₀, noise seed) of draw 0 of seed 0.
FIRST_DRAW = (
    1.0,
    0.5210541244917071,
    14.035801512184953,
    -8.050181166984373,
    108.33339878129931,
    1527.9472836744717,
    -0.26087924301038296,
    3581274545,
)


def test_the_published_intervals_and_the_gauge():
    assert INTERVALS == {
        "a11": (-4, 4),
        "a02": (1 / 15, 15),
        "a10": (-200, 200),
        "a01": (-200, 200),
        "a00": (-3000, 3000),
        "mass": (-0.75, -0.15),
    }
    assert all(boxed().draw(0, index).coefficients.a20 == 1 for index in range(20))


@pytest.mark.parametrize("name", INTERVALS)
def test_each_parameter_is_uniform_on_its_interval(name):
    low, high = INTERVALS[name]
    draws = [boxed().draw(5, index) for index in range(1000)]
    values = np.array([mass if name == "mass" else getattr(coefficients, name) for coefficients, mass, _ in draws])
    assert low < values.min() and values.max() < high
    assert kstest(values, "uniform", (low, high - low)).pvalue > 0.01


def test_a_parameter_in_log_is_uniform_in_its_logarithm():
    design = boxed("sobol", ["a02"])
    values = np.array([design.draw(5, index).coefficients.a02 for index in range(1024)])
    low, high = INTERVALS["a02"]
    assert kstest(np.log(values), "uniform", (np.log(low), np.log(high / low))).pvalue > 0.01
    assert Design.from_dict(design.as_dict()) == design
    assert "log" not in boxed().as_dict(), "stores made before hold no such key"


def test_parameters_and_noise_seeds_are_uncorrelated():
    draws = [boxed().draw(1, index) for index in range(2000)]
    table = np.array([[*list(c)[1:], m, s] for c, m, s in draws])
    off_diagonal = np.corrcoef(table.T) - np.eye(7)
    assert np.abs(off_diagonal).max() < 4.5 / np.sqrt(2000)  # 21 pairs of null correlations, sd 1/√n each


def test_a_draw_depends_on_its_seed_and_index_alone():
    alone = boxed().draw(3, 17)
    in_order = [boxed().draw(3, index) for index in range(20)]
    assert in_order[17] == alone
    assert len({tuple(c) for c, _, _ in in_order}) == len({seed for _, _, seed in in_order}) == 20
    assert boxed().draw(4, 17) != alone


def test_the_law_stays_what_stores_and_atlases_were_made_with():
    coefficients, mass, seed = boxed().draw(0, 0)
    values = [*coefficients, mass, seed]
    assert values == pytest.approx(FIRST_DRAW, rel=1e-12)


def test_wrong_seeds_are_refused():
    for seed, index in ((-1, 0), (0, -1), (0.5, 0), (0, "1"), (True, 0)):
        with pytest.raises(ValueError, match="seed|index"):
            boxed().draw(seed, index)
