"""Descriptors of many laws, a shape each: what a denser posterior and emulator learn from.

Draw k is the k-th point of a Sobol sequence in the atlas's box, of a00, a10 and a01 in the arsinh of their own scales,
so that small coefficients, where the presets lie, have their share; its schedule is drawn, as scans come from none.
A shape of 64³ that is well formed is seen as a mask and as a bad scan, as `examples/train.py` describes it. Draws are
kept in shards under `benchmarks/results/teaching`, float16; a run that is stopped goes on. Several processes share the
work by `--share 0/2` and `--share 1/2`. `--table` writes all rows, with those of `results/table.npz`, for
`examples/train.py train`.
"""

from __future__ import annotations

import argparse
import math
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from benchmarks.harness import RESULTS, Cases, Figure, Values, write_whole
from curvafit.generation.flow import generate
from curvafit.generation.result import is_well_formed
from curvafit.generation.schedule import Schedule, schedule
from curvafit.inference.table import law_of
from curvafit.scan.preparation import thinner_thickness
from examples.train import Table, load_table, measure_view, save_table

SEED, EDGE, SHARD = 70, 64, 500
FOLDER = RESULTS / "teaching"
#: Greatest a11, log a02, a10, a01 and a00; scales of the last three; the interval of the mass.
GREATEST, SCALES, MASS = (4.6, math.log(15), 200.0, 200.0, 3000.0), (20.0, 20.0, 300.0), (-0.85, -0.15)
VIEWS = ("mask", "scan")
#: Shares of draws by `paper` with half its steps, and by `fast`; the others are by `deep`, with steps between two.
PAPER, FAST, STEPS = 0.15, 0.25, (800, 4000)


def parameters_at(index: int) -> np.ndarray:
    """Return the parameters `(6,)` (`table.PARAMETERS`) of a draw."""
    engine = qmc.Sobol(6, scramble=True, rng=np.random.default_rng(SEED))
    point = (engine.fast_forward(index) if index else engine).random(1)[0]
    ends = np.array(GREATEST)
    ends[2:] = np.arcsinh(ends[2:] / SCALES)
    values = ends * (2 * point[:5] - 1)
    values[2:] = SCALES * np.sinh(values[2:])
    return np.append(values, MASS[0] + (MASS[1] - MASS[0]) * point[5])


def schedule_of(index: int) -> Schedule:
    """Return the schedule of a draw."""
    rng = np.random.default_rng([SEED, index])
    kind, steps = rng.random(), int(math.exp(rng.uniform(*np.log(STEPS))))
    return schedule("paper", 4000) if kind < PAPER else schedule("fast" if kind < PAPER + FAST else "deep", steps)


def make_draw(index: int) -> Values:
    """Grow a draw; return its rows, none where it is not well formed."""
    parameters, seed = parameters_at(index), int(np.random.SeedSequence(SEED, spawn_key=(index,)).generate_state(1)[0])
    flow = generate(*law_of(parameters), EDGE, schedule=schedule_of(index), seed=seed, reject_early=True)
    if not is_well_formed(flow.viability):
        return {"rows": [], "thickness": math.nan}
    u = flow.field.numpy()
    return {"rows": [measure_view(u, view, seed) for view in VIEWS], "thickness": thinner_thickness(u > 0)}


def run_shard(number: int, end: float) -> bool:
    """Make the draws of a shard until the time is over; return whether all are made."""
    path = FOLDER / f"{number:03d}.npz"
    kept: dict[str, list[Any]] = {"index": [], "tried": [], "descriptors": [], "amount": [], "thickness": []}
    if path.exists():
        with np.load(path) as file:
            kept = {name: list(file[name]) for name in kept}
    saved = time.monotonic()
    for index in range(number * SHARD + len(kept["tried"]), (number + 1) * SHARD):
        if time.monotonic() > end:
            break
        draw = make_draw(index)
        kept["tried"].append(bool(draw["rows"]))
        if draw["rows"]:
            descriptors, amount = zip(*draw["rows"], strict=True)
            new = {"index": index, "descriptors": descriptors, "amount": amount, "thickness": draw["thickness"]}
            for name, value in new.items():
                kept[name].append(np.asarray(value, np.int32 if name == "index" else np.float16))
        if time.monotonic() - saved > 60:
            _save(path, kept)
            saved = time.monotonic()
    _save(path, kept)
    print(f"shard {number}: {sum(kept['tried'])} shapes of {len(kept['tried'])} draws", flush=True)
    return len(kept["tried"]) == SHARD


def _save(path: Path, kept: dict[str, list[Any]]) -> None:
    path.parent.mkdir(exist_ok=True)
    arrays = {name: np.array(values) for name, values in kept.items()}
    write_whole(path, partial(np.savez_compressed, **arrays))


def gather() -> Table:
    """Return all rows as a table, after those of `results/table.npz`, which are of phase fields too."""
    first, parts = load_table(RESULTS / "table.npz"), []
    for path in sorted(FOLDER.glob("*.npz")):
        with np.load(path) as file:
            parts.append([file[name] for name in ("index", "descriptors", "amount", "thickness")])
    index, descriptors, amount, thickness = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    parameters, views = np.stack([parameters_at(int(k)) for k in index]), len(VIEWS)
    columns = {
        "shapes": np.repeat([f"teaching/{k:06d}" for k in index], views),
        "views": np.tile(VIEWS, len(index)),
        "parameters": np.repeat(parameters, views, axis=0),
        "thickness": np.repeat(thickness.astype(float), views),
        "descriptors": descriptors.reshape(-1, descriptors.shape[-1]).astype(np.float32),
        "amount": amount.ravel().astype(float),
    }
    joined = {name: np.concatenate([getattr(first, name), column]) for name, column in columns.items()}
    return Table(**joined, provenance=first.provenance | {"teaching": {"seed": SEED, "shapes": len(index)}})


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--share", default="0/1", help="which part of the shards, of how many")
    parser.add_argument("--draws", type=int, default=20_000)
    parser.add_argument("--table", type=Path, help="write all rows to this file, and draw nothing")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    if options.table is not None:
        save_table(gather(), options.table)
    elif options.quick:
        print(make_draw(1)["thickness"])
    else:
        part, parts = map(int, options.share.split("/"))
        for number in range(part, options.draws // SHARD, parts):
            if not run_shard(number, cases.end):
                break
    return {}
