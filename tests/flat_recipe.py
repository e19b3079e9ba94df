"""A recipe for quick cases of a training set."""

from pathlib import Path

from exact_store import exact_store

from curvafit.data_synth.case import Recipe
from curvafit.data_synth.imaging.modality import Detector, Imaging, Modality, Optics
from curvafit.data_synth.sources import Stored

FLAT = Modality(
    "flat",
    "for tests",
    0.5,
    Imaging(spacing=(1.0, 0.5, 0.5), optics=Optics((0.4, 0.2, 0.2)), detector=Detector(ceiling=255.0)),
    {"contrast.foreground": (80.0, 120.0), "noise.gaussian": (1.0, 3.0)},
)
SHAPE = (8, 16, 16)


def flat_recipe(path: Path) -> Recipe:
    """Images of one quiet kind of the shapes of a small exact store, which is made."""
    return Recipe(Stored((exact_store(path, 8).path,)), FLAT, SHAPE, 0.5, seed=4)
