"""The mass that gives a wanted share of volume inside, found while the flow runs."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from curvafit.priors.bounds import inside

#: Mass is corrected from this part of the steps on: before, u's sign tells little of a shape's volume.
BEGIN = 0.2
#: Part of what is missing that one correction makes good, in a flow of so many steps or fewer: the longer a flow, the
#: slower its shape answers, and the more corrections there are.
GAIN, GAIN_STEPS = 0.1, 1000
#: How far the mass may go from that of a sharp shape: thin shapes are some 0.15 off; beyond, a phase is lost.
REACH = 0.2
#: Masses that no correction leaves.
BOUND = 0.95
#: The largest constant that is added at the end to make the share exact: beyond, it was not reached.
LAST = 0.1


def first_mass(share: float) -> float:
    """The mass of a sharp shape, ±1, with this share inside.

    Raises
    ------
    ValueError
        If the share is not in (0, 1).
    """
    share = inside(share, "a volume fraction in (0, 1)", 0, 1)
    return min(max(2 * share - 1, -BOUND), BOUND)


def correction(u: Tensor, share: float, mass: float, steps: int) -> float:
    """What to add to the mass of a flow of so many steps, on its way: a sharp shape gains half of it in volume."""
    missing = share - float(np.count_nonzero(u.numpy() > 0)) / u.numel()
    gain, sharp = min(GAIN, GAIN * GAIN_STEPS / steps), first_mass(share)
    target = min(max(mass + gain * 2 * missing, sharp - REACH), sharp + REACH)
    return min(max(target, -BOUND), BOUND) - mass


def last_shift(u: Tensor, share: float) -> float:
    """The constant that, added to u, leaves round(share × voxels) of its values above 0."""
    values, inside = u.numpy().ravel(), round(share * u.numel())
    place = min(max(u.numel() - inside, 1), u.numel() - 1)
    below, above = np.partition(values, (place - 1, place))[place - 1 : place + 1]
    return -(float(below) + float(above)) / 2
