"""Designs: Experiment 4's random law, Sobol's sequence, lists, surroundings; their YAML."""

import numpy as np
import pytest
from scipy.stats import kstest

from curvafit.data_synth.design import INTERVALS, Design, design_around, design_box, read_design
from curvafit.priors.law import preset


def test_the_law_stays_what_stores_and_atlases_were_made_with():
    """The published intervals, the gauge, and draw 0 of seed 0."""
    published = {"a11": (-4, 4), "a02": (1 / 15, 15), "a10": (-200, 200), "a01": (-200, 200), "a00": (-3000, 3000)}
    assert published | {"mass": (-0.75, -0.15)} == INTERVALS
    coefficients, mass, seed = design_box().draw(0, 0)
    first = [1.0, 0.5210541244917071, 14.035801512184953, -8.050181166984373, 108.33339878129931, 1527.9472836744717]
    assert [*coefficients, mass, seed] == pytest.approx([*first, -0.26087924301038296, 3581274545], rel=1e-12)


@pytest.mark.parametrize("name", INTERVALS)
def test_each_parameter_is_uniform_on_its_interval(name):
    low, high = INTERVALS[name]
    draws = [design_box().draw(5, index) for index in range(1000)]
    values = np.array([mass if name == "mass" else getattr(coefficients, name) for coefficients, mass, _ in draws])
    assert low < values.min() and values.max() < high
    assert kstest(values, "uniform", (low, high - low)).pvalue > 0.01


def test_a_parameter_in_log_is_uniform_in_its_logarithm():
    design = design_box("sobol", ["a02"])
    values = np.array([design.draw(5, index).coefficients.a02 for index in range(1024)])
    low, high = INTERVALS["a02"]
    assert kstest(np.log(values), "uniform", (np.log(low), np.log(high / low))).pvalue > 0.01
    assert Design.from_dict(design.as_dict()) == design
    assert "log" not in design_box().as_dict(), "stores made before hold no such key"


def test_parameters_and_noise_seeds_are_uncorrelated():
    """And Sobol's sequence fills the box more evenly than chance."""
    draws = [design_box().draw(1, index) for index in range(2000)]
    rows = np.array([[*list(c)[1:], m, s] for c, m, s in draws])
    off_diagonal = np.corrcoef(rows.T) - np.eye(7)
    assert np.abs(off_diagonal).max() < 4.5 / np.sqrt(2000)  # 21 pairs of null correlations, sd 1/√n each
    low, high = np.array([*INTERVALS.values()]).T
    values = (table(design_box("sobol"), 256)[:, 1:] - low) / (high - low)
    for column in values.T:  # one point in every 256th part of every interval: a (0, m, s)-net seen from one side
        assert sorted(np.floor(256 * column).astype(int)) == list(range(256))
    assert not np.array_equal(table(design_box("sobol"), 4), table(design_box("sobol"), 4, seed=1))


def written(tmp_path, text: str):
    path = tmp_path / "design.yaml"
    path.write_text(text)
    return path


def table(design: Design, count: int, seed: int = 0) -> np.ndarray:
    return np.array([[*draw.coefficients, draw.mass] for draw in (design.draw(seed, i) for i in range(count))])


def test_a_draw_of_any_design_depends_on_seed_and_index_alone():
    many = [design_box().draw(0, index) for index in range(20)]
    assert len({tuple(draw.coefficients) for draw in many}) == 20 and many[17] != design_box().draw(4, 17)
    listed, near = Design("list", points=((1.0,) * 6 + (0.0,),)), design_around(table(design_box(), 1)[0], 0.1)
    for design in (design_box(), design_box("sobol"), near, listed):
        assert design.draw(3, 17) == design.draw(3, 17)
        assert Design.from_dict(design.as_dict()) == design
        assert len({design.draw(0, index).seed for index in range(20)}) == 20


@pytest.mark.parametrize(
    ("text", "design"),
    [
        ("law: sobol\nbox:\n  a11: [1, 2]\n  a02: 6\n", design_box("sobol", a11=(1, 2), a02=6)),
        ("log: [a02]\nbox: {a11: 2}\n", design_box("random", ["a02"], a11=2)),
        ("box: {a00: [-1e3, 1e3], a02: 6e-2}", design_box(a00=(-1000, 1000), a02=0.06)),  # texts in YAML
        ("\ufeffbox: {a11: 2}", design_box(a11=2)),
    ],
)
def test_a_box_in_yaml_changes_some_intervals_and_fixes_others(tmp_path, text, design):
    assert read_design(written(tmp_path, text)) == design
    found = table(design, 50)
    assert (found[:, 0] == 1).all()
    for values, (low, high) in zip(found.T, design.box, strict=True):
        assert low <= values.min() <= values.max() <= high and (low == high or np.ptp(values) > 0.7 * (high - low))


def test_surroundings_hold_their_point_and_have_the_asked_for_width(tmp_path):
    tubes = preset("tubes")
    found, centres = (
        table(read_design(written(tmp_path, "around: tubes\nspread: 0.2\n")), 300),
        [*tubes.coefficients, tubes.mass],
    )
    for column, centre, (low, high) in zip(found[:, 1:].T, centres[1:], INTERVALS.values(), strict=True):
        assert column.min() < centre < column.max()
        assert np.ptp(column) == pytest.approx(0.2 * (high - low), rel=0.05)
    scaled = design_around([2 * value for value in tubes.coefficients] + [tubes.mass], 0.2)
    np.testing.assert_allclose(table(scaled, 5), table(design_around(centres, 0.2), 5))


def test_a_list_comes_in_turn_with_other_noise(tmp_path):
    text = "list:\n  - sponge\n  - {a20: 1, a11: 2, a02: 3, a10: -4, a01: 5, a00: 6, mass: -0.3}\n"
    draws = [read_design(written(tmp_path, text)).draw(0, index) for index in range(4)]
    assert draws[0].coefficients == draws[2].coefficients == preset("sponge").coefficients
    assert [*draws[1].coefficients, draws[1].mass] == [1, 2, 3, -4, 5, 6, -0.3]
    assert draws[0].seed != draws[2].seed


#: Aliases of aliases: nine to the power of twelve values, in half a kilobyte.
BOMB = "a0: &a0 [1]\n" + "".join(f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * 9)}]\n" for k in range(12))


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("box: {a11: [1, 2]", "YAML"), ("- 1", "keys"), ("bxo: {a11: 3}", "bxo"), ("law: sobol", "box"),
        ("box: {}\nlist: []", "list"), ("list: []\nlaw: sobol", "law"), ("list: []", "7 parameters"),
        ("box: {\n", "line 2"), ("box: {a12: [1, 2]}", "a12"), ("box: {a11: [2, 1]}", "a11"),
        ("box: {a11: [1, two]}", "a11"), ("box: {a11: .nan}", "finite"), ("log: [a11]\nbox: {}", "a11"),
        ("log: [[a02]]\nbox: {}", "a02"), ("log: a02\nbox: {}", "a02"), ("log: [a02]\naround: tubes", "log"),
        ("box: {mass: [-2, 0]}", "-2"), ("law: even\nbox: {}", "even"), ("box: !!bool abc", "abc"),
        ("box: !!python/object:os.system {}", "YAML"), (f"box: {{a11: 1{'0' * 5000}}}", "digits"),
        ("[" * 100_000, "recursion"), ("box: &a [*a]", "box"), (BOMB, "a0"), (f"box: {'x' * 100_000}", "x"),
        ("around: tubs", "preset"), ("around: nowhere/fit.json", "nowhere"), ("around: tubes\nspread: wide", "spread"),
        ("around: tubes\nspread: 0", "spread"), ("list:\n - {a20: 1}", "a20"), (None, "design.yaml"),
    ],
)  # fmt: skip
def test_wrong_yaml_is_one_sentence(tmp_path, text, word):
    with pytest.raises((ValueError, FileNotFoundError), match=word) as error:
        read_design(tmp_path / "design.yaml" if text is None else written(tmp_path, text))
    assert "\n" not in str(error.value) and len(str(error.value)) < 600
