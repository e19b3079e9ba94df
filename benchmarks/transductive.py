"""Two annotated slices of the very volume that is to be segmented: what F_ε on the rest of it adds to a network.

A shape of 64³ (two laws off the presets, `trabec`, and a block of real bone, $CURVAFIT_DATA) is blurred, under noise
of two contrasts; slices 21 and 42 are annotated, and a small U-Net learns from them. All ways share network, patches,
steps and their first third, which is Dice + CE alone (`plain`). `area`, `willmore`, `law` and `wrong` add the energy
of all voxels: the law is that of another volume's mask, the wrong one another texture's. `pseudo` learns what
`reconstruct` fills from slices and image, each voxel as sure as it is; `filled` is that itself, without a network.
`refine` (`segment`, with the law) works on what `plain` predicts. Weights are chosen for each texture and way by slice
32, on a seed of its own.

Scores are those of the slices that nobody annotated. Differences pair networks by seed, with 95 % intervals of a
bootstrap over textures and seeds; p of Holm over two contrasts, `law` less `plain` and less `willmore`.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Iterable
from functools import partial

import numpy as np
import torch
from scipy import ndimage, stats
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.completion import EDGE, LAWS_TRIED, fitted, shape
from benchmarks.harness import Cases, Figure, Values, bootstrap, data, scores, show
from curvafit.inference.fit import Fit
from curvafit.inference.inference import infer
from curvafit.priors import CombinedLoss, CurvaturePrior
from curvafit.priors.law import LawLike
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.segmentation import segment
from curvafit.segmentation.trials import dice

TEXTURES = ("draw-0", "draw-5", "trabec", "bone")
KNOWN, JUDGE = (21, 42), 32
STEPS, RATE, SEEDS = 240, 6e-3, 4
#: Weights that are tried, as shares of the gradient.
WEIGHTS = dict.fromkeys(("area", "willmore", "law", "wrong"), (0.1, 0.3, 1.0))
WAYS = ("plain", "area", "willmore", "law", "wrong", "pseudo", "refine", "filled")
#: The seed by which weights are chosen, and that of the volume that the law is read from.
TUNING, OTHER = 100, 200
#: Steps over which a prior grows to its weight.
WARM = 24
KEYS = ("dice", "cldice", "betti")
#: A voxel without a label, voxels along an edge of a patch; noise of an image in contrasts, and its blur in voxels.
UNKNOWN, PATCH, NOISE, BLUR = 2, 48, 2.0, 0.7
Loss = Callable[[Tensor, Tensor], Tensor]


# ---- volumes ---------------------------------------------------------------------------------------------------------


def truth_of(texture: str, seed: int, cases: Cases) -> np.ndarray:
    """Return a mask of 64³: a grown shape, or a block of bone that lies elsewhere for each seed."""
    if texture != "bone":
        return shape(texture, seed, cases)
    import tifffile

    whole = tifffile.imread(data("scans", "lhdl_trabecular_200_otsu_mask.tif")) > 0
    corners = [(z, y, x) for z in (0, 68, 136) for y in (0, 68, 136) for x in (0, 68, 136)]
    z, y, x = corners[np.random.default_rng(7).permutation(len(corners))[{TUNING: 25, OTHER: 26}.get(seed, seed)]]
    return whole[z : z + EDGE, y : y + EDGE, x : x + EDGE]


def image_of(truth: np.ndarray, seed: int) -> np.ndarray:
    """Return a noisy image of a mask, standardised."""
    clear = ndimage.gaussian_filter(truth.astype(np.float32), BLUR, mode="nearest")
    values = clear + NOISE * np.random.default_rng(seed).standard_normal(truth.shape, dtype=np.float32)
    return (values - values.mean()) / values.std()


def annotated(truth: np.ndarray, slices: Iterable[int]) -> np.ndarray:
    """Return the labels of some slices, `UNKNOWN` elsewhere."""
    target = np.full(truth.shape, UNKNOWN, np.float32)
    target[list(slices)] = truth[list(slices)]
    return target


def law_of(texture: str, cases: Cases) -> Fit:
    """Return the law of another volume's mask."""
    if texture != "bone":
        return fitted(texture, OTHER, cases)

    def read() -> str:
        mask = truth_of(texture, OTHER, cases).astype(np.uint8)
        return infer(mask, kind="mask", growth=None).fit.to_json()

    return Fit.load(cases.text(f"fit-{texture}.json", read))


def prior_of(way: str, texture: str, cases: Cases) -> LawLike:
    if way in LAWS_TRIED:
        return LAWS_TRIED[way]
    other = TEXTURES[(TEXTURES.index(texture) + 1) % len(TEXTURES)]
    return law_of(texture if way == "law" else other, cases)


# ---- training --------------------------------------------------------------------------------------------------------


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


def lessons(image: np.ndarray, target: np.ndarray, seed: int) -> Callable[[int], tuple[Tensor, Tensor]]:
    """Return patches of an image and its target by step, turned, mirrored and with their grey values changed."""

    def batch(step: int) -> tuple[Tensor, Tensor]:
        random = np.random.default_rng([seed, step % 2**32])
        corner = [int(random.integers(n - PATCH + 1)) for n in image.shape]
        box = tuple(slice(a, a + PATCH) for a in corner)
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


def soft_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return Dice and cross-entropy of probabilities, each voxel weighed by how sure it is."""
    sure, y = (2 * target - 1).abs(), (target > 0.5).float()
    p = logits.sigmoid()
    overlap = (2 * (sure * p * y).sum() + 1) / ((sure * (p + y)).sum() + 1)
    return 1 - overlap + functional.binary_cross_entropy_with_logits(logits, y, sure)


def filled(texture: str, seed: int, cases: Cases) -> np.ndarray:
    """Return the probabilities that `reconstruct` gives a volume, from two slices and its image."""
    truth = truth_of(texture, seed, cases)
    slices = np.zeros(truth.shape, np.uint8)
    slices[list(KNOWN)] = truth[list(KNOWN)]
    found = reconstruct(slices, known=KNOWN, image=image_of(truth, seed))
    assert found.probability is not None
    return found.probability.values.astype(np.float32)


def train(way: str, weight: float, texture: str, seed: int, steps: int, cases: Cases) -> np.ndarray:
    """Return the probabilities of a network that was taught two slices of a volume, for all of it."""
    truth, net = truth_of(texture, seed, cases), network(seed)
    image, target = image_of(truth, seed), annotated(truth, KNOWN)
    if way == "pseudo":
        target = filled(texture, seed, cases)
    batch, losses = lessons(image, target, seed), list[CombinedLoss]()

    def loss_at(step: int) -> Loss:
        if way == "pseudo":
            return soft_loss
        if step == steps // 3 and way in WEIGHTS:
            prior = CurvaturePrior(prior_of(way, texture, cases), sigmoid=True)
            pairs = [(predict(net, x).detach(), y) for x, y in map(batch, range(-5, 0))]
            share = float(np.median([prior.suggest_weight(dice_ce, pair) for pair in pairs]))
            losses.append(CombinedLoss(dice_ce, prior, weight * share, WARM))
        return losses[0] if losses else dice_ce

    learn(net, batch, steps, RATE, loss_at)
    return predict_whole(net, image).sigmoid().numpy()


def predicted(way: str, weight: float, texture: str, seed: int, steps: int, cases: Cases) -> np.ndarray:
    """Return the probabilities of a way's network, trained once."""
    make = partial(train, way, weight, texture, seed, steps, cases)
    name = f"p-{texture}-{way}-{weight:g}-{seed}-{steps}"
    return cases.array(name, lambda: make().astype(np.float16)).astype(np.float32)


def case(way: str, weight: float, texture: str, seed: int, steps: int, cases: Cases) -> Values:
    """Return the scores of a way on the slices that nobody annotated, and the Dice of the slice that judges."""
    taught = "plain" if way == "refine" else way
    p = filled(texture, seed, cases) if way == "filled" else predicted(taught, weight, texture, seed, steps, cases)
    truth, mask, said = truth_of(texture, seed, cases), p > 0.5, ""
    if way == "refine":
        truths = truth_of(texture, TUNING, cases).astype(np.uint8)
        example = predicted("plain", 0.0, texture, TUNING, steps, cases), truths
        found = segment(p, law_of(texture, cases), probabilities=True, example=example)
        mask, said = found.mask.values > 0, found.status
    rest = np.setdiff1d(np.arange(len(truth)), [*KNOWN, JUDGE])
    return {"dice": dice(mask[rest], truth[rest]), "betti": scores(mask, truth)["betti"], "cldice": cldice(mask, truth),
            "judge": dice(mask[JUDGE], truth[JUDGE]), "status": said}  # fmt: skip


def cldice(mask: np.ndarray, truth: np.ndarray) -> float:
    from skimage.morphology import skeletonize

    thin, true_thin = skeletonize(mask), skeletonize(truth)
    parts = ((thin & truth).sum() / max(thin.sum(), 1), (true_thin & mask).sum() / max(true_thin.sum(), 1))
    return float(2 * parts[0] * parts[1] / max(sum(parts), 1e-9))


# ---- runs ------------------------------------------------------------------------------------------------------------


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", category=UserWarning)
    steps, seeds = (6, 1) if cases.quick else (STEPS, SEEDS)
    ways, textures = (("plain", "law", "refine"), ("trabec",)) if cases.quick else (WAYS, TEXTURES)

    def scored(way: str, weight: float, texture: str, numbers: range) -> list[Values]:
        jobs = {f"{texture}-{way}-{weight:g}-{seed}-{steps}": partial(case, way, weight, texture, seed, steps, cases)
                for seed in numbers}  # fmt: skip
        return list(cases.all(jobs).values())

    def chosen(way: str, texture: str) -> float:
        if way not in WEIGHTS or cases.quick:
            return WEIGHTS.get(way, (0.0,))[0]
        judged = {weight: scored(way, weight, texture, range(TUNING, TUNING + 1)) for weight in WEIGHTS[way]}
        return max(judged, key=lambda weight: judged[weight][0]["judge"] if judged[weight] else -1.0)

    found = {(way, texture): scored(way, chosen(way, texture), texture, range(seeds))
             for texture in textures for way in ways}  # fmt: skip
    if cases.quick or any(len(rows) < seeds for rows in found.values()):
        return {}
    table = {way: np.array([[[row[key] for key in KEYS] for row in found[way, texture]] for texture in textures])
             for way in ways}  # fmt: skip
    show(["way", *KEYS], [[way, *rows.mean((0, 1)).tolist()] for way, rows in table.items()])
    figures = {f"transductive.{way}.{key}": bootstrap((table[way] - table["plain"])[..., k].ravel(), np.mean)
               for way in ways[1:] for k, key in enumerate(KEYS)}  # fmt: skip
    apart = {base: (table["law"] - table[base])[..., 0].ravel() for base in ("plain", "willmore")}
    p = {base: float(stats.wilcoxon(each)[1]) for base, each in apart.items()}
    least, most = sorted(p, key=p.__getitem__)
    figures[f"transductive_p.{least}"] = Figure(min(1.0, 2 * p[least]))  # Holm
    figures[f"transductive_p.{most}"] = Figure(max(min(1.0, 2 * p[least]), p[most]))
    figures["transductive_p.contrast"] = bootstrap(apart["willmore"], np.mean)
    show(["less plain; p", ""], list(figures.items()))
    return figures
