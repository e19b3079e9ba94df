"""Seeded starts of the flow."""

from __future__ import annotations

import torch

from curvafit.core.checks import check_float, check_seed, check_type
from curvafit.generation.memory import FIELD, check_memory
from curvafit.priors.grid import Grid
from curvafit.priors.shapes import Float

#: Width of the published start's interval, 40 Δx at Δx = 0.01.
AMPLITUDE = 0.4


def white_noise(grid: Grid, seed: int, amplitude: float = AMPLITUDE) -> Float[torch.Tensor, "3 z y x"]:
    """Return A₀, independent and uniform on [0, amplitude) in every voxel and component; float32, on the processor.

    The same seed and shape make the same numbers, whatever was drawn before. In a box with walls the mean is
    subtracted: a constant A has no divergence in a periodic box, but has a flux through walls.

    Raises
    ------
    ValueError
        If the seed is not a whole number from 0, or the box does not fit into memory.
    """
    check_type(grid, Grid, "a Grid")
    amplitude = check_float(amplitude, "a finite amplitude")
    generator = torch.Generator().manual_seed(check_seed(seed))
    check_memory((*grid.shape, 3), FIELD, "a box")
    noise = amplitude * torch.rand((3, *grid.shape), generator=generator, dtype=torch.float32)
    return noise if grid.periodic else noise - amplitude / 2
