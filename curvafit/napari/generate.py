"""The widget that grows a texture, and the plugin's sample: tubes in noise, of which every 8th slice is annotated."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from magicgui.widgets import ComboBox, FloatSpinBox, SpinBox
from scipy import ndimage

from curvafit.core.runtime import Progress
from curvafit.core.units import METRES
from curvafit.generation.flow import generate
from curvafit.generation.result import Flow, Watch
from curvafit.generation.schedule import schedule
from curvafit.napari.dock import Dock
from curvafit.napari.layers import place_of_field, put_layer
from curvafit.priors.law import PRESETS
from curvafit.volumes.volume import Volume


class Generate(Dock):
    """Grow a shape of a published texture, as labels."""

    def __init__(self, napari_viewer: Any) -> None:
        self.preset = ComboBox(label="texture", choices=sorted(PRESETS), value="tubes")
        self.edge = SpinBox(label="voxels a side", value=64, min=24, max=512)
        self.seed = SpinBox(label="seed", value=0, min=0, max=2**31 - 1)
        self.steps = SpinBox(label="steps", value=1000, min=1, max=20000, tooltip="More give a smoother shape.")
        self.spacing = FloatSpinBox(label="voxel edge", value=1.0, min=1e-6, max=1e6, step=0.1)
        self.unit = ComboBox(label="unit", choices=["voxel", *METRES], value="voxel")
        choices = [self.preset, self.edge, self.seed, self.steps, self.spacing, self.unit]
        super().__init__(napari_viewer, choices, "Grow")

    def prepare(self) -> Callable[[Progress], Flow]:
        """Read the choices."""
        options = {"grid": self.edge.value, "seed": self.seed.value, "schedule": schedule("fast", self.steps.value)}
        return partial(_grow, self.preset.value, options)

    def show_result(self, result: Flow) -> str:
        """Add the shape."""
        edge = 1.0 if self.unit.value == "voxel" else self.spacing.value
        shape = Volume((result.field.numpy() > 0).astype(np.uint8), (edge, edge, edge), self.unit.value)
        name = f"{self.preset.value}, seed {self.seed.value}"
        put_layer(self.viewer, "labels", shape.values, name, **place_of_field(shape))
        return f"{result.status}."


def _grow(law: str, options: dict[str, Any], progress: Progress) -> Flow:
    return generate(law, watch=Watch(callbacks=[lambda step, total, _: progress("growing", step / total)]), **options)


def annotated_tubes() -> list[tuple[Any, dict[str, Any], str]]:
    """Return layers: an image of grown tubes in noise, every 8th slice of them as labels, and all of them, hidden."""
    tubes = generate("tubes", grid=(65, 80, 80), seed=0, schedule=schedule("fast", 400)).field.numpy() > 0
    noise = np.random.default_rng(0).standard_normal(tubes.shape)
    image = (100 + 60 * ndimage.gaussian_filter(tubes.astype(np.float32), 1.0) + 12 * noise).clip(0, 255)
    some = np.zeros(tubes.shape, np.uint8)
    some[::8] = tubes[::8]
    place = {"scale": (0.5, 0.5, 0.5), "units": ("micrometer",) * 3}
    return [
        (image.astype(np.uint8), {"name": "tubes", **place}, "image"),
        (some, {"name": "every 8th slice", **place}, "labels"),
        (tubes.astype(np.uint8), {"name": "all of them", "visible": False, **place}, "labels"),
    ]
