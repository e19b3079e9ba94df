"""Files beside the package: one version, pins that hold, links that lead somewhere, no place of one machine."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

import curvafit

ROOT = Path(__file__).resolve().parents[2]


def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


# ---- versions --------------------------------------------------------------------------------------------------------


def test_one_version_everywhere() -> None:
    version = project()["version"]
    released = re.findall(r"^## \[(\d[^\]]*)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    cited = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert released[0] == version
    assert cited == [version]
    assert curvafit.__version__ == version


def test_the_command_is_installed() -> None:
    from importlib.metadata import entry_points

    (script,) = entry_points(group="console_scripts", name="curvafit")
    assert callable(script.load())


def test_constraints_hold_every_requirement() -> None:
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    pins = {canonicalize_name(name): version for name, version in pins.items()}
    groups = [project()["dependencies"], *project()["optional-dependencies"].values()]
    for requirement in (Requirement(text) for group in groups for text in group):
        if requirement.name != "curvafit":
            assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), requirement


# ---- docs ------------------------------------------------------------------------------------------------------------


class Loader(yaml.SafeLoader):
    """YAML with the tag by which mkdocs reads the environment."""


Loader.add_constructor("!ENV", lambda loader, node: loader.construct_sequence(node))


def test_every_page_of_the_docs_is_in_the_table_of_contents() -> None:
    docs = ROOT / "docs"
    nav = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), Loader)["nav"]
    there = {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")}
    there |= {path.relative_to(docs).as_posix() for path in (docs / "notebooks").glob("*.py")}
    assert set(pages(nav)) == there


def pages(part: Any) -> Iterator[str]:
    """The files that a table of contents names."""
    if isinstance(part, str):
        yield part
        return
    for inner in part.values() if isinstance(part, dict) else part:
        yield from pages(inner)


def test_links_of_the_first_pages_lead_somewhere() -> None:
    for page in ("README.md", "CONTRIBUTING.md"):
        links = re.findall(r"\]\(([^)#\s]+)", (ROOT / page).read_text(encoding="utf-8"))
        assert [link for link in links if "://" not in link and not (ROOT / link).exists()] == []


def test_what_ci_makes_is_in_the_makefile() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    texts = [path.read_text(encoding="utf-8") for path in (*(ROOT / ".github").rglob("*.yml"), ROOT / ".ci" / "run")]
    called = set(re.findall(r"\bmake ([a-z-]+)", "\n".join(re.sub(r"#.*", "", text) for text in texts)))
    assert called <= targets


# ---- sources ---------------------------------------------------------------------------------------------------------


def sources() -> list[Path]:
    return [p for part in ("curvafit", "tests", "benchmarks", "examples") for p in sorted((ROOT / part).rglob("*.py"))]


def test_no_file_names_a_place_on_one_machine() -> None:
    place = re.compile(r"(?<![\w.:/-])/(?:home|root|Users|work|tmp|mnt|media|opt|var)/|\b[A-Z]:\\\\\w")
    files = [*sources(), *ROOT.glob("*.md"), *ROOT.glob("*.t[ox][mt]l*"), ROOT / "Makefile", ROOT / ".ci" / "run"]
    files += [*(ROOT / "docs").rglob("*.md")]
    assert place.search("open('/" + "home/me/scan.tif')")
    found = {str(p.relative_to(ROOT)): m[0] for p in files if (m := place.search(p.read_text(encoding="utf-8")))}
    assert found == {}


def test_no_test_hides_another() -> None:
    for path in sorted((ROOT / "tests").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names = [node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
        assert len(names) == len(set(names)), path.name
        assert path.name.startswith("test_") or not names, path.name
