"""The score: what a phase field costs. Needs torch and numpy only."""

if __name__ != "curvafit.priors":
    raise ImportError("import curvafit.priors, not priors: the folder at the project's root is a link into the package")

from curvafit.priors.coefficients import PRESETS, Coefficients, Preset, preset
from curvafit.priors.curvature import diffuse_curvatures, geometric_curvatures, jet
from curvafit.priors.energy import cahn_hilliard_area, discrepancy_ratio, energy, energy_terms, orientation
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Grid
from curvafit.priors.profile import SIGMA, optimal_profile, phase_field, profile_distance, signed_distance

__all__ = [
    "PRESETS",
    "SIGMA",
    "WORKING_EPSILON",
    "WORKING_SPACING",
    "Coefficients",
    "Grid",
    "Preset",
    "cahn_hilliard_area",
    "diffuse_curvatures",
    "discrepancy_ratio",
    "energy",
    "energy_terms",
    "geometric_curvatures",
    "jet",
    "optimal_profile",
    "orientation",
    "phase_field",
    "preset",
    "profile_distance",
    "signed_distance",
]
