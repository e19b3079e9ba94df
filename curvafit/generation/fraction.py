"""Corrections of the mass while a flow runs, towards a given share of volume inside."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from curvafit.core.checks import check_open_interval

#: Share of the steps after which corrections begin: before, the sign of u says little about a shape's volume.
BEGIN = 0.2
#: Share of the shortfall that one correction adds, in a flow of at most `GAIN_STEPS` steps: in a longer flow the shape
#: responds more slowly, and there are more corrections.
GAIN, GAIN_STEPS = 0.1, 1000
#: The greatest distance of the mass from that of a sharp shape: thin shapes differ by some 0.15; beyond `REACH`, a
#: phase is lost.
REACH = 0.2
#: The greatest modulus of a mass.
BOUND = 0.95
#: The largest constant that is added at the end to make the share exact; beyond, the share was not reached.
LAST = 0.1


def first_mass(share: float, mass: float | None = None) -> float:
    """Return the mass that a flow towards this share begins with: a given one, as far as a shape of this share may have
    it; else that of a sharp shape, with values ±1.

    Raises
    ------
    ValueError
        If the share is not in (0, 1).
    """
    share = check_open_interval(share, "a volume fraction in (0, 1)", 0, 1)
    sharp = min(max(2 * share - 1, -BOUND), BOUND)
    begin = sharp if mass is None else min(max(mass, sharp - REACH), sharp + REACH)
    return min(max(begin, -BOUND), BOUND)


def correction(u: Tensor, share: float, mass: float, steps: int) -> float:
    """Return what to add to the mass during a flow of `steps` steps; a sharp shape's share grows by half of that."""
    shortfall = share - float(np.count_nonzero(u.numpy() > 0)) / u.numel()
    gain, sharp = min(GAIN, GAIN * GAIN_STEPS / steps), first_mass(share)
    target = min(max(mass + gain * 2 * shortfall, sharp - REACH), sharp + REACH)
    return min(max(target, -BOUND), BOUND) - mass


def last_shift(u: Tensor, share: float) -> float:
    """Return the constant whose sum with u has round(share × voxels) values above 0."""
    values, inside = u.numpy().ravel(), round(share * u.numel())
    place = min(max(u.numel() - inside, 1), u.numel() - 1)
    below, above = np.partition(values, (place - 1, place))[place - 1 : place + 1]
    return -(float(below) + float(above)) / 2
