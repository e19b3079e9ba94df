"""The page of measured scans: its files, tables and names, and what is refused."""

import csv
from pathlib import Path

import numpy as np
import pytest
from calling import call, done, refused
from found import lattice

from curvafit.report.page import WORD, name_parts, outlines_figure, shorten
from curvafit.scan.measures import Measures, Outline
from curvafit.scan.tiles import measure
from curvafit.volumes.read import load
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import save


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Thin rods and thick ones, in mm and in um."""
    folder = tmp_path_factory.mktemp("scans")
    found = []
    for radius, edge, unit in ((4.5, 0.02, "mm"), (6.0, 20.0, "um")):
        mask = (lattice(56, 28, radius) > 0).astype(np.uint8)
        found.append(Path(save(Volume(mask, (edge,) * 3, unit), folder / f"r{10 * radius:.0f}.nii.gz")))
    return found


def rows_of(file: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(file.read_text(encoding="utf-8").splitlines()))


def test_a_folder_has_page_figures_and_table(scans: list[Path], tmp_path: Path) -> None:
    table = tmp_path / "mice.csv"
    table.write_text("scan,subject,group\nr45.nii.gz,m1,a\nr60.nii.gz,m2,b\n")
    words = ("measure", *scans, "--subjects", table, "-o", tmp_path / "out")
    done(*words)
    rows = rows_of(tmp_path / "out" / "measures.csv")
    assert {row["group"] for row in rows} == {"a", "b"}
    thickness = [float(row["value"]) for row in rows if row["symbol"] == "Tb.Th"]
    alone = [measure(scan).convert("mm")["Tb.Th"].value for scan in scans]
    assert thickness == pytest.approx(alone, rel=1e-9)
    assert {row["unit"] for row in rows if row["symbol"] == "Tb.Th"} == {"mm"}
    page = (tmp_path / "out" / "measures.html").read_text(encoding="utf-8")
    assert "What was taken for the structure" in page and (tmp_path / "out" / "outlines.png").exists()
    wide = rows_of(tmp_path / "out" / "wide.csv")
    assert [row["group"] for row in wide] == ["a", "b"]
    assert [float(row["Tb.Th (mm)"]) for row in wide] == thickness and "BV/TV" in wide[0]
    assert "<text" in (tmp_path / "out" / "numbers.svg").read_text(encoding="utf-8")
    done(*words)  # the same command replaces its own
    refused(call("measure", scans[0], "-o", tmp_path / "out"), "not free", progress=True)


def test_maps_lie_beside_the_page_of_one_scan(scans: list[Path], tmp_path: Path) -> None:
    said = done("measure", scans[0], "--maps", "-o", tmp_path / "out").stdout
    page = (tmp_path / "out" / "measures.html").read_text(encoding="utf-8")
    for symbol in ("Tb.Th.SD", "BS/BV", "BS/TV"):  # the table is on the page, and printed
        assert symbol in said and f"{symbol}<" in page
    assert not (tmp_path / "out" / "numbers.svg").exists()  # of one scan the table is enough
    thickness = load(tmp_path / "out" / "thickness.nii.gz")
    assert thickness.spacing == pytest.approx(load(scans[0]).spacing) and thickness.unit == load(scans[0]).unit
    assert thickness.values[thickness.values > 0].mean() == pytest.approx(measure(scans[0])["Tb.Th"].value, rel=1e-4)
    for words in (scans, [scans[0], "--windows", "16"]):
        refused(call("measure", *words, "--maps", "-o", tmp_path / "other"), "--maps", progress=True)
    refused(call("measure", scans[0], "--maps", "-o", tmp_path / "other.csv"), "--maps", progress=True)


def test_an_outline_shows_what_counted(scans: list[Path]) -> None:
    """Slices through the middle of a region, in which alone structure is outlined; lengths in the measures' unit."""
    found, region = measure(scans[0]), np.zeros((56, 56, 56), np.uint8)
    region[30:50, 4:20, 8:] = 1
    part = measure(scans[0], roi=region).convert("um").outline
    assert found.outline is not None and part is not None
    assert found.outline.places == (28, 28, 28) and part.places == (39, 11, 31)
    assert part.spacing == pytest.approx([1000 * h for h in found.outline.spacing])
    values = load(scans[0]).values
    assert (part.inside[0] == ((values > 0) & (region > 0))[39]).all()
    assert (part.levels[2] == values[..., 31]).all()
    figure = outlines_figure(["a", "b", "c"], [part, None, part], "um")
    assert figure is not None and len(figure.axes) == 6
    assert outlines_figure(["a"], [None], "um") is None


def test_a_slice_shows_its_contour_in_physical_places() -> None:
    """The outline of a ball of voxels of 0.1 mm misses its radius by half of one at most; the bar is 1 mm long."""
    inside = np.linalg.norm(np.indices((32, 32, 32)) - 15.5, axis=0) < 8
    outline = Outline.cut(Volume(inside.astype(np.uint8), (0.1,) * 3, "mm"), inside.__getitem__)
    figure = outlines_figure(["ball"], [outline], "mm")
    assert figure is not None
    for axes, width in zip(figure.axes, (1.0, 0.0, 0.0), strict=True):
        border = np.concatenate([path.vertices for path in axes.collections[0].get_paths()])
        assert 0.1 * np.hypot(*(border - 15.5).T) == pytest.approx(0.8, abs=0.05)
        assert sum(0.1 * np.ptp(bar.get_xdata()) for bar in axes.lines) == pytest.approx(width)
    assert figure.axes[0].texts[0].get_text() == "1\xa0mm"


def test_compartments_have_rows(scans: list[Path], tmp_path: Path) -> None:
    labels = np.ones((56, 56, 56), np.uint8)
    labels[28:] = 2
    labels[24:32, :6, :6] = 3  # without structure
    labels[(lattice(56, 28, 6.0) > 0) & ~(lattice(56, 28, 4.5) > 0) & (labels == 2)] = 4  # a shell of background
    region = save(Volume(labels, (0.02,) * 3, "mm"), tmp_path / "roi.nii.gz")
    twin = tmp_path / "twin.nii.gz"
    twin.write_bytes(scans[0].read_bytes())
    done("measure", scans[0], twin, "--roi", region, "--kind", "mask", "-o", tmp_path / "out")
    assert {row["compartment"] for row in rows_of(tmp_path / "out" / "measures.csv")} == {"1", "2", "3", "4"}
    page = (tmp_path / "out" / "measures.html").read_text(encoding="utf-8")
    assert "r45.nii.gz, compartment 2" in page and "No intervals" in page  # the note of a compartment


def test_scans_that_do_not_go_together_are_refused(scans: list[Path], tmp_path: Path) -> None:
    bare = tmp_path / "bare.npy"
    np.save(bare, (lattice(56, 28, 5.0) > 0).astype(np.uint8))
    refused(call("measure", bare, *scans, "-o", tmp_path / "out"), "physical spacing", progress=True)
    refused(call("measure", scans[0], "--labels", "-o", tmp_path / "out"), "no page", progress=True)
    refused(call("measure", scans[0], "-o", "/"), "of its own")
    refused(call("measure", scans[0], "-o", tmp_path / "study.v2"), "no suffix", progress=True)
    empty = save(Volume(np.zeros((40, 40, 40), np.uint8), (0.02,) * 3, "mm"), tmp_path / "empty.nii.gz")
    refused(call("measure", scans[0], empty, "-o", tmp_path / "out"), "empty.nii.gz", progress=True)
    assert not (tmp_path / "out").exists()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["bare.npy", "empty.nii.gz"]


def test_names_are_short_and_differ(scans: list[Path]) -> None:
    long = [f"{'x' * 20}{k}{'y' * 30}" for k in range(3)]
    assert len(set(shorten(long))) == 3 and max(map(len, shorten(long))) <= WORD + 2
    found: list[Measures] = [measure(scan).convert("mm") for scan in scans]
    assert name_parts(found) == ["r45.nii.gz", "r60.nii.gz"]
    assert len(set(name_parts([measure(lattice(56, 28, 5.0)), measure(lattice(56, 28, 6.0))]))) == 2  # arrays
