"""What an import brings along, which names each room offers, and arrows that run one way, down the floors."""

import ast
import graphlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "curvafit"
WINGS = ("priors", "generation", "data_synth")
ROOMS = ["curvafit"] + [
    f"curvafit.{path.parent.name}"
    for path in sorted(PACKAGE.glob("*/__init__.py"))
    if "__all__" in path.read_text("utf-8")
]


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


FILES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
PRIORS = [name for name in FILES if f"{name}.".startswith("curvafit.priors.") and "kernels" not in name]

#: Asks everything in an order in which no answer depends on an earlier question, and prints the answers as JSON.
SCRIPT = r"""
import contextlib, importlib, io, json, sys, types
from importlib.machinery import PathFinder

before = set(sys.modules)
import curvafit
new = {name.split(".")[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names)
rooms = {".".join(name.split(".")[:2]) for name in sys.modules if name.startswith("curvafit.")}
answers = {"package": sorted(new), "rooms": sorted(rooms), "wings": []}

with contextlib.redirect_stdout(io.StringIO()) as shown, contextlib.suppress(SystemExit):
    from curvafit.cli.app import app
    app(["--help"])
answers["help"] = shown.getvalue()
answers["heavy"] = sorted({"torch", "numpy", "scipy", "matplotlib", "numba", "jax"} & set(sys.modules))
for wing in WINGS:
    try:
        importlib.import_module(wing)
    except ImportError as error:
        answers["wings"].append(str(error))

# every package but torch, numpy and what torch itself is made of is hidden, as if it were not installed
NEEDS = (
    "numpy torch torchgen functorch triton nvidia sympy mpmath networkx jinja2 markupsafe filelock fsspec "
    "typing_extensions setuptools _distutils_hack pkg_resources lazy_loader packaging"
)
SEEN = {"curvafit", *NEEDS.split(), *sys.stdlib_module_names}
class Only:
    @staticmethod
    def find_spec(name, path=None, target=None):
        return PathFinder.find_spec(name, path, target) if name.partition(".")[0] in SEEN else None
finders = list(sys.meta_path)
sys.meta_path[:] = [finder for finder in finders if finder is not PathFinder] + [Only]
answers["seen"] = []
for hidden in ("numba", "scipy", "skimage", "jax", "jaxtyping", "geomloss", "nibabel", "matplotlib"):
    with contextlib.suppress(ImportError):
        importlib.import_module(hidden)
        answers["seen"].append(hidden)
for name in PRIORS:
    importlib.import_module(name)
import torch
from curvafit.priors import Grid, energy, preset
u = torch.rand((8, 8, 8), generator=torch.Generator().manual_seed(0)).requires_grad_()
value = energy(u, preset("tubes").coefficients, Grid((8, 8, 8)), 0.02)
value.backward()
answers["energy"] = [float(value), float(u.grad.abs().max())]
sys.meta_path[:] = finders

answers["names"] = {}
for room in ROOMS:
    face = importlib.import_module(room)
    modules = [name for name in face.__all__ if isinstance(getattr(face, name), types.ModuleType)]
    # a module of that name must not take the function's place
    homes = [(name, sys.modules.get(f"{room}.{name}")) for name in face.__all__]
    hidden = [name for name, home in homes if home is not None and getattr(face, name) is not getattr(home, name)]
    answers["names"][room] = modules + hidden + sorted(set(face.__all__) - set(dir(face)))
print(json.dumps(answers))
"""


@pytest.fixture(scope="module")
def answers() -> dict[str, Any]:
    head = f"WINGS, ROOMS, PRIORS = {WINGS!r}, {ROOMS!r}, {PRIORS!r}\n"
    done = subprocess.run([sys.executable, "-c", head + SCRIPT], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_the_package_imports_nothing(answers) -> None:
    """Priors need torch and NumPy only; a room offers its names and nothing else."""
    assert set(answers["package"]) <= {"curvafit", "lazy_loader"} and set(answers["rooms"]) <= {"curvafit.core"}
    assert "generate" in answers["help"] and answers["heavy"] == []
    links = [wing for wing in WINGS if (ROOT / wing).is_symlink()]  # a tree may be made without them
    assert [wing for wing in links if not any(f"curvafit.{wing}" in said for said in answers["wings"])] == []
    assert answers["seen"] == []
    value, slope = answers["energy"]
    assert abs(value) < float("inf") and slope > 0
    assert answers["names"] == {room: [] for room in ROOMS}


#: The house from the ground up. A folder (or a file at the root) imports from floors below its own.
FLOORS = (
    ("core",), ("priors",), ("generation", "volumes", "geometry"), ("scan", "drawing"), ("inference",), ("data_synth",),
    ("segmentation",), ("studies",), ("report",), ("cli", "napari", "nnunet"), ("__main__",),
)  # fmt: skip


def test_arrows_run_one_way() -> None:
    """And modules do not import each other in a circle."""
    for module, line in {
        "priors.energy": "from curvafit.generation.flow import generate", "report.page": "from ..scan import a",
        "generation.flow": "def f():\n    from curvafit import generate", "drawing.plot": "from priors import energy",
    }.items():  # fmt: skip
        assert complaints(f"curvafit.{module}", line) != []
    graph = {}
    for module, path in FILES.items():
        text = path.read_text(encoding="utf-8")
        assert module == "curvafit" or complaints(module, text) == []
        targets = {name if name in FILES else name.rpartition(".")[0] for name, _ in imports(text)}
        graph[module] = targets & FILES.keys() - {"curvafit", module}
    graphlib.TopologicalSorter(graph).prepare()
    with pytest.raises(graphlib.CycleError):
        graphlib.TopologicalSorter(graph | {"curvafit.core.checks": {"curvafit.cli.app"}}).prepare()


def complaints(module: str, text: str) -> list[str]:
    """The imports of a module that its floor does not permit; names are imported from where they are made."""
    own, found = module.split(".")[1], []
    for name, level in imports(text):
        head, *rest = name.split(".")
        if level or head in WINGS or (head == "curvafit" and not permitted(own, rest[0])):
            found.append(f"{module}: {name}")
    return found


def permitted(own: str, target: str) -> bool:
    floors = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
    return own == target or floors.get(target, len(FLOORS)) < floors[own]


def imports(text: str) -> Iterator[tuple[str, int]]:
    """Every imported name, as far as it may be a module, with its relative level, wherever in the text it stands."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from ((f"{alias.name}.*", 0) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((f"{node.module or ''}.{alias.name}", node.level) for alias in node.names)
