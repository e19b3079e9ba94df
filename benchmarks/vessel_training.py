"""A small 3D U-Net and the four losses it is trained with on sparse labels."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from monai.inferers.utils import sliding_window_inference
from monai.losses.cldice import SoftclDiceLoss
from monai.networks.nets.dynunet import DynUNet
from skimage.morphology import dilation, skeletonize
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.vessel_data import PATCH, SPACING, UNKNOWN, Part, patch, sparse
from curvafit.core.files import write_atomically
from curvafit.priors.combined import CombinedLoss
from curvafit.priors.segmentation import CurvaturePrior

LOSSES = ("dice+ce", "cldice", "skeleton", "curvature")
FILTERS = (8, 16, 32, 48)
#: Patches of a batch: a batch of one takes PyTorch's slow convolutions on one thread.
BATCH = 2
#: Batches over whose median the curvature prior's weight is balanced.
BATCHES = 9


class Setting(NamedTuple):
    """A loss: its name; the weight of what it adds to Dice + CE (for the curvature prior, its share of the gradient);
    ε in µm and the fit of the curvature prior."""

    loss: str
    weight: float = 0.0
    epsilon: float = 0.0
    fit: str = ""


class Plan(NamedTuple):
    """Steps in all; those of Dice + CE alone, with which every loss begins; the first learning rate."""

    steps: int
    alone: int
    rate: float


def network() -> nn.Module:
    """A U-Net of four levels; slices are five times thicker than pixels, so the first stays in the plane.

    Batch normalisation: instance normalisation would forget how bright a patch is.
    """
    kernels, strides = [(1, 3, 3), 3, 3, 3], [1, (1, 2, 2), 2, 2]
    model = DynUNet(3, 1, 1, kernels, strides, strides[1:], filters=FILTERS, norm_name="batch")
    return model.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]


def dice_ce(logits: Tensor, target: Tensor) -> Tensor:
    """Soft Dice and cross-entropy of the labelled voxels."""
    known = target != UNKNOWN
    z, y = logits[known], target[known]
    p = z.sigmoid()
    dice = 1 - (2 * (p * y).sum() + 1) / (p.sum() + y.sum() + 1)
    return dice + functional.binary_cross_entropy_with_logits(z, y)


class ClDice(nn.Module):
    """Soft clDice (Shit et al. 2021) of the annotated slices."""

    def forward(self, logits: Tensor, target: Tensor, mask: None = None) -> Tensor:
        z, y = _slices(logits, target)
        return SoftclDiceLoss(iter_=5, sigmoid=True)(z, y)


class SkeletonRecall(nn.Module):
    """Soft recall of the labels' thickened skeletons (Kirchhoff et al. 2024) on the annotated slices."""

    def forward(self, logits: Tensor, target: Tensor, mask: None = None) -> Tensor:
        z, y = _slices(logits, target)
        tubes = [dilation(skeletonize(label), np.ones((3, 3))) & label for label in (y[:, 0] > 0).numpy()]
        tube = torch.from_numpy(np.stack(tubes)).to(z)
        return 1 - ((z[:, 0].sigmoid() * tube).sum() + 1) / (tube.sum() + 1)


def curvature(setting: Setting) -> CurvaturePrior:
    """F_ε of the whole patch, slices without labels included."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "ε = .* interpolating", UserWarning)
        return CurvaturePrior(setting.fit, sigmoid=True, spacing=SPACING, epsilon=setting.epsilon)


class Training:
    """A network in training on a part: `steps` taken with Dice + CE, then with what a setting adds."""

    def __init__(self, part: Part | None, plan: Plan, seed: int) -> None:
        torch.manual_seed(seed)
        if part is not None:
            self.image, self.target = part.image, sparse(part.label)
        self.plan, self.seed = plan, seed
        self.model = network()
        self.optimiser = torch.optim.AdamW(self.model.parameters(), plan.rate)
        self.step = 0

    def run(self, loss: Callable[[Tensor, Tensor], Tensor], until: int) -> None:
        """Go on to a step; the rate follows half a cosine to zero."""
        self.model.train()
        for step in range(self.step, until):
            self.optimiser.param_groups[0]["lr"] = self.plan.rate * (1 + math.cos(math.pi * step / self.plan.steps)) / 2
            self.optimiser.zero_grad()
            x, y = self.batch(step)
            loss(self.model(x), y).backward()
            nn.utils.clip_grad_norm_(self.model.parameters(), 5.0)
            self.optimiser.step()
        self.step = until

    def finish(self, setting: Setting) -> float:
        """The steps that remain, with the setting's loss, faded in over a tenth of all; the weight of what it adds."""
        if setting.loss == "dice+ce":
            self.run(dice_ce, self.plan.steps)
            return 0.0
        extra = {"cldice": ClDice, "skeleton": SkeletonRecall, "curvature": lambda: curvature(setting)}[setting.loss]()
        weight = setting.weight * (self.balance(extra) if isinstance(extra, CurvaturePrior) else 1)
        self.run(CombinedLoss(dice_ce, extra, weight, self.plan.steps // 10), self.plan.steps)
        return weight

    def balance(self, prior: CurvaturePrior) -> float:
        """The weight that gives the prior the gradient of Dice + CE, the median of some batches."""
        with torch.no_grad():
            batches = [self.batch(-1 - k) for k in range(BATCHES)]
            batches = [(self.model(x), y) for x, y in batches]
        return float(np.median([prior.suggest_weight(dice_ce, batch) for batch in batches]))

    def batch(self, step: int) -> tuple[Tensor, Tensor]:
        pairs = [patch(self.image, self.target, (self.seed, step % 2**32, k)) for k in range(BATCH)]
        x, y = (torch.cat(tensors) for tensors in zip(*pairs, strict=True))
        return x, y

    def save(self, path: Path) -> None:
        state = {"model": self.model.state_dict(), "optimiser": self.optimiser.state_dict(), "step": self.step}
        write_atomically(path, lambda temporary: torch.save(state, temporary))

    def load(self, path: Path) -> None:
        state = torch.load(path)
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = state["step"]


def predict(model: nn.Module, image: np.ndarray) -> np.ndarray:
    """Probabilities of a part, by overlapping windows of a patch's size."""
    model.eval()
    with torch.no_grad():
        x = torch.from_numpy(image)[None, None]
        logits = sliding_window_inference(x, PATCH, 4, model, overlap=(0.5, 0.25, 0.25), mode="gaussian")
    return logits.sigmoid()[0, 0].numpy()  # type: ignore[union-attr]


def _slices(logits: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """The annotated slices of patches, `(slices, 1, Y, X)`."""
    known = (target != UNKNOWN).flatten(3).all(3)[:, 0]
    return logits[:, 0][known][:, None], target[:, 0][known][:, None]
