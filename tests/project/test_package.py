"""The two archives that a release is made of: one copy of the package, and what goes with it."""

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: Files of the package in this tree, without what interpreters and compilers leave behind.
PACKAGE = {
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "curvafit").rglob("*")
    if path.is_file() and "__pycache__" not in path.parts
}


def build(target: str, folder: Path) -> Path:
    pytest.importorskip("hatchling", reason="needs hatchling, of the extra [dev]")
    command = [sys.executable, "-m", "hatchling", "build", "--target", target, "--directory", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (archive,) = folder.iterdir()
    return archive


def test_wheel_holds_one_copy_of_the_package(tmp_path: Path) -> None:
    with zipfile.ZipFile(build("wheel", tmp_path)) as archive:
        names = archive.namelist()
    assert len(names) == len(set(names))
    assert {name for name in names if ".dist-info/" not in name} == PACKAGE
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_sdist_holds_one_copy_and_the_tests(tmp_path: Path) -> None:
    with tarfile.open(build("sdist", tmp_path)) as archive:
        members = archive.getmembers()
    names = [member.name.partition("/")[2] for member in members if member.isfile()]
    assert len(names) == len(set(names)) and not [member.name for member in members if member.issym()]
    wings = ("priors/", "generation/", "data_synth/")
    assert not [name for name in names if name.startswith(wings)]
    assert {*PACKAGE, "pyproject.toml", "LICENSE", "README.md", "tests/project/test_package.py"} <= set(names)
