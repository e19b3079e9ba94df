"""`curvafit generate`: what it hands on, what it writes, and the files it touches: resumed, failed, other people's."""

import importlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
import tifffile
import torch
import trimesh
from calling import LAW, QUICK, call, done, made, refused
from found import made_fit
from matplotlib.figure import Figure

from curvafit.drawing.plot import make_figure
from curvafit.generation.schedule import schedule
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energies import orientation
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset
from curvafit.priors.profile import phase_field
from curvafit.volumes import Volume, load, save

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Empty pictures, but where a test is named after its own."""
    if "a_field_a_picture" not in request.node.name:
        monkeypatch.setattr("curvafit.drawing.shapes.surface_figure", lambda u, width: make_figure(1, 1))


@pytest.fixture
def prior(tmp_path: Path) -> Path:
    return made_fit().save(tmp_path / "fit.json")


def test_generate_writes_a_field_a_picture_and_a_record(tmp_path: Path) -> None:
    target = tmp_path / "new" / "tubes.nii.gz"
    result = done("generate", *QUICK, "--seed", 7, "-o", target)
    assert sorted(path.name for path in target.parent.iterdir()) == ["tubes.json", "tubes.nii.gz", "tubes.png"]
    record = json.loads((target.parent / "tubes.json").read_text())
    assert list(record["coefficients"].values()) == [1, 2, 6, -40, -40, 400]
    assert (record["mass"], record["seed"], record["schedule"]) == (-0.6, 7, schedule("fast", 30).as_dict())
    field = load(target)
    assert field.shape == (24, 24, 24) and field.unit == "voxel"
    assert field.values.mean() == pytest.approx(-0.6, abs=1e-5)
    assert str(target) in result.stdout


def test_a_fit_without_a_law_is_refused_by_all_that_take_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made_fit(chosen=None).save("fit.json")
    np.save("scan.npy", np.zeros((8, 8, 8), dtype=np.uint8))
    for words in ("generate -o out.npy", "segment scan.npy -o out.npy", "reconstruct scan.npy --every 4 -o out.npy",
                  "synth --modality confocal -o out"):  # fmt: skip
        refused(call(*words.split(), "--prior", "fit.json"), "law")
    Path("near.yaml").write_text("around: fit.json")
    refused(call(*["atlas", "build", "out", "--design", "near.yaml", "--count", "1"]), "law")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fit.json", "near.yaml", "scan.npy"]


# ---- what is handed on, and what is written --------------------------------------------------------------------------


@pytest.fixture
def handed(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the generator is called with; it then stops."""
    calls: dict[str, Any] = {}

    def keep(**options: Any) -> None:
        calls.update(options)
        raise ValueError("expected no flow")

    monkeypatch.setattr(importlib.import_module("curvafit.generation.flow"), "generate", keep)
    return calls


def test_every_option_reaches_the_generator(tmp_path: Path, handed: dict[str, Any]) -> None:
    """And maps take the place of numbers."""
    options = "--preset tubes --shape 8,10,12 --boundary replicate --epsilon 0.03 --orientation 0,3,4,25 --seed 5 "
    options += "--schedule paper --steps 77 --checkpoint-every 5 --volume-fraction 0.3"
    call("generate", *options.split(), "--checkpoint", tmp_path / "run.pt", "-o", tmp_path / "out.npy")
    assert handed["law"] == preset("tubes").coefficients
    assert (handed["mass"], handed["volume_fraction"], handed["seed"]) == (None, 0.3, 5)
    assert handed["grid"] == Grid((8, 10, 12), boundary="replicate")
    assert (handed["schedule"].name, handed["schedule"].steps) == ("paper", 77)
    assert torch.equal(handed["orientation"], orientation((0, 0.6, 0.8), 25))
    execution = handed["execution"]
    assert (execution.checkpoint, execution.checkpoint_every) == (tmp_path / "run.pt", 5)
    assert (handed["epsilon"], execution.device) == (0.03, "cpu")
    slope, maps = np.linspace(0.1, 0.9, 5 * 6 * 7, dtype=np.float32).reshape(5, 6, 7), tmp_path / "maps.npz"
    np.savez(maps, a00=900 * slope, mass=-slope, a11=1.5)
    call("generate", "--preset", "tubes", "--maps", maps, "-o", tmp_path / "out.npy")
    law = handed["law"]
    assert (law.a20, law.a11, law.a02, law.a10, law.a01) == (1, 1.5, 6, -40, -40)
    np.testing.assert_array_equal(law.a00, 900 * slope)
    np.testing.assert_array_equal(handed["mass"], -slope)
    assert handed["grid"].shape == (5, 6, 7)
    refused(call("generate", *LAW, "--maps", maps, "-o", tmp_path / "out.npy"), "--mass")
    refused(call("generate", *LAW, "--shape", "8", "--maps", maps, "-o", tmp_path / "out.npy"), "a00")


def test_a_law_is_a_bending_energy_and_maps_may_hold_a_direction(tmp_path: Path, handed: dict[str, Any]) -> None:
    """Whose numbers are the option's where there are no maps of them."""
    out, maps = ["-o", tmp_path / "out.npy"], tmp_path / "maps.npz"
    for text, law in (("3,-1.5,7", (3, -1.5, 7)), ("3,1", (3, 1)), ("3", (3,))):
        call("generate", "--helfrich", text, "--mass", "-0.5", *out)
        assert handed["law"] == Coefficients.helfrich(*law) and handed["mass"] == -0.5
    for text in ("3,1,7,2", "k", "3,,7"):
        refused(call("generate", "--helfrich", text, "--mass", 0, *out), "--helfrich")
    refused(call("generate", "--helfrich", 3, "--preset", "tubes", *out), "--helfrich")
    z, y, x = np.indices((5, 6, 7), dtype=np.float32)
    np.savez(maps, theta_z=1 + z, theta_y=y, mu=x)
    call("generate", "--preset", "tubes", "--maps", maps, "--orientation", "5,6,7,8", *out)
    assert torch.equal(handed["orientation"], orientation((*map(torch.from_numpy, (1 + z, y)), 7), torch.from_numpy(x)))
    refused(call("generate", "--preset", "tubes", "--maps", maps, *out), "theta_x")
    np.savez(maps, theta_z=z, theta_y=y, theta_x=x, mu=3.0)
    refused(call("generate", "--preset", "tubes", "--maps", maps, *out), "not all 0")


@pytest.mark.parametrize(
    ("name", "given", "spacing", "unit"),
    [
        ("a.tif", "0.02 um", 0.02, "um"), ("a.mrc", "0.02 um", 20, "nm"), ("a.zarr", "0.02 um", 0.02, "um"),
        ("a.tif", "0.02 m", 0.02, "m"), ("a.ome.tif", "0.02 m", 0.02, "m"),
        ("a.tif", "2e-10 m", 2e-10, "m"),
    ],
)  # fmt: skip
def test_voxels_have_their_size_in_the_file(tmp_path: Path, name: str, given: str, spacing: float, unit: str) -> None:
    """What plain TIFF cannot hold is OME, as is what is named so."""
    edge, of = given.split()
    made(*QUICK, "--spacing", edge, "--unit", of, "-o", tmp_path / name)
    field = load(tmp_path / name)
    assert field.spacing == pytest.approx((spacing,) * 3) and field.unit == unit
    assert field.values.mean() == pytest.approx(-0.6, abs=1e-5)
    if name.endswith(".tif"):
        with tifffile.TiffFile(tmp_path / name) as file:
            assert bool(file.is_ome) == (name == "a.ome.tif" or edge == "2e-10")


def test_nifti_is_whole(tmp_path: Path) -> None:
    """Zooms, qform, sform and unit as nibabel reads them."""
    record = made(*QUICK, "--spacing", "0.02", "--unit", "mm", "-o", tmp_path / "one.nii.gz")
    one = nibabel.load(tmp_path / "one.nii.gz")
    for affine in (one.get_qform(), one.get_sform(), one.affine):
        np.testing.assert_allclose(affine, np.diag([0.02, 0.02, 0.02, 1]), atol=1e-7)
    assert one.header.get_xyzt_units()[0] == "mm"
    np.testing.assert_allclose(one.header.get_zooms(), 0.02, rtol=1e-6)
    assert (record["voxel"], record["unit"]) == (0.02, "mm")


@pytest.mark.slow
def test_tubes_of_the_published_size_are_watertight_with_the_volume_of_the_phase(tmp_path: Path) -> None:
    """As STL, closed for another program, whatever shape came."""
    edge = 100
    size = ["--shape", edge, "--schedule", "cosine", "--steps", 60, "--spacing", "0.02", "--unit", "mm"]
    record = made("--preset", "tubes", *size, "-o", tmp_path / "tubes.stl")
    mesh = trimesh.load_mesh(tmp_path / "tubes.stl")
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(record["volume_fraction"] * (0.02 * edge) ** 3, rel=0.002)
    np.testing.assert_allclose(mesh.bounds, [[-0.01] * 3, [0.02 * (edge - 0.5)] * 3], atol=1e-6)


def test_a_volume_fraction_is_reached_and_its_mass_recorded(tmp_path: Path, prior: Path) -> None:
    """And a surface is in the prior's unit."""
    options = ["--volume-fraction", "0.25", "--shape", "32", "--steps", 200]
    record = made("--preset", "sponge", *options, "-o", tmp_path / "out.npy")
    values = load(tmp_path / "out.npy").values
    assert (values > 0).mean() == pytest.approx(0.25, abs=0.002)
    assert record["mass"] == pytest.approx(values.mean(), abs=1e-6) and record["wanted_volume_fraction"] == 0.25
    options = ["--prior", prior, "--mass", "-0.4", "--shape", "16,20,24", "--steps", 30]
    record = made(*options, "-o", tmp_path / "more.ply")
    assert record["coefficients"] == made_fit().coefficients.as_dict()
    assert (record["mass"], record["shape"], record["voxel"], record["unit"]) == (-0.4, [16, 20, 24], 0.0195, "mm")
    assert (tmp_path / "more.ply").read_bytes().startswith(b"ply\nformat binary_little_endian")
    again = made(*options, "--spacing", 0.04, "-o", tmp_path / "out.npy")
    assert (again["voxel"], again["unit"], again["working_spacing"]) == (0.04, "mm", [0.01] * 3)
    refused(call("generate", *options, "-o", tmp_path / "fit.npy"), "input")
    assert prior.read_text() == made_fit().to_json()


# ---- from a volume ---------------------------------------------------------------------------------------------------


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    """A mask of voxels of 0.039 mm, somewhere in the world."""
    z, y, x = np.indices((32, 32, 34)) - 15.5
    affine = np.array([[0.039, 0, 0, 5], [0, 0.039, 0, -3], [0, 0, 0.039, 2], [0, 0, 0, 1]])
    inside = (z**2 + y**2 + x**2 < 64).astype(np.uint8)
    return save(Volume(inside, (0.039,) * 3, "mm", affine), tmp_path / "ball.nii.gz")


def test_a_start_gives_its_mass_voxels_and_place(tmp_path: Path, ball: Path, prior: Path) -> None:
    """A fit's lengths are those of the scan; a mass that is stated is the mean; a phase field is taken as it is."""
    record = made("--preset", "tubes", "--start", ball, "--steps", 20, "-o", tmp_path / "out.nii.gz")
    out, start = load(tmp_path / "out.nii.gz"), load(ball)
    assert (record["seed"], record["start"], record["start_digest"]) == (None, str(ball), start.digest)
    assert (record["unit"], record["voxel"], record["working_spacing"]) == ("mm", pytest.approx(0.039), [0.01] * 3)
    np.testing.assert_allclose(out.affine, start.affine, rtol=1e-6)
    assert record["mass"] == pytest.approx(out.values.mean(), abs=1e-6)
    profile = phase_field(torch.from_numpy(start.values > 0), Grid(start.shape), 0.02)
    assert record["mass"] == pytest.approx(float(profile.mean()), abs=1e-5)
    again = made("--prior", prior, "--start", ball, "--mass", "-0.7", "--steps", 20, "-o", tmp_path / "more.nii.gz")
    assert again["mass"] == pytest.approx(-0.7, abs=1e-6) and again["working_spacing"] == pytest.approx([0.02] * 3)
    more = made("--preset", "tubes", "--start", tmp_path / "out.nii.gz", "--steps", 1, "-o", tmp_path / "next.npy")
    assert more["mass"] == pytest.approx(record["mass"], abs=1e-6) and more["shape"] == [32, 32, 34]
    refused(call("generate", "--preset", "tubes", "--start", ball, "--overwrite", "-o", ball), "input")


def test_a_vesicle_of_free_volume_has_its_spontaneous_curvature(tmp_path: Path, ball: Path) -> None:
    """H0 = 2 / R, where Helfrich's energy is 0: R of 8 voxels becomes 9.5; it is of order (ε / R)² = 0.04 longer."""
    words = ["--helfrich", f"2,0,{2 / 0.095}", "--start", ball, "--free-mass"]
    made(*words, "--checkpoint", tmp_path / "run.pt", "-o", tmp_path / "out.npy")
    inside = np.load(tmp_path / "out.npy") > 0
    assert 9.5 < (3 * inside.sum() / (4 * np.pi)) ** (1 / 3) < 1.05 * 9.5


def test_what_does_not_go_with_a_start_is_refused(tmp_path: Path, ball: Path) -> None:
    np.savez(tmp_path / "mass.npz", mass=-0.5)
    np.save(tmp_path / "grey.npy", np.random.default_rng(0).random((9, 9, 9)))
    save(Volume(load(ball).values, (0.1, 0.1, 0.3), "mm"), tmp_path / "flat.nii.gz")
    words = {
        "--shape 32": "--shape", "--seed 0": "--seed", "--volume-fraction 0.3": "--volume-fraction",
        "--maps mass.npz": "mass", "--start grey.npy": "mask", "--start flat.nii.gz": "cubes",
        "--start no.tif": "no.tif",
        "--free-mass --mass 0": "--mass", "--free-mass --orientation 0,0,1,5": "--orientation",
        "--free-mass --schedule deep": "--schedule", "--free-mass --maps mass.npz": "--maps",
        "--spacing 1,1,1": "--spacing", "--mass 2": "mass",
    }  # fmt: skip
    for line, word in words.items():
        options = [str(tmp_path / text) if "." in text and text[0].isalpha() else text for text in line.split()]
        start = [] if "--start" in options else ["--start", ball]
        refused(call("generate", "--preset", "tubes", *start, *options, "-o", tmp_path / "out.npy"), word)
    refused(call("generate", "--preset", "tubes", "--free-mass", "-o", tmp_path / "out.npy"), "--start")
    assert not list(tmp_path.glob("out.*"))


def full(*_: Any, **__: Any) -> None:
    raise OSError(28, "No space left on device", "out")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_an_interrupted_run_goes_on_from_its_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a full disk at the very end costs no run: the same command goes on, and then removes the checkpoint."""

    @contextmanager
    def interrupting() -> Iterator[Any]:
        def watch(text: str, share: float) -> None:
            if share > 0.5:
                raise KeyboardInterrupt

        yield watch

    saving = [*QUICK, "--checkpoint", tmp_path / "run.pt", "--checkpoint-every", 0]
    with monkeypatch.context() as patch:
        patch.setattr("curvafit.cli.generate.show_stages", interrupting)
        result = call("generate", *saving, "-o", tmp_path / "out.npy")
    assert result.exit_code == 130 and "resume" in result.stderr
    refused(call("generate", *saving, "--seed", 9, "-o", tmp_path / "out.npy"), "checkpoint")
    with monkeypatch.context() as patch:
        patch.setattr("curvafit.drawing.shapes.write_field", full)
        assert call("generate", *saving, "-o", tmp_path / "out.npy").exit_code == 2
    assert names(tmp_path) == ["run.pt"]
    made(*saving, "-o", tmp_path / "out.npy")
    assert names(tmp_path) == ["out.json", "out.npy", "out.png"]
    made(*QUICK, "-o", tmp_path / "whole.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), np.load(tmp_path / "whole.npy"))


@pytest.mark.filterwarnings("default:no picture was drawn")
def test_a_picture_that_fails_is_one_line_and_undoes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The former one, of another shape, goes."""

    def drawn(figure: Figure, path: Path) -> None:
        assert names(path.parent) == ["out.npy"]
        full()

    made(*QUICK, "-o", tmp_path / "out.npy")
    monkeypatch.setattr("curvafit.drawing.shapes.write_picture", drawn)
    result = call("generate", *QUICK, "--seed", 1, "-o", tmp_path / "out.npy")
    assert result.exit_code == 0 and "note: " in result.stderr and "picture" in result.stderr
    assert names(tmp_path) == ["out.json", "out.npy"]
    assert json.loads((tmp_path / "out.json").read_bytes())["files"] == ["out.npy", "out.json"]


def test_a_shape_without_a_picture_leaves_that_of_others_and_no_former_one(tmp_path: Path) -> None:
    bare = [*QUICK, "--no-picture", "-o", tmp_path / "out.npy"]
    (tmp_path / "out.png").write_bytes(b"mine")
    assert made(*bare)["files"] == ["out.npy", "out.json"]
    assert (tmp_path / "out.png").read_bytes() == b"mine"
    refused(call("generate", *QUICK, "-o", tmp_path / "out.npy"), "free")
    (tmp_path / "out.png").unlink()
    assert made(*QUICK, "-o", tmp_path / "out.npy")["files"] == ["out.npy", "out.json", "out.png"]
    made(*bare)
    assert names(tmp_path) == ["out.json", "out.npy"]


def test_other_files_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scan.png").write_bytes(b"mine")
    refused(call("generate", *QUICK, "-o", tmp_path / "scan.npy"), "free")
    for name in ("out.json", "out.png"):
        options = ["--checkpoint", tmp_path / name, "-o", tmp_path / "out.npy"]
        refused(call("generate", *QUICK, *options), "checkpoint")
    assert names(tmp_path) == ["scan.png"]
    monkeypatch.setattr("curvafit.drawing.shapes.write_field", full)
    refused(call("generate", *QUICK, "-o", tmp_path / "out.zarr"), "no space left", progress=True)
    assert names(tmp_path) == ["scan.png"]
