"""A finished inference made by hand from exact shapes: a lattice of tubes as the scan, two more beside it."""

import json
from functools import lru_cache

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from curvafit.geometry.diagrams import Diagram, diagram
from curvafit.geometry.morphology import Morphometry
from curvafit.inference.atlas import Match
from curvafit.inference.candidates import Candidate, Misfit, Twin
from curvafit.inference.fit import Fit
from curvafit.inference.inference import Inference
from curvafit.inference.posterior import Combination
from curvafit.priors import Coefficients, Grid, preset
from curvafit.scan.preparation import Prepared
from curvafit.volumes.volume import Volume

EPSILON = 0.02
RADIUS = 5.0
SCALE = 0.0195


def lattice(n: int, period: float, radius: float) -> np.ndarray:
    """Tubes along the three axes, `radius` and `period` in voxels, profiled as a phase field `(n, n, n)`."""
    offset = (np.arange(n) + 0.5) % period - period / 2
    squared = [(offset**2).reshape([-1 if k == axis else 1 for k in range(3)]) for axis in range(3)]
    distances = [np.sqrt(squared[(k + 1) % 3] + squared[(k + 2) % 3]) for k in range(3)]
    nearest = np.minimum(np.minimum(*np.broadcast_arrays(*distances[:2])), distances[2])
    return np.tanh(0.01 * (radius - nearest) / (np.sqrt(2) * EPSILON)).astype(np.float32)


def measured(phase: np.ndarray) -> Diagram:
    return diagram(torch.from_numpy(phase), Grid(phase.shape, 0.01, "replicate"), EPSILON)


@lru_cache
def made_inference(
    n: int = 48, *, chosen: str | None = "posterior", lost: bool = False, source: str = "tubes <b>&.tif"
) -> Inference:
    """The inference; with `lost`, nothing grew from the middle of the posterior."""
    phase, matched, regrown = lattice(n, 24, RADIUS), lattice(n, 16, 4.5), lattice(n, 24, 5.5)
    noise = np.random.default_rng(0).normal(0, 12, phase.shape)
    grey = np.clip(110 + 60 * phase + noise, 0, 255).astype(np.uint8)
    grid = Grid(phase.shape, 0.01, "replicate")
    whole = (slice(0, n), slice(0, n), slice(0, n))
    prepared = Prepared("image", phase, phase > 0, grid, (1.0,) * 3, SCALE, "mm", 2 * RADIUS, whole, ("Split at 110.",))
    barren = Twin(None, -0.58, None, None, "the field is of one phase")
    twins = {"posterior": (barren,) if lost else (twin_of(regrown),) * 2, "match": (twin_of(matched),)}
    scan, fit = Volume(grey, (SCALE,) * 3, "mm", source=source), made_fit("match" if lost else chosen, lost)
    return Inference(scan=scan, prepared=prepared, diagram=measured(phase), twins=twins, fit=fit)


def twin_of(phase: np.ndarray) -> Twin:
    return Twin(phase, -0.58, measured(phase), NUMBERS)


NUMBERS = Morphometry(0.187, 0.195, 0.03, 0.45, 4.9, -12, 21.4, "mm")


def made_fit(chosen: str | None = "posterior", lost: bool = False) -> Fit:
    near = preset("tubes")
    other = Coefficients(1, 1.8, 5.2, -38.5, -41, 433)
    rng = np.random.default_rng(1)
    middle = np.array([1.8, np.log(5.2), -38.5, -41, 433, -0.58, np.log(8)])
    rows = middle + rng.normal(size=(60, 7)) * [0.4, 0.2, 6, 9, 51, 0.02, 0.1]
    matches = tuple(Match(f"0-{k:05d}", 2.1 + 0.4 * k, near.coefficients, -0.6 + 0.02 * k, 40 + k) for k in range(5))
    own = {"a20": 0.0, "a11": 0.4, "a02": 0.9, "a10": 6.0, "a01": 9.0, "a00": 51.0, "mass": 0.02}
    grown = (8.0, None, None, ()) if lost else (8.0, 1.6, 1.1, (NUMBERS, NUMBERS))
    candidates = (
        Candidate("posterior", other, -0.58, own, *grown, status="No shape grew: one phase." if lost else ""),
        Candidate("match", near.coefficients, near.mass, {}, 8.0, 2.2, None, (NUMBERS,)),
    )
    return Fit(
        kind="image",
        family="tubes",
        diagram=None,
        candidates=candidates if chosen else (),
        chosen=chosen,
        draws=rows if chosen else None,
        view="scan" if chosen else "",
        combinations=(
            Combination("flat", "round", {"a11": 0.1, "log a02": 0.8}, 1.2, (1.0, 1.4), 0.98),
            Combination("sparse", "full", {"a11": 0.9, "log a02": 0.1}, 0.1, (-1.5, 1.6), 0.02),
        ),
        misfit=Misfit(0.4, 0.3, 0.2),
        scale=(1.0, 1.0, 1.0),
        working_voxel=SCALE,
        length_unit="mm",
        thickness=8 * SCALE,
        matches=matches,
        status="Supported: 1.6 < 2.2 & so on.",
        morphometry=NUMBERS,
        notes=("Smoothed by one voxel, split at Otsu's threshold 110.", "Specks < 5 voxels were dropped."),
        provenance={"curvafit": "0.1.0", "scan": "tubes <b>&.tif", "seed": 0, "date": "2025-01-01T00:00:00+00:00"},
    )


def without_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports with empty pictures, where their text is what matters. What cannot be drawn is still refused."""
    from curvafit.drawing import plot
    from curvafit.report import page

    def blank(u: np.ndarray) -> Figure:
        if not np.isfinite(u).all():
            raise ValueError("expected a finite volume to draw, got NaN or infinite values")
        return Figure()

    monkeypatch.setattr(plot, "surface_figure", blank)
    monkeypatch.setattr(page, "png", lambda figure: b"\x89PNG")


#: What a reader of all of a `fit.json` refuses: where, and the JSON that stands there, or nothing.
BROKEN = [
    (where, text)
    for where, texts in {
        "thickness": ("0", '"0.02"', "true", None), "working_voxel": ("-1", "[0.01]"),
        "length_unit": ('"furlong"', "[]"), "morphometry": ("7",), "morphometry.volume_fraction": ("2",),
        "kind": ("3",), "family": ("{}",), "matches": ("{}", "[7]"), "provenance": ("5",),
        "draws": ("7", "[[true]]", '[["1"]]'), "diagram": ("7", '{"points": 3, "weights": [1]}'),
    }.items()
    for text in texts
]  # fmt: skip


def broken(where: str, text: str | None) -> str:
    """The text of a `fit.json` in which other JSON stands in one place, or nothing."""
    content = json.loads(made_fit().to_json())
    *path, name = where.split(".")
    inner = content
    for key in path:
        inner = inner[key]
    inner[name] = "\0"
    if text is None:
        del inner[name]
    return json.dumps(content).replace('"\\u0000"', text or "")
