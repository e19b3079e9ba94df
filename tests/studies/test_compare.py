"""`compare`: sizes and powers of its tests, exact p-values, whole subjects, corrections, effect sizes, refusals."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call, refused
from scipy import ndimage, stats

import curvafit
from curvafit.core.permutation import (
    correct_by_most,
    correct_holm,
    correlate,
    measure_effect,
    measure_energy,
    relabel,
    share_beyond,
)
from curvafit.drawing.groups import numbers_figure
from curvafit.geometry.diagram import Diagram
from curvafit.report.comparison import FILES, check_comparison, describe_methods, write_comparison
from curvafit.scan.measure import QUANTITIES, Measures, Quantity, interval_reach
from curvafit.studies.compare import Comparison, compare
from curvafit.studies.scans import merge_notes
from curvafit.volumes.field import Field

N = 32


def drawn(random: np.random.Generator, shift: float = 0.0) -> Measures:
    """A subject's measures without a scan: a cloud of curvatures about a random centre, and normal numbers."""
    points = random.standard_normal((60, 2)) + 0.5 * random.standard_normal(2) + shift
    diagram = Diagram(np.sort(points)[:, ::-1], random.random(60), unit="1/mm")
    numbers = random.standard_normal(len(QUANTITIES)) + shift
    rows = zip(QUANTITIES, numbers, strict=True)
    quantities = tuple(Quantity(name, symbol, float(value), 0.1, power) for (name, symbol, power, _), value in rows)
    return Measures("", "mm", "mask", quantities, (1.0, 0.0, 0.0), diagram, (2, 2, 2), ())


def study(seed: int, counts: tuple[int, int], shift: float = 0.0, **options: int) -> Comparison:
    random = np.random.default_rng(seed)
    first, second = ([drawn(random, own) for _ in range(n)] for n, own in zip(counts, (0.0, shift), strict=True))
    return compare(first, second, **options)  # type: ignore[arg-type]


# ---- the tests' own truths -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def null() -> list[Comparison]:
    return [study(seed, (4, 4)) for seed in range(200)]


def test_p_is_uniform_under_the_null(null: Sequence[Comparison]) -> None:
    """35 values are as likely each; 200 studies tell a share to ±.035 at the most, and 4 of these are allowed."""
    for p in ([each.p for each in null], [each.numbers[3].p for each in null]):
        assert np.allclose(np.array(p) * 35, np.rint(np.array(p) * 35))
        for level in (7 / 35, 14 / 35, 21 / 35, 28 / 35):
            share = np.mean(np.array(p) <= level + 1e-9)
            assert share == pytest.approx(level, abs=4 * math.sqrt(level * (1 - level) / len(p)))


def test_corrections_hold_the_chance_of_any_false_finding(null: Sequence[Comparison]) -> None:
    """At most .05 of null studies find any; 200 tell that to ±.0154, and 3 of these are allowed."""
    for any_found in (
        [min(number.family for number in each.numbers) <= each.level for each in null],
        [min(number.holm for number in each.numbers) <= each.level for each in null],
        [bool(each.significant.any()) for each in null],
    ):
        assert np.mean(any_found) <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / len(null))


def test_power_grows_with_the_difference() -> None:
    found = [np.mean([study(seed, (5, 5), shift).p <= 0.05 for seed in range(12)]) for shift in (0.0, 0.5, 1.5)]
    assert found[0] <= 0.25 and found[0] < found[1] < found[2] == 1


@pytest.mark.parametrize(("counts", "least"), [((3, 3), 2 / 20), ((3, 4), 1 / 35), ((2, 2), 2 / 6)])
def test_groups_that_are_apart_have_the_least_exact_p(counts: tuple[int, int], least: float) -> None:
    found = study(0, counts, 50.0)
    assert found.exact and found.permutations == math.comb(sum(counts), counts[1])
    assert found.p == pytest.approx(least)
    assert [each.p for each in found.numbers] == pytest.approx([least] * len(QUANTITIES))
    assert ("few subjects" in found.status) == (least > 0.05)


def test_many_subjects_are_permuted_at_random() -> None:
    found = study(0, (6, 6), permutations=99)
    assert not found.exact and found.permutations == 100
    assert found.p * 100 == pytest.approx(round(found.p * 100)) and found.p >= 0.01
    assert study(0, (6, 6), permutations=99).p == found.p


def test_choices_are_distinct_and_begin_with_the_given_one() -> None:
    second = np.array([True, False, True, False, False])
    choices, exact = relabel(second, 10)
    assert exact and len(np.unique(choices, axis=0)) == len(choices) == 10
    assert (choices.sum(1) == 2).all() and (choices[0] == second).all()
    some, exact = relabel(second, 9)
    assert not exact and len(some) == 10 and (some[0] == second).all() and (some.sum(1) == 2).all()


def test_the_energy_distance_of_points_on_a_line() -> None:
    """2 E|X - Y| - E|X - X'| - E|Y - Y'| by hand: {0, 2} and {3} give 2 · 2 - 1 - 0 = 3."""
    x = np.array([0.0, 2.0, 3.0])
    away = np.abs(x[:, None] - x)
    assert measure_energy(away, np.array([[False, False, True]])) == pytest.approx([3.0])
    both = np.abs(np.subtract.outer([0.0, 2.0, 0.0, 2.0], [0.0, 2.0, 0.0, 2.0]))
    assert measure_energy(both, np.array([[False, False, True, True]])) == pytest.approx([0.0])


def test_correlation_orders_as_students_t_does() -> None:
    values = np.random.default_rng(1).standard_normal((7, 1))
    choices, _ = relabel(np.arange(7) > 3, 99)
    t = [abs(stats.ttest_ind(values[each, 0], values[~each, 0]).statistic) for each in choices]
    assert (np.argsort(t) == np.argsort(correlate(values, choices)[:, 0])).all()
    assert (correlate(np.ones((7, 1)), choices) == 0).all()


def test_correction_by_the_most_of_one_number_is_its_p() -> None:
    values = np.random.default_rng(2).standard_normal((8, 3))
    choices, _ = relabel(np.arange(8) > 3, 99)
    p, corrected = share_beyond(correlate(values, choices)), correct_by_most(values, choices)
    assert correct_by_most(values[:, :1], choices) == pytest.approx(p[:1])
    assert (corrected >= p - 1e-12).all() and (corrected <= np.minimum(3 * p, 1) + 1e-12).all()
    assert correct_by_most(np.repeat(values[:, :1], 9, axis=1), choices) == pytest.approx([p[0]] * 9)  # Holm: 9 p


def test_holm_and_benjamini_hochberg_on_known_values() -> None:
    p = np.array([0.01, 0.04, 0.03, 0.005])
    assert correct_holm(p) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert stats.false_discovery_control(p) == pytest.approx([0.02, 0.04, 0.04, 0.02])
    found = study(3, (5, 5), 1.0)
    own = np.array([each.p for each in found.numbers])
    assert [each.holm for each in found.numbers] == pytest.approx(correct_holm(own))
    assert [each.discovery for each in found.numbers] == pytest.approx(stats.false_discovery_control(own))


def test_the_effect_size_of_known_groups() -> None:
    """Means 2 apart, deviation 1, 4 degrees of freedom: g is 2 Γ(2) / (√2 Γ(3/2)) = 1.596."""
    g, low, high = measure_effect(np.array([1.0, 2, 3]), np.array([3.0, 4, 5]))
    assert g == pytest.approx(2 / (math.sqrt(2) * math.gamma(1.5)))
    t, scale = 2 / math.sqrt(2 / 3), math.sqrt(2 / 3) / (math.sqrt(2) * math.gamma(1.5))
    assert stats.nct.cdf(t, 4, low / scale) == pytest.approx(0.975, abs=1e-5)
    assert stats.nct.cdf(t, 4, high / scale) == pytest.approx(0.025, abs=1e-5)
    assert all(map(math.isnan, measure_effect(np.ones(3), np.ones(3))))


def test_intervals_of_the_effect_size_hold_as_often_as_they_say() -> None:
    """1000 draws tell .95 to ±.007; the correction for few moves the interval by less than .02 of it."""
    random, held = np.random.default_rng(4), 0
    for _ in range(1000):
        _, low, high = measure_effect(random.standard_normal(5), 1 + random.standard_normal(6))
        held += low <= 1 <= high
    assert held / 1000 == pytest.approx(0.95, abs=0.03)


def test_known_error_is_the_scans_own_share_of_the_variance() -> None:
    found = study(5, (4, 4))
    error = (0.1 / interval_reach((2, 2, 2))) ** 2
    for number in found.numbers:
        assert number.known == pytest.approx(error / np.mean(np.square(number.deviations)))


def test_a_number_that_a_subject_lacks_is_not_tested() -> None:
    random = np.random.default_rng(9)
    scans = [drawn(random) for _ in range(6)]
    first, *others = scans[0].quantities
    scans[0] = replace(scans[0], quantities=(replace(first, value=math.nan), *others))
    found = compare(scans[:3], scans[3:])
    number, *tested = found.numbers
    assert all(map(math.isnan, (number.p, number.holm, number.effect, number.known)))
    own = np.array([each.p for each in tested])
    assert [each.holm for each in tested] == pytest.approx(correct_holm(own))
    assert sum(axes.axison for axes in numbers_figure(found).axes) == len(QUANTITIES)


def test_the_number_named_beforehand_leads_by_its_own_p() -> None:
    """A thickness that is apart where no diagram is: alone its p is the least, in a family of 22 it may not be."""
    random = np.random.default_rng(11)
    scans = [drawn(random) for _ in range(8)]
    for k, scan in enumerate(scans):
        rows = [replace(each, value=each.value + 99 * (k > 3) * (each.symbol == "Tb.Th")) for each in scan.quantities]
        scans[k] = replace(scan, quantities=tuple(rows))
    plain, named = (compare(scans[:4], scans[4:], primary=name) for name in (None, "Tb.Th"))
    assert plain.primary is None and named.primary == plain["thickness"] and named.primary.p == pytest.approx(2 / 70)
    assert "not told apart" in plain.verdict and "not told apart" not in named.verdict
    assert named.verdict in named.status and named.verdict not in plain.status
    assert "thickness" in plain.status and "Tb.Th" in describe_methods(named)  # it differs most
    with pytest.raises(ValueError, match="primary"):
        compare(scans[:4], scans[4:], primary="nothing")


# ---- subjects --------------------------------------------------------------------------------------------------------


def by_subject(scans: Mapping[str, Sequence[Measures]], *names: str) -> dict[str, Sequence[Measures]]:
    return {name: scans[name] for name in names}


def test_scans_of_a_subject_are_never_parted() -> None:
    """Alike scans of a subject count once: neither their number nor their order changes any p."""
    random = np.random.default_rng(6)
    single = {name: [drawn(random, 0.8 * (name > "c"))] for name in "abcdef"}
    several = {name: scans * k for k, (name, scans) in enumerate(single.items(), 1)}
    once, often = (compare(by_subject(s, *"abc"), by_subject(s, *"def")) for s in (single, several))
    assert often.counts == once.counts == (3, 3) and often.permutations == 20 and len(often.cases) == 21
    assert often.p == once.p
    assert often.energy == pytest.approx(once.energy, rel=0.01)  # quantiles interpolate from point to point, of 60
    assert [each.p for each in often.numbers] == pytest.approx([each.p for each in once.numbers])
    assert np.nan_to_num(often.bins_p) == pytest.approx(np.nan_to_num(once.bins_p))
    apart = compare(*([scan for name in names for scan in several[name]] for names in ("abc", "def")))
    assert apart.p < once.p  # as if 21 scans were 21 subjects


def test_the_order_of_groups_turns_signs_only() -> None:
    random = np.random.default_rng(7)
    first, second = [drawn(random) for _ in range(4)], [drawn(random, 0.5) for _ in range(5)]
    one, other = compare(first, second), compare(second, first)
    assert (one.p, one.energy, one.apart) == pytest.approx((other.p, other.energy, other.apart))
    assert other.difference == pytest.approx(-one.difference)
    for a, b in zip(one.numbers, other.numbers, strict=True):
        assert (a.difference, a.effect, a.low, a.p) == pytest.approx((-b.difference, -b.effect, -b.high, b.p), rel=1e-4)


# ---- shapes ----------------------------------------------------------------------------------------------------------


def balls(radius: float) -> np.ndarray:
    z, y, x = np.indices((N,) * 3) % 16 - 7.5
    return (z**2 + y**2 + x**2 < radius**2).astype(np.uint8)


def tubes(radius: float) -> np.ndarray:
    y, x = np.indices((N, N)) % 16 - 7.5
    return np.broadcast_to(np.hypot(y, x) < radius, (N, N, N)).astype(np.uint8)


def fields(shapes: Sequence[np.ndarray], edge: float = 0.01, unit: str = "mm") -> list[Field]:
    return [Field(shape, (edge,) * 3, unit) for shape in shapes]


@pytest.fixture(scope="module")
def shapes() -> Comparison:
    radii = (5.0, 5.4, 5.8, 6.2)
    return compare(fields([*map(tubes, radii)]), fields([*map(balls, radii)]), periodic=True, kind="mask")


def test_tubes_and_balls_differ_in_the_direction_that_they_do(shapes: Comparison) -> None:
    assert shapes.p == pytest.approx(2 / 70)
    assert "differ" in shapes.status and re.search("of tubes falls .* of spheres rises", shapes.status)
    assert shapes["share of spheres"].difference > 0.9 and shapes["share of tubes"].difference < -0.9
    assert shapes["κ2"].low > 0 and shapes["share of spheres"].family == pytest.approx(2 / 70)
    κ2, κ1 = np.meshgrid(*[(shapes.edges[1:] + shapes.edges[:-1]) / 2] * 2, indexing="ij")
    more, less = shapes.significant & (shapes.difference > 0), shapes.significant & (shapes.difference < 0)
    assert more.any() and less.any()
    assert np.median(κ2[less]) < 0.5 * np.median(κ1[less])  # tubes: κ2 is 0
    assert np.median(κ2[more]) > 0.5 * np.median(κ1[more])  # balls: κ2 is κ1


def test_windows_of_one_texture_are_not_told_apart() -> None:
    random = np.random.default_rng(8)
    field = ndimage.gaussian_filter(random.standard_normal((2 * N, 2 * N, 2 * N)), 2.0, mode="wrap")
    mask = (field > np.quantile(field, 0.7)).astype(np.uint8)
    windows = [mask[z : z + N, y : y + N, x : x + N] for z in (0, N) for y in (0, N) for x in (0, N)]
    found = compare(windows[::2], windows[1::2])
    assert found.p > 0.1 and "not told apart" in found.status  # .9 here, which other processors move little
    assert any("counted in voxels" in note for note in found.notes)
    assert any("No intervals" in note for note in found.notes)


@pytest.mark.slow
def test_each_scans_threshold_is_told(tmp_path: Path) -> None:
    """Grey levels 20 and 20 + c split half way: each scan's threshold is in the record, their range in the methods."""
    contrasts = (100.0, 110.0, 120.0, 140.0)
    scans = fields([20 + c * tubes(5.0) for c in contrasts])
    found = compare(scans[:2], scans[2:], kind="image", periodic=True)
    write_comparison(found, tmp_path / "out")
    record = json.loads((tmp_path / "out" / "compare.json").read_text(encoding="utf-8"))
    for scan, contrast in zip(record["scans"], contrasts, strict=True):
        assert any(f"threshold of {20 + contrast / 2:g}:" in note for note in scan["notes"])
    assert "70–90" in record["methods"] and "0.01 mm" in record["methods"]
    assert any("70–90" in note for note in found.notes)


def test_notes_that_differ_in_numbers_are_one_with_their_ranges() -> None:
    notes = [("3 of 1e-05.", "own"), ("-2.5 of 1e-05.",), ("7 of 1e-05.", "own")]
    scans = [replace(drawn(np.random.default_rng(0)), notes=each) for each in notes]
    assert list(merge_notes(scans)) == [([0, 1, 2], "-2.5–7 of 1e-05."), ([0, 2], "own")]


def test_the_methods_cite_the_program(shapes: Comparison) -> None:
    cited = (Path(__file__).parents[2] / "CITATION.cff").read_text(encoding="utf-8")
    methods = describe_methods(shapes)
    for name in ("version", "- name", "doi", "journal", "- family-names"):
        match = re.search(rf"^\s*{name}: (.+)$", cited, re.MULTILINE)
        assert match and match[1] in methods


def test_intervals_of_subjects_with_one_scan_are_those_of_their_scans(shapes: Comparison) -> None:
    own = [[each.half for each in scan.quantities] for scan in shapes.measures]
    np.testing.assert_allclose(shapes.halves, own, rtol=1e-12)
    known = np.isfinite(shapes.halves) & (shapes.halves > 0)
    assert (shapes.halves[known] > 1.9 * shapes.errors[known]).all()  # Student's t reaches further than a normal


def test_units_are_converted(shapes: Comparison) -> None:
    radii = (5.0, 5.4, 5.8, 6.2)
    mixed = compare(fields([*map(tubes, radii)]), fields([*map(balls, radii)], 10.0, "um"), periodic=True, kind="mask")
    assert mixed.unit == "mm" and mixed.p == shapes.p
    assert mixed.energy == pytest.approx(shapes.energy, rel=1e-4)
    for one, other in zip(mixed.numbers, shapes.numbers, strict=True):
        assert one.means == pytest.approx(other.means, rel=5e-4, abs=1e-5), one.name  # float32's distances
    assert any("converted" in note for note in mixed.notes)


# ---- files and the command -------------------------------------------------------------------------------------------


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Two folders of three tiny scans each, without spacing."""
    pair = tmp_path / "control", tmp_path / "treated"
    for folder, make in zip(pair, (tubes, balls), strict=True):
        folder.mkdir()
        for k, radius in enumerate((5.0, 5.5, 6.0)):
            np.save(folder / f"{folder.name[0]}{k}.npy", make(radius))
    return pair


@pytest.mark.slow
def test_the_command_writes_a_folder(folders: tuple[Path, Path], tmp_path: Path) -> None:
    (folders[0] / "notes.txt").write_text("mine", encoding="utf-8")
    result = call("compare", *folders, "--spacing", 0.01, "--unit", "mm", "--periodic", "-o", tmp_path / "out")
    assert result.exit_code == 0, (result.output, result.exception)
    assert "control" in result.stdout and "notes.txt" in result.stderr
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(FILES)
    page = (tmp_path / "out" / "compare.html").read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(?!data:)', page)
    record = json.loads((tmp_path / "out" / "compare.json").read_text(encoding="utf-8"))
    assert record["p"] == pytest.approx(0.1) and record["permutations"] == 20 and record["exact"]
    assert record["methods"].split(";")[0] in page and "all 20 permutations" in record["methods"]
    rows = list(csv.DictReader((tmp_path / "out" / "measures.csv").read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 6 * len(QUANTITIES) and {row["group"] for row in rows} == {"control", "treated"}
    tests = list(csv.DictReader((tmp_path / "out" / "numbers.csv").read_text(encoding="utf-8").splitlines()))
    assert [row["quantity"] for row in tests] == ["curvature diagram", *(name for name, *_ in QUANTITIES)]
    assert check_comparison(tmp_path / "out", command=record["command"]) == tmp_path / "out"  # its own files


def test_a_table_names_groups_and_subjects(folders: tuple[Path, Path], tmp_path: Path) -> None:
    scans = [
        (path, f"{path.stem[0]}{int(path.stem[1]) % 2}") for folder in folders for path in sorted(folder.iterdir())
    ]
    table, mice = tmp_path / "study.csv", tmp_path / "mice.csv"
    lines = [f"{path.relative_to(tmp_path)};{path.parent.name};{subject}" for path, subject in scans]
    table.write_text("\n".join(["\ufeffScan;Group;Subject", *lines]), encoding="utf-8")
    found = compare(subjects=table, periodic=True)
    assert found.groups == ("control", "treated") and found.counts == (2, 2) and len(found.cases) == 6
    mice.write_text(
        "\n".join(["scan,subject", *(f"{path.name},{subject}" for path, subject in scans)]), encoding="utf-8"
    )
    again = curvafit.compare(*folders, subjects=mice, periodic=True)
    assert again.subjects == found.subjects and again.p == found.p


@pytest.mark.slow
def test_workers_measure_the_same(folders: tuple[Path, Path]) -> None:
    pytest.importorskip("distributed", reason="the extra 'synth' is not installed")
    alone, crew = (compare(*folders, periodic=True, workers=workers) for workers in (0, 2))
    assert crew.p == alone.p and [each.source for each in crew.measures] == [each.source for each in alone.measures]
    assert crew.values == pytest.approx(alone.values)
    tiny(*folders)
    with pytest.raises(ValueError, match="t0.npy"):
        compare(*folders, periodic=True, workers=2)


@pytest.mark.slow
def test_a_comparison_draws_and_writes_itself(shapes: Comparison, tmp_path: Path) -> None:
    assert len(shapes.plot().axes) >= 3
    page = write_comparison(shapes, tmp_path / "out")
    assert page.is_file() and "4 scans of 4 subjects" in describe_methods(shapes)
    foreign = tmp_path / "mine"
    foreign.mkdir()
    (foreign / "numbers.csv").write_text("a\n1\n", encoding="utf-8")
    with pytest.raises(ValueError, match="free"):
        write_comparison(shapes, foreign)
    assert [path.name for path in foreign.iterdir()] == ["numbers.csv"]


def flat(first: Path, second: Path) -> None:
    np.save(second / "t0.npy", np.eye(16, dtype=np.uint8))


def empty(first: Path, second: Path) -> None:
    np.save(second / "t0.npy", np.zeros((N, N, N), dtype=np.uint8))


def tiny(first: Path, second: Path) -> None:
    np.save(second / "t0.npy", np.indices((4, 4, 4)).sum(0) > 8)


def one(first: Path, second: Path) -> None:
    for path in list(second.iterdir())[1:]:
        path.unlink()


def none(first: Path, second: Path) -> None:
    for path in second.iterdir():
        path.unlink()


def mixed(first: Path, second: Path) -> None:
    curvafit.save(Field(balls(5.0), (0.01,) * 3, "mm"), second / "t9.nii.gz")


def hole(first: Path, second: Path) -> None:
    curvafit.save(Field(balls(5.0)), second / "t9.zarr")
    next(path for path in (second / "t9.zarr").rglob("c/*/*/*") if path.is_file()).unlink()


def inside(first: Path, second: Path) -> None:
    second.rename(first / "treated")


@pytest.mark.parametrize(
    ("damage", "arguments", "word"),
    [
        (one, "control treated", "2 subjects"),
        (none, "control treated", "none that can be read"),
        (None, "control nothing", "no such folder"),
        (None, "control treated/t0.npy", "folder"),
        (None, "control control", "apart"),
        (inside, "control control/treated", "apart"),
        (None, "control", "two groups"),
        (flat, "control treated", "t0.npy"),
        (empty, "control treated", "vary"),
        (tiny, "control treated", "t0.npy"),
        (mixed, "control treated", "spacing"),
        (hole, "control treated --strict", "t9.zarr"),
        (None, "control treated --permutations 5", "permutations"),
        (None, "control treated --output control", "write over"),
    ],
)
def test_bad_input_is_one_sentence_and_nothing_is_written(
    folders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, damage: Any, arguments: str, word: str
) -> None:
    home = folders[0].parent
    monkeypatch.chdir(home)
    if damage is not None:
        damage(*folders)
    before = sorted(home.rglob("*"))
    refused(call("compare", "--output", "out", *arguments.split()), word, progress=True)
    assert sorted(home.rglob("*")) == before


@pytest.mark.parametrize(
    ("arguments", "text", "word"),
    [
        ("", "scan,group\ncontrol/c0.npy,a\ncontrol/c0.npy,b\n", "each scan once"),
        ("", "scan,group\na,1\nb,2\nc,3\n", "two groups"),
        ("", "scan,group\nnowhere.npy,1\ncontrol/c0.npy,2\n", "nowhere.npy"),
        ("", "scan,mouse\ncontrol/c0.npy,1\n", "group"),
        ("", "", "columns"),
        ("control treated", "scan,subject\nc0.npy,1\n", "row for each scan"),
        ("control treated", "scan,subject\nc0.npy,\n", "row without"),
        ("control treated", "scan,subject,group\nc0.npy,1,a\n", "groups once"),
        ("control treated", "scan,subject\n" + "".join(f"{g}{k}.npy,{k}\n" for g in "ct" for k in range(3)), "in both"),
    ],
)
def test_a_bad_table_is_one_sentence(
    folders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, arguments: str, text: str, word: str
) -> None:
    home = folders[0].parent
    monkeypatch.chdir(home)
    (home / "table.csv").write_text(text, encoding="utf-8")
    before = sorted(home.rglob("*"))
    refused(call("compare", *arguments.split(), "--subjects", "table.csv", "-o", "out"), word, progress=True)
    assert sorted(home.rglob("*")) == before
