"""A small store of exact periodic shapes, in turn layers, tubes, spheres and sponges; a recipe for cases of them."""

from pathlib import Path

import numpy as np

from curvafit.data_synth import Detector, Imaging, Modality, Optics, Store, design_box, open_store
from curvafit.data_synth.dataset import Recipe
from curvafit.data_synth.sources import Stored
from curvafit.data_synth.store import Record, Settings
from curvafit.generation.result import Viability
from curvafit.priors.coefficients import Coefficients

SHAPE = 24
EPSILON = 0.02
FAMILIES = ("layers", "tubes", "spheres", "sponge")
SETTINGS = Settings(
    (SHAPE,) * 3, (0.01,) * 3, EPSILON, 0.02, design_box("random").as_dict(), 3,
    {"name": "fast", "steps": 30, "start": 2e-2, "stop": 1e-4, "shape": "cosine", "momentum": 0.97, "memory": 0.97},
)  # fmt: skip


def exact_field(index: int) -> np.ndarray:
    """Shape number `index`, of family `FAMILIES[index % 4]`: sizes change slowly with the number."""
    size, kind = 0.035 + 0.0012 * index, index % 4
    z, y, x = np.meshgrid(*((np.arange(SHAPE) - SHAPE / 2 + 0.25) * 0.01,) * 3, indexing="ij")
    if kind == 3:
        k = 2 * np.pi / (SHAPE * 0.01)
        distance = sum(np.sin(k * a) * np.cos(k * b) for a, b in ((x, y), (y, z), (z, x))) / (1.5 * k) - 0.001 * index
    else:
        radius = np.sqrt(z**2 + (y**2 if kind > 0 else 0) + (x**2 if kind > 1 else 0))
        distance = size * (1 + 0.25 * kind) - radius
    return np.tanh(distance / (np.sqrt(2) * EPSILON)).astype(np.float32)


def exact_record(index: int, viable: bool = True) -> Record:
    """A record to go with it; its parameters are made up."""
    law = Coefficients(1.0, 0.1 * index - 1, 0.5 + index / 3, -40.0 + index, 12.5 - index, 400.125)
    told = Viability(0.1 if viable else 0.9, 0.95, -0.95, viable, "" if viable else "no second phase")
    return Record(index, law, -0.6 + index / 100, 10**9 + index, 30, told, 1.0, "done", {"torch": "2"}, 0.1)


def exact_store(path: Path, count: int, first: int = 0) -> Store:
    """A store with shapes `first` to `count`; draw 2 of every seven is not viable."""
    store = open_store(path, SETTINGS)
    for index in range(first, count):
        viable = index % 7 != 2
        store.write(exact_record(index, viable), exact_field(index) if viable else None)
    return store


#: A quiet kind of images, for quick cases of a training set.
SHARP = Imaging(spacing=(1.0, 0.5, 0.5), optics=Optics((0.4, 0.2, 0.2)), detector=Detector(ceiling=255.0))
FLAT = Modality("flat", "for tests", 0.5, SHARP, {"contrast.foreground": (80.0, 120.0), "noise.gaussian": (1.0, 3.0)})
CROP = (8, 16, 16)


def flat_recipe(path: Path) -> Recipe:
    """Images of one quiet kind of the shapes of a small exact store, which is made."""
    return Recipe(Stored((exact_store(path, 8).path,)), FLAT, CROP, 0.5, seed=4)
