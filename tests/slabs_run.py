"""A process of a flow on slabs: `python tests/slabs_run.py FOLDER Z,Y,X BOUNDARY`, with torchrun's variables.

The first one grows a shape of some steps on slabs and alone, goes on alone from the checkpoint of slabs, and prints
what the two share.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch

from curvafit.generation import slabs
from curvafit.generation.flow import Execution, generate
from curvafit.generation.result import Flow, Watch
from curvafit.generation.schedule import schedule
from curvafit.priors.grid import Grid

STEPS = 24


def grow(grid: Grid, callbacks=(), **execution) -> Flow:
    """A shape whose mass is corrected on the way, with a map of ε."""
    ε = torch.linspace(0.018, 0.022, grid.shape[0])[:, None, None].expand(grid.shape)
    plan = schedule("fast", STEPS)
    options = {"watch": Watch((0, 1, 12), callbacks), "execution": Execution(**execution)}
    return generate("tubes", None, grid, volume_fraction=0.3, epsilon=ε, schedule=plan, seed=1, **options)


def stop_halfway(step: int, total: int, state: object) -> bool:
    return step >= 10


def main(folder: str, shape: str, boundary: str) -> None:
    z, y, x = map(int, shape.split(","))
    grid, place = Grid((z, y, x), boundary=boundary), Path(folder) / "run.pt"  # type: ignore[arg-type]
    with slabs.lead():
        apart = grow(grid, backend="slabs")
        grow(grid, backend="slabs", checkpoint=place, callbacks=[stop_halfway])
    alone = grow(grid)
    onward = grow(grid, checkpoint=place)
    figures = ("energy", "gradient_max", "gradient_mean", "mass")
    both = [[getattr(flow.history, name) for name in figures] for flow in (apart, alone)]
    print(json.dumps({
        "field": torch.equal(apart.field, alone.field),
        "snapshots": [torch.equal(apart.snapshots[k], alone.snapshots[k]) for k in alone.snapshots],
        "figures": float(np.abs(np.divide(*both) - 1).max()),
        "onward": torch.equal(onward.field, alone.field),
        "moved": float((alone.snapshots[12] - alone.snapshots[0]).abs().max()),
    }))  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:]) if slabs.count_processes()[0] == 0 else slabs.serve()
