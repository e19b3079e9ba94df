"""Priors: the energy of a phase field, laws and the training loss. The folder needs torch and numpy only."""

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.priors.coefficients import Coefficients as Coefficients
    from curvafit.priors.curvature import diffuse_curvatures as diffuse_curvatures
    from curvafit.priors.curvature import geometric_curvatures as geometric_curvatures
    from curvafit.priors.curvature import jet as jet
    from curvafit.priors.energy import cahn_hilliard_area as cahn_hilliard_area
    from curvafit.priors.energy import discrepancy_ratio as discrepancy_ratio
    from curvafit.priors.energy import energy as energy
    from curvafit.priors.energy import energy_gradient as energy_gradient
    from curvafit.priors.energy import energy_terms as energy_terms
    from curvafit.priors.energy import orientation as orientation
    from curvafit.priors.grid import WORKING_EPSILON as WORKING_EPSILON
    from curvafit.priors.grid import WORKING_SPACING as WORKING_SPACING
    from curvafit.priors.grid import Grid as Grid
    from curvafit.priors.law import PRESETS as PRESETS
    from curvafit.priors.law import Law as Law
    from curvafit.priors.law import LawLike as LawLike
    from curvafit.priors.law import preset as preset
    from curvafit.priors.law import read_laws as read_laws
    from curvafit.priors.loss import CombinedLoss as CombinedLoss
    from curvafit.priors.loss import CurvaturePrior as CurvaturePrior
    from curvafit.priors.loss import curvature_prior as curvature_prior
    from curvafit.priors.profile import SIGMA as SIGMA
    from curvafit.priors.profile import optimal_profile as optimal_profile
    from curvafit.priors.profile import phase_field as phase_field
    from curvafit.priors.profile import profile_distance as profile_distance
    from curvafit.priors.profile import signed_distance as signed_distance

attach_lazy_names(__name__)
