"""Files beside the package, and the archives of a release: one version, pins that hold, links that lead somewhere."""

import json
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import curvafit

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


#: Packages that conda calls by another name.
ELSEWHERE = {"torch": "pytorch", "matplotlib": "matplotlib-base"}


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_recipe_for_conda_asks_for_what_the_package_asks_for() -> None:
    recipe = yaml.safe_load(text("conda/recipe.yaml"))
    assert recipe["context"]["version"] == PROJECT["version"]
    wanted = {Requirement(each).name: str(Requirement(each).specifier) for each in PROJECT["dependencies"]}
    given = dict(each.split(" ", 1) for each in recipe["requirements"]["run"])
    assert given.pop("python") == PROJECT["requires-python"]
    names = {canonicalize_name(name): Requirement(f"x{bounds}").specifier for name, bounds in given.items()}
    expected = {ELSEWHERE.get(name, canonicalize_name(name)): bounds for name, bounds in wanted.items()}
    assert names == {name: Requirement(f"x{bounds}").specifier for name, bounds in expected.items()}


def test_one_version_everywhere() -> None:
    """Pins hold every requirement, and no file names a place of one machine."""
    version = PROJECT["version"]
    assert re.findall(r"^## \[(\d[^\]]*)\]", text("CHANGELOG.md"), re.MULTILINE)[0] == version
    assert re.findall(r"^version: (\S+)$", text("CITATION.cff"), re.MULTILINE) == [version]
    assert json.loads(text("codemeta.json"))["version"] == version
    assert curvafit.__version__ == version
    (script,) = entry_points(group="console_scripts", name="curvafit")
    assert callable(script.load())
    lines = [line for line in text("constraints.txt").splitlines() if line and not line.startswith("#")]
    pins = {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    for requirement in (Requirement(each) for group in groups for each in group):
        if requirement.name != "curvafit":
            assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), requirement
    place = re.compile(r"(?<![\w.:/-])/(?:home|root|Users|work|tmp|mnt|media|opt|var)/|\b[A-Z]:\\\\\w")
    assert place.search("open('/" + "home/me/scan.tif')")
    files = [path for part in ("curvafit", "tests", "benchmarks", "examples") for path in (ROOT / part).rglob("*.py")]
    files += [*ROOT.glob("*.md"), *ROOT.glob("*.t[ox][mt]l*"), *(ROOT / "docs").rglob("*.md")]
    files += [ROOT / "Makefile", ROOT / ".ci" / "run"]
    found = {str(path): match[0] for path in files if (match := place.search(path.read_text(encoding="utf-8")))}
    assert found == {}
    for page in ("README.md", "CONTRIBUTING.md"):
        links = re.findall(r"\]\(([^)#\s]+)", text(page))
        assert [link for link in links if "://" not in link and not (ROOT / link).exists()] == []


#: Files of the package in this tree, without what interpreters and compilers leave behind.
FILES = (path for path in (ROOT / "curvafit").rglob("*") if path.is_file() and "__pycache__" not in path.parts)
PACKAGE = {path.relative_to(ROOT).as_posix() for path in FILES}


def build(target: str, folder: Path) -> Path:
    pytest.importorskip("hatchling", reason="needs hatchling, of the group dev")
    command = [sys.executable, "-m", "hatchling", "build", "--target", target, "--directory", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (archive,) = folder.iterdir()
    return archive


def test_wheel_holds_one_copy_of_the_package(tmp_path: Path) -> None:
    """And so does the sdist, with the tests."""
    with zipfile.ZipFile(build("wheel", tmp_path / "wheel")) as archive:
        names = archive.namelist()
    assert len(names) == len(set(names))
    assert {name for name in names if ".dist-info/" not in name} == PACKAGE
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    with tarfile.open(build("sdist", tmp_path / "sdist")) as archive:
        members = archive.getmembers()
    names = [member.name.partition("/")[2] for member in members if member.isfile()]
    assert len(names) == len(set(names)) and not [member.name for member in members if member.issym()]
    wings = ("priors/", "generation/", "data_synth/")
    assert not [name for name in names if name.startswith(wings)]
    assert {*PACKAGE, "pyproject.toml", "LICENSE", "README.md", "tests/project/test_project_files.py"} <= set(names)
