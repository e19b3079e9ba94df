"""Files beside the package, and the archives of a release: one version, pins that hold, links that lead somewhere.

README's commands and lines of Python run as they stand, by the wheel alone.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import yaml
from markdown.extensions.toc import slugify
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import curvafit
from tests.golden import FOLDER

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


#: Packages that conda calls by another name.
ELSEWHERE = {"torch": "pytorch", "matplotlib": "matplotlib-base"}


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_recipe_for_conda_asks_for_what_the_package_asks_for() -> None:
    recipe = yaml.safe_load(text("conda/recipe.yaml"))
    assert recipe["context"]["version"] == curvafit.__version__ and recipe["package"]["name"] == PROJECT["name"]
    agrees_with_project(recipe["requirements"]["run"], recipe["build"]["python"]["entry_points"])
    assert {tuple(each.split(" ", 1)) for each in recipe["requirements"]["host"]} >= {("hatchling", ">=1.27"), ("pip",)}


def test_the_recipe_for_conda_renders() -> None:
    """A package for every system, of one variant; what it runs with is what it asks for, after the renderer too."""
    reason = "needs py-rattler-build, which is in no group: pip install py-rattler-build"
    rattler_build = pytest.importorskip("rattler_build", reason=reason)
    (made,) = rattler_build.Stage0Recipe.from_file(str(ROOT / "conda" / "recipe.yaml")).render()
    recipe = made.recipe
    assert (recipe.package.name, str(recipe.package.version)) == (PROJECT["name"], curvafit.__version__)
    assert recipe.build.noarch == "python"
    agrees_with_project(recipe.requirements.run, recipe.build.to_dict()["python"]["entry_points"])


def agrees_with_project(run: list[str], commands: list[str]) -> None:
    """Requirements and commands of a recipe are those of `pyproject.toml`, by the names that conda has for them."""
    given = dict(each.split(" ", 1) for each in run)
    assert given.pop("python") == PROJECT["requires-python"]
    wanted = map(Requirement, PROJECT["dependencies"])
    expected = {ELSEWHERE.get(each.name, canonicalize_name(each.name)): each.specifier for each in wanted}
    assert {canonicalize_name(name): Requirement(f"x{bounds}").specifier for name, bounds in given.items()} == expected
    assert commands == [f"{name} = {entry}" for name, entry in PROJECT["scripts"].items()]


def test_one_version_everywhere() -> None:
    """Pins hold every requirement, and no file names a place of one machine."""
    version = curvafit.__version__
    assert re.findall(r"^## \[(\d[^\]]*)\]", text("CHANGELOG.md"), re.MULTILINE)[0] == version
    assert re.findall(r"^version: (\S+)$", text("CITATION.cff"), re.MULTILINE) == [version]
    assert json.loads(text("codemeta.json"))["version"] == version
    bundle = json.loads(text("examples/hosts/monai/configs/metadata.json"))
    assert bundle["required_packages_version"]["curvafit"] == version
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


def test_links_lead_somewhere_and_pictures_are_described() -> None:
    """mkdocs checks the same links of the site; those of README it never sees."""
    pages = [ROOT / "paper" / "paper.md", *ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    pages = [page for page in pages if page.parent.name != "notebooks"]  # what `make docs` made of them
    wrong = []
    for page in pages:
        prose = FENCES.sub("", page.read_text(encoding="utf-8"))
        for mark, words, target in LINK.findall(re.sub(r"`[^`\n]*`", "code", prose)):
            name, _, anchor = target.partition("#")
            path = page.parent / name if name else page
            if "://" in target:
                right = target.startswith("https://")
            elif path.parent.name == "notebooks":
                right = path.with_suffix(".py").is_file()
            elif path.name == "atlas.html":  # what `make docs` grows
                right = (ROOT / "docs" / "atlas.py").is_file()
            else:
                right = path.exists() and (not anchor or anchor in anchors(path))
            described = not mark or (len(words) > 10 and path.stat().st_size < 2e6)
            wrong += [] if right and described else [(str(page), target)]
        wrong += [(str(page), tag) for tag in re.findall(r"<img[^>]*>", prose) if not re.search(r'alt="[^"]{10}', tag)]
    assert wrong == []
    assert len(text("README.md").splitlines()) <= 100


FENCES = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
#: The mark of a picture, words (which may hold a pair of brackets), and where to.
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)[^)]*\)")


def anchors(page: Path) -> set[str]:
    """The names of a page's headings, and of what carries one of its own."""
    prose = FENCES.sub("", page.read_text(encoding="utf-8"))
    heads = [re.sub(r"\{.*\}|[*`]", "", head) for head in re.findall(r"^#+ (.+)$", prose, re.MULTILINE)]
    named = re.findall(r'id="([^"]+)"', prose) + re.findall(r"\{[^}\n]*#([\w-]+)", prose)
    return {slugify(LINK.sub(r"\2", head), "-") for head in heads} | set(named)


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


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", tmp_path_factory.mktemp("wheel"))


def test_wheel_holds_one_copy_of_the_package(wheel: Path, tmp_path: Path) -> None:
    """And so does the sdist, with the tests, and what README names."""
    with zipfile.ZipFile(wheel) as archive:
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
    links = {link.partition("#")[0] for _, _, link in LINK.findall(text("README.md")) if "://" not in link}
    scripts = {*re.findall(r"`python (\S+\.py)", text("README.md")), "benchmarks/__main__.py"}
    assert links - {"docs/"} | scripts <= set(names)
    assert {*PACKAGE, "pyproject.toml", "LICENSE", "README.md", "tests/project/test_project_files.py"} <= set(names)


#: Sizes that README states, and what a test has time for.
SMALLER = {"--shape 100": "--shape 20", "--count 200": "--count 1 --shape 16 --workers 0", "grid=100": "grid=20"}
#: README's files, from the inputs of `tests/golden`.
INPUTS = {
    "bone.tif": "scan.tif",
    "vessels.tif": "mask.nii.gz",
    "scan.nii.gz": "scan.tif",
    "labels.nii.gz": "mask.nii.gz",
}
WRITTEN = (
    "measured/measures.html", "vessels/centreline.svg", "compared/compare.html", "bone/fit.json", "bone/report.html",
    "tubes.stl", "Dataset101_Tubes/dataset.json", "volume.nii.gz", "mask.nii.gz",
)  # fmt: skip
#: All in one process: a command's time is mostly its imports. What a snippet takes for granted stands before it.
SCRIPT = """
import json, sys, torch, curvafit
from curvafit.cli.app import app

assert curvafit.__file__.startswith(sys.argv[1])
commands, snippets = json.load(sys.stdin)
for command in commands:
    try:
        app(command)
    except SystemExit as end:
        assert not end.code, command
names = {"logits": torch.randn(1, 2, 16, 16, 16, requires_grad=True), "target": torch.ones(1, 1, 16, 16, 16)}
names["dice_and_cross_entropy"] = lambda logits, target: torch.nn.functional.cross_entropy(logits, target[:, 0].long())
for snippet in snippets:
    exec(snippet, names)
names["loss"](names["logits"], names["target"]).backward()
assert names["logits"].grad.abs().max() > 0 and names["flow"].status and names["inference"].fit.status
"""


@pytest.mark.slow
def test_readme_runs_from_the_wheel(wheel: Path, tmp_path: Path) -> None:
    """The tree is out of reach of the process."""
    package, work = tmp_path / "package", tmp_path / "work"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(package)
    take_compiled(package)
    for name in ("control", "treated"):
        shutil.copytree(FOLDER / name, work / name)
    for name, source in INPUTS.items():
        curvafit.save(FOLDER / source, work / name)
    (work / "scan").mkdir()
    shutil.copy(FOLDER / "fit.json", work / "scan")
    readme = text("README.md")
    for stated, size in SMALLER.items():
        assert stated in readme
        readme = readme.replace(stated, size)
    commands = [shlex.split(line, comments=True)[1:] for line in re.findall(r"^curvafit .*$", readme, re.MULTILINE)]
    snippets = re.findall(r"^```python\n(.*?)^```$", readme, re.MULTILINE | re.DOTALL)
    assert len(commands) > 6 and len(snippets) == 3
    call = [sys.executable, "-W", "ignore", "-c", SCRIPT, str(package)]
    environment = os.environ | {"PYTHONPATH": str(package)}
    said = json.dumps([commands, snippets])
    done = subprocess.run(call, cwd=work, env=environment, input=said, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert [name for name in WRITTEN if not (work / name).is_file()] == []


def take_compiled(package: Path) -> None:
    """Lay what numba compiled of this tree beside the same files, which then need no half a minute."""
    for path in (ROOT / "curvafit").rglob("*.py"):
        shutil.copystat(path, package / path.relative_to(ROOT))
    for path in (ROOT / "curvafit").rglob("__pycache__/*.nb[ci]"):
        copy = package / path.relative_to(ROOT)
        copy.parent.mkdir(exist_ok=True)
        shutil.copy(path, copy)
