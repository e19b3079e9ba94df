"""Shapes grown from the posterior of each of some queries, for `benchmarks.closure`: 3 to 6 s a shape on one core.

    python -m benchmarks.closure_simulations STORE POSTERIOR.npz --cache FOLDER [--queries 60] [--count 24]

The queries are a store's first well-formed shapes, which POSTERIOR must not have been trained on. Their parameters are
draws given the query's mask, and the seeds the same few for all queries, `SEEDS`. A run ends after some minutes, and
the next one goes on. A file of a query holds parameters `(n, 6)`, seeds `(n,)`, and masks, packed `(n, bytes)`, all 0
where nothing grew.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from benchmarks.closure_trials import queries_of
from curvafit.data_synth import open_store
from curvafit.generation.flow import generate
from curvafit.generation.schedule import LEARNED
from curvafit.generation.viability import well_formed
from curvafit.geometry.descriptors import descriptors
from curvafit.inference.posterior import Posterior, load_posterior
from curvafit.inference.table import law_of
from curvafit.priors.grid import Grid

#: Seeds in turn, so that what a seed does to all parameters can be told from noise.
SEEDS = 8
BOX = (64, 64, 64)


def simulate(parameters: np.ndarray, seed: int) -> np.ndarray | None:
    """The mask that a law grows, None where it grows none."""
    law, mass = law_of(parameters)
    flow = generate(law, mass, Grid(BOX), seed=10_000 + seed, schedule=LEARNED, reject_early=True)
    return (flow.field > 0).numpy() if well_formed(flow.viability) else None


def begin(mask: np.ndarray, posterior: Posterior, count: int, path: Path) -> None:
    """The file of a query, nothing simulated yet."""
    row = descriptors(mask, Grid(mask.shape)).vector()
    draws = posterior.sample(row, "mask", count, seed=int(path.stem.rpartition("-")[2]))
    seeds = np.arange(count) % SEEDS
    np.savez(path, parameters=draws, seeds=seeds, masks=np.zeros((0, 64**3 // 8), np.uint8))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    parser.add_argument("posterior", type=Path)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--queries", type=int, default=60)
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--minutes", type=float, default=3.0)
    options = parser.parse_args()
    end = time.monotonic() + 60 * options.minutes
    store, posterior = open_store(options.store), load_posterior(options.posterior)
    options.cache.mkdir(parents=True, exist_ok=True)
    queries = queries_of(store, options.queries)
    for level in (12, options.count):
        for index in queries:
            path = options.cache / f"{store.path.stem}-{index:06d}.npz"
            if not path.exists():
                begin(store.field(index) > 0, posterior, options.count, path)
            content = dict(np.load(path))
            for k in range(len(content["masks"]), level):
                if time.monotonic() > end:
                    return
                grown = simulate(content["parameters"][k], int(content["seeds"][k]))
                packed = np.zeros(64**3 // 8, np.uint8) if grown is None else np.packbits(grown)
                content["masks"] = np.concatenate([content["masks"], packed[None]])
                np.savez(path, **content)
    print("all simulated")


if __name__ == "__main__":
    main()
