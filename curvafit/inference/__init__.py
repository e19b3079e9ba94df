"""From a scan to its parameters: prepare, measure, match, refine, judge."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.faces import offer

if TYPE_CHECKING:
    from curvafit.inference.atlas import Atlas, load_atlas, save_atlas
    from curvafit.inference.fit import Fit
    from curvafit.inference.fixed_point import fixed_point
    from curvafit.inference.infer import Inference, infer
    from curvafit.inference.match import Match, nearest
    from curvafit.inference.measure import scan_diagram
    from curvafit.inference.prepare import Prepared, prepare
    from curvafit.inference.refine import refine
    from curvafit.inference.refinement import Refinement
    from curvafit.inference.stationarity import stationarity

__all__ = [
    "Atlas",
    "Fit",
    "Inference",
    "Match",
    "Prepared",
    "Refinement",
    "fixed_point",
    "infer",
    "load_atlas",
    "nearest",
    "prepare",
    "refine",
    "save_atlas",
    "scan_diagram",
    "stationarity",
]

_HOMES = {
    "Atlas": "curvafit.inference.atlas",
    "Fit": "curvafit.inference.fit",
    "Inference": "curvafit.inference.infer",
    "Match": "curvafit.inference.match",
    "Prepared": "curvafit.inference.prepare",
    "Refinement": "curvafit.inference.refinement",
    "fixed_point": "curvafit.inference.fixed_point",
    "infer": "curvafit.inference.infer",
    "load_atlas": "curvafit.inference.atlas",
    "nearest": "curvafit.inference.match",
    "prepare": "curvafit.inference.prepare",
    "refine": "curvafit.inference.refine",
    "save_atlas": "curvafit.inference.atlas",
    "scan_diagram": "curvafit.inference.measure",
    "stationarity": "curvafit.inference.stationarity",
}

offer(__name__, _HOMES)
