"""Priors: the energy of a phase field, laws and the training loss. The folder needs torch and numpy only."""

if __name__ != "curvafit.priors":
    raise ImportError("import curvafit.priors, not priors: the folder at the project's root is a link into the package")

from curvafit.priors.coefficients import Coefficients
from curvafit.priors.curvature import diffuse_curvatures, geometric_curvatures, jet
from curvafit.priors.energy import (
    cahn_hilliard_area,
    discrepancy_ratio,
    energy,
    energy_gradient,
    energy_terms,
    orientation,
)
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Grid
from curvafit.priors.law import PRESETS, Law, LawLike, preset, read_laws
from curvafit.priors.loss import CombinedLoss, CurvaturePrior, curvature_prior
from curvafit.priors.profile import SIGMA, optimal_profile, phase_field, profile_distance, signed_distance

__all__ = [
    "PRESETS",
    "SIGMA",
    "WORKING_EPSILON",
    "WORKING_SPACING",
    "Coefficients",
    "CombinedLoss",
    "CurvaturePrior",
    "Grid",
    "Law",
    "LawLike",
    "cahn_hilliard_area",
    "curvature_prior",
    "diffuse_curvatures",
    "discrepancy_ratio",
    "energy",
    "energy_gradient",
    "energy_terms",
    "geometric_curvatures",
    "jet",
    "optimal_profile",
    "orientation",
    "phase_field",
    "preset",
    "profile_distance",
    "read_laws",
    "signed_distance",
]
