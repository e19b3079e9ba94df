"""A finished inference made by hand from exact shapes: a lattice of tubes as the scan, two more beside it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from curvafit.geometry.diagram import Diagram, diagram
from curvafit.geometry.morphometry import Morphometry
from curvafit.inference.fit import Fit
from curvafit.inference.infer import Inference
from curvafit.inference.match import Match
from curvafit.inference.prepare import Prepared
from curvafit.priors import Coefficients, Grid, preset
from curvafit.volumes.scan import Field

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
    n: int = 48, *, chosen: str = "fit", lost: bool = False, source: str = "tubes <b>&.tif"
) -> Inference:
    """The inference; with `lost`, nothing grew from the refined parameters."""
    phase, matched, regenerated = lattice(n, 24, RADIUS), lattice(n, 16, 4.5), lattice(n, 24, 5.5)
    noise = np.random.default_rng(0).normal(0, 12, phase.shape)
    grey = np.clip(110 + 60 * phase + noise, 0, 255).astype(np.uint8)
    grid = Grid(phase.shape, 0.01, "replicate")
    whole = (slice(0, n), slice(0, n), slice(0, n))
    prepared = Prepared(
        "image", phase, phase > 0, grid, (1.0,) * 3, SCALE, "mm", 110.0, 2 * RADIUS, (whole,), ("Split at 110.",)
    )
    diagrams = [measured(u) for u in (phase, matched, regenerated)]
    return Inference(
        scan=Field(grey, (SCALE,) * 3, "mm", source=source),
        prepared=prepared,
        diagram=diagrams[0],
        match_diagram=diagrams[1],
        fit_diagram=None if lost else diagrams[2],
        matched=matched,
        regenerated=None if lost else regenerated,
        fit=made_fit("match" if lost else chosen, lost),
    )


def made_fit(chosen: str = "fit", lost: bool = False) -> Fit:
    near = preset("tubes")
    other = Coefficients(1, 1.8, 5.2, -38.5, -41, 433)
    matches = tuple(Match(f"0-{k:05d}", 2.1 + 0.4 * k, near.coefficients, -0.6 + 0.02 * k, 40 + k) for k in range(5))
    return Fit(
        kind="image",
        family="tubes",
        coefficients=other if chosen == "fit" else near.coefficients,
        mass=-0.58 if chosen == "fit" else near.mass,
        chosen=chosen,
        uncertainty={"a20": 0.0, "a11": 0.4, "a02": 0.9, "a10": 6.0, "a01": 9.0, "a00": 51.0},
        scale=(1.0, 1.0, 1.0),
        working_voxel=SCALE,
        length_unit="mm",
        matches=matches,
        refined={"method": "fixed point of a short flow", "coefficients": other.as_dict(), "mass": -0.58},
        distances={"match": 2.2, "fit": None if lost else 1.6, "seed_noise": 1.1},
        status="The refined parameters are supported (within seed noise): 1.6 < 2.2 & so on.",
        morphometry=Morphometry(0.187, 0.195, 0.03, 0.45, 4.9, -12, 21.4, "mm"),
        notes=("Smoothed by one voxel, split at Otsu's threshold 110.", "Specks < 5 voxels were dropped."),
        provenance={"curvafit": "0.1.0", "scan": "tubes <b>&.tif", "seed": 0, "date": "2025-01-01T00:00:00+00:00"},
    )


def without_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports with empty pictures, where their text is what matters. What cannot be drawn is still refused."""
    import curvafit.report.pictures as pictures

    def blank(u: np.ndarray) -> Figure:
        if not np.isfinite(u).all():
            raise ValueError("expected a finite volume to draw, got NaN or infinite values")
        return Figure()

    monkeypatch.setattr(pictures, "surface_figure", blank)
    monkeypatch.setattr(pictures, "png", lambda figure: b"\x89PNG")
