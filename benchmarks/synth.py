"""Training pairs a second from a store of shapes, and shapes an hour when a store is built.

A `DataLoader` with workers of one thread each takes batches of two from a `TextureDataset`: images of `--edge` voxels,
cubic where the modality's are, else with fewer slices so that a crop stays within the stored shapes. The store is built
by the command line with 1 worker, then extended by 2, each in a process of its own.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from torch.utils.data import DataLoader

from benchmarks.harness import Cases, Figure, Values, run_python, show
from curvafit.data_synth import TextureDataset, as_dict, modality

MODALITIES = ("micro-ct", "em-membrane", "confocal", "light-sheet", "mra", "two-photon")


def building(store: Path, edge: int, count: int, workers: int) -> Values:
    """Build a store, and return shapes an hour."""
    options, begun = ["--count", count, "--shape", edge, "--workers", workers], time.perf_counter()
    run_python("-m", "curvafit", "atlas", "build", store, *options, OMP_NUM_THREADS="1")
    return {"shapes an hour": 3600 * count / (time.perf_counter() - begun)}


def rate(store: Path, name: str, edge: int, workers: int, pairs: int) -> Values:
    """Return pairs a second, the first batch of every worker left out."""
    torch.set_num_threads(1)
    imaging = modality(name)
    finest = min(imaging.base.spacing)
    size = [max(4, round(edge * finest / h)) for h in imaging.base.spacing]
    dataset = TextureDataset(store, imaging, size, length=pairs, voxel=finest, transform=as_dict)
    loader = DataLoader(dataset, batch_size=2, num_workers=workers, prefetch_factor=4 if workers else None)
    taken, begun = 0, time.perf_counter()
    for k, batch in enumerate(loader):
        if k == workers:
            taken, begun = 0, time.perf_counter()
        else:
            taken += len(batch["image"])
    return {"size": size, "pairs a second": taken / (time.perf_counter() - begun)}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--shapes", type=int, default=24)
    parser.add_argument("--edge", type=int, default=64)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--pairs", type=int, default=60)


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    edge, shapes = (32, 3) if options.quick else (options.edge, options.shapes)
    names, pairs = (MODALITIES[:1], 6) if options.quick else (MODALITIES, options.pairs)
    stores = {workers: cases.folder / f"store-{edge}-{shapes}-{workers}.zarr" for workers in (1, 2)}
    jobs = {f"build-{edge}-{shapes}-{n}": lambda n=n: building(stores[n], edge, shapes, n) for n in stores}
    built = cases.all(jobs)
    jobs = {
        f"pairs-{name}-{edge}-{options.workers}": lambda name=name: rate(stores[2], name, edge, options.workers, pairs)
        for name in names
    }
    found = cases.all(jobs)
    figures = {
        f"building.shapes_{n}": Figure(row["shapes an hour"]) for n, row in zip(stores, built.values(), strict=False)
    }
    show(["workers", "shapes an hour"], [[n, figure] for n, figure in zip(stores, figures.values(), strict=False)])
    show(["modality", "voxels", "pairs a second"], [[name, *row.values()] for name, row in found.items()])
    return figures | {f"synth.{name.split('-64')[0][6:]}": Figure(row["pairs a second"]) for name, row in found.items()}
