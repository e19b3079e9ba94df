"""Which law of a scan is supported, if any, in a sentence."""

from __future__ import annotations

from collections.abc import Sequence

from curvafit.inference.candidates import TITLES, Candidate, best_of, noise_of
from curvafit.inference.misfit import UNBELIEVABLE, Misfit
from curvafit.units import number

#: Twins that lie further from the scan than this many seeds' distances are no twins.
FURTHEST = 4.0


def verdict(candidates: Sequence[Candidate], misfit: Misfit | None, *, fast: bool = False) -> tuple[str | None, str]:
    """Return the name of the best supported law and the verdict; no name where nothing grew.

    A law that is not believable is still named: it is the nearest that there is, and the verdict says that it is not
    the scan's.
    """
    if fast:
        return candidates[0].name, _joined(_unusual(misfit), "Nothing was grown to check the law (--fast).")
    best = best_of(candidates)
    if best is None or best.distance is None:
        return None, _joined("No law: nothing grew from any candidate.", candidates[0].status)
    noise = noise_of(candidates)
    title = TITLES[best.name]
    apart = f"its twins lie {best.distance:.1f} from the scan's curvature diagram"
    apart += f", {noise:.1f} from each other." if noise else "."
    far = noise is not None and best.distance > FURTHEST * noise
    strange = misfit is not None and misfit.probability < UNBELIEVABLE
    if far or strange:
        reason = _unusual(misfit) if strange else f"Twins should lie some {noise:.1f} from it."
        return best.name, _joined(f"No believable twin: of the nearest law ({title}), {apart}", reason)
    return best.name, _joined(f"Supported ({title}): {apart}", _unusual(misfit), best.status)


def _joined(*sentences: str) -> str:
    """Return the sentences that are not empty, one after the other."""
    return " ".join(filter(None, sentences))


def _unusual(misfit: Misfit | None) -> str:
    """Return how usual the scan's descriptors are for the model, as a sentence."""
    if misfit is None:
        return ""
    p = number(misfit.probability, 2)
    if misfit.probability >= UNBELIEVABLE:
        return f"The scan's descriptors are of a kind that the model makes (p = {p})."
    names = ", ".join(misfit.strangest) or "none by itself"
    return f"The model does not make such descriptors (p = {p}); the strangest: {names}."
