"""`compare`: sizes and powers of its tests, exact p-values, whole subjects, corrections, effect sizes, refusals."""

import itertools
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call, done, refused
from scipy import stats
from scipy.spatial.distance import cdist

import curvafit
from curvafit.core import permutation
from curvafit.core.permutation import correct_by_most, correlate, measure_effect, relabel
from curvafit.core.units import GLOSSARY
from curvafit.geometry.diagrams import Diagram
from curvafit.report.comparison import FILES, check_comparison, describe_methods, numbers_figure
from curvafit.scan.measures import QUANTITIES, Measures, Quantity
from curvafit.scan.tiles import measure
from curvafit.studies.comparison import LEVEL, Comparison, compare
from curvafit.studies.scans import MEASURED, merge_notes
from curvafit.volumes.volume import Volume

N = 32
#: Labels of nine values: numbers, three groups, and pairs with the blocks that they are exchanged in.
NUMBERS = np.array([0.0, 1, 1, 2, 5])
THREE = np.array([0, 0, 1, 1, 2, 2])
PAIRS, BLOCKS = np.array([0, 0, 0, 0, 1, 1, 1, 1]), np.array([0, 1, 2, 3, 0, 1, 2, 3])


def drawn(random: np.random.Generator, shift: float = 0.0) -> Measures:
    """A subject's measures without a scan: a cloud of curvatures about a random centre, and normal numbers."""
    points = random.standard_normal((60, 2)) + 0.5 * random.standard_normal(2) + shift
    diagram = Diagram(np.sort(points)[:, ::-1], random.random(60), unit="1/mm")
    rows = zip(QUANTITIES, random.standard_normal(len(QUANTITIES)) + shift, strict=True)
    quantities = tuple(Quantity(name, symbol, float(value), 0.1, power) for (name, symbol, power, _), value in rows)
    return Measures("", "mm", "mask", quantities, (1.0, 0.0, 0.0), diagram, (2, 2, 2), ())


def study(seed: int, counts: Sequence[int], shift: float = 0.0, **options: Any) -> Comparison:
    """Groups, each further shifted than the one before."""
    random = np.random.default_rng(seed)
    return compare(*([drawn(random, k * shift) for _ in range(n)] for k, n in enumerate(counts)), **options)


def dose(seed: int, numbers: Sequence[float], shift: float = 0.0) -> Comparison:
    random = np.random.default_rng(seed)
    return compare([drawn(random, shift * number) for number in numbers], by=numbers)


def pairs(seed: int, count: int, shift: float = 0.0, spread: float = 2.0, paired: bool = True) -> Comparison:
    """Subjects that differ much, each before and after."""
    random = np.random.default_rng(seed)
    own = spread * random.standard_normal(count)
    return compare([drawn(random, x) for x in own], [drawn(random, x + shift) for x in own], paired=paired)


# ---- arrangements and statistics -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("labels", "blocks"), [(NUMBERS, None), (THREE, None), (PAIRS, None), (PAIRS, BLOCKS)])
def test_all_distinct_arrangements_are_tried_the_given_one_first(labels: np.ndarray, blocks: np.ndarray | None) -> None:
    """Counted by hand: of all orders of the labels, those that leave each block its own labels."""
    every = set(itertools.permutations(labels.tolist()))
    parts = [] if blocks is None else [blocks == k for k in np.unique(blocks)]
    every = {row for row in every if all(sorted(np.array(row)[part]) == sorted(labels[part]) for part in parts)}
    arranged, exact = relabel(labels, len(every), blocks=blocks)
    assert exact and {tuple(row) for row in arranged.tolist()} == every and len(arranged) == len(every)
    assert (arranged[0] == labels).all()
    some, exact = relabel(labels, len(every) - 1, 3, blocks)
    assert not exact and len(some) == len(every) and {tuple(row) for row in some.tolist()} <= every
    assert (some[0] == labels).all() and (relabel(labels, len(every) - 1, 3, blocks)[0] == some).all()


def test_the_energy_of_more_groups_is_the_mean_of_their_pairs() -> None:
    """Weighted by the numbers of pairs of subjects: the between-sample dispersion of DISCO, to a constant.

    Of two it is 2 E|X - Y| - E|X - X'| - E|Y - Y'|: {0, 2} and {3} give 2 · 2 - 1 - 0 = 3.
    """
    away = np.abs(np.subtract.outer([0.0, 2.0, 3.0], [0.0, 2.0, 3.0]))
    assert permutation.measure_energy(away, np.array([[False, False, True]])) == pytest.approx([3.0])
    labels, points = np.array([0, 0, 0, 1, 1, 2, 2, 2, 2]), np.random.default_rng(0).standard_normal((9, 3))
    away, weights, energies = cdist(points, points), [], []
    for a, b in itertools.combinations(range(3), 2):
        own = np.isin(labels, (a, b))
        energies.append(permutation.measure_energy(away[np.ix_(own, own)], (labels[own] == b)[None])[0])
        weights.append((labels == a).sum() * (labels == b).sum())
    assert permutation.measure_energy(away, labels[None]) == pytest.approx([np.average(energies, weights=weights)])


def test_distance_correlation_is_its_definition() -> None:
    """By the double centring of Székely, Rizzo & Bakirov; 1 of what is the number itself."""
    random = np.random.default_rng(1)
    points, numbers = random.standard_normal((7, 2)), random.standard_normal(7)
    a, b = (cdist(each, each) for each in (points, numbers[:, None]))
    a, b = (each - each.mean(0) - each.mean(1)[:, None] + each.mean() for each in (a, b))
    expected = math.sqrt((a * b).mean() / math.sqrt((a * a).mean() * (b * b).mean()))
    away = cdist(points, points)
    assert permutation.measure_dependence(away, numbers[None]) == pytest.approx([expected])
    own = np.abs(np.subtract.outer(numbers, numbers))
    assert permutation.measure_dependence(own, numbers[None]) == pytest.approx([1.0])
    assert permutation.measure_dependence(np.zeros((7, 7)), numbers[None]) == [0.0]


def test_what_differs_between_blocks_changes_nothing() -> None:
    """Pairs are told by their differences: subjects may be as far apart as they like."""
    random, arranged = np.random.default_rng(2), relabel(PAIRS, 99, blocks=BLOCKS)[0]
    values = random.standard_normal((8, 2))
    moved = values + 40 * random.standard_normal((4, 2))[BLOCKS]
    one, other = (correlate(each, arranged, BLOCKS) for each in (values, moved))
    assert other == pytest.approx(one)
    assert measure_effect(moved[:4, 0], moved[4:, 0], paired=True) == pytest.approx(
        measure_effect(values[:4, 0], values[4:, 0], paired=True), rel=1e-6
    )


@pytest.mark.parametrize(
    ("kind", "labels", "blocks", "statistic"),
    [
        ("independent", PAIRS, None, lambda *x: abs(stats.ttest_ind(*x).statistic)),
        ("independent", THREE, None, lambda *x: stats.f_oneway(*x).statistic),
        ("samples", PAIRS, BLOCKS, lambda a, b: abs((b - a).mean())),
        ("pairings", NUMBERS, None, lambda x: abs(np.corrcoef(x, NUMBERS)[0, 1])),
    ],
)
def test_p_is_scipy_s_by_the_familiar_statistic(
    kind: Any, labels: np.ndarray, blocks: np.ndarray | None, statistic: Callable[..., float]
) -> None:
    """Student's t, Fisher's F, the mean difference of pairs, Pearson's r, over all permutations."""
    values = np.random.default_rng(3).standard_normal((len(labels), 3)) + 0.5 * labels[:, None]
    arranged, exact = relabel(labels, 9999, 0, blocks)
    assert exact
    for x, p in zip(values.T, permutation.share_beyond(correlate(values, arranged, blocks)), strict=True):
        parts = (x,) if kind == "pairings" else tuple(x[labels == k] for k in np.unique(labels))
        how = {"permutation_type": kind, "n_resamples": np.inf, "alternative": "greater", "vectorized": False}
        assert p == pytest.approx(stats.permutation_test(parts, statistic, **how).pvalue)


def test_correction_by_the_most_of_one_number_is_its_p() -> None:
    values = np.random.default_rng(2).standard_normal((8, 3))
    choices, _ = relabel(np.arange(8) > 3, 99)
    p, corrected = permutation.share_beyond(correlate(values, choices)), correct_by_most(values, choices)
    assert correct_by_most(values[:, :1], choices) == pytest.approx(p[:1])
    assert (corrected >= p - 1e-12).all() and (corrected <= np.minimum(3 * p, 1) + 1e-12).all()
    assert correct_by_most(np.repeat(values[:, :1], 9, axis=1), choices) == pytest.approx([p[0]] * 9)  # Holm: 9 p
    assert (correlate(np.ones((8, 1)), choices) == 0).all()


def test_the_effect_size_of_known_groups() -> None:
    """Means 2 apart, deviation 1, 4 degrees of freedom: g is 2 Γ(2) / (√2 Γ(3/2)) = 1.596."""
    g, low, high = measure_effect(np.array([1.0, 2, 3]), np.array([3.0, 4, 5]))
    assert g == pytest.approx(2 / (math.sqrt(2) * math.gamma(1.5)))
    t, scale = 2 / math.sqrt(2 / 3), math.sqrt(2 / 3) / (math.sqrt(2) * math.gamma(1.5))
    assert stats.nct.cdf(t, 4, low / scale) == pytest.approx(0.975, abs=1e-5)
    assert stats.nct.cdf(t, 4, high / scale) == pytest.approx(0.025, abs=1e-5)
    assert all(map(math.isnan, measure_effect(np.ones(3), np.ones(3))))


def test_intervals_of_effects_hold_as_often_as_they_say() -> None:
    """1000 draws tell .95 to ±.007; corrections for few move intervals by less than .02 of it."""
    random, held = np.random.default_rng(4), np.zeros(3)
    for _ in range(1000):
        x, y, z = random.standard_normal((3, 8))
        for k, (true, (_, low, high)) in enumerate((
            (1.0, measure_effect(x[:5], 1 + y[:6])),
            (1.0, measure_effect(9 * z, 9 * z + 1 + y, paired=True)),
            (0.6, permutation.measure_slope(0.6 * x + 0.8 * y, x)[1]),
        )):  # fmt: skip
            held[k] += low <= true <= high
    assert held / 1000 == pytest.approx(0.95, abs=0.03)


# ---- sizes and powers, and subjects ----------------------------------------------------------------------------------


MAKE: dict[str, Callable[[int, float], Comparison]] = {
    "two": lambda seed, shift: study(seed, (5, 5), shift, permutations=199),
    "three": lambda seed, shift: study(seed, (3, 3, 4), shift, permutations=199),
    "pairs": lambda seed, shift: pairs(seed, 7, shift),
    "number": lambda seed, shift: dose(seed, (0, 1, 2, 3, 4), shift),
}


@pytest.mark.parametrize("name", MAKE)
def test_any_false_finding_is_as_rare_as_said_and_power_grows(name: str) -> None:
    """At most .05 of null studies find any; 80 tell that to ±.0244, of which 3 are allowed."""
    found = [MAKE[name](seed, 0.0) for seed in range(80)]
    most = 0.05 + 3 * math.sqrt(0.05 * 0.95 / len(found))
    for any_found in (
        [each.p <= LEVEL for each in found],
        [min(number.family for number in each.numbers) <= LEVEL for each in found],
    ):
        assert np.mean(any_found) <= most
    shares = [np.mean([MAKE[name](seed, shift).p <= 0.05 for seed in range(8)]) for shift in (0.4, 3.0)]
    assert np.mean([each.p <= 0.05 for each in found]) < shares[0] + 0.01 and shares[1] == 1


@pytest.mark.parametrize(
    ("make", "labels", "count", "least"),
    [
        (study, (3, 3), 20, 2 / 20), (study, (2, 2, 2), 90, 6 / 90), (pairs, 6, 64, 2 / 64),
        (dose, (0, 1, 2, 3, 4), 120, 2 / 120), (dose, (0, 1, 10, 90, 90), 60, 1 / 60),
    ],
)  # fmt: skip
def test_what_is_apart_has_the_least_exact_p(make: Any, labels: Any, count: int, least: float) -> None:
    """Counted by hand: groups of one size may change their names, different numbers may be turned round."""
    found = make(0, labels, 90.0)
    assert found.exact and found.permutations == count
    assert found.p == pytest.approx(least) == found.least
    assert found.numbers[0].family == pytest.approx(least)
    assert ("few subjects" in found.status) == (least > 0.05)


def test_a_number_that_a_subject_lacks_is_not_tested() -> None:
    random = np.random.default_rng(9)
    scans = [drawn(random) for _ in range(6)]
    first, *others = scans[0].quantities
    scans[0] = replace(scans[0], quantities=(replace(first, value=math.nan), *others))
    for found in (
        compare(scans[:3], scans[3:]),
        compare(scans[::2], scans[1::2], paired=True),
        compare(scans, by=range(6)),
    ):
        number, *tested = found.numbers
        assert all(map(math.isnan, (number.p, number.family, number.effect, number.known)))
        assert all(math.isfinite(each.family) for each in tested)
    figure = numbers_figure(found, [each.symbol for each in found.numbers])
    assert sum(axes.axison for axes in figure.axes) == len(QUANTITIES)


def test_the_number_named_beforehand_leads_by_its_own_p() -> None:
    """A thickness that is apart where no diagram is: alone its p is the least, in a family of 22 it may not be."""
    random = np.random.default_rng(11)
    scans = [drawn(random) for _ in range(8)]
    for k, scan in enumerate(scans):
        rows = [replace(each, value=each.value + 99 * (k > 3) * (each.symbol == "Tb.Th")) for each in scan.quantities]
        scans[k] = replace(scan, quantities=tuple(rows))
    plain, named = (compare(scans[:4], scans[4:], primary=name) for name in (None, "Tb.Th"))
    assert plain.primary is None and named.primary == plain["thickness"] and named.primary.p == pytest.approx(2 / 70)
    assert plain.verdict.startswith("A and B differ: Tb.Th +") and [each.symbol for each in plain.found] == ["Tb.Th"]
    assert "diagrams are not told apart" in plain.status and named.verdict == "A and B differ by their thickness"
    assert named.verdict in named.status and named.verdict not in plain.status
    assert "thickness" in plain.status and "Tb.Th" in describe_methods(named)  # it differs most
    figure = numbers_figure(named, ["Tb.Th", "BV/TV"])
    marked = [[text.get_text() for text in axes.texts if "named beforehand" in text.get_text()] for axes in figure.axes]
    assert [len(each) for each in marked] == [1, 0]
    legend = " ".join(text.get_text() for text in figure.legends[0].get_texts())
    assert "bold: family-wise p ≤ 0.05" in legend and "where known" not in legend
    with pytest.raises(ValueError, match="primary"):
        compare(scans[:4], scans[4:], primary="nothing")


def test_scans_of_a_subject_are_never_parted() -> None:
    """Alike scans of a subject count once: neither their number nor their order changes any p."""
    random = np.random.default_rng(6)
    single = {name: [drawn(random, 0.8 * (name > "c"))] for name in "abcdef"}
    several = {name: scans * k for k, (name, scans) in enumerate(single.items(), 1)}
    once, often = (compare(*({n: s[n] for n in part} for part in ("abc", "def"))) for s in (single, several))
    assert often.counts == once.counts == (3, 3) and often.permutations == 20 and len(often.cases) == 21
    assert often.p == once.p
    assert often.statistic == pytest.approx(once.statistic, rel=0.01)  # quantiles interpolate between 60 points
    assert [each.p for each in often.numbers] == pytest.approx([each.p for each in once.numbers])
    apart = compare(*([scan for name in names for scan in several[name]] for names in ("abc", "def")))
    assert apart.p < once.p  # as if 21 scans were 21 subjects


def test_relabelling_changes_what_it_should_and_no_more() -> None:
    """Two numbers are two groups; another unit or origin of a number scales slopes; names of groups say nothing."""
    random = np.random.default_rng(8)
    scans = [drawn(random, 0.3 * k) for k in range(6)]
    groups, numbers = compare(scans[:3], scans[3:]), compare(scans, by=[7, 7, 7, 9, 9, 9])
    for a, b in zip(groups.numbers, numbers.numbers, strict=True):
        assert (a.p, a.family, a.difference) == pytest.approx((b.p, b.family, 2 * b.difference))
    assert groups.p == numbers.p
    one, other = (compare(scans, by=[a + b * k for k in (0, 1, 2, 4, 8, 9)]) for a, b in ((0, 1), (100, -7)))
    assert (other.p, other.statistic) == pytest.approx((one.p, one.statistic))
    for a, b in zip(one.numbers, other.numbers, strict=True):
        assert (a.p, a.family, a.difference, a.effect) == pytest.approx((b.p, b.family, -7 * b.difference, -b.effect))
    turned = compare(scans[3:], scans[:3])
    assert (turned.p, turned.statistic) == (groups.p, pytest.approx(groups.statistic))
    assert turned.differences == pytest.approx(-groups.differences)
    for a, b in zip(groups.numbers, turned.numbers, strict=True):
        assert (a.effect, a.low, a.p) == pytest.approx((-b.effect, -b.high, b.p), rel=1e-4)


# ---- shapes ----------------------------------------------------------------------------------------------------------


def balls(radius: float) -> np.ndarray:
    z, y, x = np.indices((N,) * 3) % 16 - 7.5
    return (z**2 + y**2 + x**2 < radius**2).astype(np.uint8)


def tubes(radius: float) -> np.ndarray:
    y, x = np.indices((N, N)) % 16 - 7.5
    return np.broadcast_to(np.hypot(y, x) < radius, (N, N, N)).astype(np.uint8)


def fields(shapes: Sequence[np.ndarray], edge: float = 0.01, unit: str = "mm") -> list[Volume]:
    return [Volume(shape, (edge,) * 3, unit) for shape in shapes]


RADII = (5.0, 5.4, 5.8, 6.2)


@pytest.fixture(scope="module")
def shapes() -> Comparison:
    return compare(fields([*map(tubes, RADII)]), fields([*map(balls, RADII)]), periodic=True, kind="mask")


def test_tubes_and_balls_differ_in_the_direction_that_they_do(shapes: Comparison) -> None:
    assert shapes.p == pytest.approx(2 / 70)
    assert shapes.verdict.startswith("A and B differ: ") and re.search("Of 22 numbers [0-9]+ differ", shapes.status)
    assert re.search("diagrams differ: p = 0.029, energy distance [0-9.]+ 1/mm", shapes.status)
    assert shapes["share of spheres"].difference > 0.9 and shapes["share of tubes"].difference < -0.9
    assert shapes["κ2"].low > 0 and shapes["share of spheres"].family == pytest.approx(2 / 70)
    κ2, κ1 = np.meshgrid(*[(shapes.edges[1:] + shapes.edges[:-1]) / 2] * 2, indexing="ij")
    less, more = shapes.differences[0].argmin(), shapes.differences[0].argmax()
    assert κ2.flat[less] < 0.5 * κ1.flat[less]  # tubes: κ2 is 0
    assert κ2.flat[more] > 0.5 * κ1.flat[more]  # balls: κ2 is κ1


def test_tubes_that_grow_go_with_time_and_in_another_order_do_not() -> None:
    """A circle of voxels has the radius of its area, and κ1 is its inverse to 5 %."""
    radii = (4.0, 4.5, 5.0, 5.5, 6.0)
    grown = compare(fields([*map(tubes, radii)]), by=(0, 7, 14, 28, 56), periodic=True, kind="mask")
    found = 0.16 * np.sqrt(grown.values[:, 0] / math.pi)
    assert found == pytest.approx(0.01 * np.array(radii), abs=0.005)
    assert grown.values[:, [each.symbol for each in grown.numbers].index("κ1")] == pytest.approx(1 / found, rel=0.05)
    assert grown.p == grown["BV/TV"].p == grown["κ1"].p == pytest.approx(2 / 120)
    assert grown["BV/TV"].effect > 0.9 and grown["κ1"].effect < -0.9
    other = compare([grown.measures[k] for k in (2, 0, 4, 1, 3)], by=range(5))
    assert other.p > 0.1 and not any(each.p <= 0.05 for each in other.numbers)
    same = compare([grown.measures[1]] * 5, by=range(5))
    assert same.p == 1 and {each.p for each in same.numbers} == {1.0}


def test_notes_that_differ_in_numbers_are_one_with_their_ranges() -> None:
    notes = [("3 of 1e-05.", "own"), ("-2.5 of 1e-05.",), ("7 of 1e-05.", "own")]
    scans = [replace(drawn(np.random.default_rng(0)), notes=each) for each in notes]
    assert list(merge_notes(scans)) == [([0, 1, 2], "-2.5 to 7 of 1e-05."), ([0, 2], "own")]


def test_units_are_converted(shapes: Comparison) -> None:
    mixed = compare(fields([*map(tubes, RADII)]), fields([*map(balls, RADII)], 10.0, "um"), periodic=True, kind="mask")
    assert mixed.unit == "mm" and mixed.p == shapes.p
    assert mixed.statistic == pytest.approx(shapes.statistic, rel=1e-4)
    for one, other in zip(mixed.numbers, shapes.numbers, strict=True):
        assert one.means == pytest.approx(other.means, rel=5e-4, abs=1e-5), one.name  # float32's distances
    assert any("converted" in note for note in mixed.notes)


# ---- files and the command -------------------------------------------------------------------------------------------


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the test stands: two folders of three tiny scans each, without spacing, of files with the same names."""
    for name, make in (("control", tubes), ("treated", balls)):
        (tmp_path / name).mkdir()
        for k, radius in enumerate((5.0, 5.5, 6.0)):
            np.save(tmp_path / name / f"m{k}.npy", make(radius))
    monkeypatch.chdir(tmp_path)
    return tmp_path


SCANS = [f"{group}/m{k}.npy" for group in ("control", "treated") for k in range(3)]


def test_a_figure_shows_the_numbers_that_are_named_in_their_order(shapes: Comparison) -> None:
    titles = [axes.get_title() for axes in numbers_figure(shapes, ["BV/TV", "Tb.Th"]).axes]
    assert titles == ["BV/TV", "Tb.Th (mm)"]


@pytest.mark.slow
def test_the_command_writes_a_folder_and_replaces_its_own(home: Path) -> None:
    done("compare", *SCANS, "--by", "a,a,b,b,$c,$c", "--periodic", "-o", "out")  # $c is no formula
    assert {path.name for path in (home / "out").iterdir()} == set(FILES)
    page = (home / "out" / "compare.html").read_text(encoding="utf-8")
    assert "a · m0.npy" in (home / "out" / "outlines.svg").read_text(encoding="utf-8")
    assert not re.search(rf'src="(?!data:)|href="(?!{GLOSSARY}#)', page)  # it stands alone, but for its words
    command = json.loads((home / "out" / "compare.json").read_text(encoding="utf-8"))["command"]
    assert check_comparison(home / "out", command=command) == home / "out"
    (home / "out" / FILES[0]).write_text("mine", encoding="utf-8")
    with pytest.raises(ValueError, match="free"):
        check_comparison(home / "out", command=command)


def test_a_table_names_groups_subjects_and_numbers(home: Path) -> None:
    """As sequences by subject do; two animals at three times have their times exchanged, 36 ways."""
    study = home / "study.csv"
    lines = [f"{path};{path[:7]};{path[0]}{k % 3 % 2};{path[0]};{k % 3 * 7};{k}" for k, path in enumerate(SCANS)]
    study.write_text("\n".join(["\ufeffScan;Group;Subject;Animal;Day;Dose", *lines]), encoding="utf-8")
    found = compare(study, periodic=True)
    assert found.groups == ("control", "treated") and found.counts == (2, 2) and len(found.cases) == 6
    assert any("counted in voxels" in note for note in found.notes)
    groups = ({f"{part[0][0]}0": part[::2], f"{part[0][0]}1": part[1:2]} for part in (SCANS[:3], SCANS[3:]))
    again = curvafit.compare(*groups, periodic=True)
    assert [name for _, name in again.subjects] == [name for _, name in found.subjects] and again.p == found.p
    dose = compare(study, by="animal", periodic=True)
    assert dose.groups == ("c", "t") and dose.by == "animal"
    study.write_text(study.read_text().replace("Subject", "Mouse").replace("Animal", "Subject"), encoding="utf-8")
    times = compare(study, by="Day", paired=True, periodic=True)
    assert times.groups == () and times.permutations == 36 and times.labels.tolist() == [0, 7, 14] * 2
    slopes = [np.polyfit([0, 7, 14], times.values[k : k + 3, 0], 1)[0] for k in (0, 3)]
    assert times["BV/TV"].difference == pytest.approx(np.mean(slopes))


def test_each_scan_is_measured_in_its_region(home: Path) -> None:
    """In a column of a table: with the numbers of `measure --roi`."""
    for path in SCANS:
        region = np.zeros((N,) * 3, np.uint8)
        region[4:, 2:30] = 1
        np.save(path.replace(".npy", "_roi.npy"), region)
    rows = [f"{path},{path[:7]},{path.replace('.npy', '_roi.npy')}" for path in SCANS]
    (home / "study.csv").write_text("\n".join(["scan,group,roi", *rows]), encoding="utf-8")
    found = compare(home / "study.csv")
    assert found.counts == (3, 3) and [case.roi for case in found.cases] == [home / row.split(",")[2] for row in rows]
    alone = [measure(path, roi=path.replace(".npy", "_roi.npy")) for path in SCANS]
    assert [scan["BV/TV"].value for scan in found.measures] == [scan["BV/TV"].value for scan in alone]
    assert found.measures[0]["BV/TV"].value != measure(SCANS[0])["BV/TV"].value
    where = "32 x 32 x 32 voxels, measured within a region of interest of 25100 voxel³"  # 28² · 32
    assert f"All 6 scans: {where}." in found.notes and where in describe_methods(found)
    sized = [measure(Volume(tubes(5.0), (h,) * 3, unit), roi=np.load("control/m0_roi.npy")).notes[0]
             for h, unit in ((0.02, "mm"), (20.0, "um"), (0.5, "um"))]  # fmt: skip
    assert [note.rpartition(" of ")[2] for note in sized] == ["0.201 mm³.", "0.201 mm³.", "3140 µm³."]


def test_first_notes_are_thresholds_by_group_and_masks_among_images(home: Path) -> None:
    """Thresholds lie apart in two groups of three; a mask that was left in a folder is asked about."""
    for path, level in zip(SCANS, (80, 82, 85, 120, 125, 130), strict=True):
        noise = np.random.default_rng(level).normal(0, 6, (N,) * 3)
        np.save(path, np.rint(level * (0.5 + np.load(path)) + noise).astype(np.uint8))
    found = compare("control", "treated")
    first = re.fullmatch(
        r"Otsu's thresholds: control (\S+) to (\S+), treated (\S+) to (\S+): they do not overlap; "
        r"try one --threshold for all\.", found.notes[0],
    )  # fmt: skip
    assert first, found.notes
    levels = [float(re.findall(r"threshold of (\S+):", " ".join(scan.notes))[0]) for scan in found.measures]
    ends = [end(levels[own]) for own in (slice(3), slice(3, 6)) for end in (min, max)]
    assert [float(end) for end in first.groups()] == pytest.approx(ends, rel=5e-3) and ends[1] < ends[2]
    assert any(re.match(r"control/m\d\.npy( and \d more)?: Smoothed", note) for note in found.notes), found.notes
    mixed = compare(SCANS, by=["a", "b"] * 3)
    assert "overlap" not in mixed.notes[0] and mixed.notes[0].startswith("Otsu's thresholds: a ")
    np.save("treated/x_otsu_mask.npy", balls(5.0))
    notes = compare("control", "treated").notes
    assert notes[0] == "treated has 3 images and 1 mask (x_otsu_mask.npy): is the mask a scan of its own?"
    assert notes[1] == found.notes[0]


def test_nothing_is_measured_twice(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of `measure` is compared as its scans are, by any column that it was given; none is read again."""
    rows = [f"{path},{path[:7]},{k % 3},{k}" for k, path in enumerate(SCANS)]
    (home / "study.csv").write_text("\n".join(["scan,group,subject,dose", *rows]), encoding="utf-8")
    done("measure", *SCANS, "--subjects", "study.csv", "--kind", "mask", "-o", "measured")
    fresh = {by: compare("study.csv", by=by, kind="mask", paired=True) for by in ("group", "dose")}
    monkeypatch.setattr("curvafit.studies.scans._measure_one", None)
    for by, expected in fresh.items():
        found = compare("measured", by=by, paired=True)
        assert (found.groups, found.subjects) == (expected.groups, expected.subjects)
        assert (found.p, found.statistic) == pytest.approx((expected.p, expected.statistic))
        assert [each.family for each in found.numbers] == pytest.approx([each.family for each in expected.numbers])
    refused(call("compare", "measured", "--by", "age", "-o", "out"), "age", progress=True)
    (home / "measured" / MEASURED).write_bytes(b"no")
    refused(call("compare", "measured", "-o", "out"), MEASURED, progress=True)


TIMES = "".join(f"{path},{path[:7]},{path[:7]},{k}\n" for k, path in enumerate(SCANS))
EACH = " ".join(SCANS)


@pytest.mark.parametrize(
    ("arguments", "table", "word"),
    [
        ("control treated", "", "t0.npy"), ("control nothing", "", "nothing"), ("control control", "", "apart"),
        ("control treated/m0.npy", "", "folder"), ("control", "", "two folders"), ("table.csv", "", "columns"),
        ("control treated --by age", "", "by"), ("control treated --permutations 5", "", "permutations"),
        ("control treated --output control", "", "write over"),
        ("control/m0.npy control/m1.npy --by 0,1", "", "more than 2"), (EACH + " --by 0,1", "", "label"),
        (EACH + " --by 1,1,1,1,1,1", "", "same"), (EACH + " --by a,a,a,b,b,nan", "", "subjects"),
        (EACH + " --by 1,2,3,4,5,inf", "", "finite"), (EACH + " --by 1,2,3,4,5,6 --paired", "", "pair"),
        ("table.csv", "scan,group\ncontrol/m0.npy,a\ncontrol/m0.npy,b\n", "each scan once"),
        ("table.csv", "scan,group\nnowhere.npy,1\ncontrol/m0.npy,2\n", "nowhere.npy"),
        ("table.csv --by time", "scan,subject,group,time\n" + TIMES, "--paired"),
        ("table.csv --by time", "scan,subject,group,time\n" + TIMES.replace(",5", ","), "row without"),
        ("table.csv", "scan,group,roi\ncontrol/m0.npy,1,no.npy\n", "no.npy"),
    ],
)  # fmt: skip
def test_bad_input_is_one_sentence_and_nothing_is_written(home: Path, arguments: str, table: str, word: str) -> None:
    (home / "table.csv").write_text(table, encoding="utf-8")
    if word == "t0.npy":  # too small to measure
        np.save(home / "treated" / word, np.indices((4, 4, 4)).sum(0) > 8)
    before = sorted(home.rglob("*"))
    refused(call("compare", "--output", "out", *arguments.split()), word, progress=True)
    assert sorted(home.rglob("*")) == before


def test_methods_can_be_copied(shapes: Comparison) -> None:
    """What was done, in the words of a paper: no results, no notes; some 120 words."""
    text = describe_methods(shapes)
    assert 90 <= len(text.split()) <= 140
    assert "32 x 32 x 32 voxels of 0.01 mm" in text and "all 70 permutations of groups" in text
    assert not re.search(r"p = |E = |Of curvature|Dropped", text)
