"""`curvafit segment` and `reconstruct`: what they write, to the bit, and what they refuse; tiles: test_tiles.py."""

import json
from dataclasses import replace
from pathlib import Path

import nibabel
import numpy as np
import pytest
from calling import call, done, refused
from found import made_fit

import curvafit.segmentation
from curvafit.core.units import convert_length
from curvafit.segmentation.filler import FILLER_FILE
from curvafit.volumes.read import load
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import save

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

#: Turned about z and sheared a little, with a shift that no float32 holds: what is not kept to the bit shows.
OBLIQUE = np.array(
    [[0.0613, -0.011, 0.0031, -17.1234567], [0.0097, 0.0622, -0.001, 3.3], [-0.003, 0.002, 0.09, 0.1], [0, 0, 0, 1]]
)


def ball(shape: tuple[int, int, int] = (20, 18, 16)) -> np.ndarray:
    z, y, x = (np.arange(n) - n / 2 + 0.4 for n in shape)
    return z[:, None, None] ** 2 + y[:, None] ** 2 + x**2 < 36


def grey(noise: float = 40) -> np.ndarray:
    mask = ball()
    values = 100 + 100 * mask + noise * np.random.default_rng(0).standard_normal(mask.shape)
    return values.clip(0, 255).astype(np.uint8)


EXAMPLE = "--probabilities --example p.npy --example-probabilities law.npy"
#: What a header says of the place, whatever its unit is called.
KEPT = [*(f"srow_{k}" for k in "xyz"), *(f"quatern_{k}" for k in "bcd"), *(f"qoffset_{k}" for k in "xyz")]
KEPT += ["pixdim", "qform_code", "sform_code", "dim"]


@pytest.fixture
def oblique(tmp_path: Path) -> Path:
    """A NIfTI scan with an oblique sform, another qform, scaled values and a note."""
    image = nibabel.Nifti1Image(grey().T, OBLIQUE)
    image.header.set_xyzt_units("mm")
    image.set_sform(OBLIQUE, code="scanner")
    turned = OBLIQUE.copy()
    turned[:3, 3] += 1
    image.set_qform(turned, code="aligned")
    image.header.set_slope_inter(2.0, -7.0)
    image.header["descrip"] = b"a scan"
    image.header["cal_max"] = 300
    path = tmp_path / "scan.nii.gz"
    nibabel.save(image, path)
    return path


def test_segment_keeps_the_header_to_the_bit(oblique: Path, tmp_path: Path) -> None:
    target = tmp_path / "new" / "mask.nii.gz"
    result = done("segment", oblique, "--prior", "tubes", "--weight", 0.5, "--steps", 120, "-o", target)
    assert sorted(path.name for path in target.parent.iterdir()) == ["mask.json", "mask.nii.gz", "mask.png"]
    one, other = nibabel.load(oblique), nibabel.load(target)
    for name in (*KEPT, "xyzt_units", "descrip"):
        assert one.header[name].tobytes() == other.header[name].tobytes(), name  # type: ignore[index]
    assert other.affine.tobytes() == one.affine.tobytes()  # type: ignore[attr-defined]
    values = np.asanyarray(other.dataobj)  # type: ignore[attr-defined]
    assert values.dtype == np.uint8 and np.unique(values).tolist() == [0, 1]
    overlap = (values.T > 0) & ball()
    assert 2 * overlap.sum() / ((values > 0).sum() + ball().sum()) > 0.9
    record = json.loads(target.with_name("mask.json").read_text())
    assert record["format"] == "curvafit-mask-1" and record["job"] == "segment" and record["prior"] == "tubes"
    assert record["steps"] == 120 and record["weight"] == 0.5
    assert record["command"] == f"curvafit segment {oblique} --prior tubes --weight 0.5 --steps 120 -o {target}"
    assert record["unit"] == "mm" and record["epsilon"] == pytest.approx(2 * min(record["spacing"]))
    assert str(target) in result.stdout and "of the volume is inside" in result.stdout
    again = call("segment", oblique, "--prior", "tubes", "--steps", 1, "-o", target)
    assert again.exit_code == 0 and json.loads(target.with_name("mask.json").read_text())["steps"] == 1


UNITS = ("um", "voxel", "cm")


@pytest.mark.parametrize(
    ("stated", "unit", "written"),
    [
        ("mm", "um", "mm"),
        ("mm", "cm", "mm"),
        *(("unknown", *pair) for pair in (("um", "um"), ("voxel", "voxel"), ("cm", "mm"))),
    ],
)
def test_another_unit_renames_and_keeps_the_rest_of_the_header(stated, unit, written, oblique, tmp_path) -> None:
    """Lengths in a unit that the file states are converted, so its header stays; others get the unit's name."""
    target, again = tmp_path / "mask.nii.gz", tmp_path / "again.nii"
    one = nibabel.load(oblique)
    one.header.set_xyzt_units(stated, "sec")  # type: ignore[attr-defined]
    nibabel.save(one, oblique)
    done("segment", oblique, "--unit", unit, "--prior", "tubes", "--steps", 1, "-o", target)
    other, made, told = nibabel.load(target), load(target), load(oblique, unit=unit)
    factor = convert_length(1.0, told.unit, written) if written != "voxel" else 1.0
    assert made.unit == written and made.spacing == pytest.approx([factor * h for h in told.spacing], rel=1e-6)
    np.testing.assert_allclose(made.affine[:3], factor * told.affine[:3], rtol=1e-6)  # type: ignore[index]
    for name in KEPT if (stated, unit) != ("unknown", "cm") else ["qform_code", "sform_code", "quatern_b"]:
        assert one.header[name].tobytes() == other.header[name].tobytes(), name  # type: ignore[index]
    assert other.header.get_xyzt_units()[1] == "sec"  # type: ignore[attr-defined]
    if written == "voxel":  # our own note that there is no unit goes once there is one
        done("segment", target, "--unit", "um", "--prior", "tubes", "--steps", 1, "-o", again)
        assert load(again).unit == "um" and load(again).spacing == pytest.approx(made.spacing, rel=1e-6)


def test_other_formats_and_a_fit_in_another_unit(tmp_path: Path) -> None:
    """And an axis of one, and another spacing."""
    path, prior, target = tmp_path / "scan.tif", tmp_path / "fit.json", tmp_path / "mask.ome.tif"
    save(Volume(grey(), (19.5,) * 3, "um"), path)
    prior.write_text(made_fit().to_json())
    options = ("--dark", "--threshold", 150, "--weight", 1, "--steps", 2)
    result = done("segment", path, "--prior", prior, *options, "-o", target)
    assert "um" in result.stdout
    made = load(target)
    assert made.unit == "um" and made.spacing == pytest.approx((19.5,) * 3)
    assert made.values.mean() > 0.5
    record = json.loads((tmp_path / "mask.json").read_text())
    assert record["dark"] is True and record["threshold"] == 150
    assert record["coefficients"] == pytest.approx(made_fit().coefficients_physical.in_unit(1e-3).as_dict())
    path, target = tmp_path / "scan.nii", tmp_path / "axis.nii"
    image = nibabel.Nifti2Image(grey().T[..., None], np.diag([0.2, 0.2, 0.4, 1]))
    nibabel.save(image, path)
    done("segment", path, "--prior", "sponge", "--steps", 2, "-o", target)
    made = nibabel.load(target)
    assert isinstance(made, nibabel.Nifti2Image) and made.shape == (16, 18, 20, 1)
    other = tmp_path / "other.nii"
    told = call("segment", path, "--prior", "sponge", "--steps", 2, "--spacing", "3,2,2", "--unit", "um", "-o", other)
    assert told.exit_code == 0 and "z" in told.stdout
    assert load(other).spacing == (3, 2, 2) and load(other).unit == "um"


def test_reconstruct_fills_what_it_is_not_told(tmp_path: Path) -> None:
    """And one label of a volume."""
    truth, path, target = ball((20, 18, 17)), tmp_path / "slices.nii.gz", tmp_path / "volume.nii.gz"
    given = np.zeros(truth.shape, dtype=np.uint8)
    given[..., ::4] = truth[..., ::4]
    save(Volume(given, (0.1, 0.1, 0.1), "mm"), path)
    done("reconstruct", path, "--every", 4, "--axis", "x", "-o", target)
    made = load(target).values.astype(bool)
    assert np.array_equal(made[..., ::4], truth[..., ::4]) and (made != truth).mean() < 0.02
    record = json.loads((tmp_path / "volume.json").read_text())
    assert (record["every"], record["axis"], record["weight"]) == (4, 2, None)
    named = tmp_path / "named.nii.gz"
    options = ("--known", "0,4,8,12,16", "--axis", "x")
    done("reconstruct", path, *options, "-o", named)
    assert np.array_equal(load(named).values, load(target).values)
    given[..., [k for k in range(17) if k % 4]] = 9
    save(Volume(2 * given, (0.1, 0.1, 0.1), "mm"), path)  # also one label of several
    for name, more in (("ignoring", ("--ignore", 18)), ("label", ("--every", 4, "--label", 2))):
        done("reconstruct", path, *more, "--axis", "x", "-o", tmp_path / f"{name}.nii.gz")
        assert np.array_equal(load(tmp_path / f"{name}.nii.gz").values, load(target).values)


def test_reconstruct_writes_what_is_uncertain(tmp_path: Path) -> None:
    """A probability beside the mask, with the header of the slices, as long as its mask; and what to annotate next."""
    path, target = tmp_path / "slices.nii.gz", tmp_path / "out" / "volume.nii.gz"
    save(Volume(ball().astype(np.uint8), (0.1, 0.1, 0.1), "mm"), path)
    told = ("reconstruct", path, "--every", 4, "-o", target)
    result = done(*told, "--suggest", 2)
    names = ["volume.json", "volume.nii.gz", "volume.png", "volume_probability.nii.gz"]
    assert sorted(each.name for each in target.parent.iterdir()) == names
    chances, mask = load(target.parent / names[-1]), load(target)
    assert chances.values.dtype == np.float32 and np.array_equal(chances.affine, mask.affine)  # type: ignore[arg-type]
    assert np.array_equal(chances.values[::4], ball()[::4])
    record = json.loads((target.parent / "volume.json").read_text())
    assert 0 <= record["calibration_error"] < 1
    assert sorted(record["files"]) == names and len(record["suggestions"]) == 2
    said = " ".join(result.stdout.split())
    assert f"annotate next: {', '.join(map(str, record['suggestions']))}." in said
    done(*told)
    assert sorted(each.name for each in target.parent.iterdir()) == names


#: In `bad_files`: words that a command refuses, and one of its sentence.
REFUSALS: dict[str, dict[str, str]] = {
    "segment grey.nii": {
        "--prior tube": "preset", "--prior none.json": "none.json", "--prior fit.json --unit voxel": "--unit",
        "--threshold low": "--threshold", "--spacing 0": "--spacing", "--like ball.nii": "--like",
        "--example ball.nii --example-probabilities ball.nii": "example",
        "--prior tubes -o mask.xyz": "mask.xyz", "--prior tubes -o taken.nii/mask.tif": "file",
    },
    "segment none.tif": {"": "no such file"},
    "reconstruct ball.nii": {"--known 1,a": "--known", "--known 0,4 --first 2": "--first"},
    "reconstruct ball.nii --every 4": {
        "--axis w": "--axis", "--ignore 2": "ignore", "--filler fit.json": "fit.json",
        "--example coarse.nii": "spacing", "--example other.nii": "spacing",
        "--labels all --example grey.nii": "example",
        "--filler version.npz": "version 2", "--filler cut.npz": "truncated", "--filler arrays.npz": "filler",
        "--filler lacks.npz": "slope", "--filler ball.nii": "something else", "--instances": "--image",
        "--suggest 16": "slices", "--label 4": "label", "--labels all --label 2": "labels", "--labels two": "labels",
        "-o taken.nii": "free", "-o noted.nii": "free", "-o mapped.nii": "free",
    },
    "reconstruct --every 4": {
        "many.nii --labels all": "256", "grey.nii": "grey image", "levels.nii": "whole numbers",
        "empty.nii --labels 1": "but not 1",
    },
}  # fmt: skip


@pytest.mark.parametrize("command", REFUSALS)
def test_wrong_input_is_a_sentence_and_changes_no_file(command, bad_files, monkeypatch) -> None:
    monkeypatch.chdir(bad_files)
    before = {path: path.read_bytes() for path in bad_files.iterdir()}
    for words, key in REFUSALS[command].items():
        out = () if "-o" in words else ("-o", "m.nii")
        refused(call(*command.split(), *words.split(), *out), key, progress=True)
        assert before == {path: path.read_bytes() for path in bad_files.iterdir()}, words


@pytest.fixture(scope="module")
def bad_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mask, and what is not to be had in place of a mask, an example, weights or an output."""
    folder, mask, draw = tmp_path_factory.mktemp("bad"), ball(), np.random.default_rng(0)
    emptied = mask.copy()
    emptied[::4] = False
    volumes = {
        "ball": mask, "coarse": mask, "other": mask, "empty": emptied, "grey": grey(),
        "levels": grey() / np.float32(3), "many": draw.integers(0, 512, mask.shape, dtype=np.int16),
    }  # fmt: skip
    for name, values in volumes.items():
        edge, unit = 0.04 if name == "coarse" else 0.02, "um" if name == "other" else "mm"
        save(Volume(values, (edge,) * 3, unit), folder / f"{name}.nii")
    packaged = Path(curvafit.segmentation.__file__).parent / "data" / "filler.npz"
    (folder / "cut.npz").write_bytes(packaged.read_bytes()[:9999])
    header, arrays = FILLER_FILE.read(packaged)
    header = {name: header[name] for name in ("width", "card", "error")}
    replace(FILLER_FILE, version=2).write(folder / "version.npz", header, arrays)
    FILLER_FILE.write(folder / "lacks.npz", header, {name: arrays[name] for name in arrays if name != "slope"})
    np.savez(folder / "arrays.npz", slope=np.ones(3))
    (folder / "fit.json").write_text(made_fit().to_json())
    for name in ("taken.nii", "noted.json", "mapped_probability.nii"):
        (folder / name).write_text("mine")
    return folder


def test_a_part_of_a_file_is_segmented_where_it_was(oblique: Path, tmp_path: Path) -> None:
    whole = nibabel.load(oblique)
    times = np.stack([np.asanyarray(whole.dataobj)[::-1], np.asanyarray(whole.dataobj)], axis=-1)
    nibabel.save(nibabel.Nifti1Image(times, OBLIQUE), tmp_path / "times.nii")
    options = ["--channel", "1", "--crop", "2:,1:17,:-1", "--spacing", "0.09,0.06,0.06", "--unit", "mm"]
    for k, (source, part) in enumerate(((tmp_path / "times.nii", options), (oblique, options[2:4]))):
        target = tmp_path / f"mask{k}.nii.gz"
        done("segment", source, *part, "--prior", "tubes", "--steps", 5, "-o", target)
        mask = nibabel.load(target)
        assert mask.shape == (15, 16, 18)
        assert "2:20, 1:17, 0:15" in " ".join(json.loads((tmp_path / f"mask{k}.json").read_text())["notes"])
        values, there = np.asanyarray(mask.dataobj).T > 0, ball()[2:, 1:17, :-1]
        assert 2 * (values & there).sum() / (values.sum() + there.sum()) > 0.8
        if not k:
            continue  # the place of voxels of another size than the file's is another
        for voxel in ([0, 0, 0], [3, 4, 5]):
            at = [voxel[0], voxel[1] + 1, voxel[2] + 2]
            assert mask.affine @ [*voxel, 1] == pytest.approx(whole.affine @ [*at, 1], rel=1e-3, abs=1e-4)


@pytest.mark.parametrize(
    ("arguments", "target"),
    [
        ("segment g.npy --prior tubes", "g.npy"), ("segment g.npy --prior tubes", "link.npy"),
        (f"segment g.npy {EXAMPLE}", "p.npy"), (f"segment g.npy {EXAMPLE}", "law.npy"),
        ("segment g.npy --logits --weight 1 --like p.npy", "p.npy"), ("segment g.npy --prior mine.json", "mine.npy"),
        ("segment g.npy --prior law.npy", "law.npy"), ("segment slices --prior tubes", "slices/1.tif"),
        ("reconstruct g.npy --every 4 --prior tubes", "sub/../g.npy"),
        ("reconstruct h.h5::g.npy --every 4 --prior tubes", "hard.npy"),
    ],
)  # fmt: skip
def test_no_input_is_written_over(arguments, target, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("sub", "slices"):
        (tmp_path / folder).mkdir()
    for name in ("g.npy", "p.npy", "law.npy", "h.h5", "slices/1.tif"):
        (tmp_path / name).write_text(name)
    (tmp_path / "mine.json").write_text('{"format": "curvafit-mask-1"}')
    (tmp_path / "link.npy").symlink_to("g.npy")
    (tmp_path / "hard.npy").hardlink_to("h.h5")
    monkeypatch.setattr("curvafit.volumes.read.load", lambda *_, **__: pytest.fail("read all the same"))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    refused(call(*arguments.split(), "-o", target), "input")
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


def test_what_a_format_does_not_hold_is_said_before_the_work(oblique: Path, tmp_path: Path) -> None:
    """Turned axes go out in NIfTI; others say that they hold no place, or no voxel size."""
    for name, word in (
        ("mask.tif", "the position in space"),
        ("mask.zarr", "turned axes"),
        ("mask.mrc", "turned axes"),
        ("mask.npy", "voxel size"),
    ):
        result = done("segment", oblique, "--prior", "tubes", "--steps", 1, "-o", tmp_path / name, "--overwrite")
        assert f"{name} does not hold" in result.stderr and word in result.stderr
        assert word in json.loads((tmp_path / "mask.json").read_text())["not_held"][0]
    plain = save(Volume(grey(), (0.3, 0.2, 0.1), "um"), tmp_path / "plain.tif")
    for name in ("plain_mask.nii.gz", "plain_mask.zarr", "plain_mask.tif"):
        result = done("segment", plain, "--prior", "tubes", "--steps", 1, "-o", tmp_path / name, "--overwrite")
        assert "hold" not in result.stderr
