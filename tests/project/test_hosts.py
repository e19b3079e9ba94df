"""What calls curvafit from Fiji, 3D Slicer, PolNet and MONAI: its options exist, and what comes back is in place."""

import importlib.util
import os
import random
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from calling import done
from scipy import ndimage

from curvafit.generation import generate
from curvafit.priors import Coefficients, Grid, preset
from curvafit.volumes import Volume, load, save

HOSTS = Path(__file__).resolve().parents[2] / "examples" / "hosts"
pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")


def run(*words: object, folder: Path | None = None) -> subprocess.CompletedProcess:
    command = [sys.executable, *map(str, words)]
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)


@pytest.fixture
def labels(tmp_path: Path) -> Path:
    z, y, x = np.mgrid[:17, :24, :24]
    tube = np.hypot(y - 11 + np.sin(z / 4), x - 12) < 6
    tube[np.arange(17) % 8 > 0] = False
    affine = np.array([[-0.3, 0, 0, 5], [0, -0.3, 0, 6], [0, 0, 0.6, 7], [0, 0, 0, 1]])
    return save(Volume(tube.astype(np.uint8), (0.6, 0.3, 0.3), "mm", affine), tmp_path / "labels.nii.gz")


def test_slicer_gets_volumes_in_their_place_and_progress(labels: Path, tmp_path: Path) -> None:
    script = HOSTS / "CurvafitComplete.py"
    module = ElementTree.parse(script.with_suffix(".xml")).getroot()
    flags, usage = [flag.text for flag in module.iter("longflag")], run(script, "--help").stdout
    assert flags and all(flag in usage for flag in flags)
    program = Path(sys.executable).with_name("curvafit")
    if not program.exists():
        pytest.skip("the program curvafit is not installed beside this Python")
    filled, likely = tmp_path / "filled.nii.gz", tmp_path / "likely.nii.gz"
    ended = run(script, labels, filled, "--probability", likely, "--every", 8, "--program", program)
    assert ended.returncode == 0, ended.stderr
    assert re.search(r"<filter-progress>0\.\d+</filter-progress>\n<filter-comment>\w", ended.stdout)
    known, mask = load(labels), load(filled)
    np.testing.assert_allclose(mask.affine, known.affine)  # type: ignore[arg-type]
    assert np.array_equal(mask.values[::8], known.values[::8]) and mask.values[4].sum() > 60
    assert load(likely).values.dtype == np.float32
    missing = run(script, tmp_path / "no.nii.gz", filled, "--program", program)
    assert missing.returncode == 2 and "no such file" in missing.stderr
    without = run(script, labels, filled, "--program", tmp_path / "none")
    assert without.returncode == 1 and "choose the curvafit program" in without.stderr


def test_the_command_of_fiji_s_macro_runs(labels: Path, tmp_path: Path) -> None:
    macro = (HOSTS / "Complete_Slices.ijm").read_text()
    called = re.search(r"exec\(program, (.*)\);", macro)
    assert called is not None
    values = {"knownOption": "--axis", "knownValue": "z", "labelOption": "--labels", "labelValue": "all"}
    values |= {"imageOption": "--axis", "imageValue": "z", "folder": f"{tmp_path}/"}
    save(load(labels), tmp_path / "labels.tif")
    words = ["".join(each.strip('"') if '"' in each else values[each] for each in part.split(" + "))
             for part in called[1].split(", ")]  # fmt: skip
    done(*words)
    for name in re.findall(r'open\(folder \+ "(.*)"\)', macro):
        assert load(tmp_path / name).shape == (17, 24, 24)


@pytest.mark.slow
def test_polnet_s_units_are_only_units(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a stand-in for what is built on in PolNet: a class that keeps a file's parameters, and a register of kinds."""

    class Generator:
        @classmethod
        def from_params(cls, params: dict) -> Any:
            made, params = cls(), {"EPS": 0.15, "DELTA_X": 0.03, "M0": -0.5, "MODE": "periodic"} | params
            vars(made).update({f"_{key}" if key == "M0" else f"_{key.lower()}": params[key] for key in params})
            return made

    kinds: dict[str, Any] = {}
    factory = SimpleNamespace(register=lambda name: lambda kind: kinds.setdefault(name, kind))
    for name, content in {
        "": {}, ".sample": {}, ".sample.membranes": {}, ".sample.membranes.mb": {"MbError": ArithmeticError},
        ".sample.membranes.mb_curvatubes": {"CurvatubesGen": Generator},
        ".sample.membranes.mb_factory": {"MbFactory": factory},
    }.items():  # fmt: skip
        monkeypatch.setitem(sys.modules, f"polnet{name}", ModuleType(f"polnet{name}"))
        vars(sys.modules[f"polnet{name}"]).update(content)
    spec = importlib.util.spec_from_file_location("curvafit_membranes", HOSTS / "curvafit_membranes.py")
    assert spec is not None and spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))

    law, s = preset("tubes"), 8  # lengths in the file are longer by s, a power of two: nothing is rounded
    numbers = dict(zip(("A20", "A11", "A02", "B10", "B01", "C"), law.coefficients, strict=True))
    numbers |= {"B10": numbers["B10"] / s, "B01": numbers["B01"] / s, "C": numbers["C"] / s**2}
    numbers |= {"SIGMA_BLUR": 2.0, "EPS": 0.02 * s, "DELTA_X": 0.01 * s, "M0": law.mass}
    random.seed(5)
    field = kinds["curvatubes"].from_params(numbers)._run_curvatubes((24, 32, 28))
    random.seed(5)
    same = generate(Coefficients(*law.coefficients), law.mass, Grid((24, 32, 28)), seed=random.getrandbits(31))
    assert field.dtype == np.float32
    np.testing.assert_array_equal(field, same.field.numpy())
    with pytest.raises(ArithmeticError, match="no shape"):
        kinds["curvatubes"].from_params(numbers | {"M0": -0.999, "MODE": "replicate"})._run_curvatubes((16, 16, 16))


@pytest.mark.slow
def test_the_monai_bundle_learns_from_slices_and_writes_masks(tmp_path: Path) -> None:
    for package in ("fire", "ignite"):
        pytest.importorskip(package)
    folder = tmp_path / "bundle"
    shutil.copytree(HOSTS / "monai", folder)
    z, y, x = np.mgrid[:48, :40, :40] - 20.0
    truth = (np.hypot(y, x + z / 3) < 6) | (np.hypot(z, y - 8) < 4)
    image = ndimage.gaussian_filter(truth.astype(float), 0.8)
    image += 0.4 * np.random.default_rng(0).standard_normal(truth.shape)
    known = np.where(np.arange(40) % 8 == 0, truth, False)
    for kind, values in (("images", image.astype(np.float32)), ("labels", known.astype(np.uint8))):
        (folder / "data" / kind).mkdir(parents=True)
        save(Volume(values.T, 0.5, "mm"), folder / "data" / kind / "case.nii.gz")
    for name, words in (("train", ("--epochs", "60", "--every", "8")), ("inference", ())):
        files = str([f"configs/{each}.json" for each in ("common", name)])
        ended = run("-m", "monai.bundle", "run", "--config_file", files, *words, folder=folder)
        assert ended.returncode == 0, ended.stderr
    predicted = load(folder / "predicted" / "case_mask.nii.gz")
    mask = predicted.values.T > 0
    assert predicted.spacing == (0.5, 0.5, 0.5)
    assert 2 * (mask & truth).sum() / (mask.sum() + truth.sum()) > 0.8
