"""What the tests of the training loss share: a law, noise, probabilities, a fit file, a gradient."""

import json
from pathlib import Path

import torch
from torch import Tensor

from curvafit.priors import Coefficients, Grid, preset
from curvafit.priors.stencils import gaussian_blur

TUBES = preset("tubes").coefficients
LAW = Coefficients(1.3, -0.7, 4.0, -0.6, 0.35, 0.05)


def noise(*shape: int, seed: int = 0, dtype=torch.float64) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def probabilities(*shape: int, seed: int = 0) -> Tensor:
    """Smooth, with interfaces."""
    grid = Grid(shape[-3:], 1.0, "replicate")
    return torch.sigmoid(14 * gaussian_blur(noise(*shape, seed=seed), grid, 1.5))


def slope_of(loss, value: Tensor) -> Tensor:
    leaf = value.detach().clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(leaf).sum(), leaf)
    return slope


def fit_file(path: Path, unit: str, status: str = "") -> Path:
    fit = {"format": "curvafit-fit-5", "status": status, "mass": -0.3, "epsilon_physical": 4.0}
    fit |= {"working_voxel": 2.0, "length_unit": unit}
    fit["coefficients"] = TUBES.as_dict()
    fit["coefficients_physical"] = TUBES.in_unit(1 / 200).as_dict()
    path.write_text(json.dumps(fit))
    return path
