"""Train a MONAI network with the curvature prior beside Dice + cross-entropy, and one without, on shapes grown here.

The images are shapes of one law, blurred, with noise and little contrast; few slices are annotated. Both networks see
the same patches in the same order; the prior also sees the slices between. Needs MONAI (`pip install monai`).
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

from curvafit.generation.flow import generate
from curvafit.generation.schedule import schedule
from curvafit.priors import WORKING_SPACING, CombinedLoss, CurvaturePrior, Grid
from curvafit.priors.law import Law
from curvafit.priors.stencils import gaussian_blur

EXAMPLES = """examples:
  python examples/monai_training.py --small
  python examples/monai_training.py --prior tubes --every 4
  python examples/monai_training.py --prior bone/fit.json --steps 1000 --share 0.2 -o bone_training
"""
#: The label of slices that are not annotated.
IGNORED = 2


class Annotated(nn.Module):
    """A loss of the slices that are annotated."""

    def __init__(self, loss: nn.Module) -> None:
        super().__init__()
        self.loss = loss

    def forward(self, logits: Tensor, target: Tensor) -> Tensor:
        slices = (target != IGNORED).flatten(-2).all(-1)[:, 0]
        pairs = [(x[:, known], y[:, known]) for x, y, known in zip(logits, target, slices, strict=True) if known.any()]
        return torch.stack([self.loss(x[None], y[None]) for x, y in pairs]).mean()


def scan(law: str, edge: int, seed: int, steps: int | None, every: int) -> dict[str, Tensor]:
    """Return an image and its labels, of all slices and of one in `every`, `(1, Z, Y, X)` each."""
    texture = Law.of(law)
    grid, plan = Grid((edge, edge, edge)), schedule("cosine", steps)
    field = generate(texture.coefficients, texture.mass, grid, seed=seed, schedule=plan).field
    truth = (field > 0).float()
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(seed))
    image = gaussian_blur(truth, Grid(tuple(truth.shape), 1.0), 1.0) + 0.5 * noise
    label = torch.full_like(truth, IGNORED)
    label[every // 2 :: every] = truth[every // 2 :: every]
    return {"image": image[None], "label": label[None], "truth": truth[None]}


def train(loss: CombinedLoss, share: float, scans: list[dict[str, Tensor]], steps: int, patch: int) -> nn.Module:
    """Train half of the steps without the prior, then with its share of the gradient of Dice + CE."""
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
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--prior", default="trabec", help="law of the shapes and of the prior: a preset's name or a fit.json (trabec)")
    add("--every", type=int, default=8, help="one slice in so many is annotated (8)")
    add("--steps", type=int, default=200, help="steps of the training, half of them without the prior (200)")
    add("--share", type=float, default=0.1, help="the prior's share of the gradient of Dice + CE (0.1)")
    add("--edge", type=int, default=80, help="voxels along an edge of the shapes (80)")
    add("--patch", type=int, default=48, help="voxels along an edge of the patches (48)")
    add("--grow", type=int, help="steps that a shape grows for (as many as the fast schedule has)")
    add("--small", action="store_true", help="a smoke test: --edge 32 --patch 16 --grow 60 --steps 2")
    add("-o", "--output", type=Path, default=Path("monai_training"), help="folder for the picture (monai_training)")
    options = parser.parse_args()
    if options.small:
        options.edge, options.patch, options.grow, options.steps = 32, 16, 60, 2
    edge, steps, patch = options.edge, options.steps, options.patch
    *scans, test = [scan(options.prior, edge, seed, options.grow, options.every) for seed in range(3)]
    base = Annotated(DiceCELoss(sigmoid=True))
    in_voxels = Law.of(options.prior).coefficients.in_unit(WORKING_SPACING)
    prior = CurvaturePrior(in_voxels, sigmoid=True)
    panels = {"image": test["image"], "truth": test["truth"]}
    for name, share in (("Dice + CE", 0.0), ("with the prior", options.share)):
        net = train(CombinedLoss(base, prior, 0.0), share, scans, steps, patch)
        with torch.no_grad():
            logits = sliding_window_inference(test["image"][None], (patch,) * 3, 1, net, overlap=0.25)
        mask = (logits > 0).float()  # type: ignore[operator]
        dice = float(DiceMetric()(mask, test["truth"][None]))  # type: ignore[arg-type]
        print(f"{name}: Dice {dice:.3f}")
        panels[f"{name}: Dice {dice:.3f}"] = mask[0]
    options.output.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(1, len(panels), figsize=(3 * len(panels), 3.3), layout="constrained")
    for each, (title, volume) in zip(axes, panels.items(), strict=True):
        each.imshow(volume[0, edge // 2], cmap="gray")
        each.set(title=title, xticks=[], yticks=[])
    figure.savefig(options.output / "monai_training.png", dpi=120)
    print(options.output / "monai_training.png")


if __name__ == "__main__":
    main()
