"""`measure`: exact shapes, laws of units and symmetries, sums over blocks and their errors, tables and the command."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from calling import call, done, refused

from curvafit.geometry.morphology import morphometry
from curvafit.geometry.topology import euler_number, euler_shares
from curvafit.report.measures import check_windows
from curvafit.scan.measures import COLUMNS, LEAST, QUANTITIES, Blocks, Measures, errors
from curvafit.scan.tiles import measure
from curvafit.studies.scans import write_table
from curvafit.studies.windowed import NAMES, Windows, windows
from curvafit.volumes.read import load
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import save

N = 48


def tubes(n: int = N, pitch: int = 24, radius: float = 6.0) -> np.ndarray:
    """Parallel tubes along z, on a square lattice, uint8."""
    y, x = np.indices((n, n)) % pitch - pitch / 2
    return np.broadcast_to(np.hypot(y, x) < radius, (n, n, n)).astype(np.uint8)


def balls(n: int = N, pitch: int = 24, radius: float = 8.0) -> np.ndarray:
    z, y, x = np.indices((n,) * 3) % pitch - pitch / 2 + 0.5
    return (z**2 + y**2 + x**2 < radius**2).astype(np.uint8)


@pytest.fixture(scope="module")
def cut() -> np.ndarray:
    """A window of a level set of a Gaussian field, uint8."""
    from scipy import ndimage

    field = ndimage.gaussian_filter(np.random.default_rng(3).standard_normal((64,) * 3), 2.5, mode="wrap")
    return (field > np.quantile(field, 0.7))[:56, :52, :].astype(np.uint8)


@pytest.fixture(scope="module")
def measures(cut: np.ndarray) -> Measures:
    return measure(Volume(cut, (0.5, 0.5, 0.5), "um"))


# ---- exact shapes, and laws ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def of_balls() -> Measures:
    return measure(balls(), periodic=True, kind="mask")


def test_parallel_tubes() -> None:
    found = measure(tubes(), periodic=True)
    assert found["volume fraction"].value == pytest.approx(tubes().mean(), abs=1e-12)
    assert found["Tb.Th"].value == pytest.approx(12, abs=1e-6)
    assert found["Tb.N"].value == pytest.approx(math.pi / 4 * 12 / 24**2, rel=0.04)  # a disk of 113 has 109 voxels
    assert found["share of tubes"].value > 0.95
    assert found["κ1"].value == pytest.approx(1 / 6, rel=0.05)
    assert abs(found["κ2"].value) < 0.01
    assert found["Euler number"].value == 0  # on the torus
    assert np.abs(found.direction) == pytest.approx([1, 0, 0], abs=1e-3)
    assert found["DA"].value == pytest.approx(1, abs=1e-6)  # the surface has no normal along z
    assert found.unit == "voxel"


def test_balls_in_a_periodic_box(of_balls: Measures) -> None:
    found = of_balls
    assert found["Euler number"].value == 8
    assert found["connectivity density"].value == pytest.approx(-7 / N**3)
    assert found["share of spheres"].value > 0.95
    assert found["H"].value == pytest.approx(1 / 8, rel=0.05)
    assert found["K"].value == pytest.approx(1 / 64, rel=0.1)
    assert found["BS/BV"].value == pytest.approx(3 / 8, rel=0.05)
    assert found["DA"].value < 0.02


def test_the_familiar_numbers_are_those_of_morphometry(cut: np.ndarray, measures: Measures) -> None:
    numbers = morphometry(cut > 0, 0.5, "um")
    thickness, spacing = (numbers.thickness_mean, numbers.thickness_std), (numbers.spacing_mean,)
    others = (numbers.volume_fraction, numbers.connectivity_density, numbers.surface_to_volume)
    symbols = ("Tb.Th", "Tb.Th.SD", "Tb.Sp", "BV/TV", "Conn.D", "BS/BV")
    assert [measures[symbol].value for symbol in symbols] == pytest.approx([*thickness, *spacing, *others], rel=1e-5)
    assert round(measures["χ"].value) == numbers.euler


def test_curvature_obeys_gauss_and_bonnet(of_balls: Measures) -> None:
    """∫K dA = 4πχ of the solid, here 8 balls."""
    found = of_balls
    assert found["K"].value * found["BS/TV"].value * N**3 == pytest.approx(4 * math.pi * 8, rel=0.05)


def test_a_change_of_unit_scales_each_number_by_its_power(cut: np.ndarray, measures: Measures) -> None:
    longer = measure(Volume(cut, (1.5, 1.5, 1.5), "um"))
    for one, other in zip(measures.quantities, longer.quantities, strict=True):
        assert other.value == pytest.approx(one.value * 3.0**one.power, rel=1e-4, abs=1e-9), one.name
        assert other.half == pytest.approx(one.half * 3.0**one.power, rel=1e-3, abs=1e-9), one.name


def test_a_turn_changes_nothing_but_the_direction(cut: np.ndarray, measures: Measures) -> None:
    turned = measure(Volume(np.ascontiguousarray(cut.transpose(1, 2, 0)), (0.5, 0.5, 0.5), "um"))
    for one, other in zip(measures.quantities, turned.quantities, strict=True):
        # Lewiner's cubes and balls painted in another order: not to the bit
        assert other.value == pytest.approx(one.value, rel=0.01, abs=0.002), one.name
    z, y, x = np.abs(measures.direction)
    assert np.abs(turned.direction) == pytest.approx([y, x, z], abs=0.05)


def test_layers_say_that_the_direction_is_within_them() -> None:
    """Layers of 6 every 16 voxels have 1 / 16 of them a voxel."""
    layers = np.broadcast_to((np.indices((N,))[0] % 16 < 6)[:, None, None], (N, N, N)).astype(np.uint8)
    found = measure(Volume(layers, 0.5, "mm"), kind="mask", periodic=True)
    assert found["share of layers"].value > 0.95
    assert abs(found.direction[0]) < 1e-6
    assert found["Tb.Th"].value == pytest.approx(3, abs=0.5)
    assert (found["Tb.N"].value, found["Tb.N"].power) == (pytest.approx(1 / (16 * 0.5), rel=1e-6), -1)


# ---- blocks ----------------------------------------------------------------------------------------------------------


def test_blocks_add_up_to_the_whole() -> None:
    blocks, rng = Blocks.divide((50, 37, 29), (1.0, 1.0, 1.0), 9.0), np.random.default_rng(0)
    values, places, weights = rng.random((50, 37, 29)), rng.uniform(-0.5, 60, (500, 3)), rng.random((500, 2))
    assert blocks.counts == (5, 4, 3)
    assert blocks.sums(values).sum() == pytest.approx(values.sum())
    assert blocks.gather(places, weights).sum(0) == pytest.approx(weights.sum(0))
    assert blocks.gather(np.array([[10.4, 0, 0]]), np.ones((1, 1))).argmax() == 12  # slice 10 begins the second block


def test_shares_of_the_euler_number_add_up(cut: np.ndarray) -> None:
    mask = cut > 0
    assert int(euler_shares(mask, periodic=True).sum(dtype=np.int64)) == euler_number(mask, periodic=True)
    padded = np.pad(mask, ((1, 0),) * 3)  # what lies before the first voxels is seen to be empty
    rim = np.pad(mask, ((1, 1),) * 3)
    assert int(euler_shares(rim).sum(dtype=np.int64)) == euler_number(mask)
    assert euler_shares(padded)[1:, 1:, 1:].shape == mask.shape


def mean(sums: np.ndarray) -> np.ndarray:
    return sums[..., :1] / sums[..., 1:]


@pytest.mark.parametrize(
    ("counts", "weights"), [((2, 2, 2), [1.0]), ((4, 3, 1), [1.0]), ((4, 4, 4), [1.0]), ((4, 4, 4), [0.0, 0.1, 1.0])]
)
def test_intervals_of_independent_blocks_hold_as_often_as_they_say(
    counts: tuple[int, int, int], weights: list[float]
) -> None:
    """Blocks of unequal weight are parts of blocks, whose sums vary as much less."""
    blocks, rng = Blocks((12, 12, 12), tuple(tuple(range(n)) for n in counts)), np.random.default_rng(1)  # type: ignore[arg-type]
    own = rng.permutation(np.resize(weights, blocks.count))
    own, held = own / own.mean(), 0
    for _ in range(2000):
        values = np.sqrt(own) * rng.standard_normal(blocks.count)
        half = errors(np.stack([values, own], axis=1), blocks, mean, own if len(weights) > 1 else None)
        held += abs(values.mean()) <= half[0]
    # Satterthwaite's degrees of freedom are approximate: within 2 % of 95 %, and 2000 draws tell 1.5 %
    assert held / 2000 == pytest.approx(0.95, abs=0.03)


def test_intervals_widen_where_neighbours_are_alike() -> None:
    """By 2.3 in truth; the kernel counts half of what neighbours share, a jackknife of single blocks nothing."""
    blocks = Blocks((12, 12, 12), ((0, 3, 6, 9),) * 3)  # type: ignore[arg-type]
    rng, rows = np.random.default_rng(2), []
    for _ in range(200):
        rough = rng.standard_normal((5, 5, 5))
        alike = sum(rough[i : i + 4, j : j + 4, k : k + 4] for i in (0, 1) for j in (0, 1) for k in (0, 1)) / 8**0.5
        both = [rng.standard_normal(64), np.ravel(alike)]
        rows.append([errors(np.stack([each, np.ones(64)], axis=1), blocks, mean)[0] for each in both])
    apart, together = np.median(rows, axis=0)
    assert together > 1.3 * apart


def test_a_small_scan_has_no_intervals(cut: np.ndarray) -> None:
    found = measure(cut[:24, :24, :24], kind="mask")
    assert math.prod(found.blocks) < LEAST
    assert all(math.isnan(each.half) for each in found.quantities)
    assert any(note.startswith("No intervals") for note in found.notes)


# ---- tables and the command ------------------------------------------------------------------------------------------


def test_tables_are_tidy(measures: Measures, tmp_path: Path) -> None:
    path = write_table([measures, measures], tmp_path / "table.csv")
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == 2 * len(QUANTITIES)
    assert float(rows[1]["value"]) == measures["Tb.Th"].value
    assert float(rows[1]["high"]) - float(rows[1]["low"]) == pytest.approx(2 * measures["Tb.Th"].half)
    assert [rows[k]["unit"] for k in (0, 1, 4, 5, 7)] == ["", "um", "1/um", "1/um^3", "1/um"]
    assert write_table([measures], path) == path  # its own file


#: What `measure scan.npy` refuses, and a word of the sentence.
REFUSALS = {
    "-o mine.csv": "free", "-o table.xlsx": ".csv", "-o scan.npy": ".csv", "none.npy -o t.csv": "none.npy",
    "--kind tube -o t.csv": "kind", "--label 7 -o t.csv": "label", "--roi empty.npy": "vary",
    "--roi short.npy": "shape", "--roi grey.npy": "grey", "--subjects other.csv -o t.csv": "none for scan.npy",
    "--subjects taken.csv -o t.csv": "got value", "--subjects other.csv": "--subjects is for the table",
    "--windows 32 --stride 48 -o out": "stride", "--windows 32 --stride 12 -o out": "divides",
    "--windows 64 -o out": "fit into", "--stride 32 -o out": "--windows",
    "--windows 32": "folder", "--windows 32 -o maps.csv": "folder",
    "scan.npy --windows 32 -o out": "one scan", "--windows 32 --tile 32 -o out": "--tile",
}  # fmt: skip


def test_bad_input_is_refused(cut: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    grey = np.random.default_rng(0).integers(0, 99, cut.shape)
    for name, values in {"scan": cut, "empty": 0 * cut, "short": cut[1:], "grey": grey}.items():
        np.save(f"{name}.npy", values)
    for name, text in {"mine": "a,b\n1,2", "other": "scan,group\na.npy,x", "taken": "scan,value\nscan.npy,1"}.items():
        Path(f"{name}.csv").write_text(text + "\n", encoding="utf-8")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for words, key in REFUSALS.items():
        refused(call("measure", "scan.npy", *words.split()), key, progress=True)
        assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before, words


# ---- compartments ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rods() -> tuple[np.ndarray, np.ndarray]:
    """Rods of 8 voxels before rods of 12, along y and x, and 1 and 2 where each are."""
    halves = [tubes(N, 24, radius).transpose(axes) for radius, axes in ((4.0, (1, 0, 2)), (6.0, (1, 2, 0)))]
    return np.concatenate(halves), np.repeat(np.uint8([1, 2]), N)[:, None, None] * np.ones((1, N, N), np.uint8)


def test_each_half_of_a_scan_has_its_own_numbers(rods: tuple[np.ndarray, np.ndarray]) -> None:
    found = measure(rods[0], roi=rods[1], kind="mask")
    assert list(found.compartments) == [1, 2]
    for label, radius, axis in ((1, 4.0, 1), (2, 6.0, 2)):
        part = found.compartments[label]
        assert part["Tb.Th"].value == pytest.approx(2 * radius, rel=0.1)
        assert part["BV/TV"].value == pytest.approx(rods[0][rods[1] == label].mean(), abs=1e-12)
        assert part["κ1"].value == pytest.approx(1 / radius, rel=0.1)
        assert abs(part.direction[axis]) == pytest.approx(1, abs=0.01)
    areas = [each.diagram.area for each in (found, *found.compartments.values())]
    assert areas[0] == pytest.approx(sum(areas[1:]), rel=1e-9)


def test_compartments_add_up_to_the_whole(cut: np.ndarray) -> None:
    """Volumes, areas and curvatures do, in one tile and in several, and in these they are those of the one."""
    labels = np.ones(cut.shape, np.uint8)
    labels[:, 20:], labels[:, :, 25:] = 2, 3
    whole, found = measure(cut), measure(cut, roi=labels)
    for each in (found, measure(cut, roi=labels, tile=32)):
        parts, shares = each.compartments.values(), np.bincount(labels.ravel())[1:] / labels.size
        for symbol in ("BV/TV", "BS/TV"):
            assert np.dot(shares, [part[symbol].value for part in parts]) == pytest.approx(
                whole[symbol].value, rel=1e-6
            )
        assert sum(part["χ"].value for part in parts) == pytest.approx(each["χ"].value, abs=1e-9)
        areas = [part.diagram.area for part in parts]
        assert sum(areas) == pytest.approx(whole.diagram.area, rel=1e-6)
        assert np.dot(areas, [part["H"].value for part in parts]) / sum(areas) == pytest.approx(
            whole["H"].value, rel=1e-5
        )
        for part, same in zip(parts, found.compartments.values(), strict=True):
            values = [[quantity.value for quantity in one.quantities] for one in (part, same)]
            assert values[0] == pytest.approx(values[1], rel=1e-6, abs=1e-9)


def test_a_compartment_without_structure_has_none(cut: np.ndarray) -> None:
    labels = np.zeros(cut.shape, np.uint8)
    labels[:2, :2, :2], labels[30:] = 7, 1
    found = measure(np.where(labels == 7, 0, cut), roi=labels, kind="mask").compartments[7]
    assert found["BV/TV"].value == 0
    assert math.isnan(found["Tb.Th"].value)
    assert found.rows()[1]["value"] is None


# ---- windows ---------------------------------------------------------------------------------------------------------

SIZE, STRIDE = 48, 24
THIN, THICK = 4.0, 6.0


@pytest.fixture(scope="module")
def halves() -> Volume:
    """Thin rods below thick ones, along z."""
    return Volume(np.concatenate([tubes(2 * N, 16, THIN)[:N], tubes(2 * N, 24, THICK)[:N]]), (0.5, 0.5, 0.5), "um")


@pytest.fixture(scope="module")
def mapped(halves: Volume) -> Windows:
    return windows(halves, SIZE, STRIDE)


def test_a_volume_of_two_halves_gives_its_map_back(mapped: Windows) -> None:
    thickness = mapped["Tb.Th"].values
    assert thickness[0] == pytest.approx(np.full((3, 3), THIN), rel=0.1)  # in um, of 0.5 um a voxel
    assert thickness[2] == pytest.approx(np.full((3, 3), THICK), rel=0.1)
    assert [place[0] for place in mapped.extremes("thickness")] == [0, 2]
    assert mapped["share of tubes"].values[0].min() > 0.9


def test_disjoint_windows_agree_with_the_whole(halves: Volume, mapped: Windows) -> None:
    whole, apart = measure(halves), mapped.values[::2, ::2, ::2].reshape(8, -1)
    names = ("volume fraction", "thickness", "surface density")
    fraction, thickness, surface = (apart[:, NAMES.index(name)] for name in names)
    assert fraction.mean() == pytest.approx(whole["BV/TV"].value, rel=1e-9)
    assert surface.mean() == pytest.approx(whole["BS/TV"].value, rel=1e-9)
    assert (fraction * thickness).sum() / fraction.sum() == pytest.approx(whole["Tb.Th"].value, rel=1e-9)


def test_the_grid_has_its_place(halves: Volume) -> None:
    affine = np.array([[0, -0.5, 0, 7], [0.5, 0, 0, -3], [0, 0, 0.5, 1], [0, 0, 0, 1]])
    grid = windows(Volume(halves.values[:, :49], (0.5, 0.5, 0.5), "um", affine), (96, 48, 48), (48, 48, 24)).grid
    assert grid.shape == (1, 1, 3)
    assert grid.spacing == (24, 24, 12)
    # columns x, y, z; the first centre lies 47, 23.5, 23.5 steps of a voxel (z, y, x) from the first voxel's
    for index, voxel in (((0, 0, 0), (23.5, 23.5, 47.5)), ((2, 0, 0), (71.5, 23.5, 47.5))):
        assert grid.affine is not None
        assert grid.affine @ [*index, 1] == pytest.approx(affine @ [*voxel, 1])


def test_windows_without_structure_are_unknown(halves: Volume) -> None:
    values = halves.values.copy()
    values[:, :, 48:] = 0
    found = windows(values, SIZE, STRIDE)
    assert np.isnan(found.values[:, :, 2]).all()
    assert not found.known[:, :, 2].any()
    assert np.isfinite(found.values[:, :, 0]).all()
    assert f" {(~found.known).sum()} of them" in found.status


def test_the_command_writes_maps_table_and_page(halves: Volume, mapped: Windows, tmp_path: Path) -> None:
    scan, out = tmp_path / "scan.npy", tmp_path / "maps"
    np.save(scan, halves.values)
    done("measure", scan, "--windows", SIZE, "--spacing", 0.5, "--unit", "um", "-o", out)
    thickness = load(out / "thickness.nii.gz")
    assert thickness.values == pytest.approx(mapped["thickness"].values)
    assert thickness.spacing == pytest.approx((12, 12, 12))
    rows = list(csv.DictReader((out / "windows.csv").read_text(encoding="utf-8").splitlines()))
    assert [float(row["thickness"]) for row in rows] == pytest.approx(mapped["Tb.Th"].values.ravel())
    command = json.loads((out / "windows.json").read_text(encoding="utf-8"))["command"]
    assert check_windows(out, [scan], command=command) == out  # its own files
    with pytest.raises(ValueError, match="free"):
        check_windows(out, [scan], command="curvafit measure another.npy -o maps")


def test_windows_smaller_than_the_structure_are_refused() -> None:
    sparse = np.zeros((48, 48, 48), dtype=np.uint8)
    sparse[20:28, 20:28, 20:28] = 1
    with pytest.raises(ValueError, match="larger"):
        windows(sparse, 24, 24)


def test_numbers_of_bone_are_in_mm(tmp_path: Path) -> None:
    """Where a file states µm and its structure is 10 µm thick or more, unless a unit is stated."""
    coarse, fine = (save(Volume(tubes(), (h, h, h), "um"), tmp_path / f"{h:g}.nii.gz") for h in (12.0, 0.5))

    def unit_of(*words: object) -> tuple[str, float]:
        done("measure", *words, "-o", table := tmp_path / f"{len(list(tmp_path.iterdir()))}.csv")
        rows = list(csv.DictReader(table.read_text("utf-8").splitlines()))
        density, thickness = (next(row for row in rows if row["symbol"] == name) for name in ("Conn.D", "Tb.Th"))
        assert density["unit"] == f"1/{thickness['unit']}^3"
        return thickness["unit"], float(thickness["value"])

    unit, thickness = unit_of(coarse)
    assert unit == "mm" and thickness == pytest.approx(measure(coarse)["Tb.Th"].value / 1000)
    assert unit_of(fine)[0] == "um" and unit_of(coarse, "--unit", "um")[0] == "um"
    assert unit_of(coarse, fine)[0] == "mm" and unit_of(fine, coarse)[0] == "um"  # the first scan's
