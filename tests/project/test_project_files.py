"""Files that other programs read: workflows, issue forms, the docs' table of contents."""

from __future__ import annotations

import importlib
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
GITHUB = ROOT / ".github"


class Loader(yaml.SafeLoader):
    """YAML with the tag by which mkdocs reads the environment."""


Loader.add_constructor("!ENV", lambda loader, node: loader.construct_sequence(node))


def read(path: Path) -> Any:
    return yaml.load(path.read_text(encoding="utf-8"), Loader)


def test_the_workflow_tests_every_python_from_the_least() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    matrix = read(GITHUB / "workflows" / "test.yml")["jobs"]["test"]["strategy"]["matrix"]
    minors = [int(version.removeprefix("3.")) for version in matrix["python"]]
    assert project["requires-python"] == f">={matrix['python'][0]}"
    assert minors == list(range(11, minors[-1] + 1)) and minors[-1] >= 14
    assert {name.partition("-")[0] for name in matrix["os"]} == {"ubuntu", "macos", "windows"}


def test_a_workflow_makes_what_the_makefile_knows() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    texts = [path.read_text(encoding="utf-8") for path in (*GITHUB.rglob("*.yml"), ROOT / ".ci" / "run")]
    called = set(re.findall(r"\bmake ([a-z-]+)", "\n".join(re.sub(r"#.*", "", text) for text in texts)))
    assert {"lint", "test", "docs"} <= called <= targets


def test_a_release_publishes_only_what_was_checked() -> None:
    jobs = read(GITHUB / "workflows" / "release.yml")["jobs"]
    assert jobs["publish"]["needs"] == "build" and jobs["publish"]["permissions"] == {"id-token": "write"}
    assert any("twine check" in step.get("run", "") for step in jobs["build"]["steps"])


@pytest.mark.parametrize("name", ["bug", "feature", "question"])
def test_issue_forms_are_forms(name: str) -> None:
    form = read(GITHUB / "ISSUE_TEMPLATE" / f"{name}.yml")
    assert form["name"] and form["description"]
    asked = [part["attributes"]["label"] for part in form["body"]]
    assert asked and any(part.get("validations", {}).get("required") for part in form["body"])


def test_every_page_of_the_docs_is_in_the_table_of_contents() -> None:
    docs = ROOT / "docs"
    listed = set(pages(read(ROOT / "mkdocs.yml")["nav"]))
    there = {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")}
    there |= {path.relative_to(docs).as_posix() for path in (docs / "notebooks").glob("*.py")}
    assert listed == there


def pages(part: Any) -> list[str]:
    """The files that a table of contents names."""
    if isinstance(part, str):
        return [part]
    parts = part.values() if isinstance(part, dict) else part
    return [page for each in parts for page in pages(each)]


def test_every_face_has_its_page() -> None:
    rooms = {p.parent.name for p in (ROOT / "curvafit").glob("*/__init__.py") if "__all__" in p.read_text("utf-8")}
    documented = {path.stem for path in (ROOT / "docs" / "api").glob("*.md")} - {"index", "curvafit"}
    assert documented == rooms


def test_links_of_the_first_pages_lead_somewhere() -> None:
    for page in ("README.md", "CONTRIBUTING.md"):
        links = re.findall(r"\]\(([^)#\s]+)", (ROOT / page).read_text(encoding="utf-8"))
        assert [link for link in links if "://" not in link and not (ROOT / link).exists()] == []
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < 130


def test_a_function_named_as_its_module_stands_on_the_page_of_its_room() -> None:
    """The page of a room lists its names by itself but for these, which it takes for the modules."""
    for page in (ROOT / "docs" / "api").glob("*.md"):
        room = f"curvafit.{page.stem}"
        if page.stem not in ("index", "curvafit"):
            names = importlib.import_module(room).__all__
            twins = {
                f"::: {room}.{name}.{name}"
                for name in names
                if (ROOT / "curvafit" / page.stem / f"{name}.py").is_file()
            }
            assert twins <= set(page.read_text(encoding="utf-8").splitlines()), page.name
