"""A MONAI training with the curvature prior beside Dice + cross-entropy, on shapes generated here.

python examples/monai_training.py [--small] [--steps 200] [--weight 0.003] [-o monai_training]

The images are trabecular shapes, blurred, with noise and few contrast; only every eighth slice is annotated. Both
networks see the same patches in the same order; the prior also sees the slices between. Needs monai
(`pip install monai`).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from monai.data import DataLoader, Dataset
from monai.inferers import sliding_window_inference
from monai.losses import DiceCELoss
from monai.metrics import DiceMetric
from monai.networks.nets import UNet
from monai.transforms import Compose, RandFlipd, RandGaussianNoised, RandSpatialCropd
from monai.utils import set_determinism
from torch import Tensor, nn

from curvafit import generate
from curvafit.priors import CombinedLoss, CurvaturePrior, Grid
from curvafit.priors.stencils import gaussian_blur

#: Every how many slices one is annotated, and the label of the others.
EVERY, IGNORED = 8, 2
PRESET = "trabec"


class Annotated(nn.Module):
    """A loss of what is annotated."""

    def __init__(self, loss: nn.Module) -> None:
        super().__init__()
        self.loss = loss

    def forward(self, logits: Tensor, target: Tensor) -> Tensor:
        slices = (target != IGNORED).flatten(-2).all(-1)[:, 0]
        chosen = [(x[:, known], y[:, known]) for x, y, known in zip(logits, target, slices, strict=True) if known.any()]
        return torch.stack([self.loss(x[None], y[None]) for x, y in chosen]).mean()


def scan(edge: int, seed: int, steps: int | None) -> dict[str, Tensor]:
    """An image and its labels, all and annotated, `(1, Z, Y, X)` each."""
    from curvafit.generation.schedule import schedule

    field = generate(PRESET, grid=edge, seed=seed, schedule=schedule("fast", steps)).field
    truth = (field > 0).float()
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(seed))
    image = gaussian_blur(truth, Grid(tuple(truth.shape), 1.0), 1.0) + 0.5 * noise
    label = torch.full_like(truth, IGNORED)
    label[EVERY // 2 :: EVERY] = truth[EVERY // 2 :: EVERY]
    return {"image": image[None], "label": label[None], "truth": truth[None]}


def train(loss: CombinedLoss, share: float, scans: list[dict[str, Tensor]], steps: int, patch: int) -> nn.Module:
    """Half of the steps without the prior, then with its share of the gradient of Dice + CE."""
    set_determinism(0)
    keys = ["image", "label"]
    augment = Compose(
        [
            RandSpatialCropd(keys, (patch,) * 3, random_size=False),
            *(RandFlipd(keys, prob=0.5, spatial_axis=axis) for axis in range(3)),
            RandGaussianNoised("image", prob=0.5, std=0.1),
        ]
    )
    loader = DataLoader(Dataset([scans[k % len(scans)] for k in range(2 * steps)], augment), batch_size=2)
    net = UNet(spatial_dims=3, in_channels=1, out_channels=1, channels=(8, 16, 32), strides=(2, 2), num_res_units=1)
    adam = torch.optim.Adam(net.parameters(), 3e-3)
    for step, data in enumerate(loader):
        adam.zero_grad()
        logits = net(data["image"])
        if share and step == steps // 2:
            loss.weight = loss.prior.suggest_weight(loss.base, (logits, data["label"]), share)
            print(f"the prior's weight, for {share:g} of the gradient: {loss.weight:.2g}")
        loss(logits, data["label"]).backward()
        adam.step()
    return net.eval()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help="a few steps on tiny shapes: a smoke test")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--share", type=float, default=0.1, help="of the gradient of Dice + CE")
    parser.add_argument("-o", "--output", type=Path, default=Path("monai_training"))
    options = parser.parse_args()
    edge, steps, patch, flow = (32, 2, 16, 60) if options.small else (80, options.steps, 48, None)
    *scans, test = [scan(edge, seed, flow) for seed in range(3)]
    base = Annotated(DiceCELoss(sigmoid=True))
    prior = CurvaturePrior(PRESET, sigmoid=True)
    panels = {"image": test["image"], "truth": test["truth"]}
    for name, share in (("Dice + CE", 0.0), ("with the prior", options.share)):
        net = train(CombinedLoss(base, prior, 0.0), share, scans, steps, patch)
        with torch.no_grad():
            logits = sliding_window_inference(test["image"][None], (patch,) * 3, 1, net, overlap=0.25)
        found = (logits > 0).float()  # type: ignore[operator]
        dice = float(DiceMetric()(found, test["truth"][None]))  # type: ignore[arg-type]
        print(f"{name}: Dice {dice:.3f}")
        panels[f"{name}: Dice {dice:.3f}"] = found[0]
    options.output.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(1, len(panels), figsize=(3 * len(panels), 3.3), layout="constrained")
    for each, (title, volume) in zip(axes, panels.items(), strict=True):
        each.imshow(volume[0, edge // 2], cmap="gray")
        each.set(title=title, xticks=[], yticks=[])
    figure.savefig(options.output / "monai_training.png", dpi=120)
    print(options.output / "monai_training.png")


if __name__ == "__main__":
    main()
