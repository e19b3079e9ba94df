"""What calls the program from Fiji and 3D Slicer: its options exist, and the volumes come back in their place."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from calling import call

from curvafit.volumes import Field, load, save

ROOT = Path(__file__).resolve().parents[2] / "integrations"
SCRIPT = ROOT / "slicer/CurvafitComplete.py"
pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")


@pytest.fixture
def labels(tmp_path: Path) -> Path:
    z, y, x = np.mgrid[:17, :24, :24]
    tube = np.hypot(y - 11 + np.sin(z / 4), x - 12) < 6
    tube[np.arange(17) % 8 > 0] = False
    affine = np.array([[-0.3, 0, 0, 5], [0, -0.3, 0, 6], [0, 0, 0.6, 7], [0, 0, 0, 1]])
    return save(Field(tube.astype(np.uint8), (0.6, 0.3, 0.3), "mm", affine), tmp_path / "labels.nii.gz")


def slicer(*arguments: object) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, SCRIPT, *map(str, arguments)], capture_output=True, text=True, check=False)


def test_slicer_s_description_names_the_script_s_options() -> None:
    module = ElementTree.parse(ROOT / "slicer/CurvafitComplete.xml").getroot()
    flags = [flag.text for flag in module.iter("longflag")]
    usage = slicer("--help").stdout
    assert flags and all(flag in usage for flag in flags)
    indices = {image.findtext("name"): image.findtext("index") for image in module.iter("image")}
    assert (indices["labels"], indices["filled"]) == ("0", "1")
    assert {image.get("fileExtensions") for image in module.iter("image")} == {".nii.gz"}


def test_slicer_gets_volumes_in_their_place_and_progress(labels: Path, tmp_path: Path) -> None:
    program = Path(sys.executable).with_name("curvafit")
    if not program.exists():
        pytest.skip("the program curvafit is not installed beside this Python")
    filled, likely = tmp_path / "filled.nii.gz", tmp_path / "likely.nii.gz"
    done = slicer(labels, filled, "--probability", likely, "--every", 8, "--program", program)
    assert done.returncode == 0, done.stderr
    assert re.search(r"<filter-progress>0\.\d+</filter-progress>\n<filter-comment>\w", done.stdout)
    known, mask = load(labels), load(filled)
    np.testing.assert_allclose(mask.affine, known.affine)  # type: ignore[arg-type]
    assert np.array_equal(mask.values[::8], known.values[::8]) and mask.values[4].sum() > 60
    assert load(likely).values.dtype == np.float32
    assert sorted(path.name for path in tmp_path.iterdir()) == ["filled.nii.gz", "labels.nii.gz", "likely.nii.gz"]
    missing = slicer(tmp_path / "no.nii.gz", filled, "--program", program)
    assert missing.returncode == 2 and "no such file" in missing.stderr


def test_slicer_is_told_where_no_program_is(labels: Path, tmp_path: Path) -> None:
    done = slicer(labels, tmp_path / "filled.nii.gz", "--program", tmp_path / "none")
    assert done.returncode == 1 and "choose the curvafit program" in done.stderr


def test_the_command_of_fiji_s_macro_runs(labels: Path, tmp_path: Path) -> None:
    macro = (ROOT / "fiji/Complete_Slices.ijm").read_text()
    called = re.search(r"exec\(program, (.*)\);", macro)
    assert called is not None
    values = {"knownOption": "--axis", "knownValue": "z", "labelOption": "--labels", "labelValue": "all"}
    values |= {"imageOption": "--axis", "imageValue": "z", "folder": f"{tmp_path}/"}
    save(load(labels), tmp_path / "labels.tif")
    words = ["".join(each.strip('"') if '"' in each else values[each] for each in part.split(" + "))
             for part in called[1].split(", ")]  # fmt: skip
    result = call(*words)
    assert result.exit_code == 0, result.stderr
    for name in re.findall(r'open\(folder \+ "(.*)"\)', macro):
        assert load(tmp_path / name).shape == (17, 24, 24)
