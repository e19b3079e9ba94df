"""Small grown shapes that many tests share: each is grown once and kept under the hash of what makes it."""

import hashlib
import os
import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from curvafit.generation.flow import generate
from curvafit.generation.schedule import schedule
from curvafit.priors import Grid, preset

ROOT = Path(__file__).resolve().parents[1]
CACHE = ROOT / ".pytest_cache" / "shapes"
#: The shared shapes: preset, edge in voxels, seed. Periodic boxes; steps as in `STEPS`.
SHAPES = (
    ("tubes", 32, 0), ("tubes", 48, 1), ("sponge", 32, 0), ("sponge", 48, 1), ("trabec", 48, 0), ("pearls", 32, 0),
)  # fmt: skip
STEPS = 600


@lru_cache
def grown(name: str, edge: int, seed: int = 0) -> torch.Tensor:
    """The phase field of a shape of `SHAPES`, float32 `(edge, edge, edge)`, spacing 0.01, ε = 0.02.

    Do not write into it: tests of one process share it. On another processor it is another shape of the same law.
    """
    assert (name, edge, seed) in SHAPES, "one more shape costs every run: take one of SHAPES, or add it there"
    path = CACHE / f"{_digest(name, edge, seed)}.npy"
    if not path.is_file():
        law = preset(name)
        plan = schedule("fast", steps=STEPS)
        flow = generate(law.coefficients, law.mass, Grid((edge, edge, edge)), seed=seed, schedule=plan)
        assert flow.viability.viable, flow.status
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, partial = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            np.save(file, flow.field.numpy())
        os.replace(partial, path)
    return torch.from_numpy(np.load(path))


def _digest(*key: object) -> str:
    """The hash of a shape's parameters and of the sources that grow it."""
    found = hashlib.sha256(repr((*key, STEPS)).encode())
    for room in ("priors", "generation"):
        for source in sorted((ROOT / "curvafit" / room).rglob("*.py")):
            found.update(source.read_bytes())
    return found.hexdigest()[:24]
