"""The training loss: its time beside other losses, and a training step with it.

Forward and backward on logits (2, 1, edge, edge, edge), by turns, each call after one of its own as in training. Needs
monai. `--accuracy` times nothing: exact balls and cylinders at the loss's own ε of two voxels, the error of F_ε over σ
times the sharp energy, in per cent of the sum of that energy's six terms, each taken as positive (the terms of a law
cancel where it is at home). `thick`: the greatest change of the value of exact tori, by radius, tilt and law, where
slices are so many edges thick.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import Cases, Figure, Values, bootstrap, in_turns, show
from curvafit.priors import SIGMA, Coefficients, CombinedLoss, CurvaturePrior, Grid, Law, optimal_profile
from curvafit.priors.stencils import gaussian_blur

Loss = Callable[[Tensor, Tensor], Tensor]
#: ε and radii in voxels, laws, and the thickness of slices in edges.
EPSILON, RADII, THICK = 2.0, (4.0, 6.0, 10.0, 16.0, 24.0), (2, 3, 4, 6)
LAWS = ("willmore", "tubes", "sponge", "trabec", "pearls")


def batch(edge: int, device: str = "cpu") -> tuple[Tensor, Tensor]:
    """Return logits of a noisy segmentation, and labels: both with tubes in them."""
    grid, random = Grid((edge,) * 3, 1.0), torch.Generator().manual_seed(0)
    shapes = gaussian_blur(torch.randn((2, 1, *grid.shape), generator=random), grid, 4.0)
    target = (shapes > shapes.std()).float()
    logits = 8 * shapes / shapes.std() - 8 + torch.randn(shapes.shape, generator=random)
    return logits.to(device), target.to(device)


def losses() -> dict[str, Loss]:
    from monai.losses import DiceCELoss, SoftclDiceLoss

    return {
        "CurvaturePrior": CurvaturePrior("tubes", sigmoid=True),
        "DiceCELoss": DiceCELoss(sigmoid=True),
        "SoftclDiceLoss, 3": lambda x, y: SoftclDiceLoss(iter_=3)(y, x.sigmoid()),
    }


def both_ways(loss: Loss, logits: Tensor, target: Tensor) -> None:
    leaf = logits.detach().requires_grad_()
    loss(leaf, target).backward()


def loss_times(edge: int, rounds: int) -> Values:
    """Return the seconds of each loss in each round."""
    logits, target = batch(edge)
    actions = {name: lambda loss=loss: both_ways(loss, logits, target) for name, loss in losses().items()}
    return {name: taken.tolist() for name, taken in in_turns(actions, rounds, before=1).items()}


def training_times(edge: int, rounds: int) -> Values:
    """Return the seconds of a step of a small U-Net by Dice + cross-entropy, without the prior and with it."""
    from monai.losses import DiceCELoss
    from monai.networks.nets import UNet

    torch.manual_seed(0)
    logits, target = batch(edge)
    net = UNet(spatial_dims=3, in_channels=1, out_channels=1, channels=(16, 32, 64, 128), strides=(2, 2, 2))
    adam, base = torch.optim.Adam(net.parameters()), DiceCELoss(sigmoid=True)

    def step(loss: Loss) -> None:
        adam.zero_grad()
        loss(net(logits), target).backward()
        adam.step()

    both = CombinedLoss(base, CurvaturePrior("tubes", sigmoid=True), 1e-3)
    actions = {"without": lambda: step(base), "with": lambda: step(both)}
    return {name: taken.tolist() for name, taken in in_turns(actions, rounds).items()}


def law_of(name: str) -> Coefficients:
    """Return a preset, or the Willmore energy, with lengths in voxels."""
    return Coefficients.willmore() if name == "willmore" else Law.of(name).in_unit(None, 1.0)


def sharp_terms(law: Coefficients, form: str, radius: float, length: float) -> np.ndarray:
    """Return the six terms of ∫ p dA of a ball or a cylinder of some length."""
    κ = (1 / radius, 1 / radius if form == "ball" else 0.0)
    area = 4 * np.pi * radius**2 if form == "ball" else 2 * np.pi * radius * length
    return area * np.array([*law]) * [κ[0] ** 2, κ[0] * κ[1], κ[1] ** 2, κ[0], κ[1], 1]


def errors(form: str, radius: float) -> Values:
    """Return the error of the loss by law, in per cent."""
    edge = int(2 * radius + 24)
    axis = torch.arange(edge, dtype=torch.float64) - (edge - 1) / 2
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    distance = radius - ((0 if form == "cylinder" else z**2) + y**2 + x**2).sqrt()
    u, found = optimal_profile(distance, EPSILON), {}
    for name in LAWS:
        law = law_of(name)
        prior = CurvaturePrior(law, epsilon=EPSILON, reduction="sum", border=0)
        terms = SIGMA * sharp_terms(law, form, radius, edge)
        found[name] = float(100 * (float(prior((u + 1)[None, None] / 2)) - terms.sum()) / np.abs(terms).sum())
    return found


def thick(edges: int) -> Values:
    """Return by how much slices so many edges thick change the value of tori, by law, radius and tilt."""
    found = {}
    for name, (wide, radius), tilt in product(LAWS, ((16, 7), (11, 5), (15, 5.5)), (0.25, 0.7, 1.05, 1.4)):
        law = law_of(name)
        values = []
        for step in (1, edges):
            axes = [(torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * h for n, h in ((60 // step, step), (56, 1))]
            z, y, x = torch.meshgrid(axes[0], axes[1], axes[1], indexing="ij")
            z, x = np.cos(tilt) * z + np.sin(tilt) * x, np.cos(tilt) * x - np.sin(tilt) * z
            u = optimal_profile(radius - (((x**2 + y**2).sqrt() - wide) ** 2 + z**2).sqrt(), EPSILON)
            prior = CurvaturePrior(law, spacing=(step, 1.0, 1.0), epsilon=EPSILON, reduction="sum")
            values.append(float(prior((u + 1)[None, None] / 2)))
        found[f"{name} {radius} {tilt:.1f}"] = 100 * (values[1] / values[0] - 1)
    return found


def accuracy(cases: Cases) -> dict[str, Figure]:
    """Return errors by shape and law, and the worst change by thick slices."""
    pairs = [("ball", 6.0)] if cases.quick else list(product(("ball", "cylinder"), RADII))
    found = cases.all({f"{form}-{radius:g}": partial(errors, form, radius) for form, radius in pairs})
    figures = {f"accuracy.{case.replace('-', '_')}.{law}": Figure(value)
               for case, values in found.items() for law, value in values.items()}  # fmt: skip
    thicker = cases.all({f"thick-{edges}": partial(thick, edges) for edges in (() if cases.quick else THICK)})
    worst = {edges: max(thicker[f"thick-{edges}"].values(), key=abs) for edges in THICK if f"thick-{edges}" in thicker}
    figures |= {f"thick.{edges}": Figure(value) for edges, value in worst.items()}
    show(["figure", "%"], list(figures.items()))
    return figures


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--accuracy", action="store_true", help="errors on exact shapes, no times")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    if options.accuracy:
        warnings.simplefilter("ignore")
        return accuracy(cases)
    edge, rounds = (24, 1) if options.quick else (96, 15)
    jobs = {f"losses-{edge}-{rounds}": lambda: loss_times(edge, rounds)}
    jobs |= {f"training-{edge}-{rounds}": lambda: training_times(edge, rounds)}
    times, training = cases.all(jobs).values()
    ours = np.array(times["CurvaturePrior"])
    ratios = {name: bootstrap(np.array(taken) / ours) for name, taken in times.items()}
    more = bootstrap(100 * (np.array(training["with"]) / np.array(training["without"]) - 1))
    rows = [[f"{name}, over the prior's", ratio] for name, ratio in ratios.items()]
    rows += [["a U-Net's step with the prior, % more", more]]
    show(["what", "figure"], rows, f"forward and backward, (2, 1, {edge}³), {torch.get_num_threads()} threads")
    return {
        "prior.cldice_3": ratios["SoftclDiceLoss, 3"],
        "prior.dice_ce": ratios["DiceCELoss"],
        "prior.training": more,
    }
