"""The rules that keep the house in order: what an import brings along, sizes, names, paths, versions."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "curvafit"
WINGS = ("priors", "generation", "data_synth")


# ---- what an import brings along -------------------------------------------------------------------------------------

#: Hides every package but torch, numpy and what torch itself is made of, as if the others were not installed.
ONLY_TORCH = """
import sys
from importlib.machinery import PathFinder
NEEDS = "numpy torch torchgen functorch triton nvidia sympy mpmath networkx jinja2 markupsafe filelock fsspec " \\
        "typing_extensions setuptools _distutils_hack pkg_resources"
SEEN = {"curvafit", *NEEDS.split(), *sys.stdlib_module_names}
class Only:
    @staticmethod
    def find_spec(name, path=None, target=None):
        return PathFinder.find_spec(name, path, target) if name.partition(".")[0] in SEEN else None
sys.meta_path[:] = [finder for finder in sys.meta_path if finder is not PathFinder] + [Only]
"""


def test_priors_need_torch_and_numpy_only() -> None:
    files = [path.relative_to(ROOT).with_suffix("") for path in sorted((PACKAGE / "priors").rglob("*.py"))]
    names = [".".join(path.parts).removesuffix(".__init__") for path in files]
    modules = [name for name in names if not name.startswith("curvafit.priors.kernels.")]
    script = """
    for hidden in ("numba", "scipy", "skimage", "jax", "jaxtyping", "geomloss", "nibabel", "matplotlib"):
        try:
            __import__(hidden)
        except ImportError:
            continue
        raise SystemExit(f"{hidden} was not hidden")
    from importlib import import_module
    for name in MODULES:
        import_module(name)
    import torch
    from curvafit.priors import Grid, energy, preset
    u = torch.rand((8, 8, 8), generator=torch.Generator().manual_seed(0)).requires_grad_()
    value = energy(u, preset("tubes").coefficients, Grid((8, 8, 8)), 0.02)
    value.backward()
    assert torch.isfinite(value) and u.grad.abs().max() > 0
    print("ok")
    """
    assert run(ONLY_TORCH + f"MODULES = {modules!r}\n" + textwrap.dedent(script)) == "ok"


def test_the_package_imports_nothing() -> None:
    script = """
    import sys
    before = set(sys.modules)
    import curvafit
    new = {name for name in set(sys.modules) - before if name.partition(".")[0] not in sys.stdlib_module_names}
    print(*sorted(new))
    """
    assert run(textwrap.dedent(script)) == "curvafit curvafit.core curvafit.core.faces"


@pytest.mark.parametrize("wing", WINGS)
def test_a_wing_through_its_link_raises(wing: str) -> None:
    if not (ROOT / wing).is_symlink():
        pytest.skip("this tree was made without symbolic links")
    script = f"""
    try:
        import {wing}
    except ImportError as error:
        print(error)
    """
    assert run(textwrap.dedent(script)).startswith(f"import curvafit.{wing}, not {wing}")


def run(script: str) -> str:
    """What a fresh interpreter at the root prints; its errors fail the test."""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


# ---- sizes, names, paths ---------------------------------------------------------------------------------------------


def sources() -> list[Path]:
    return [p for part in ("curvafit", "tests", "benchmarks", "examples") for p in sorted((ROOT / part).rglob("*.py"))]


def test_no_file_names_a_place_on_one_machine() -> None:
    place = re.compile(r"(?<![\w.:/-])/(?:home|root|Users|work|tmp|mnt|media|opt|var)/|\b[A-Z]:\\\\\w")
    files = [*sources(), *ROOT.glob("*.md"), *ROOT.glob("*.t[ox][mt]l*"), ROOT / "Makefile", ROOT / ".ci" / "run"]
    files += [*(ROOT / "docs").rglob("*.md")]
    assert place.search("open('/" + "home/me/scan.tif')")
    found = {str(p.relative_to(ROOT)): m[0] for p in files if (m := place.search(p.read_text(encoding="utf-8")))}
    assert found == {}


def test_test_files_are_found_and_no_test_hides_another() -> None:
    for path in sorted((ROOT / "tests").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names = [node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
        assert len(names) == len(set(names)), path.name
        classes = any(isinstance(node, ast.ClassDef) and node.name.startswith("Test") for node in tree.body)
        assert path.name.startswith("test_") == bool(names or classes), path.name


# ---- versions --------------------------------------------------------------------------------------------------------


def test_one_version_everywhere() -> None:
    version = project()["version"]
    released = re.findall(r"^## \[(\d[^\]]*)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    cited = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert released[0] == version
    assert cited == [version]


def test_constraints_hold_every_requirement() -> None:
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    pins = {canonicalize_name(name): version for name, version in pins.items()}
    assert pins["torch"] == "2.13.0"
    groups = [project()["dependencies"], *project()["optional-dependencies"].values()]
    for requirement in (Requirement(text) for group in groups for text in group):
        if requirement.name not in ("curvafit", "triton"):  # a torch for CUDA brings the triton that it wants
            assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), requirement


def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
