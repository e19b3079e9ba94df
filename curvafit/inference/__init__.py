"""From a scan to its parameters: prepare, measure, read the posterior, grow, compare, judge."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.inference.atlas import Atlas as Atlas
    from curvafit.inference.atlas import Match as Match
    from curvafit.inference.atlas import load_atlas as load_atlas
    from curvafit.inference.atlas import nearest as nearest
    from curvafit.inference.atlas import save_atlas as save_atlas
    from curvafit.inference.candidates import Candidate as Candidate
    from curvafit.inference.candidates import Misfit as Misfit
    from curvafit.inference.fit import Fit as Fit
    from curvafit.inference.infer import Inference as Inference
    from curvafit.inference.infer import infer as infer
    from curvafit.inference.posterior import Posterior as Posterior
    from curvafit.inference.posterior import load_posterior as load_posterior
    from curvafit.inference.posterior import save_posterior as save_posterior
    from curvafit.inference.stationarity import stationarity as stationarity
    from curvafit.inference.table import Table as Table
    from curvafit.inference.table import load_table as load_table
    from curvafit.inference.table import save_table as save_table
    from curvafit.inference.training import train_posterior as train_posterior
    from curvafit.scan.measure import scan_diagram as scan_diagram
    from curvafit.scan.prepare import Prepared as Prepared
    from curvafit.scan.prepare import prepare as prepare

attach_lazy_names(__name__)
