"""Whether Adam's moments in 16 bits make another texture.

    python -m benchmarks.moments [--presets tubes,trabec,sponge,pearls] [--seeds 3] [--first 20] [--edge 64]
                                 [-o moments]

Both moments are rounded to bfloat16 or float16 after each step of torch's Adam, beside the same flow in float32.
Distances are those of `benchmarks.texture`: `noise` between two seeds of one type, `/noise` between the pooled diagrams
in 16 bits and in float32, over the noise in float32; three seeds of one flow and three others are some 0.6 apart.
Shapes are kept in the folder.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from unittest import mock

import torch

from benchmarks.texture import Shape, compare, noise_of
from curvafit.core.files import write_atomically
from curvafit.generation import setup
from curvafit.generation.flow import generate
from curvafit.generation.stepper import TorchStepper
from curvafit.geometry.diagram import Diagram, diagram
from curvafit.priors.grid import WORKING_EPSILON, Grid

TYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


def rounding(dtype: torch.dtype) -> type[TorchStepper]:
    """A stepper whose moments are rounded after each step; the gradient is the fused one."""

    class Rounding(TorchStepper):
        def __init__(self, *arguments, **options) -> None:
            super().__init__(*arguments, **options | {"fused": True})

        def step(self, rate: float | None) -> None:
            super().step(rate)
            for state in self._optimiser.state.values():
                for name in ("exp_avg", "exp_avg_sq"):
                    state[name].copy_(state[name].to(dtype))

    return Rounding


def shape_of(name: str, kind: str, seed: int, edge: int, folder: Path) -> Shape:
    """Generate and measure, or read what an earlier run kept."""
    path = folder / f"{name}-{kind}-{edge}-{seed}.pt"
    if not path.exists():
        grid = Grid((edge,) * 3)
        with mock.patch.object(setup, "TorchStepper", rounding(TYPES[kind])):
            flow = generate(name, grid=grid, schedule="deep", seed=seed, backend="torch")
        shape = diagram(flow.field, grid, WORKING_EPSILON)
        content = [flow.history.energy[-1], flow.viability.viable, shape.points, shape.weights]
        write_atomically(path, lambda temporary: torch.save(content, temporary))
    energy, viable, points, weights = torch.load(path, weights_only=False)
    return Shape(float(energy), 0.0, bool(viable), Diagram(points, weights), "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", default="tubes,trabec,sponge,pearls")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=20)
    parser.add_argument("--edge", type=int, default=64)
    parser.add_argument("-o", "--output", type=Path, default=Path("moments"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    seeds = range(options.first, options.first + options.seeds)
    print(f"{options.edge}³, seeds {[*seeds]}")
    print(f"{'preset':12}{'moments':>10}{'viable':>8}{'E':>10}{'noise':>8}{'/noise':>8}")
    for name in options.presets.split(","):
        shapes = {kind: [shape_of(name, kind, k, options.edge, options.output) for k in seeds] for kind in TYPES}
        for kind, mine in shapes.items():
            row = compare(shapes["float32"], mine)
            apart = "" if kind == "float32" else f"{row.bias / row.noise:8.2f}"
            viable = sum(shape.viable for shape in mine)
            print(f"{name:12}{kind:>10}{viable:8}{row.energies[1]:10.1f}{noise_of(mine):8.2f}{apart}", flush=True)


if __name__ == "__main__":
    main()
