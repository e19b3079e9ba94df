"""The mass that gives a wanted share of volume inside, found while the flow runs."""

from __future__ import annotations

import numpy as np
from torch import Tensor

#: Mass is corrected from this part of the steps on: the first steps only smooth the noise.
BEGIN = 0.02
#: Part of what is missing that one correction makes good, in a flow of so many steps or fewer: the longer a flow, the
#: slower its shape answers, and the more corrections there are.
GAIN, GAIN_STEPS = 0.3, 1000
#: The most that is taken to be missing, as a mass.
LARGEST = 0.1
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
    if not 0 < share < 1:
        raise ValueError(f"expected a volume fraction in (0, 1), got {share}")
    return min(max(2 * share - 1, -BOUND), BOUND)


def correction(u: Tensor, share: float, mass: float, steps: int) -> float:
    """What to add to the mass of a flow of so many steps, on its way: a sharp shape gains half of it in volume."""
    missing = share - float(np.count_nonzero(u.numpy() > 0)) / u.numel()
    gain = min(GAIN, GAIN * GAIN_STEPS / steps)
    change = gain * min(max(2 * missing, -LARGEST), LARGEST)
    return min(max(mass + change, -BOUND), BOUND) - mass


def last_shift(u: Tensor, share: float) -> float:
    """The constant that, added to u, leaves round(share × voxels) of its values above 0."""
    values, inside = u.numpy().ravel(), round(share * u.numel())
    place = min(max(u.numel() - inside, 1), u.numel() - 1)
    below, above = np.partition(values, (place - 1, place))[place - 1 : place + 1]
    return -(float(below) + float(above)) / 2
