"""Masks from the probabilities of real networks: p > 1/2, smoothing, TV, F_ε, and the network that repairs.

Needs $CURVAFIT_DATA and monai. Small U-Nets learn one part of a scan, three annotated slices of it, and predict two
others: an example, and the test. Scans: vessels (VesselExpress) under noise of one contrast, capillaries (Poon; the
test is another place of the other stack), and bone under noise of two contrasts. Smoothing and TV of p take the best
setting *in hindsight*; F_ε takes law and weight by the example; `repair` takes nothing, `tuned` the example. `random`
is the null: parts of p > 1/2 are joined at random until as many voxels are added as `repair` adds (`pip install
topocheck`).

Differences to p > 1/2 with 95 % intervals: a bootstrap over seeds and cubes of 32 voxels. The Betti error of a cube is
the sum of the differences of its Betti numbers.
"""

from __future__ import annotations

import argparse
import math
import os
import warnings
from functools import cache, partial
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage
from skimage.morphology import skeletonize
from skimage.restoration import denoise_tv_chambolle
from torch import Tensor, nn

from benchmarks.harness import Cases, Figure, Values, best, show
from benchmarks.networks import SPACING, STACKS, dice_ce, part, sparse
from curvafit.geometry.topology import betti_numbers
from curvafit.inference.infer import infer
from curvafit.segmentation.refine import refine
from curvafit.volumes.field import Field

SCANS = ("vessels", "capillaries", "bone")
WAYS = ("half", "random", "smoothing", "TV", "F_ε", "repair", "tuned")
STEPS, BATCH, RATE = 300, 2, 6e-3
NOISE = {"vessels": 1.0, "bone": 2.0}
WIDTHS, WEIGHTS = (0.5, 0.7, 1.0, 1.4, 2.0), (0.1, 0.2, 0.4, 0.8, 1.6)
CUBE, DRAWN, RANDOM = 32, 2000, 5
SCORES = ("Dice", "clDice", "Betti")


# ---- scans -----------------------------------------------------------------------------------------------------------


@cache
def scene(scan: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return image and truth of the three parts of a scan: `fit`, `example` and `test`."""
    import tifffile

    folder = Path(os.environ["CURVAFIT_DATA"]) / "scans"
    if scan == "capillaries":
        one, other = STACKS
        return {"fit": part(one, "fit"), "example": part(one, "validation"), "test": part(other, "test")}
    if scan == "vessels":
        values = np.log1p(tifffile.imread(folder / "vesselexpress_000.tif").astype(np.float32))
        truth, cuts = tifffile.imread(folder / "vesselexpress_000_mask.tif") > 0, (0, 40, 60, 100)
    else:
        values = tifffile.imread(folder / "lhdl_trabecular_200.tif").astype(np.float32)[:, 36:164, 36:164]
        truth = (tifffile.imread(folder / "lhdl_trabecular_200_otsu_mask.tif") > 0)[:, 36:164, 36:164]
        cuts = (0, 64, 112, 200)
    contrast = values[truth].mean() - values[~truth].mean()
    values += NOISE[scan] * contrast * np.random.default_rng(0).standard_normal(values.shape, dtype=np.float32)
    values = (values - values.mean()) / values.std()
    parts = [slice(*pair) for pair in pairwise(cuts)]
    return {name: (values[rows], truth[rows]) for name, rows in zip(("fit", "example", "test"), parts, strict=True)}


def spacing(scan: str) -> tuple[float, float, float]:
    return SPACING if scan == "capillaries" else (1.0, 1.0, 1.0)


# ---- networks --------------------------------------------------------------------------------------------------------


def window(scan: str) -> tuple[int, int, int]:
    """Return the voxels of a patch."""
    return (12, 80, 80) if scan == "capillaries" else (24, 48, 48)  # not so deep that slices lie at one place in it


def train(scan: str, seed: int, steps: int) -> nn.Module:
    """Return a U-Net that was taught one part of a scan."""
    from monai.networks.nets.dynunet import DynUNet

    torch.manual_seed(seed)
    flat = scan == "capillaries"
    strides: list = [1, (1, 2, 2) if flat else 2, 2, 2]
    kernels: list = [(1, 3, 3) if flat else 3, 3, 3, 3]
    net = DynUNet(3, 1, 1, kernels, strides, strides[1:], filters=(8, 16, 32, 48), norm_name="batch")
    adam = torch.optim.AdamW(net.parameters(), RATE)
    image, truth = scene(scan)["fit"]
    target = sparse(truth)
    net.train()
    for step in range(steps):
        adam.param_groups[0]["lr"] = RATE * (1 + math.cos(math.pi * step / steps)) / 2
        pairs = [cut(image, target, window(scan), (seed, step, k)) for k in range(BATCH)]
        x, y = (torch.stack(each) for each in zip(*pairs, strict=True))
        adam.zero_grad()
        dice_ce(net(x), y).backward()
        nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        adam.step()
    return net


def cut(image: np.ndarray, target: np.ndarray, edges: tuple[int, ...], seed: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Return a random patch, mirrored, its grey levels changed."""
    random = np.random.default_rng(seed)
    corner = [random.integers(n - edge + 1) for n, edge in zip(image.shape, edges, strict=True)]
    box = tuple(slice(start, start + edge) for start, edge in zip(corner, edges, strict=True))
    mirrors = tuple(axis for axis, value in enumerate(random.random(3)) if value < 0.5)
    x, y = (np.flip(values[box], mirrors).astype(np.float32) for values in (image, target))
    x = random.uniform(0.9, 1.1) * x + random.uniform(-0.1, 0.1)
    return torch.from_numpy(x.astype(np.float32))[None], torch.from_numpy(y.copy())[None]


def predict(net: nn.Module, scan: str, image: np.ndarray) -> np.ndarray:
    """Return a network's probabilities, float16."""
    from monai.inferers.utils import sliding_window_inference

    net.eval()
    with torch.no_grad():
        x = torch.from_numpy(image.astype(np.float32))[None, None]
        logits = sliding_window_inference(
            x, window(scan), 4, net, overlap=0.5, mode="gaussian", padding_mode="replicate"
        )
    return logits[0, 0].sigmoid().numpy().astype(np.float16)  # type: ignore[index,union-attr]


def maps(scan: str, seed: int, steps: int, cases: Cases) -> tuple[np.ndarray, np.ndarray]:
    """Return a network's probabilities of the example and of the test."""
    names = [f"{end}-{scan}-{seed}-{steps}" for end in ("example", "test")]
    if not all((cases.folder / f"{name}.npz").exists() for name in names):
        net = train(scan, seed, steps)
        for name, end in zip(names, ("example", "test"), strict=True):
            found = predict(net, scan, scene(scan)[end][0])
            cases.array(name, lambda found=found: found)
    one, other = (cases.array(name, partial(_missing, name)).astype(np.float32) for name in names)
    return one, other


def _missing(name: str) -> np.ndarray:
    raise FileNotFoundError(name)


def law_of(scan: str, cases: Cases) -> Path:
    """Return the fit of the example's true mask."""

    def read() -> str:
        truth = scene(scan)["example"][1].astype(np.uint8)
        return infer(Field(truth, spacing(scan), "um"), kind="mask", fast=True).fit.to_json()

    return cases.text(f"fit-{scan}.json", read)


# ---- ways ------------------------------------------------------------------------------------------------------------


def mask_of(way: str, scan: str, seed: int, steps: int, cases: Cases) -> tuple[np.ndarray, str]:
    """Return the mask of a way, and what was said of it."""
    (example, p), truth = maps(scan, seed, steps, cases), scene(scan)["test"][1]
    place, edges = {"spacing": spacing(scan), "unit": "um"}, spacing(scan)
    if way == "half":
        return p > 0.5, ""
    if way == "smoothing":
        widths = ([width * min(edges) / h for h in edges] for width in WIDTHS)
        return best((ndimage.gaussian_filter(p, width) > 0.5 for width in widths), truth), ""
    if way == "TV":
        return best((denoise_tv_chambolle(p, weight) > 0.5 for weight in WEIGHTS), truth), ""
    pair = (example, scene(scan)["example"][1].astype(np.uint8))
    if way == "F_ε":
        found = refine(p, law_of(scan, cases), example=pair, **place)
    else:
        found = refine(p, repair=True, example=pair if way == "tuned" else None, **place)
    return found.mask.values > 0, found.status


def case(way: str, scan: str, seed: int, steps: int, cases: Cases) -> Values:
    """Return counts of a way's mask, by cubes of the test, and breaks and false merges of all of it."""
    truth = scene(scan)["test"][1]
    if way == "random":
        p, repaired = maps(scan, seed, steps, cases)[1] > 0.5, mask_of("repair", scan, seed, steps, cases)[0]
        added = int((repaired & ~p).sum())
        masks, said = [join_at_random(p, added, np.random.default_rng([seed, k])) for k in range(RANDOM)], ""
    else:
        mask, said = mask_of(way, scan, seed, steps, cases)
        masks = [mask]
    values = {"counts": np.mean([counts(mask, truth) for mask in masks], axis=0).tolist(), "status": said}
    return values | {name: float(np.mean([breaks(mask, truth)[name] for mask in masks])) for name in ("break", "merge")}


def join_at_random(mask: np.ndarray, voxels: int, random: np.random.Generator) -> np.ndarray:
    """Return a mask whose parts are joined at random until so many voxels are added, as topocheck's null does."""
    from topocheck.checks import _random_repair

    return _random_repair(mask, voxels, random)


@cache
def units_of(scan_truth: bytes, shape: tuple[int, ...]) -> list:
    """Return the branches of a true mask."""
    from topocheck import build_units

    return build_units(np.frombuffer(scan_truth, bool).reshape(shape))


def breaks(mask: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Return the shares of true branches that are broken, and of joined parts that should not be."""
    from topocheck import break_rate, false_merge_rate

    units = units_of(np.ascontiguousarray(truth).tobytes(), truth.shape)
    merged = false_merge_rate(mask, truth)["false_merge_rate"]
    return {"break": break_rate(mask, units)["break_frac"], "merge": 0.0 if np.isnan(merged) else merged}


def counts(mask: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return what scores are made of, for every cube, (8, cubes)."""
    thin, true_thin = skeletonize(mask), skeletonize(truth)
    volumes = (mask & truth, mask, truth, thin & truth, thin, true_thin & mask, true_thin)
    sums = [[int(each.sum()) for each in cubes(volume)] for volume in volumes]
    pairs = zip(cubes(mask), cubes(truth), strict=True)
    wrong = [sum(abs(a - b) for a, b in zip(betti_numbers(m), betti_numbers(t), strict=True)) for m, t in pairs]
    return np.array([*sums, wrong], dtype=float)


def cubes(volume: np.ndarray) -> list[np.ndarray]:
    starts = product(*(range(0, max(n - CUBE // 2, 1), CUBE) for n in volume.shape))
    return [volume[tuple(slice(a, a + CUBE) for a in start)] for start in starts]


def scores_of(rows: np.ndarray) -> np.ndarray:
    """Return `SCORES` `(…, 3)` of cubes taken together, of counts `(…, 8, cubes)`; the Betti error is a cube's."""
    both, found, true, hits, thin, true_hits, true_thin = np.moveaxis(rows[..., :7, :].sum(-1), -1, 0)
    precision, recall = hits / np.maximum(thin, 1), true_hits / np.maximum(true_thin, 1)
    overlap = 2 * precision * recall / np.maximum(precision + recall, 1e-9)
    return np.stack([2 * both / np.maximum(found + true, 1), overlap, rows[..., 7, :].mean(-1)], -1)


def differences(rows: np.ndarray, base: np.ndarray) -> list[Figure]:
    """Return the differences of scores of counts `(seeds, 8, cubes)`, with their intervals."""
    random, (seeds, _, places) = np.random.default_rng(0), rows.shape
    picks = [(np.arange(seeds), np.arange(places))]
    picks += [(random.integers(seeds, size=seeds), random.integers(places, size=places)) for _ in range(DRAWN)]
    drawn = np.array([(scores_of(rows[s][..., p]) - scores_of(base[s][..., p])).mean(0) for s, p in picks])
    return [Figure(float(each[0]), *map(float, np.quantile(each[1:], (0.025, 0.975)))) for each in drawn.T]


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--scans", default=",".join(SCANS))
    parser.add_argument("--ways", default=",".join(WAYS))


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    steps, seeds = (4, 1) if cases.quick else (STEPS, options.seeds)
    scans, ways = options.scans.split(","), options.ways.split(",")
    scans, ways = (scans[:1], ["half", "repair"]) if cases.quick else (scans, ways)
    figures: dict[str, Figure] = {}
    for scan in scans:
        found: dict[str, np.ndarray] = {}
        rows = []
        for way in ways:
            slug = way.replace("_ε", "").lower()
            jobs = {
                f"{scan}-{slug}-{seed}-{steps}": partial(case, way, scan, seed, steps, cases) for seed in range(seeds)
            }
            values = list(cases.all(jobs).values())
            if len(values) == seeds:
                found[slug] = np.array([each["counts"] for each in values])
                ends = [float(np.mean([each[name] for each in values])) for name in ("break", "merge")]
                rows.append([way, *scores_of(found[slug]).mean(0).tolist(), *ends])
                keys = ("dice", "cldice", "betti", "break", "merge")
                figures |= {
                    f"maps_{scan}.{slug}.{key}": Figure(each) for key, each in zip(keys, rows[-1][1:], strict=True)
                }
        show(["way", *SCORES, "breaks", "merges"], rows, f"{scan}, {seeds} seeds")
        for name, base, ways_of in (("gain", "half", set(found) - {"half"}), ("null", "random", {"repair", "tuned"})):
            apart = {way: differences(found[way], found[base]) for way in found if way in ways_of and base in found}
            show([f"less {base}", *SCORES], [[way, *each] for way, each in apart.items()])
            for way, each in apart.items():
                for score, figure in zip(("dice", "cldice", "betti"), each, strict=True):
                    figures[f"maps_{scan}.{way}.{name}_{score}"] = figure
    return {} if cases.quick else figures
