"""Epochs of a pool's shapes in a `DataLoader`: `python tests/pool_run.py METHOD WORKERS PERSISTENT LOG`.

Each growth adds a line to the log. Prints the samples of two epochs, the pool's room, and whether it was there.
"""

import dataclasses
import hashlib
import json
import os
import signal
import sys
import time
from dataclasses import dataclass

import numpy as np
from torch.utils.data import DataLoader

from curvafit.data_synth.dataset import Sample, TextureDataset
from curvafit.data_synth.imaging.modality import Imaging, Modality
from curvafit.data_synth.sources import PhaseField, Pool

SHAPES = 4


@dataclass(frozen=True)
class Balls:
    """Grows balls, slowly enough that workers meet, and notes each; of number 13 none grows."""

    log: str
    names = ("balls",)

    def shape(self, voxels: tuple[int, ...], index: int, rng: np.random.Generator) -> PhaseField:
        with open(self.log, "a") as log:
            log.write(f"{index} {os.getpid()}\n")
        time.sleep(0.2)
        if index == 13:
            raise ValueError("balls grew from none of 8 seeds")
        place = np.stack(np.meshgrid(*map(np.arange, voxels), indexing="ij"))
        values = np.cos(2 * np.pi * place / voxels[0]).sum(0) + rng.normal()
        return PhaseField(values.astype(np.float32), 2.0, {"name": "balls", "parameters": {"a20": 0.1 + 0.2}})


def balls(log: str, **options) -> TextureDataset:
    """A set of training pairs from slow balls."""
    kind = Modality("quiet", "for tests", 1.0, Imaging())
    pairs = TextureDataset("tubes", kind, 12, shapes=SHAPES, transform=brief, **options)
    assert isinstance(pairs.source, Pool)
    pairs.source = dataclasses.replace(pairs.source, generated=Balls(log))  # type: ignore[arg-type]
    return pairs


def brief(sample: Sample) -> str:
    voxels = hashlib.sha256(sample.image.numpy().tobytes()).hexdigest()
    return f"{sample.record['number']} {voxels} {sample.record['source']}"


def main(method: str, workers: str, persistent: str, log: str) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's jobs in the background ignore it
    pairs, found = balls(log, length=12), []
    how = {"multiprocessing_context": method, "persistent_workers": bool(int(persistent))}
    loader = DataLoader(pairs, None, num_workers=int(workers), **how)
    for epoch in range(2):
        pairs.set_epoch(epoch)
        found += list(loader)
    assert isinstance(pairs.source, Pool)
    print(json.dumps({"samples": sorted(found), "room": str(pairs.source.room), "there": pairs.source.room.is_dir()}))


if __name__ == "__main__":
    main(*sys.argv[1:])
