"""Small U-Nets that a few annotated slices teach, and images to teach them on: what `transductive` and `sets` share."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional

#: A voxel without a label, and voxels along an edge of a patch.
UNKNOWN, PATCH = 2, 48
#: Noise of an image in contrasts, and its blur in voxels.
NOISE, BLUR = 2.0, 0.7
Loss = Callable[[Tensor, Tensor], Tensor]


def image_of(truth: np.ndarray, seed: int) -> np.ndarray:
    """Return a noisy image of a mask, standardised."""
    clear = ndimage.gaussian_filter(truth.astype(np.float32), BLUR, mode="nearest")
    values = clear + NOISE * np.random.default_rng(seed).standard_normal(truth.shape, dtype=np.float32)
    return (values - values.mean()) / values.std()


def annotated(truth: np.ndarray, slices: Sequence[int]) -> np.ndarray:
    """Return the labels of some slices, `UNKNOWN` elsewhere."""
    target = np.full(truth.shape, UNKNOWN, np.float32)
    target[list(slices)] = truth[list(slices)]
    return target


def network(seed: int) -> nn.Module:
    from monai.networks.nets.dynunet import DynUNet

    torch.manual_seed(seed)
    net = DynUNet(3, 1, 1, [3, 3, 3], [1, 2, 2], [2, 2], filters=(8, 16, 32), norm_name="batch")
    return net.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]


def predict(net: nn.Module, x: Tensor) -> Tensor:
    """Return logits in single precision, of convolutions in half: on processors that have them they take a seventh."""
    with torch.autocast("cpu", torch.bfloat16):
        return net(x).float()


def predict_whole(net: nn.Module, image: np.ndarray) -> Tensor:
    """Return the logits of a whole image."""
    net.eval()
    with torch.no_grad():
        return predict(net, torch.from_numpy(image)[None, None])[0, 0]


def dice_ce(logits: Tensor, target: Tensor) -> Tensor:
    """Return soft Dice and cross-entropy of the labelled voxels."""
    known = target != UNKNOWN
    z, y = logits[known], target[known]
    p = z.sigmoid()
    overlap = (2 * (p * y).sum() + 1) / (p.sum() + y.sum() + 1)
    return 1 - overlap + functional.binary_cross_entropy_with_logits(z, y)


def lessons(pairs: Sequence[tuple[np.ndarray, np.ndarray]], seed: int) -> Callable[[int], tuple[Tensor, Tensor]]:
    """Return patches of images and targets by step, turned, mirrored and with their grey values changed."""

    def batch(step: int) -> tuple[Tensor, Tensor]:
        random = np.random.default_rng([seed, step % 2**32])
        while True:
            image, target = pairs[int(random.integers(len(pairs)))]
            corner = [int(random.integers(n - PATCH + 1)) for n in image.shape]
            box = tuple(slice(a, a + PATCH) for a in corner)
            if (target[box] != UNKNOWN).any():
                break
        axes = tuple(axis for axis in range(3) if random.random() < 0.5)
        x, y = (np.flip(each[box], axes).astype(np.float32) for each in (image, target))
        x = random.uniform(0.9, 1.1) * x + random.uniform(-0.1, 0.1)
        return torch.from_numpy(x.astype(np.float32))[None, None], torch.from_numpy(y.copy())[None, None]

    return batch


def learn(
    net: nn.Module,
    batch: Callable[[int], tuple[Tensor, Tensor]],
    steps: int,
    rate: float,
    loss_at: Callable[[int], Loss] = lambda step: dice_ce,
) -> None:
    """Teach a network by the loss of logits and target at each step; the rate falls to 0."""
    adam = torch.optim.AdamW(net.parameters(), rate)
    net.train()
    for step in range(steps):
        loss = loss_at(step)
        adam.param_groups[0]["lr"] = rate * (1 + np.cos(np.pi * step / steps)) / 2
        x, y = batch(step)
        adam.zero_grad()
        loss(predict(net, x), y).backward()
        nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        adam.step()
