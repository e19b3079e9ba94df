"""Sets that teach: how many labelled slices a network still needs after pairs of generated shapes.

Needs $CURVAFIT_DATA. One half of a scan's mask (bone; pores of sandstone) lends fraction, thickness and law to sets
of six shapes; the other half is what a small U-Net is to segment: four blocks of 96³, apart from each other, blurred,
under noise of two contrasts. Shapes are brought to that fraction and thickness and imaged alike, so that sets differ
in shape: `law`, grown by the law that `infer` reads; `wrong`, by the law of a preset of layers; `cut`, level cuts of
Gaussian fields whose two-point function is that of the mask (mirrored, since it must repeat); `tubes`, straight ones;
`real`, blocks of the lending half as they are. A network learns a set, or nothing (`scratch`), then 0, 1, 3 or 10
labelled slices of the block; scores are those of slices that none of these has. Seeds are blocks, and after four of
them other networks; intervals are those of t over blocks.
"""

from __future__ import annotations

import argparse
import os
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage, stats

from benchmarks.harness import Cases, Figure, Values, show
from benchmarks.nulls import level_cut
from benchmarks.unets import annotated, image_of, learn, lessons, network, predict_whole
from curvafit.generation.flow import generate
from curvafit.geometry.morphometry import local_thickness
from curvafit.inference.fit import Fit
from curvafit.inference.infer import infer
from curvafit.priors.grid import Grid
from curvafit.priors.law import Law, LawLike
from curvafit.segmentation.trials import dice
from curvafit.volumes.read import load

SCANS = {"bone": "lhdl_trabecular_200_otsu_mask.tif", "pores": "openpnm_berea_100_to_300.npz"}
SETS = ("law", "wrong", "cut", "tubes", "real")
#: Voxels along an edge of blocks and shapes, shapes of a set, labelled slices, and the preset whose law is wrong.
EDGE, SHAPES, SLICES, WRONG = 96, 6, (0, 1, 3, 10), "bilayers"
#: Voxels of grown shapes and of level cuts, before they are scaled; blocks of the half to segment.
GROWN, CUT, BLOCKS = 80, 128, 4
#: Steps on a set, steps on slices after it, steps on slices alone, and the greatest rate.
TAUGHT, TUNED, ALONE, RATE = 300, 120, 300, 6e-3


# ---- shapes ----------------------------------------------------------------------------------------------------------


def halves(scan: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the half of a mask that lends, and the half to segment."""
    mask = load(Path(os.environ["CURVAFIT_DATA"]) / "scans" / SCANS[scan]).values > 0
    mask = ~mask if mask.mean() > 0.5 else mask
    return mask[:, :, : mask.shape[2] // 2], mask[:, :, mask.shape[2] // 2 :]


def block(mask: np.ndarray, number: int) -> np.ndarray:
    """Return one of four blocks of a half, at its far side and apart from each other."""
    z, y = (0 if number & bit == 0 else mask.shape[axis] - EDGE for axis, bit in enumerate((1, 2)))
    return mask[z : z + EDGE, y : y + EDGE, -EDGE:]


def mean_thickness(mask: np.ndarray) -> float:
    found = local_thickness(mask, (1.0, 1.0, 1.0))
    return float(found[mask].mean())


def shapes(scan: str, kind: str, cases: Cases) -> np.ndarray:
    """Return the shapes of a set, bool `(SHAPES, EDGE, EDGE, EDGE)`, made once."""

    def make() -> np.ndarray:
        lent = halves(scan)[0]
        fraction, thickness = float(lent.mean()), mean_thickness(lent)
        made = [like(kind, scan, number, fraction, thickness, cases) for number in range(SHAPES)]
        return np.packbits(np.stack(made))

    return np.unpackbits(cases.array(f"set-{scan}-{kind}", make)).reshape(SHAPES, *(EDGE,) * 3) > 0


def like(kind: str, scan: str, seed: int, fraction: float, thickness: float, cases: Cases) -> np.ndarray:
    """Return one shape of a set, of a volume fraction and a thickness in voxels."""
    lent = halves(scan)[0][:, :, ::-1]
    if kind == "real":
        start = seed % 2 * (lent.shape[0] - EDGE), (seed * EDGE // 3) % (lent.shape[1] - EDGE)
        return lent[start[0] : start[0] + EDGE, start[1] : start[1] + EDGE, -EDGE:]
    if kind == "tubes":
        return straight(fraction, thickness / 2, seed)
    if kind == "cut":
        half = CUT // 2
        part = block(lent, seed % 4)[:half, :half, :half]
        for axis in range(3):
            part = np.concatenate([part, np.flip(part, axis)], axis)
        return matched(level_cut(part, Grid(CUT), seed), fraction, thickness)
    known: LawLike = law_of(scan, cases) if kind == "law" else Law.of(WRONG)
    return matched(generate(known, grid=GROWN, schedule="fast", seed=seed).field.numpy(), fraction, thickness)


def matched(field: np.ndarray, fraction: float, thickness: float) -> np.ndarray:
    """Return a level set of a field that repeats, scaled so that it has a fraction and a thickness."""
    scale, mask = 1.0, field > np.quantile(field, 1 - fraction)
    own = mean_thickness(mask)
    for _ in range(3):
        scale *= own / thickness
        scaled = ndimage.map_coordinates(field, np.indices((EDGE,) * 3) * scale, order=1, mode="grid-wrap")
        mask = scaled > np.quantile(scaled, 1 - fraction)
        own = mean_thickness(mask)
    return mask


def straight(fraction: float, radius: float, seed: int) -> np.ndarray:
    """Return straight tubes at random places, until they fill a fraction."""
    random, mask = np.random.default_rng(seed), np.zeros((EDGE,) * 3, dtype=bool)
    places = np.stack(np.indices(mask.shape), -1).astype(np.float32)
    while mask.mean() < fraction:
        along = random.standard_normal(3)
        away = places - random.uniform(0, EDGE, 3)
        mask |= np.linalg.norm(np.cross(away, along / np.linalg.norm(along)), axis=-1) < radius
    return mask


def law_of(scan: str, cases: Cases) -> Fit:
    """Return the law of the half that lends."""

    def read() -> str:
        return infer(halves(scan)[0].astype(np.uint8), kind="mask", fast=True).fit.to_json()

    return Fit.load(cases.text(f"fit-{scan}.json", read))


# ---- networks --------------------------------------------------------------------------------------------------------


def case(scan: str, kind: str, seed: int, cases: Cases) -> Values:
    """Return the Dice of a network after a set, and after 0, 1, 3 and 10 labelled slices."""
    taught, tuned, alone = (4, 2, 4) if cases.quick else (TAUGHT, TUNED, ALONE)
    truth, net = block(halves(scan)[1], seed % BLOCKS), network(seed)
    image, fresh = image_of(truth, seed), kind == "scratch"
    if not fresh:
        made = enumerate(shapes(scan, kind, cases))
        learn(net, lessons([(image_of(m, 1000 + k), m.astype(np.float32)) for k, m in made], seed), taught, RATE)
    state = {key: value.clone() for key, value in net.state_dict().items()}
    found: Values = {}
    judged = np.setdiff1d(np.arange(EDGE), [each for n in SLICES for each in slices_of(n)])
    for count in SLICES[1:] if fresh else SLICES:
        net.load_state_dict(state)
        if count:
            batch = lessons([(image, annotated(truth, slices_of(count)))], seed)
            learn(net, batch, alone if fresh else tuned, RATE if fresh else RATE / 2)
        mask = predict_whole(net, image).numpy() > 0
        found[f"dice_{count}"] = dice(mask[judged], truth[judged])
    return found


def slices_of(count: int) -> list[int]:
    """Return labelled slices, evenly spread."""
    return [round((k + 0.5) * EDGE / count) for k in range(count)]


# ---- runs ------------------------------------------------------------------------------------------------------------


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seeds", type=int, default=8, help="blocks of each set, and after four of them other networks"
    )
    parser.add_argument("--scans", default=",".join(SCANS))


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    torch.set_num_threads(1)
    names = ["bone"] if cases.quick else options.scans.split(",")
    kinds = ("tubes", "scratch") if cases.quick else (*SETS, "scratch")
    seeds = range(1 if cases.quick else options.seeds)
    jobs = {f"{scan}-{kind}-{seed}": partial(case, scan, kind, seed, cases)
            for seed in seeds for scan in names for kind in kinds}  # fmt: skip
    found = cases.all(jobs)
    if cases.quick or len(found) < len(jobs):
        return {}
    figures: dict[str, Figure] = {}
    for scan in names:
        table = {kind: {n: np.array([found[f"{scan}-{kind}-{seed}"][f"dice_{n}"] for seed in seeds])
                        for n in (SLICES[1:] if kind == "scratch" else SLICES)} for kind in kinds}  # fmt: skip
        figures |= {f"sets_{scan}.{kind}.dice_{n}": over_blocks(values)
                    for kind, curve in table.items() for n, values in curve.items()}  # fmt: skip
        figures |= {f"sets_{scan}_less.{other}.at_{n}": over_blocks(table["law"][n] - table[other][n])
                    for other in kinds if other not in ("law", "scratch") for n in SLICES}  # fmt: skip
    show(["Dice, and that of the law's shapes less that of others", "mean over blocks"], list(figures.items()))
    return figures


def over_blocks(values: np.ndarray) -> Figure:
    """Return the mean over seeds, with the 95 % interval of t over the means of blocks."""
    means = np.array([values[k::BLOCKS].mean() for k in range(min(BLOCKS, len(values)))])
    half = stats.t.ppf(0.975, len(means) - 1) * means.std(ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan
    return Figure(float(means.mean()), float(means.mean() - half), float(means.mean() + half))
