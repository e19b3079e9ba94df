"""From a scan to its parameters: prepare, measure, read the posterior, grow, compare, judge."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.inference.atlas import Atlas, load_atlas, save_atlas
    from curvafit.inference.candidates import Candidate
    from curvafit.inference.draws import Draws
    from curvafit.inference.fit import Fit
    from curvafit.inference.fixed_point import fixed_point
    from curvafit.inference.infer import Inference, infer
    from curvafit.inference.match import Match, nearest
    from curvafit.inference.measure import scan_diagram
    from curvafit.inference.misfit import Misfit
    from curvafit.inference.posterior import Posterior, load_posterior, save_posterior
    from curvafit.inference.posterior_training import train_posterior
    from curvafit.inference.refinement import Refinement
    from curvafit.inference.stationarity import stationarity
    from curvafit.inference.table import Table, load_table, save_table
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
    "fixed_point",
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
    "Draws": "curvafit.inference.draws",
    "Fit": "curvafit.inference.fit",
    "Inference": "curvafit.inference.infer",
    "Match": "curvafit.inference.match",
    "Misfit": "curvafit.inference.misfit",
    "Posterior": "curvafit.inference.posterior",
    "Prepared": "curvafit.scan.prepare",
    "Refinement": "curvafit.inference.refinement",
    "Table": "curvafit.inference.table",
    "fixed_point": "curvafit.inference.fixed_point",
    "infer": "curvafit.inference.infer",
    "load_atlas": "curvafit.inference.atlas",
    "load_posterior": "curvafit.inference.posterior",
    "load_table": "curvafit.inference.table",
    "nearest": "curvafit.inference.match",
    "prepare": "curvafit.scan.prepare",
    "save_atlas": "curvafit.inference.atlas",
    "save_posterior": "curvafit.inference.posterior",
    "save_table": "curvafit.inference.table",
    "scan_diagram": "curvafit.inference.measure",
    "stationarity": "curvafit.inference.stationarity",
    "train_posterior": "curvafit.inference.posterior_training",
}

offer(__name__, _HOMES)
