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

ROOT = Path(__file__).resolve().parent.parent


# ---- public names ----------------------------------------------------------------------------------------------------


def test_every_public_name_loads_and_is_listed() -> None:
    for name in curvafit.__all__:
        assert getattr(curvafit, name) is not None
        assert name in dir(curvafit)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'curvafit' has no attribute 'nothing'"):
        _ = curvafit.nothing


def test_functions_win_over_modules_of_their_name() -> None:
    script = """
    import sys, types
    for first in ("import curvafit.inference.infer, curvafit.geometry.diagram", "import curvafit; curvafit.infer"):
        for name in [name for name in sys.modules if name.partition(".")[0] == "curvafit"]:
            del sys.modules[name]
        exec(first)
        import curvafit
        for name in ("infer", "diagram"):
            assert isinstance(getattr(curvafit, name), types.FunctionType), name
            assert isinstance(sys.modules["curvafit." + name], types.ModuleType), name
        from curvafit.geometry.diagram import Diagram, diagram
        assert curvafit.diagram is diagram and curvafit.Diagram is Diagram
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


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
    assert {"pyproject.toml", "LICENSE", "README.md", "tests/test_package.py"} <= set(names)


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
