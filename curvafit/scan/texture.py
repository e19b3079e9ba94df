"""Whether a scan shows a texture at all: noise, a single body and a flat surface are none."""

from __future__ import annotations

import numpy as np

from curvafit.geometry.diagram import Diagram
from curvafit.geometry.topology import betti_numbers
from curvafit.scan.prepare import Prepared

#: Least mean of √(κ1² + κ2²) times the window's edge at which a surface is not flat; a ball that fits has 2.8.
FLATTEST = 2.0
NOISE = "No law: the scan is noise, its voxels have nothing to do with those a few voxels away."


def untextured(prepared: Prepared, diagram: Diagram) -> str:
    """Return why a scan shows no texture whose law could be read, as a sentence; empty where it may."""
    edge = max(s.stop - s.start for s in prepared.windows[0]) * prepared.grid.spacing[0]
    bend = np.average(np.hypot(*np.asarray(diagram.points).T), weights=np.asarray(diagram.weights)) * edge
    if bend < FLATTEST:
        return "No law: the surface is flat, and a flat surface says nothing of how it would bend."
    if is_ball(prepared.mask) or is_ball(~prepared.mask):
        return "No law: the scan shows a single ball-like body, and a texture is many alike."
    return ""


def is_ball(mask: np.ndarray) -> bool:
    """Return whether a structure is one body, away from the box's faces, without handles or cavities."""
    faces = (mask.take(end, axis) for axis in range(3) for end in (0, -1))
    return not any(face.any() for face in faces) and betti_numbers(mask) == (1, 0, 0)
