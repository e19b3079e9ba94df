"""A scan in tiles has the numbers of the scan in one piece, whatever the tiles; a killed run goes on."""

import csv
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from calling import call, done, refused
from scipy import ndimage
from shapes import grown

from curvafit.core.workers import cluster
from curvafit.geometry.balls import border_distance, paint_balls, paint_coarse_balls
from curvafit.geometry.morphology import local_thickness
from curvafit.scan import tiles
from curvafit.scan.instances import OF_BODIES, measure_instances
from curvafit.scan.measures import Measures
from curvafit.scan.survey import Plan
from curvafit.scan.tiles import measure
from curvafit.volumes import ScanError, Volume, save
from curvafit.volumes.volume import cut_boxes, grow

#: Shapes of scans, in voxels: of quick tests, and of those of any size of tiles, which have intervals.
SMALL, LARGE = (66, 51, 54), (99, 67, 73)


def texture(shape: tuple[int, int, int] = SMALL) -> np.ndarray:
    """A grown texture, repeated as far as a shape goes."""
    phase = grown("tubes", 48, 1).numpy()
    return phase[np.ix_(*(np.arange(n) % 48 for n in shape))]


def noisy(mask: np.ndarray, seed: int = 0) -> np.ndarray:
    """The image of a mask, float32: grey levels of contrast 100 under noise of 20."""
    grey = 100 * ndimage.gaussian_filter(mask.astype(np.float32), 0.7)
    return grey + np.random.default_rng(seed).normal(0, 20, mask.shape).astype(np.float32)


def scans(shape: tuple[int, int, int] = SMALL) -> dict[str, Volume]:
    mask = texture(shape) > 0
    flat = mask[::2]
    return {
        "mask": Volume(mask.astype(np.uint8), 0.5, "um"),  # type: ignore[arg-type]
        "image": Volume(noisy(mask), 0.5, "um"),  # type: ignore[arg-type]
        "dark levels": Volume(np.clip(200 - noisy(mask), 0, 255).astype(np.uint8)),
        "field": Volume(texture(shape)),
        "slices": Volume(flat.astype(np.uint8), (2.0, 1.0, 1.0), "nm"),
        "slices of an image": Volume(noisy(flat), (2.0, 1.0, 1.0), "nm"),
    }


def check_alike(found: Measures, whole: Measures) -> None:
    """Sums over tiles are those over the whole but for the order of additions, in float32 for triangles: shares of some
    ten thousand of them differ by under a millionth, and χ, of which whole numbers are summed, not at all."""
    for one, other in zip(found.quantities, whole.quantities, strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-6, abs=1e-9), one.name
        # an interval is made of differences of such sums
        assert one.half == pytest.approx(other.half, rel=1e-3, abs=1e-7, nan_ok=True), one.name
    assert found["χ"].value == whole["χ"].value
    assert (found.kind, found.unit, found.blocks) == (whole.kind, whole.unit, whole.blocks)
    assert [note for note in found.notes if not note.startswith("Measured in")] == list(whole.notes)
    assert found.direction == pytest.approx(whole.direction, abs=1e-6)
    assert found.diagram.area == pytest.approx(whole.diagram.area, rel=1e-6)
    assert found.diagram.mean() == pytest.approx(whole.diagram.mean(), rel=1e-5)
    assert found.outline is not None and whole.outline is not None and found.outline.places == whole.outline.places
    for one, other in zip(found.outline.inside, whole.outline.inside, strict=True):
        assert (one != other).mean() < 0.01  # specks, which tiles outline as well


@pytest.mark.parametrize(
    ("name", "edge", "shape"),
    [
        ("mask", 48, SMALL), ("image", 33, SMALL), ("slices", 32, SMALL), ("dark levels", 51, SMALL),
        *(pytest.param(name, edge, LARGE, marks=pytest.mark.slow)
          for k, name in enumerate(("mask", "image", "field", "slices", "slices of an image"))
          for edge in ((33, 64), (47, 96))[k % 2]),
    ],
)  # fmt: skip
def test_tiles_of_any_size_equal_the_whole(name: str, edge: int, shape: tuple[int, int, int]) -> None:
    """An edge of 48 leaves a last tile of 3 voxels along y, one of 51 along x, and 32 one of 1 voxel along z of 33."""
    scan, dark = scans(shape)[name], name.startswith("dark")
    check_alike(measure(scan, tile=edge, dark=dark), measure(scan, dark=dark))


def test_wide_balls_are_those_of_the_whole() -> None:
    """A background with balls of over 24 voxels in radius is painted on a coarser grid, in tiles too."""
    z, y, x = np.ogrid[:104, :70, :66]
    mask = np.zeros((104, 70, 66), dtype=bool)
    for row, column in ((6, 8), (64, 60), (62, 6), (8, 58)):
        mask |= np.hypot(y - row, x - column - 3 * np.sin(z / 12)) < 5
    assert 24 < border_distance(~mask, (1.0, 1.0, 1.0)).max() < tiles.WIDEST
    scan = Volume(mask.astype(np.uint8))
    check_alike(measure(scan, tile=52), measure(scan))


def test_a_label_is_measured_in_tiles() -> None:
    labels = np.where(texture() > 0, 7, 3).astype(np.uint16)
    found = measure(labels, label=7, tile=64)
    check_alike(found, measure(labels, label=7))
    with pytest.raises(ScanError, match="label 5"):
        measure(labels, label=5, tile=64)


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.3, 0.17, 0.17)])
def test_balls_of_a_core_are_those_of_the_whole(spacing: tuple[float, float, float]) -> None:
    mask, core = texture((50, 48, 44)) > 0, (slice(20, 34), slice(18, 30), slice(10, 20))
    for phase in (mask, ~mask):
        radius = border_distance(phase, spacing)
        assert radius == pytest.approx(ndimage.distance_transform_edt(phase, sampling=spacing), rel=1e-6)
        whole = paint_balls(radius, spacing)
        assert np.array_equal(2 * whole, local_thickness(phase, spacing))
        assert np.array_equal(paint_balls(radius, spacing, core=core)[core], whole[core])
        assert np.mean(paint_coarse_balls(radius, spacing, 2)[phase]) == pytest.approx(whole[phase].mean(), rel=0.1)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scan = Volume(noisy(texture((70, 48, 48)) > 0), 0.5, "um")  # type: ignore[arg-type]
    return save(scan, tmp_path_factory.mktemp("scans") / "scan.zarr")


@pytest.mark.slow
def test_workers_make_the_same_bytes(store: Path, tmp_path: Path) -> None:
    with cluster(2) as crew:
        two = measure(store, tile=40, workers=crew)
    one = measure(store, tile=40)
    numbers = [np.array([(each.value, each.half) for each in found.quantities]) for found in (one, two)]
    assert numbers[0].tobytes() == numbers[1].tobytes()
    assert two.diagram.points.tobytes() == one.diagram.points.tobytes()


def test_the_same_command_goes_on_after_a_kill(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, target = tmp_path / "whole.csv", tmp_path / "killed.csv"
    done("measure", store, "--tile", 40, "-o", whole)
    calls: list[int] = []

    def stop(plan: Plan, number: int, measured=tiles.measure_tile) -> object:
        calls.append(number)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return measured(plan, number)

    monkeypatch.setattr(tiles, "measure_tile", stop)
    result = call("measure", store, "--tile", 40, "-o", target)
    assert result.exit_code == 130 and "same command" in result.stderr
    assert not target.exists()
    refused(call("measure", store, "--tile", 36, "-o", target), "tile")
    done("measure", store, "--tile", 40, "-o", target)
    assert calls[3:] == [2, 3, 4, 5, 6, 7]
    assert target.read_bytes() == whole.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["killed.csv", "whole.csv"]


def test_bad_input_ends_in_one_sentence(store: Path, tmp_path: Path) -> None:
    values = noisy(texture((64, 40, 40)) > 0)
    broken, out = tmp_path / "nan.npy", tmp_path / "table.csv"
    values[50, 3, 3] = np.nan
    np.save(broken, values)
    flat = tmp_path / "flat.npy"
    np.save(flat, np.full((64, 40, 40), 3, np.uint8))
    for arguments, word in (
        ((broken,), "finite"), ((flat,), "vary"), ((flat, "--label", 3), "label"), ((store, "--labels"), "tile"),
        ((store, "--threshold", 1e6), "threshold"), ((store, "--tile", 8), "tile"), ((store, "--periodic"), "tile"),
    ):  # fmt: skip
        more = () if "--tile" in arguments else ("--tile", 40)
        refused(call("measure", *arguments, *more, "-o", out), word, progress=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flat.npy", "nan.npy"]


def test_a_store_that_ends_while_it_is_read(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = (texture((64, 40, 40)) > 0).astype(np.uint8)
    scan, out = tmp_path / "scan.npy", tmp_path / "table.csv"
    np.save(scan, values)

    def cut(plan: Plan, number: int, measured=tiles.measure_tile) -> object:
        if number == 1:
            scan.write_bytes(scan.read_bytes()[:5000])
        return measured(plan, number)

    monkeypatch.setattr(tiles, "measure_tile", cut)
    refused(call("measure", scan, "--tile", 40, "-o", out), "scan.npy", progress=True)
    assert [path.name for path in tmp_path.iterdir()] == ["scan.npy"]


# ---- instances -------------------------------------------------------------------------------------------------------

#: Label, centre and radius of balls: 5 and 9 touch, 8 is half outside.
BALLS = ((5, (20, 20, 18), 12), (9, (20, 20, 40), 10), (300, (20, 20, 64), 8), (8, (0, 20, 64), 9))
ROD, ROW = 11, 2


@pytest.fixture(scope="module")
def labels() -> np.ndarray:
    values = np.zeros((40, 52, 84), np.uint16)
    z, y, x = np.indices(values.shape)
    for label, centre, radius in BALLS:
        values[(z - centre[0]) ** 2 + (y - centre[1]) ** 2 + (x - centre[2]) ** 2 < radius**2] = label
    values[(np.hypot(z - 20, y - 42) < 4) & (x >= 10) & (x < 60)] = ROD
    values[36, 36, 70:80] = ROW
    return values


@pytest.fixture(scope="module")
def bodies(labels: np.ndarray) -> dict[int, Measures]:
    found = measure_instances(Volume(labels, (0.5, 0.5, 0.5), "um"))
    assert all(each.part is not None and each.part[0] == "instance" for each in found)
    return {each.part[1]: each for each in found if each.part}


def test_balls_have_their_radius_and_volume(bodies: dict[int, Measures], labels: np.ndarray) -> None:
    assert sorted(bodies) == [ROW, 5, 8, 9, ROD, 300]
    for label, _, radius in BALLS:
        ball, r = bodies[label], radius / 2
        assert ball["V"].value == np.count_nonzero(labels == label) * 0.5**3
        assert ball["Tb.Th"].value == pytest.approx(2 * r, rel=0.05)
        assert ball["H"].value == pytest.approx(1 / r, rel=0.1)
        assert ball["χ"].value == 1
        assert ball["S"].value == pytest.approx((2 if label == 8 else 4) * math.pi * r**2, rel=0.06)
        assert ball["S.cut"].value == pytest.approx(math.pi * r**2 if label == 8 else 0, rel=0.05)
        if label != 8:
            assert ball["V"].value == pytest.approx(4 / 3 * math.pi * r**3, rel=0.03)
            assert (ball["Ψ"].value, ball["E"].value) == pytest.approx((1, 1), abs=0.03)


def test_rods_rows_and_units(bodies: dict[int, Measures]) -> None:
    rod, row, ball = bodies[ROD], bodies[ROW], bodies[300]
    assert rod["E"].value == pytest.approx(math.sqrt(50**2 / 12 / (45 / math.pi / 4)), rel=0.02)  # a disk of 45 voxels
    assert rod["Tb.Th"].value == pytest.approx(4, rel=0.1)
    assert rod["share of tubes"].value > 0.7  # the ends have the rest
    assert abs(rod.direction[2]) == pytest.approx(1, abs=0.01)
    assert row["V"].value == 10 * 0.5**3 and row["E"].value == pytest.approx(10)
    assert math.isnan(row["H"].value) and "curvature" in row.notes[0]  # too thin for any
    assert ball.convert("nm")["V"].value == pytest.approx(ball["V"].value * 1e9)
    assert ball["V"].format("um")[2] == "µm³"


def test_neighbours_change_nothing(labels: np.ndarray, bodies: dict[int, Measures]) -> None:
    (alone,) = measure_instances(Volume(np.where(labels == 9, 1, 0), (0.5, 0.5, 0.5), "um"))
    assert alone.part == ("instance", 1)
    assert [each.value for each in alone.quantities] == [each.value for each in bodies[9].quantities]


def test_one_body_of_several_pieces_is_said(labels: np.ndarray, tmp_path: Path) -> None:
    """Pieces that touch at a corner are one: of a mask of three boxes the number is said, of one box nothing."""
    path = tmp_path / "mask.npy"
    for several in (True, False):
        mask = np.zeros((30, 30, 70), np.uint8)
        mask[5:20, 5:20, 5:20] = mask[20:25, 20:25, 20:25] = 4
        mask[5:20, 5:20, 30:45] = mask[5:20, 5:20, 50:65] = 4 * several
        np.save(path, mask)
        result = done("measure", path, "--labels")
        assert result.stdout.endswith("1 body; 0 cut by the border, 0 too thin for curvature.\n")
        assert ("Label 4 is 3 pieces" in result.stderr) == ("pieces" in result.stderr) == several


def test_the_command_writes_rows_for_each_instance(labels: np.ndarray, tmp_path: Path) -> None:
    path, table = tmp_path / "labels.npy", tmp_path / "table.csv"
    np.save(path, np.where(labels == ROD, 0, labels))
    done("measure", path, "--labels", "-o", table)
    rows = list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))
    names = [str(label) for label in (ROW, 5, 8, 9, 300)]
    assert [row["instance"] for row in rows] == [name for name in names for _ in OF_BODIES]
    assert rows[0]["unit"] == "voxel^3"
    np.save(tmp_path / "grey.npy", np.random.default_rng(0).integers(0, 200, (20, 20, 20)))
    np.save(tmp_path / "part.npy", labels + 0.5)
    for arguments, word in (
        (("grey.npy",), "grey"), (("part.npy",), "whole"), (("labels.npy", "--dark"), "--dark"),
        (("labels.npy", "--roi", path), "--roi"), (("labels.npy", "--label", 5), "label"),
    ):  # fmt: skip
        refused(call("measure", tmp_path / arguments[0], "--labels", *arguments[1:]), word, progress=True)


# ---- maps ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["image", "slices"])
def test_maps_are_those_of_the_whole_on_the_scan_s_voxels(name: str) -> None:
    """Their mean is the thickness that is measured; in tiles they are the same, and 0 outside a region."""
    scan = scans()[name]
    whole, in_tiles = measure(scan, maps=True), measure(scan, maps=True, tile=33)
    structure, thickness = (whole.maps[each].values for each in ("structure", "thickness"))
    assert whole.maps["thickness"].spacing == scan.spacing and whole.maps["thickness"].unit == scan.unit
    assert structure.mean() == pytest.approx(whole["BV/TV"].value) and ((thickness > 0) == (structure > 0)).all()
    assert thickness[structure > 0].mean() == pytest.approx(whole["Tb.Th"].value, rel=1e-5)
    for each, volume in whole.maps.items():
        assert np.allclose(in_tiles.maps[each].values, volume.values, rtol=1e-5), each
    region = np.zeros(scan.shape, bool)
    region[4:20, 10:40, 8:] = True
    part = measure(scan, roi=region, maps=True).maps["structure"].values
    assert (part == structure * region).all()
    assert not measure(scan).maps


def test_wide_gaps_do_not_cut_a_scan_into_small_tiles() -> None:
    """Their balls reach over 100 voxels around a tile: cores of a few voxels would read all of it many times."""
    mask = np.zeros((128, 128, 128), bool)
    mask[4:12] = mask[118:126] = True
    found = measure(mask, roi=np.ones(mask.shape, np.uint8))
    assert not [note for note in found.notes if "tiles" in note]


@pytest.mark.parametrize("processes", [1, 2, 8])
def test_tiles_are_few_but_fit_into_memory_and_are_shared(processes: int) -> None:
    volume = SimpleNamespace(shape=(512, 512, 512), spacing=(1.0, 1.0, 1.0))
    plan: Any = SimpleNamespace(volume=volume, reach=5.0, scale=(1.0, 1.0, 1.0))
    cores = cut_boxes(volume.shape, tiles._choose_edges(plan, processes))
    read = max(math.prod(e.stop - e.start for e in grow(core, tiles.HALO, volume.shape)) for core in cores)
    assert read <= tiles.LARGEST_TILE
    assert len(cores) == 27 if processes == 8 else 4 * processes <= len(cores) < 27


def test_maps_of_wide_balls_are_painted_where_they_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles, "COARSE", 3)
    mask = np.zeros((40, 40, 40), np.uint8)
    mask[8:32, 8:32, 8:32] = 1
    found = measure(mask, maps=True, tile=32)
    thickness = found.maps["thickness"].values
    assert thickness[mask > 0].mean() == pytest.approx(found["Tb.Th"].value, rel=1e-4) and thickness.max() > 20
