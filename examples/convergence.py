"""A shape on its way: surfaces, diagrams, energy and gradient over 8000 steps (paper, Figs. 2 and 3).

python examples/convergence.py [--small] [--edge 100] [--schedule paper] [-o convergence]

Preset `flow`: a = (1, 2.4, 9, 30, 170, -195), m₀ = -0.66. A killed run goes on where it was.
"""

from __future__ import annotations

import numpy as np
import torch
from common import CELL, DIAGRAM, SURFACE, draw, parser, plan_of, program, write_table
from matplotlib.figure import Figure

from curvafit.drawing.plot import write_picture
from curvafit.generation.flow import Execution, Flow, generate
from curvafit.generation.result import State, viability
from curvafit.geometry.diagrams import Diagram, diagram
from curvafit.geometry.distances import wasserstein
from curvafit.geometry.mesh import NoSurface
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.law import preset

#: Numbers of steps in the table, and those that the paper shows.
MARKS = (10, 30, 100, 300, 1000, 2000, 4000, 8000)
SHOWN = (10, 300, 1000, 4000, 8000)


def main() -> None:
    options = parser(__doc__, "convergence", plan="paper").parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    grid, plan, shape = Grid((options.edge,) * 3), plan_of(options), preset("flow")
    marks = sorted({mark for mark in MARKS if mark < plan.steps} | {plan.steps})
    files = {mark: options.output / f"convergence-{mark}.npy" for mark in marks}

    def keep(step: int, total: int, state: State) -> None:
        if step in files:  # on disk, so that a run that goes on has the stages before
            np.save(files[step], state.field.numpy())

    flow = generate(
        shape.coefficients,
        shape.mass,
        grid,
        schedule=plan,
        seed=options.seed,
        callbacks=[keep],
        execution=Execution(device=options.device, checkpoint=options.output / "convergence.checkpoint"),
    )
    stages = {step: np.load(file) for step, file in files.items() if step in flow.history.step}
    diagrams = {step: diagram_of(u, grid, options.curvature) for step, u in stages.items()}
    write_table(options, "convergence", [*table(flow, stages, diagrams), flow.status], [program()])
    shown = {step: (stages[step], diagrams[step]) for step in stages if step in (*SHOWN, plan.steps)}
    print(write_picture(picture(flow, shown), options.output / "convergence.png"))


def diagram_of(u: np.ndarray, grid: Grid, kind) -> Diagram | None:
    """The diagram, if there is a surface: early fields are noise."""
    try:
        return diagram(u, grid, WORKING_EPSILON, curvature=kind)
    except NoSurface:
        return None


def table(flow: Flow, stages: dict[int, np.ndarray], diagrams: dict[int, Diagram | None]) -> list[str]:
    """A line a mark; the distance is the one to the last diagram."""
    history, last = flow.history, diagrams[max(diagrams)]
    lines = [
        f"{'step':>5} {'energy':>12} {'max |∂G|':>10} {'mean |∂G|':>10} {'discrep.':>9} {'u > 0':>7} {'distance':>9}"
    ]
    for step, u in stages.items():
        at = int(np.flatnonzero(history.step == step)[0])
        seen = diagrams[step]
        away = wasserstein(seen, last) if seen and last else float("nan")
        ratio = viability(torch.from_numpy(u), flow.grid, WORKING_EPSILON).discrepancy
        line = (
            f"{step:5d} {history.energy[at]:12.4f} {history.gradient_max[at]:10.3e} {history.gradient_mean[at]:10.3e}"
        )
        lines.append(f"{line} {ratio:9.3f} {(u > 0).mean():7.4f} {away:9.3f}")
    return lines


def picture(flow: Flow, shown: dict[int, tuple[np.ndarray, Diagram | None]]) -> Figure:
    """Surfaces and diagrams at some steps, above the curves."""
    figure = Figure(figsize=(CELL * len(shown), SURFACE + DIAGRAM + 3), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[SURFACE + DIAGRAM, 3], squeeze=False).flat
    draw(above, {f"{step} steps": stage for step, stage in shown.items()}, len(shown))
    history, axes = flow.history, below.subplots(1, 3)
    curves = {"energy": history.energy, "max |∂G|": history.gradient_max, "mean |∂G|": history.gradient_mean}
    for each, (name, values) in zip(axes, curves.items(), strict=True):
        each.plot(history.step[1:], values[1:], color="#2B6FA8", linewidth=1)
        each.set_yscale("log" if (values[1:] > 0).all() else "symlog")
        each.set(title=name, xlabel="steps")
    return figure


if __name__ == "__main__":
    main()
