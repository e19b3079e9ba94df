"""Who teaches the filler best, at equal steps: random laws, presets, level cuts, capsules, or all of them.

Each teacher has 32 shapes of 64³: of laws drawn in the paper's box, of the eight presets, level cuts of Gaussian fields
with the fraction and the two-point function of each preset's shapes, and capsules at all angles. A filler is taught by
each for `--steps`, and fills every eighth slice of the real blocks of `completion` on which nothing was chosen: gains
in Dice on the best of nearest, linear and spline, in hindsight, with known slices as they are, and as a hand draws
them. What the real other half teaches is `completion --ways scratch`. $CURVAFIT_DATA names the scans.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
from scipy import ndimage

from benchmarks.completion import CHOSEN_ON, FEW, LAWS, STRUCTURES, blocks, shape
from benchmarks.harness import Cases, Figure, Values, bootstrap, show
from benchmarks.nulls import level_cut
from curvafit.data_synth.atlas import build
from curvafit.data_synth.design import design_box
from curvafit.data_synth.store import find_well_formed
from curvafit.priors.grid import Grid
from curvafit.segmentation.filler import Taught, fill
from curvafit.segmentation.slices import WAYS, Slices
from curvafit.segmentation.teach import Texture, teach, tremble
from curvafit.segmentation.trials import dice
from curvafit.segmentation.uncertainty import best_log_odds

TEACHERS = ("laws", "presets", "cuts", "capsules", "all")
SHAPES, EDGE, EVERY = 32, 64, 8


def capsules(seed: int) -> np.ndarray:
    """Return a field, positive in capsules of one radius at any angle."""
    random, found = np.random.default_rng(seed), np.full((EDGE,) * 3, np.inf, np.float32)
    points = np.stack(np.indices(found.shape), axis=-1).astype(np.float32)
    radius = random.uniform(3, 6)
    for _ in range(int(random.integers(8, 24))):
        axis = random.standard_normal(3)
        axis *= random.uniform(0.2, 0.6) * EDGE / np.linalg.norm(axis)
        away = points - random.uniform(0, EDGE, 3)
        along = np.clip(away @ axis / (axis @ axis), -0.5, 0.5)
        found = np.minimum(found, np.linalg.norm(away - along[..., None] * axis, axis=-1))
    return (radius - found).astype(np.float32)


def textures(teacher: str, cases: Cases) -> list[list[Texture]]:
    """Return the shapes of a teacher, by source."""
    if teacher == "all":
        return [textures(each, cases)[0] for each in TEACHERS[:-1]]
    if teacher == "laws":
        store = build(cases.folder / "laws.zarr", SHAPES, EDGE, design=design_box("sobol", ["a02"]))
        return [[Texture(store.field(index)) for _, index in find_well_formed((store.path,))]]
    if teacher == "capsules":
        return [[Texture(capsules(seed), periodic=False) for seed in range(SHAPES)]]
    masks = [shape(law, seed, cases) for law, seed in product(LAWS, range(10, 10 + SHAPES // len(LAWS)))]
    if teacher == "presets":
        return [
            [Texture(ndimage.gaussian_filter(2.0 * mask - 1, 0.7, mode="wrap").astype(np.float32)) for mask in masks]
        ]
    return [[Texture(level_cut(mask, Grid(EDGE), seed)) for seed, mask in enumerate(masks)]]


def gains(taught: Taught, hand: bool) -> list[float]:
    """Return the gain of each real block, in points; `hand`: known slices are as a hand draws them."""
    found = []
    for name in STRUCTURES:
        for side in {0, 1} - set(CHOSEN_ON.get(name, ())):
            for number, block in enumerate(blocks(name, side)[: STRUCTURES[name].targets]):
                axis = int(block.shape[0] < FEW)
                truth, places = np.moveaxis(block.values > 0, axis, 0), range(0, block.shape[axis], EVERY)
                slices, random = Slices.of(block, places, axis), np.random.default_rng(number)
                if hand:
                    slices = replace(slices, inside=np.stack([tremble(mask, random) for mask in slices.inside]))
                rows = [k for k in range(places[-1]) if k % EVERY]
                plain = max(dice(slices.level(way)[rows] > 0, truth[rows]) for way in WAYS)
                logits = fill(slices, taught)[rows]
                found.append(100 * (dice(logits > best_log_odds(logits), truth[rows]) - plain))
    return found


def case(teacher: str, seed: int, steps: int, cases: Cases) -> Values:
    checkpoint = cases.folder / f"{teacher}-{seed}-{steps}.pt"
    taught = teach(textures(teacher, cases), {}, steps=steps, seed=seed, checkpoint=checkpoint, workers=0)
    return {"exact": gains(taught, False), "hand": gains(taught, True), "loss": taught.card["held_out_loss"]}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--teachers", default=",".join(TEACHERS))
    parser.add_argument("--steps", type=int, default=600)


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    teachers, steps = options.teachers.split(","), 2 if options.quick else options.steps
    teachers, seeds = (["capsules"], (0,)) if options.quick else (teachers, (0, 1))
    jobs = {f"{teacher}-{seed}-{steps}": partial(case, teacher, seed, steps, cases)
            for seed, teacher in product(seeds, teachers)}  # fmt: skip
    found, figures, table = cases.all(jobs), {}, []
    for teacher in teachers:
        rows = [found[name] for seed in seeds if (name := f"{teacher}-{seed}-{steps}") in found]
        if len(rows) < len(seeds):
            continue
        for kind in ("exact", "hand"):
            each = np.mean([row[kind] for row in rows], axis=0)
            figures[f"teachers.{teacher}.{kind}"] = bootstrap(each)
            figures[f"teachers.{teacher}.{kind}_least"] = Figure(float(each.min()))
        table.append([teacher, *(figures[f"teachers.{teacher}.{key}"] for key in ("exact", "hand"))])
    show(["teacher", "gain, points", "as a hand draws them"], table, f"{steps} steps, {len(seeds)} seeds")
    return figures
