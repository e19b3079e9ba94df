"""What the scripts of this folder share: options, shapes kept between runs, tables with their origin, pictures."""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import FigureBase

from curvafit.core.files import write_atomically
from curvafit.data_synth.atlas import versions
from curvafit.drawing.plot import diagram_on, shared_limits, surface_on
from curvafit.drawing.rendering import QUIET
from curvafit.generation.flow import Execution, Flow, generate
from curvafit.generation.schedule import Schedule, schedule
from curvafit.geometry.diagrams import Diagram, diagram
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, Grid

KINDS = ("geometric", "diffuse")
#: Voxels along an edge with --small.
SMALL = 40
#: Edge of the bins that diagrams are kept in, 1 / working unit: it divides the one that distances are taken with.
BIN = 0.5
#: Pixels that a surface is drawn with, inches that a picture's cell is wide, and that a surface and a diagram are high.
PIXELS = 400
CELL, SURFACE, DIAGRAM = 2.5, 2.6, 2.5


class Shape(NamedTuple):
    """A finished shape: its field (empty where not kept), its diagrams by curvature, and what is known of it."""

    field: np.ndarray
    diagrams: dict[str, Diagram]
    facts: dict[str, Any]


# ---- options ---------------------------------------------------------------------------------------------------------


def parser(doc: str | None, name: str, plan: str = "fast") -> argparse.ArgumentParser:
    """The options that all scripts have."""
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--edge", type=int, default=100, help="voxels along an edge; 100, as published, if not given")
    made.add_argument("--small", action="store_const", const=SMALL, dest="edge", help=f"--edge {SMALL}")
    made.add_argument("--schedule", default=plan, help=f"fast, or paper: the published one; {plan} if not given")
    made.add_argument("--steps", type=int, help="how many, if not the schedule's")
    made.add_argument("--curvature", choices=KINDS, default="diffuse", help="in pictures; diffuse is the paper's")
    made.add_argument("--device", default="cpu", help="cpu or cuda")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("-o", "--output", type=Path, default=Path(name), help=f"folder; {name} if not given")
    return made


def plan_of(options: argparse.Namespace) -> Schedule:
    return schedule(options.schedule, options.steps)


# ---- shapes ----------------------------------------------------------------------------------------------------------


def grown(
    path: Path, coefficients: Coefficients, mass: float, options: argparse.Namespace, *, keep: bool = True, **more
) -> Shape:
    """`generate` in a cube, unless the file has this shape already; `more` goes to `generate`."""
    told = {"seed": options.seed} | more
    grid, plan = Grid((options.edge,) * 3), plan_of(options)
    stated = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in told.items()}
    about = {"a": coefficients.as_dict(), "mass": mass, "grid": grid.shape, "plan": plan.as_dict(), **stated}
    told |= {"schedule": plan, "execution": Execution(device=options.device)}
    return kept(path, about, lambda: generate(coefficients, mass, grid, **told), keep)


def kept(path: Path, about: dict[str, Any], make: Callable[[], Flow], keep: bool = True) -> Shape:
    """The shape in a file, where it was made from the same; else made, measured and written there.

    `keep` is whether the field is kept too.
    """
    about = json.loads(json.dumps(about))
    if path.is_file():
        with np.load(path) as data:
            facts = json.loads(str(data["facts"]))
            if facts["about"] == about:
                seen = {kind: Diagram(data[f"{kind} points"], data[f"{kind} weights"]) for kind in facts["kinds"]}
                return Shape(data["field"], seen, facts)
    flow = make()
    shape = _measured(flow, about)
    shape = shape if keep else shape._replace(field=np.zeros((0, 0, 0), dtype=np.float32))
    arrays: dict[str, Any] = {"facts": np.array(json.dumps(shape.facts)), "field": shape.field}
    for kind, seen in shape.diagrams.items():
        arrays |= {f"{kind} points": seen.points, f"{kind} weights": seen.weights}
    write_atomically(path, lambda temporary: np.savez_compressed(temporary, **arrays))
    print(f"{path.stem}: {flow.status}", flush=True)
    return shape


def _measured(flow: Flow, about: dict[str, Any]) -> Shape:
    u, end = flow.field.numpy(), flow.viability
    facts = {
        "about": about,
        "program": program(),
        "status": flow.status,
        "viable": end.viable,
        "energy": float(flow.history.energy[-1]),
        "discrepancy": end.discrepancy,
        "fraction": float((u > 0).mean()),
        "kinds": list(KINDS if end.viable else ()),
    }
    seen = {kind: diagram(u, flow.grid, WORKING_EPSILON, curvature=kind) for kind in facts["kinds"]}
    if seen:
        facts["density"] = seen["geometric"].area / (1 - seen["geometric"].excluded) / flow.grid.volume
    return Shape(u, {kind: measure.bin(BIN) for kind, measure in seen.items()}, facts)


def program() -> str:
    """Versions of what runs, and the commit of the tree that this script is in."""
    git = ["git", "-C", str(Path(__file__).resolve().parent)]
    found = []
    for words in (("rev-parse", "--short", "HEAD"), ("status", "--porcelain", "--", ":/curvafit")):
        done = subprocess.run([*git, *words], capture_output=True, text=True, check=False)
        found.append(done.stdout.strip())
    commit = (found[0] or "unknown") + (" with changes" if found[1] else "")
    return ", ".join(f"{name} {version}" for name, version in versions().items()) + f", commit {commit}"


# ---- results ---------------------------------------------------------------------------------------------------------


def write_table(options: argparse.Namespace, name: str, lines: Sequence[str], programs: Sequence[str] = ()) -> None:
    """Print a table and write it into the folder, headed by all options and by what made the shapes."""
    told = ", ".join(f"{key} {value}" for key, value in vars(options).items() if key != "output")
    plan = plan_of(options)
    head = [f"# {name}: {told}", f"# {plan}, ε {WORKING_EPSILON}, spacing {Grid((4, 4, 4)).spacing[0]}"]
    head += [f"# made by {each}" for each in sorted(set(programs)) or [program()]]
    text = "\n".join([*head, *lines]) + "\n"
    print(text, end="")
    write_atomically(options.output / f"{name}.txt", lambda path: _write_text(path, text))


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def draw(figure: FigureBase, shapes: Mapping[str, tuple[np.ndarray, Diagram | None]], columns: int, **options) -> None:
    """Surfaces under their names, each above its diagram; all diagrams have the same limits."""
    rows = -(-len(shapes) // columns)
    heights = [SURFACE, DIAGRAM] * rows
    axes = figure.subplots(2 * rows, columns, squeeze=False, gridspec_kw={"height_ratios": heights})
    for each in axes.flat:
        each.set_axis_off()
    limits = shared_limits([seen for _, seen in shapes.values() if seen is not None])
    for k, (name, (field, seen)) in enumerate(shapes.items()):
        row, column = divmod(k, columns)
        above, below = axes[2 * row, column], axes[2 * row + 1, column]
        above.set_title(name, fontsize=11)
        surface_on(above, field, width=PIXELS, **options)
        if seen is None:
            below.text(0.5, 0.5, "no surface", ha="center", color=QUIET)
        else:
            below.set_axis_on()
            diagram_on(below, seen, limits=limits)
            below.set(xlabel="κ₁" if row == rows - 1 else "", ylabel="κ₂" if column == 0 else "")
            below.tick_params(labelleft=column == 0)
