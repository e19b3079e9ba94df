"""Which slices to annotate next: those that would remove most of a volume's entropy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from curvafit.segmentation.slices import reach

__all__ = ["remaining", "suggestions"]


def suggestions(entropies: np.ndarray, places: Sequence[int], count: int, periodic: bool = False) -> tuple[int, ...]:
    """Return the slices to annotate next, the most telling first, each chosen as if those before it were known.

    There are fewer where no other slice would tell anything.

    Parameters
    ----------
    entropies
        The entropy of each slice, in nats, (Z,).
    places
        The numbers of the known slices.
    periodic
        Whether the last slice is followed by the first.
    """
    known, left = set(places), np.asarray(entropies, dtype=np.float64)
    chosen: list[int] = []
    for _ in range(count):
        unknown = [n for n in range(len(left)) if n not in known]
        after = [remaining(left, known, n, periodic) for n in unknown]
        sums = [each.sum() for each in after]
        if not sums or min(sums) >= left.sum():
            break
        best = int(np.argmin(sums))
        left = after[best]
        chosen.append(unknown[best])
        known.add(unknown[best])
    return tuple(chosen)


def remaining(entropies: np.ndarray, places: Sequence[int] | set[int], new: int, periodic: bool = False) -> np.ndarray:
    """Return the entropies (Z,) of the slices once a new one is known.

    The uncertain layer of a slice is as thick as its `reach`: in that proportion the entropy falls. A new slice tells
    nothing about slices beyond other known ones.
    """
    before, after = (reach(sorted(known), len(entropies), periodic) for known in (places, {*places, new}))
    return entropies * np.divide(after, before, out=np.zeros_like(before), where=before > 0)
