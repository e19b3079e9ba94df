"""Networks on real capillaries, three annotated slices: Dice + CE alone, and with F_ε.

Needs $CURVAFIT_DATA (two two-photon stacks of one field of view, Poon et al. 2015, in vesselNN) and monai. A small 3D
U-Net is fitted on x < 240 of one stack, with labels on three slices of y < 368; y ≥ 384, fully labelled, chooses the
weight of what a loss adds; the test is x > 272 of the other stack; then the two swap. All losses share network,
patches, steps, rate and their first third, which is Dice + CE alone. F_ε takes its law from `infer` on what the network
of Dice + CE predicts on its own fitting part: no label beyond the three slices enters there.

Differences to Dice + CE with 95 % intervals: bootstrap over places (blocks of the plane, the same in both stacks) and
seeds. The Betti-0 error is the mean over blocks of the difference in components; `specks` counts the smallest too.
"""

from __future__ import annotations

import argparse
import math
import os
import warnings
from functools import cache, partial
from itertools import product
from pathlib import Path

import numpy as np
import torch
from skimage.measure import label
from skimage.morphology import skeletonize
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.harness import Cases, Figure, Values, show
from curvafit.inference.infer import infer
from curvafit.priors import CombinedLoss, CurvaturePrior
from curvafit.volumes.field import Field

STACKS, SPACING = ("noLeakage", "Leakage"), (5.0, 0.994, 0.994)
PARTS = {"fit": np.s_[:, :368, :240], "validation": np.s_[:, 384:, :240], "test": np.s_[:, :, 272:]}
SLICES, UNKNOWN, PATCH, BATCH, RATE, STEPS = 3, 2, (12, 80, 80), 2, 8e-3, 400
#: Weights that are tried: shares of the gradient; ε in µm. The seed that chooses.
WEIGHTS = {"dice+ce": (0.0,), "curvature": (0.1, 0.3, 1.0)}
EPSILON, TUNING = 2.0, 100
#: Pixels (y, x) of a block, which runs through all slices; a component of fewer voxels than a speck is one.
BLOCK, SPECK = (64, 60), 10
SCORES = ("Dice", "clDice", "Betti-0", "with specks")


# ---- data ------------------------------------------------------------------------------------------------------------


@cache
def part(stack: str, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a part's image, standardised logarithms, and its label."""
    import tifffile

    folder = Path(os.environ["CURVAFIT_DATA"]) / "scans" / "vesselNN"
    image, label = (
        tifffile.imread(folder / f"poon2015_BBB_{stack}_{kind}.tif")[PARTS[name]] for kind in ("img", "label")
    )
    values = np.log1p(image.astype(np.float32))
    return (values - values.mean()) / values.std(), label > 0


def sparse(label: np.ndarray) -> np.ndarray:
    """Return labels on the middle slices of three equal parts of the depth, `UNKNOWN` elsewhere."""
    target = np.full(label.shape, UNKNOWN, np.uint8)
    chosen = [(2 * k + 1) * len(label) // (2 * SLICES) for k in range(SLICES)]
    target[chosen] = label[chosen]
    return target


def patch(image: np.ndarray, target: np.ndarray, seed: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Return a random patch, turned, mirrored and with its grey values changed."""
    random = np.random.default_rng(seed)
    corner = [random.integers(n - edge + 1) for n, edge in zip(image.shape, PATCH, strict=True)]
    window = tuple(slice(start, start + edge) for start, edge in zip(corner, PATCH, strict=True))
    turns, mirrors = int(random.integers(4)), tuple(axis for axis, value in enumerate(random.random(3)) if value < 0.5)
    x, y = (np.flip(np.rot90(values[window], turns, (1, 2)), mirrors).astype(np.float32) for values in (image, target))
    x = random.uniform(0.9, 1.1) * x + random.uniform(-0.1, 0.1) + random.normal(0, random.uniform(0, 0.1), x.shape)
    return torch.from_numpy(x.astype(np.float32))[None], torch.from_numpy(y.copy())[None]


# ---- training --------------------------------------------------------------------------------------------------------


def dice_ce(logits: Tensor, target: Tensor) -> Tensor:
    """Soft Dice and cross-entropy of the labelled voxels."""
    known = target != UNKNOWN
    z, y = logits[known], target[known]
    p = z.sigmoid()
    overlap = (2 * (p * y).sum() + 1) / (p.sum() + y.sum() + 1)
    return 1 - overlap + functional.binary_cross_entropy_with_logits(z, y)


def trained(loss: str, weight: float, seed: int, stack: str, steps: int, law: str) -> nn.Module:
    """Return a network that was trained on a stack's three slices."""
    from monai.networks.nets.dynunet import DynUNet

    torch.manual_seed(seed)
    image, truth = part(stack, "fit")
    target, strides = sparse(truth), [1, (1, 2, 2), 2, 2]
    # Slices are five times thicker than pixels, so the first level stays in the plane. Instance normalisation would
    # forget how bright a patch is.
    net = DynUNet(3, 1, 1, [(1, 3, 3), 3, 3, 3], strides, strides[1:], filters=(8, 16, 32, 48), norm_name="batch")
    adam = torch.optim.AdamW(net.parameters(), RATE)

    def batch(step: int) -> tuple[Tensor, Tensor]:
        pairs = [patch(image, target, (seed, step % 2**32, k)) for k in range(BATCH)]
        x, y = (torch.stack(each) for each in zip(*pairs, strict=True))
        return x, y

    criterion = dice_ce
    for step in range(steps):
        if step == steps // 3 and loss != "dice+ce":
            criterion = with_prior(weight, law, [(net(x).detach(), y) for x, y in map(batch, range(-5, 0))], steps)
        net.train()
        adam.param_groups[0]["lr"] = RATE * (1 + math.cos(math.pi * step / steps)) / 2
        adam.zero_grad()
        x, y = batch(step)
        criterion(net(x), y).backward()
        nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        adam.step()
    return net


def with_prior(weight: float, law: str, batches: list[tuple[Tensor, Tensor]], steps: int) -> CombinedLoss:
    """Return Dice + CE with F_ε, faded in over a tenth of all steps."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "ε = .* interpolating", UserWarning)
        prior = CurvaturePrior(law, sigmoid=True, spacing=SPACING, epsilon=EPSILON)
    balance = float(np.median([prior.suggest_weight(dice_ce, pair) for pair in batches]))
    return CombinedLoss(dice_ce, prior, weight * balance, steps // 10)


def predict(net: nn.Module, image: np.ndarray) -> np.ndarray:
    from monai.inferers.utils import sliding_window_inference

    net.eval()
    with torch.no_grad():
        x = torch.from_numpy(image)[None, None]
        logits = sliding_window_inference(x, PATCH, 4, net, overlap=(0.5, 0.25, 0.25), mode="gaussian")
    return (logits[0, 0] > 0).numpy()  # type: ignore[index,operator]


# ---- scores ----------------------------------------------------------------------------------------------------------


def counts(predicted: np.ndarray, true: np.ndarray) -> list[list[int]]:
    """Return what the scores are made of, for every block of the plane `(11, blocks)`."""
    thin, true_thin = skeletonize(predicted), skeletonize(true)
    volumes = (predicted & true, predicted, true, thin & true, thin, true_thin & predicted, true_thin)
    sums = [[int(block.sum()) for block in blocks(volume)] for volume in volumes]
    masks = (remove_specks(predicted), remove_specks(true), predicted, true)
    return sums + [[int(np.max(label(block, connectivity=3))) for block in blocks(mask)] for mask in masks]


def blocks(volume: np.ndarray) -> list[np.ndarray]:
    starts = product(*(range(0, n, edge) for n, edge in zip(volume.shape[1:], BLOCK, strict=True)))
    return [volume[:, y : y + BLOCK[0], x : x + BLOCK[1]] for y, x in starts]


def remove_specks(mask: np.ndarray) -> np.ndarray:
    labels = np.asarray(label(mask, connectivity=3))
    large = np.bincount(labels.ravel()) >= SPECK
    large[0] = False
    return large[labels]


def scores_of(rows: np.ndarray) -> np.ndarray:
    """Return `SCORES` `(…, 4)` of blocks taken together, of counts `(…, 11, blocks)`."""
    both, predicted, true, hits, thin, true_hits, true_thin = np.moveaxis(rows[..., :7, :].sum(-1, dtype=float), -1, 0)
    precision, recall = hits / np.maximum(thin, 1), true_hits / np.maximum(true_thin, 1)
    clear, specks = (np.abs(rows[..., a, :] - rows[..., a + 1, :]).mean(-1) for a in (7, 9))
    overlap = 2 * both / np.maximum(predicted + true, 1)
    return np.stack([overlap, 2 * precision * recall / np.maximum(precision + recall, 1e-9), clear, specks], -1)


def differences(one: np.ndarray, base: np.ndarray) -> list[Figure]:
    """Return the differences of the scores of counts `(seeds, stacks, 11, blocks)`, with their intervals."""
    random, (seeds, _, _, places) = np.random.default_rng(0), one.shape
    picks = [(np.arange(seeds), np.arange(places))]
    picks += [(random.integers(seeds, size=seeds), random.integers(places, size=places)) for _ in range(2000)]
    drawn = np.array([(scores_of(one[s][..., p]) - scores_of(base[s][..., p])).mean((0, 1)) for s, p in picks])
    return [Figure(float(k[0]), *map(float, np.quantile(k[1:], (0.025, 0.975)))) for k in drawn.T]


# ---- runs ------------------------------------------------------------------------------------------------------------


def case(loss: str, weight: float, seed: int, stack: str, steps: int, cases: Cases) -> Values:
    """Train on a stack; return the counts of its validation part, and of the other stack's test part."""
    law = "tubes" if cases.quick or loss != "curvature" else str(law_of(stack, steps, cases))
    net, other = trained(loss, weight, seed, stack, steps, law), STACKS[1 - STACKS.index(stack)]
    ends = {"validation": part(stack, "validation"), "test": part(other, "test")}
    return {end: counts(predict(net, image), label) for end, (image, label) in ends.items()}


def law_of(stack: str, steps: int, cases: Cases) -> Path:
    """Return the fit of what Dice + CE predicts on its own fitting part."""

    def read() -> str:
        mask = predict(trained("dice+ce", 0, TUNING, stack, steps, ""), part(stack, "fit")[0])
        return infer(Field(mask.astype(np.uint8), SPACING, "um"), kind="mask").fit.to_json()

    return cases.text(f"fit-{stack}-{steps}.json", read)


def merit(rows: np.ndarray) -> float:
    """Dice + clDice - the Betti-0 error as a share of the true components."""
    overlap, centre, error, _ = scores_of(rows)
    return float(overlap + centre - error / rows[8].mean())


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--losses", default=",".join(WEIGHTS))


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    steps, seeds = (6, 1) if cases.quick else (STEPS, options.seeds)
    found: dict[str, np.ndarray] = {}
    for loss in options.losses.split(","):

        def runs(weight: float, numbers: range, loss: str = loss) -> list[Values]:
            jobs = {f"{loss}-{weight:g}-{seed}-{stack}-{steps}": partial(case, loss, weight, seed, stack, steps, cases)
                    for seed in numbers for stack in STACKS}  # fmt: skip
            return list(cases.all(jobs).values())

        tried = WEIGHTS[loss][:1] if cases.quick else WEIGHTS[loss]
        chosen = tried[0]
        if len(tried) > 1:
            tuning = {w: runs(w, range(TUNING, TUNING + 1)) for w in tried}
            chosen = max(tried, key=lambda w: sum(merit(np.array(each["validation"])) for each in tuning[w]))
        tests = [each["test"] for each in runs(chosen, range(seeds))]
        if len(tests) == seeds * len(STACKS):
            found[loss] = np.array(tests).reshape(seeds, len(STACKS), 11, -1)
    rows = [[loss, *scores_of(rows).mean((0, 1)).tolist()] for loss, rows in found.items()]
    show(["loss", *SCORES], rows, f"{seeds} seeds, both stacks, {steps} steps")
    if "dice+ce" not in found:
        return {}
    apart = {loss: differences(rows, found["dice+ce"]) for loss, rows in found.items() if loss != "dice+ce"}
    show(["less Dice + CE", *SCORES], [[loss, *each] for loss, each in apart.items()])
    keys = ("dice", "cldice", "betti", "specks")
    return {f"losses.{loss}.{key}": each[k] for loss, each in apart.items() for k, key in enumerate(keys)}
