"""`compare` of bodies: a subject counts once, however many bodies it has; tables are read as they were written."""

import csv
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calling import call, done, refused
from scipy import stats

from curvafit.report.comparison import numbers_figure
from curvafit.scan.instances import measure_instances
from curvafit.scan.measures import Measures
from curvafit.scan.tiles import measure
from curvafit.studies.comparison import Comparison, compare
from curvafit.studies.scans import write_table
from curvafit.volumes.volume import Volume

EDGE = 0.5
#: Subjects of a group, and bodies of one.
SUBJECTS, BODIES = 4, 11


def spheres(radius: float) -> np.ndarray:
    """A label image (20, 40, 40) of four spheres and of a voxel too small for curvature; their median has a radius."""
    z, y, x = np.indices((20, 40, 40))
    labels = np.zeros(z.shape, np.uint8)
    for k in range(4):
        centre = 9.7, 9.7 + 20 * (k % 2), 9.7 + 20 * (k // 2)
        own = radius + 0.1 * (k - 1)
        labels[sum((a - c) ** 2 for a, c in zip((z, y, x), centre, strict=True)) < own**2] = k + 1
    labels[0, 0, 0] = 5
    return labels


@pytest.fixture(scope="module")
def body() -> Measures:
    """A sphere's measures in voxels, to be scaled: a law that all its numbers obey."""
    return measure_instances(spheres(8.0))[0]


def drawn(body: Measures, random: np.random.Generator, size: float, count: int = BODIES, unit: str = "um") -> tuple:
    """The bodies of a subject, whose lengths vary by a twentieth about its size."""
    scales = size * np.exp(0.05 * random.standard_normal(count))
    return tuple(
        replace(body.scale(scale, unit), source="labels.tif", part=("instance", k)) for k, scale in enumerate(scales, 1)
    )


def study(body: Measures, seed: int, spread: float, ratio: float = 1.0) -> list[dict[str, tuple[Measures, ...]]]:
    """Two groups of subjects, whose sizes vary by a `spread` and between groups by a `ratio`."""
    random = np.random.default_rng(seed)
    sizes = np.exp(spread * random.standard_normal((2, SUBJECTS))) * [[1], [ratio]]
    groups = zip("ab", sizes, strict=True)
    return [{f"{name}{k}": drawn(body, random, size) for k, size in enumerate(group)} for name, group in groups]


def volumes(bodies: Sequence[Measures]) -> np.ndarray:
    return np.array([each["V"].value for each in bodies])


# ---- subjects count, not bodies --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_subjects_that_differ_are_no_finding_however_many_their_bodies_are(body: Measures) -> None:
    """Of 40 studies without an effect a t-test of bodies finds most; one of subjects .05, to 3 deviations of 40."""
    by_subject, by_body = [], []
    for seed in range(40):
        one, other = study(body, seed, spread=0.3)
        found = compare(one, other, primary="V")
        by_subject.append(min(found["V"].p, *(number.family for number in found.numbers)))
        both = (np.concatenate([volumes(bodies) for bodies in group.values()]) for group in (one, other))
        by_body.append(stats.ttest_ind(*both).pvalue)
    assert np.mean(np.array(by_body) <= 0.05) > 0.5
    assert np.mean(np.array(by_subject) <= 0.05) <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / 40)


def test_an_effect_is_found_by_subjects(body: Measures) -> None:
    """Lengths by 1.3, and so volumes by 1.3³, between subjects that are alike: the least p that 4 and 4 can have."""
    found = compare(*study(body, 0, spread=0.02, ratio=1.3))
    assert found.of_bodies and found.counts == (SUBJECTS, SUBJECTS) and len(found.cases) == 2 * SUBJECTS * BODIES
    assert (found["V"].p, found["V"].family, found.least) == pytest.approx((2 / 70,) * 3)
    for symbol, power in (("V", 3), ("S", 2), ("Tb.Th", 1), ("BS/BV", -1), ("H", -1), ("K", -2)):
        one, other = found[symbol].means
        assert other / one == pytest.approx(1.3**power, rel=0.05 * abs(power))
    assert found["Ψ"].p == 1 and math.isnan(found["Ψ"].effect)  # the same of all spheres
    assert found.verdict.startswith("A and B differ: ") and "diagram" not in found.status


def test_a_subject_s_value_is_the_median_and_its_interval_that_of_the_median(body: Measures) -> None:
    """The median of 11 bodies drawn with replacement is at most the k-th if 6 draws or more are: binomial."""
    ranks = stats.binom.sf(BODIES // 2, BODIES, np.arange(BODIES + 1) / BODIES)
    one, other = study(body, 3, spread=0.1)
    other["b0"] = other["b0"][:4]
    found = compare(one, other)
    column = [number.symbol for number in found.numbers].index("V")
    for k, bodies in enumerate([*one.values(), *other.values()]):
        assert found.values[k, column] == pytest.approx(np.median(volumes(bodies)))
        sizes, shares = np.sort(volumes(bodies)), np.diff(ranks)
        error = math.nan  # of fewer than five bodies
        if len(bodies) == BODIES:
            error = math.sqrt(shares @ sizes**2 - (shares @ sizes) ** 2)
        assert found.halves[k, column] == pytest.approx(stats.norm.ppf(0.975) * error, nan_ok=True)


def test_bodies_without_curvature_are_counted_and_left_out(body: Measures) -> None:
    thin = tuple(replace(each, value=math.nan) if each.symbol in ("H", "K") else each for each in body.quantities)
    one, other = study(body, 5, spread=0.1)
    medians = compare(one, other).values
    some = {name: (*bodies, replace(body, unit="um", quantities=thin)) for name, bodies in one.items()}
    found = compare(some, other)
    assert any(f"not known of {SUBJECTS} of {2 * SUBJECTS * BODIES + SUBJECTS} bodies" in note for note in found.notes)
    column = [number.symbol for number in found.numbers].index("H")
    assert found.values[:, column] == pytest.approx(medians[:, column])
    none = compare({**one, "a0": some["a0"][-1:]}, other)
    assert math.isnan(none["H"].p) and math.isfinite(none["V"].p)
    assert numbers_figure(none, ["H", "V"]).axes


# ---- files and the command -------------------------------------------------------------------------------------------


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: Measures) -> Path:
    """Where the test stands: two folders of a table for each subject, a table of each group, and a table of all."""
    monkeypatch.chdir(tmp_path)
    rows = ["scan,group,subject,day"]
    groups, everything, columns = study(body, 0, spread=0.1, ratio=1.2), [], []
    for name, group in zip(("control", "drug"), groups, strict=True):
        Path(name).mkdir()
        together = []
        for k, (subject, bodies) in enumerate(group.items()):
            write_table(bodies, f"{name}/{subject}.csv")
            together += [replace(each, source=f"{name}/{subject}.tif") for each in bodies]
            columns += [{"group": name, "subject": f"m{k}", "day": str(7 * (name == "drug"))}] * len(bodies)
            rows.append(f"{name}/{subject}.csv,{name},m{k},{7 * (name == 'drug')}")
        write_table(together, f"{name}.csv")
        everything += together
    write_table(everything, "all.csv", columns=columns)
    Path("study.csv").write_text("\n".join(rows), encoding="utf-8")
    return tmp_path


def same(one: Comparison, other: Comparison) -> bool:
    """Whether the same subjects have the same values and tests."""
    assert other.values == pytest.approx(one.values, nan_ok=True)
    return [(n.p, n.family) for n in one.numbers] == [(n.p, n.family) for n in other.numbers]


def test_the_answer_is_the_same_however_the_tables_are_given(home: Path, body: Measures) -> None:
    groups = study(body, 0, spread=0.1, ratio=1.2)
    given = compare(*groups)
    listed = [list(group.values()) for group in groups]
    for found in (compare("control", "drug"), compare("control.csv", "drug.csv"), compare(*listed)):
        assert found.counts == given.counts and same(given, found)
    assert compare("control.csv", "drug").groups == ("control", "drug")
    paths = [f"{name}/{letter}{k}.csv" for name, letter in (("control", "a"), ("drug", "b")) for k in range(SUBJECTS)]
    assert same(given, compare(paths, by=["x"] * SUBJECTS + ["y"] * SUBJECTS))
    paired = compare("study.csv", paired=True)
    assert paired.blocks is not None and paired.permutations == 2**SUBJECTS
    assert same(paired, compare("all.csv", by="Group", paired=True)) and same(paired, compare(*listed, paired=True))
    numbers = compare("all.csv", by="day", paired=True)
    assert numbers.groups == () and numbers["V"].p == pytest.approx(paired["V"].p) and numbers["V"].difference > 0
    assert numbers_figure(numbers, ["V"]).axes and numbers.verdict.startswith("With day subjects")


def test_a_table_that_names_subjects_keeps_images_of_one_together(home: Path, body: Measures) -> None:
    """Of two images a subject; without the column each image is one."""
    for path, other in (("control.csv", "drug"), ("drug.csv", "control")):
        bodies = [each for k in range(2 * SUBJECTS) for each in drawn(body, np.random.default_rng(k), 1.0)]
        bodies = [replace(each, source=f"{k // BODIES}/labels.tif") for k, each in enumerate(bodies)]
        names = [{"subject": f"{path[0]}{k // BODIES // 2}"} for k in range(len(bodies))]
        write_table(bodies, path, overwrite=True)
        assert sorted(compare(path, other).counts) == [SUBJECTS, 2 * SUBJECTS]
        write_table(bodies, path, columns=names, overwrite=True)
    assert compare("control.csv", "drug.csv").counts == (SUBJECTS, SUBJECTS)


def test_lengths_are_converted(home: Path, body: Measures) -> None:
    given = compare("control", "drug")
    random = study(body, 0, spread=0.1, ratio=1.2)[1]
    for subject, bodies in random.items():
        write_table([each.convert("nm") for each in bodies], f"drug/{subject}.csv", overwrite=True)
    found = compare("control", "drug")
    assert found.unit == "um" and same(given, found) and any("converted" in note for note in found.notes)


@pytest.mark.slow
def test_the_command_compares_spheres_of_two_sizes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of radii 6 and 8 voxels: volume and mean curvature 1 / r to a twentieth, thickness 2 r to a voxel."""
    monkeypatch.chdir(tmp_path)
    for group, radius in (("control", 6.0), ("drug", 8.0)):
        for k in range(SUBJECTS):
            np.save(f"{group}{k}.npy", spheres(radius + 0.1 * k))
        images = [f"{group}{k}.npy" for k in range(SUBJECTS)]
        done("measure", *images, "--labels", "--spacing", str(EDGE), "--unit", "um", "-o", f"{group}.csv")
    done("compare", "control.csv", "drug.csv", "--primary", "V", "-o", "out")
    page = Path("out/compare.html").read_text(encoding="utf-8")
    assert f"control ({SUBJECTS} subjects, 20 bodies); drug ({SUBJECTS} subjects, 20 bodies)" in page
    assert "control and drug differ by their volume" in page and "not known of 8 of 40 bodies" in page
    with Path("out/subjects.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["bodies"] for row in rows] == ["5"] * 2 * SUBJECTS
    for k, row in enumerate(rows):
        radius = EDGE * ((6.0, 8.0)[k // SUBJECTS] + 0.1 * (k % SUBJECTS))
        assert float(row["V (um^3)"]) == pytest.approx(4 / 3 * math.pi * radius**3, rel=0.05)
        assert float(row["Tb.Th (um)"]) == pytest.approx(2 * radius, abs=EDGE)
        assert float(row["H (1/um)"]) == pytest.approx(1 / radius, rel=0.05)
    assert not Path("out/difference.png").exists() and Path("out/numbers.png").exists()
    refused(call("compare", "control.csv", "drug.csv", "-o", "out"), "free", progress=True)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ("control drug --spacing 2", "--spacing"), ("control drug --kind mask", "--kind"),
        ("control drug --primary Tb.Sp", "primary"), ("control mixed", "both"), ("control voxels", "physical spacing"),
        ("control whole", "none that can be read"), ("control cut", "no Ψ"), ("control bent", "no V in um^3"),
        ("control words", "1,5"), ("control.csv control.csv", "apart"), ("control.csv", "column group"),
        ("twice.csv", "each scan once"), ("all.csv --by cage", "column cage"), ("all.csv", "--paired"),
        ("region.csv", "region"),
    ],
)  # fmt: skip
def test_bad_input_is_one_sentence_and_nothing_is_written(
    home: Path, body: Measures, arguments: str, word: str
) -> None:
    for name in ("mixed", "voxels", "whole", "cut", "bent", "words"):
        Path(name).mkdir()
    table = Path("drug/b0.csv").read_text(encoding="utf-8")
    Path("mixed/b0.csv").write_text(table, encoding="utf-8")
    Path("cut/b0.csv").write_text(table.replace("sphericity,Ψ", "roundness,R"), encoding="utf-8")
    Path("bent/b0.csv").write_text(table.replace("um^3", "nm^3"), encoding="utf-8")
    Path("words/b0.csv").write_text(table.replace(f",{float(1)},", ',"1,5",'), encoding="utf-8")
    np.save("mixed/b1.npy", spheres(6.0) > 0)
    for name in ("b0", "b1"):
        write_table([replace(body, source="b.tif")], f"voxels/{name}.csv")
    write_table([measure(Volume(spheres(8.0) > 0, (1.0,) * 3, "um"))], "whole/b0.csv")
    Path("region.csv").write_text("scan,group,roi\ncontrol/a0.csv,1,mixed/b1.npy\n", encoding="utf-8")
    Path("twice.csv").write_text("scan,group\ncontrol/a0.csv,1\ncontrol/a0.csv,2\n", encoding="utf-8")
    before = sorted(home.rglob("*"))
    refused(call("compare", "--output", "out", *arguments.split()), word, progress=True)
    assert sorted(home.rglob("*")) == before


def test_bodies_need_a_subject(body: Measures) -> None:
    bodies = drawn(body, np.random.default_rng(0), 1.0)
    with pytest.raises(ValueError, match="by subject"):
        compare(bodies[:6], bodies[6:])


def test_a_number_that_a_subject_lacks_is_said_not_to_be_tested(home: Path, body: Measures) -> None:
    """Not as if it had been compared: a note, fewer numbers, and no primary."""
    random = study(body, 0, spread=0.1, ratio=1.2)[1]
    subject, bodies = next(iter(random.items()))
    lacks = [
        replace(each, quantities=tuple(replace(q, value=math.nan) if q.symbol == "H" else q for q in each.quantities))
        for each in bodies
    ]
    write_table(lacks, f"drug/{subject}.csv", overwrite=True)
    found = compare("control", "drug")
    assert any(f"Not tested, as not known of {subject}: H" in note for note in found.notes)
    assert found.count == len(found.numbers) - 1 and f"of {found.count} numbers" in found.status.lower()
    with pytest.raises(ValueError, match=f"not known of .*{subject}"):
        compare("control", "drug", primary="H")
