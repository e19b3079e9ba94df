"""From a scan to its parameters: prepare, measure, read the posterior, grow, compare, judge."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.inference.atlas import Atlas, Match, load_atlas, nearest, save_atlas
    from curvafit.inference.candidates import Candidate, Misfit
    from curvafit.inference.fit import Draws, Fit
    from curvafit.inference.infer import Inference, infer
    from curvafit.inference.posterior import Posterior, load_posterior, save_posterior
    from curvafit.inference.stationarity import Refinement, stationarity
    from curvafit.inference.table import Table, load_table, save_table
    from curvafit.inference.training import train_posterior
    from curvafit.scan.measure import scan_diagram
    from curvafit.scan.prepare import Prepared, prepare

__all__ = [
    "Atlas",
    "Candidate",
    "Draws",
    "Fit",
    "Inference",
    "Match",
    "Misfit",
    "Posterior",
    "Prepared",
    "Refinement",
    "Table",
    "infer",
    "load_atlas",
    "load_posterior",
    "load_table",
    "nearest",
    "prepare",
    "save_atlas",
    "save_posterior",
    "save_table",
    "scan_diagram",
    "stationarity",
    "train_posterior",
]

_HOMES = {
    "Atlas": "curvafit.inference.atlas",
    "Candidate": "curvafit.inference.candidates",
    "Draws": "curvafit.inference.fit",
    "Fit": "curvafit.inference.fit",
    "Inference": "curvafit.inference.infer",
    "Match": "curvafit.inference.atlas",
    "Misfit": "curvafit.inference.candidates",
    "Posterior": "curvafit.inference.posterior",
    "Prepared": "curvafit.scan.prepare",
    "Refinement": "curvafit.inference.stationarity",
    "Table": "curvafit.inference.table",
    "infer": "curvafit.inference.infer",
    "load_atlas": "curvafit.inference.atlas",
    "load_posterior": "curvafit.inference.posterior",
    "load_table": "curvafit.inference.table",
    "nearest": "curvafit.inference.atlas",
    "prepare": "curvafit.scan.prepare",
    "save_atlas": "curvafit.inference.atlas",
    "save_posterior": "curvafit.inference.posterior",
    "save_table": "curvafit.inference.table",
    "scan_diagram": "curvafit.scan.measure",
    "stationarity": "curvafit.inference.stationarity",
    "train_posterior": "curvafit.inference.training",
}

offer(__name__, _HOMES)
