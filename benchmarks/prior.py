"""What the curvature prior costs beside other losses, and what a training step costs with it.

python -m benchmarks.prior [--edge 96] [--device cpu]

Forward and backward of each loss on logits (2, 1, edge, edge, edge), interleaved in one run, least and median of the
rounds; then a step of a small 3D U-Net with Dice + cross-entropy, without and with the prior; then the most memory that
the prior takes at a time, in float32 fields of the input's size. Needs monai (`pip install monai`).
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable

import torch
from torch import Tensor

from curvafit.priors import CombinedLoss, CurvaturePrior
from curvafit.priors.grid import Grid
from curvafit.priors.stencils import gaussian_blur

#: Rounds of all losses, and of training steps.
ROUNDS, STEPS = 5, 4


def batch(edge: int, device: str) -> tuple[Tensor, Tensor]:
    """Logits of a noisy segmentation, and labels: both with tubes in them."""
    grid = Grid((edge,) * 3, 1.0)
    made = torch.Generator().manual_seed(0)
    shapes = gaussian_blur(torch.randn((2, 1, *grid.shape), generator=made), grid, 4.0)
    target = (shapes > shapes.std()).float()
    logits = 8 * shapes / shapes.std() - 8 + torch.randn(shapes.shape, generator=made)
    return logits.to(device), target.to(device)


def losses() -> dict[str, Callable[[Tensor, Tensor], Tensor]]:
    from monai.losses import DiceCELoss, DiceLoss, SoftclDiceLoss

    ours = CurvaturePrior("tubes", sigmoid=True)
    return {
        "CurvaturePrior": ours,
        "CurvaturePrior, per area": CurvaturePrior("tubes", sigmoid=True, normalize="area"),
        "DiceLoss": DiceLoss(sigmoid=True),
        "DiceCELoss": DiceCELoss(sigmoid=True),
        "SoftclDiceLoss, 3": lambda x, y: SoftclDiceLoss(iter_=3)(y, x.sigmoid()),
        "SoftclDiceLoss, 10": lambda x, y: SoftclDiceLoss(iter_=10)(y, x.sigmoid()),
    }


def seconds(action: Callable[[], object], device: str) -> float:
    if device != "cpu":
        torch.cuda.synchronize()
    begun = time.perf_counter()
    action()
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter() - begun


def both_ways(loss: Callable[[Tensor, Tensor], Tensor], logits: Tensor, target: Tensor) -> None:
    leaf = logits.detach().requires_grad_()
    loss(leaf, target).backward()


def loss_table(edge: int, device: str) -> None:
    logits, target = batch(edge, device)
    named = losses()
    times: dict[str, list[float]] = {name: [] for name in named}
    for turn in range(ROUNDS + 1):
        for name, loss in named.items():
            took = seconds(lambda loss=loss: both_ways(loss, logits, target), device)
            if turn:  # the first warms up
                times[name].append(took)
    ours = min(times["CurvaturePrior"])
    print(f"forward and backward on {tuple(logits.shape)}, {device}, {torch.get_num_threads()} threads")
    print(f"{'loss':26} {'least ms':>9} {'median ms':>10} {'times the prior':>16}")
    for name, took in times.items():
        least, median = min(took), sorted(took)[len(took) // 2]
        print(f"{name:26} {1e3 * least:9.1f} {1e3 * median:10.1f} {least / ours:16.1f}")


def step_table(edge: int, device: str) -> None:
    from monai.losses import DiceCELoss
    from monai.networks.nets import UNet

    torch.manual_seed(0)
    logits, target = batch(edge, device)
    net = UNet(spatial_dims=3, in_channels=1, out_channels=1, channels=(16, 32, 64, 128), strides=(2, 2, 2)).to(device)
    adam = torch.optim.Adam(net.parameters())
    base = DiceCELoss(sigmoid=True)
    both = CombinedLoss(base, CurvaturePrior("tubes", sigmoid=True), 1e-3)

    def step(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
        adam.zero_grad()
        loss(net(logits), target).backward()
        adam.step()

    times: dict[str, list[float]] = {"without": [], "with": []}
    for turn in range(STEPS + 1):
        for name, loss in (("without", base), ("with", both)):
            took = seconds(lambda loss=loss: step(loss), device)
            if turn:
                times[name].append(took)
    without, with_ = min(times["without"]), min(times["with"])
    size = sum(p.numel() for p in net.parameters())
    print(f"a training step of a U-Net ({size / 1e6:.1f} million parameters), Dice + cross-entropy, Adam, same batch")
    print(f"without the prior {1e3 * without:.0f} ms, with it {1e3 * with_:.0f} ms: {with_ / without - 1:+.1%}")


MEMORY = """
import resource, sys, torch
from benchmarks.prior import batch, both_ways
from curvafit.priors import CurvaturePrior
edge, device = int(sys.argv[1]), sys.argv[2]
prior = CurvaturePrior("tubes", sigmoid=True, normalize=sys.argv[3])
both_ways(prior, *batch(16, device))
logits, target = batch(edge, device)
def most():
    if device != "cpu":
        return torch.cuda.max_memory_allocated()
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1]) * 1024
if device == "cpu":
    open("/proc/self/clear_refs", "w").write("5")
else:
    torch.cuda.reset_peak_memory_stats()
now = most()
both_ways(prior, logits, target)
print((most() - now) / (4 * logits.numel()))
"""


def memory(edge: int, device: str) -> None:
    """In a process of its own, so that nothing freed before hides what is taken."""
    for normalize in ("voxel", "area"):
        command = [sys.executable, "-c", MEMORY, str(edge), device, normalize]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        print(f'peak memory beyond logits and target, normalize "{normalize}": {float(done.stdout):.1f} float32 fields')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edge", type=int, default=96)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    options = parser.parse_args()
    loss_table(options.edge, options.device)
    step_table(options.edge, options.device)
    memory(options.edge, options.device)


if __name__ == "__main__":
    main()
