"""Files beside the package: one version, pins that hold, links that lead somewhere, no place of one machine."""

import re
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import curvafit

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_one_version_everywhere() -> None:
    version = PROJECT["version"]
    assert re.findall(r"^## \[(\d[^\]]*)\]", text("CHANGELOG.md"), re.MULTILINE)[0] == version
    assert re.findall(r"^version: (\S+)$", text("CITATION.cff"), re.MULTILINE) == [version]
    assert curvafit.__version__ == version
    (script,) = entry_points(group="console_scripts", name="curvafit")
    assert callable(script.load())


def test_constraints_hold_every_requirement() -> None:
    lines = [line for line in text("constraints.txt").splitlines() if line and not line.startswith("#")]
    pins = {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    for requirement in (Requirement(each) for group in groups for each in group):
        if requirement.name != "curvafit":
            assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), requirement


def test_no_file_names_a_place_on_one_machine() -> None:
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
