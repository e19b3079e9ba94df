"""Training pairs a second from a store of shapes, and where the time goes.

    python -m benchmarks.synth [--store STORE] [--shapes 100] [--edge 64] [--workers 2] [--pairs 200]

A `DataLoader` with workers of one thread each takes pairs of batches of two from a `TextureDataset`: images of `--edge`
voxels, cubic where the modality's are, else with fewer slices so that a crop stays within the stored shapes. One voxel
of a shape is one of the image. Then one process takes some pairs with a clock around every stage. The store is
made where none is named (10 minutes for 100 shapes at 64³ on two cores).
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch.utils.data import DataLoader

from curvafit.data_synth import build, cluster
from curvafit.data_synth.imaging import degrade
from curvafit.data_synth.imaging.modalities import MODALITIES
from curvafit.data_synth.imaging.modality import Modality
from curvafit.data_synth.sets import case as case_module
from curvafit.data_synth.sets.sources import Stored
from curvafit.data_synth.sets.training import TextureDataset, as_dict

#: What is timed in one process: names in `degrade`, and the stage that each belongs to.
STAGES = {
    "occupancy": "partial volume",
    "texture": "texture",
    "dropout": "drop-out",
    "clutter": "clutter",
    "blur": "blur",
    "blur_with_depth": "blur",
    "sample": "sampling",
    "bias": "bias",
    "stripes": "stripes",
    "rings": "rings",
    "poisson_gaussian": "noise",
    "rician": "noise",
    "digitised": "digitising",
}
TIMED = 40


def pairs_of(store: Path, modality: Modality, edge: int, length: int) -> TextureDataset:
    finest = min(modality.base.spacing)
    shape = [round(edge * finest / h) for h in modality.base.spacing]
    return TextureDataset(store, modality, shape, length=length, voxel=finest, transform=as_dict)


def rate(dataset: TextureDataset, workers: int) -> tuple[float, float]:
    """Pairs a second, the first batch of every worker left out; and seconds until then."""
    loader = DataLoader(dataset, batch_size=2, num_workers=workers, prefetch_factor=4 if workers else None)
    begun, taken, first = time.perf_counter(), 0, 0.0
    for k, batch in enumerate(loader):
        if k == workers:
            first = time.perf_counter()
        taken += len(batch["image"]) * (k > workers)
    return taken / (time.perf_counter() - first), first - begun


@contextmanager
def clocks(spent: Counter[str]) -> Iterator[None]:
    """Every stage's function under a clock."""

    def timed(function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        def run(*arguments: Any, **options: Any) -> Any:
            begun = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                spent[stage] += time.perf_counter() - begun  # type: ignore[assignment]

        return run

    swaps = [patch.object(degrade, name, timed(getattr(degrade, name), stage)) for name, stage in STAGES.items()]
    swaps.append(patch.object(Stored, "shape", timed(Stored.shape, "read, turn, crop")))
    swaps.append(patch.object(case_module, "regrid", timed(case_module.regrid, "label")))
    for swap in swaps:
        swap.start()
    try:
        yield
    finally:
        for swap in swaps:
            swap.stop()


def shares(dataset: TextureDataset) -> tuple[float, Counter[str]]:
    """Milliseconds a pair, and those of each stage; `label` holds the sampling of fields, not of images."""
    spent: Counter[str] = Counter()
    dataset[0]
    with clocks(spent):
        begun = time.perf_counter()
        for number in range(1, TIMED + 1):
            dataset[number]
        total = time.perf_counter() - begun
    spent["sampling"] -= spent["label"]
    return 1e3 * total / TIMED, Counter({stage: 1e3 * seconds / TIMED for stage, seconds in spent.items()})  # type: ignore[misc]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, default=Path("synth-store.zarr"))
    parser.add_argument("--shapes", type=int, default=100)
    parser.add_argument("--edge", type=int, default=64)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--pairs", type=int, default=200)
    options = parser.parse_args()
    if not options.store.exists():
        with cluster() as crew:
            build(options.store, options.shapes, options.edge, workers=crew)
    torch.set_num_threads(1)
    print(f"pairs from {options.store.name}, {options.workers} workers of one thread")
    print(
        f"{'modality':>14} {'voxels':>14} {'pairs/s':>8} {'start s':>8} {'ms a pair, one process; share by stage':>40}"
    )
    for name, modality in MODALITIES.items():
        dataset = pairs_of(options.store, modality, options.edge, options.pairs)
        speed, start = rate(dataset, options.workers)
        total, spent = shares(dataset)
        told = ", ".join(f"{stage} {ms / total:.0%}" for stage, ms in spent.most_common())
        voxels = " x ".join(map(str, dataset.size))
        rest = 1 - sum(spent.values()) / total
        print(f"{name:>14} {voxels:>14} {speed:8.1f} {start:8.1f} {total:10.1f}; {told}, rest {rest:.0%}", flush=True)


if __name__ == "__main__":
    main()
