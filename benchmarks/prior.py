"""The training loss: its time beside other losses, and a training step with it.

Forward and backward on logits (2, 1, edge, edge, edge), by turns, each call after one of its own as in training. Needs
monai.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import Cases, Figure, Values, bootstrap, in_turns, show
from curvafit.priors import CombinedLoss, CurvaturePrior, Grid
from curvafit.priors.stencils import gaussian_blur

Loss = Callable[[Tensor, Tensor], Tensor]


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


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
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
