"""Plain interpolations of the volume between known slices, ITK's among them, scores of a volume, and its picture."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from curvafit.core.files import write_atomically, write_content
from curvafit.geometry.topology import betti_numbers
from curvafit.segmentation.slices import WAYS, Slices

#: ITK's morphological contour interpolation (Albu, Beugeling, Laurendeau 2008; Zukić et al. 2016).
ITK = "ITK"


def baselines() -> tuple[str, ...]:
    """The plain interpolations; ITK's where its package is installed, or a sentence on what to install."""
    if find_spec("itk") is not None:
        return (*WAYS, ITK)
    print("no ITK: install itk-morphologicalcontourinterpolation, or the extra 'bench'")
    return WAYS


def interpolated(slices: Slices, way: str) -> np.ndarray:
    """The mask of a plain interpolation."""
    return _by_itk(slices) if way == ITK else slices.level(way) > 0


def _by_itk(slices: Slices) -> np.ndarray:
    """ITK's mask between the first and the last known slice, none beyond; it does not go around."""
    import itk

    labels = np.zeros((slices.length, *slices.inside.shape[1:]), dtype=np.uint8)
    labels[list(slices.places)] = slices.inside
    interpolator = itk.MorphologicalContourInterpolator.New(itk.image_from_array(labels))  # type: ignore[attr-defined]
    interpolator.SetAxis(2)  # ITK counts axes from the last
    interpolator.Update()
    mask = itk.array_from_image(interpolator.GetOutput()) > 0
    mask[list(slices.places)] = slices.inside
    return mask


def scores(mask: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Dice, and the sum of the Betti numbers' errors."""
    pairs = zip(betti_numbers(mask), betti_numbers(truth), strict=True)
    dice = 2 * float((mask & truth).sum()) / float(mask.sum() + truth.sum())
    return {"dice": dice, "betti": float(sum(abs(a - b) for a, b in pairs))}


def stored(path: Path, make: Callable[[], dict]) -> dict:
    """What a file holds, made once."""
    if not path.exists():
        write_content(path, json.dumps(make()))
    return json.loads(path.read_text())


def draw(truth: np.ndarray, masks: Mapping[str, np.ndarray], every: int, path: Path) -> None:
    """Draw three of the fullest slices half way between known ones: the truth, and each way's outline over it.

    Arrays are (slices, Y, X).
    """
    middles = [n + every // 2 for n in range(0, len(truth) - every, every)]
    chosen = sorted(sorted(middles, key=lambda n: -int(truth[n].sum()))[:3])
    figure = Figure(figsize=(3 * len(chosen), 3 * len(masks)), layout="constrained")
    FigureCanvasAgg(figure)
    for row, (way, mask) in enumerate(masks.items()):
        for column, n in enumerate(chosen):
            axes = figure.add_subplot(len(masks), len(chosen), row * len(chosen) + column + 1)
            axes.imshow(truth[n], cmap="gray_r", interpolation="nearest", vmax=3)
            axes.contour(mask[n], [0.5], colors="tab:orange", linewidths=1.6)
            axes.set(title=f"{way}, slice {n}", xticks=[], yticks=[])
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=110))
