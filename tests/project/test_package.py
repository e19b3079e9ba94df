"""What an installed package offers, and what the two archives hold."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import textwrap
import tomllib
import zipfile
from pathlib import Path, PurePosixPath

import pytest

import curvafit

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ["curvafit"] + [
    f"curvafit.{path.parent.name}"
    for path in sorted((ROOT / "curvafit").glob("*/__init__.py"))
    if "offer(__name__" in path.read_text(encoding="utf-8")
]


# ---- public names ----------------------------------------------------------------------------------------------------


def test_every_public_name_loads_and_is_listed() -> None:
    for name in curvafit.__all__:
        assert getattr(curvafit, name) is not None
        assert name in dir(curvafit)


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_offers_its_names_and_nothing_else(room: str) -> None:
    """In a fresh interpreter: every name loads, also after its module was imported, and completion lists no other."""
    script = f"""
    import importlib, types
    face = importlib.import_module("{room}")
    assert sorted(face.__all__) == dir(face), set(dir(face)) ^ set(face.__all__)
    for name, home in face._homes.items():
        module = importlib.import_module(home)
        assert getattr(face, name) is getattr(module, name) and not isinstance(getattr(face, name), types.ModuleType)
    try:
        face.nothing
    except AttributeError as error:
        print(error)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == f"module '{room}' has no attribute 'nothing'"


def test_the_version_is_the_project_s() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert curvafit.__version__ == project["version"]


def test_the_command_is_installed() -> None:
    from importlib.metadata import entry_points

    (script,) = entry_points(group="console_scripts", name="curvafit")
    assert callable(script.load())


# ---- archives --------------------------------------------------------------------------------------------------------


def test_wheel_holds_one_copy_of_the_package(tmp_path: Path) -> None:
    with zipfile.ZipFile(build("wheel", tmp_path)) as archive:
        names = archive.namelist()
    assert len(names) == len(set(names))
    inside = {name for name in names if ".dist-info/" not in name}
    assert inside == package_files()
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_sdist_holds_one_copy_and_the_tests(tmp_path: Path) -> None:
    with tarfile.open(build("sdist", tmp_path)) as archive:
        members = archive.getmembers()
    names = [str(PurePosixPath(*PurePosixPath(member.name).parts[1:])) for member in members if member.isfile()]
    assert len(names) == len(set(names))
    assert not [member.name for member in members if member.issym()]
    assert {name for name in names if re.search(r"(^|/)(priors|generation|data_synth)/", name)} <= package_files()
    assert package_files() <= set(names)
    assert {"pyproject.toml", "LICENSE", "README.md", "tests/project/test_package.py"} <= set(names)


def package_files() -> set[str]:
    """Files of the package in this tree, without what interpreters and compilers leave behind."""
    paths = (path for path in (ROOT / "curvafit").rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(ROOT).as_posix() for path in paths}


def build(target: str, folder: Path) -> Path:
    pytest.importorskip("hatchling", reason="needs hatchling, of the extra [dev]")
    command = [sys.executable, "-m", "hatchling", "build", "--target", target, "--directory", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (archive,) = folder.iterdir()
    return archive
