"""Which law of a scan is supported, if any, in a sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from curvafit.core.units import number
from curvafit.geometry.morphometry import Morphometry
from curvafit.inference.candidates import CLOSE, TITLES, Candidate, best_of, noise_of
from curvafit.inference.misfit import UNBELIEVABLE, Misfit

#: Beyond `CLOSE`, twins within so many seeds' distances whose familiar numbers are the scan's are near, and so are
#: those that are close but for one familiar number; others are no twins.
FURTHEST = 5.0
#: What a verdict begins with where no law is the scan's, and where it is not known.
UNBELIEVED, UNDECIDED = "No believable twin", "Undecided"
#: Seeds further apart than this (1 / working unit) tell no texture: those of the presets lie .3 to 1.3 apart at 100³.
TELLING = 2.0
#: Familiar numbers in which twins may differ from the scan, and the part by which all of them must to be named.
FAMILIAR = {"thickness": "thickness_mean", "spacing": "spacing_mean", "connectivity": "connectivity_density"}
NEAR = 0.15


def verdict(
    candidates: Sequence[Candidate], misfit: Misfit | None, scan: Morphometry, *, fast: bool = False
) -> tuple[str | None, str]:
    """Return the name of the best supported law and the verdict on a scan of these familiar numbers; no name where
    nothing grew.

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
    ratio, other = 0.0 if not noise else best.distance / noise, unlike(scan, best.twins)
    familiar = f"Twins over scan: {', '.join(other)}." if other else ""
    strange = misfit is not None and misfit.probability < UNBELIEVABLE
    allowed = 1 if ratio <= CLOSE else 0
    if strange or ratio > FURTHEST or len(other) > allowed:
        far = f"Twins should lie some {noise:.1f} from it." if ratio > CLOSE else ""
        reason = _unusual(misfit) if strange else far
        return best.name, _joined(f"{UNBELIEVED}: of the nearest law ({title}), {apart}", reason, familiar)
    word, doubt = "Supported", ""
    if ratio > CLOSE:
        word, doubt = "Near", "They have its thickness, spacing and connectivity, and another law may come nearer."
    elif noise is None:
        word, doubt = UNDECIDED, "No law grew twice, so it is not known how far apart two seeds lie."
    elif noise > TELLING:
        word, doubt = (
            "Undecided",
            "Seeds so far apart tell no texture: this law makes none, or the volume holds too little.",
        )
    elif familiar:
        word, doubt = "Near", "That is near enough."
    return best.name, _joined(f"{word} ({title}): {apart}", doubt, familiar, _unusual(misfit), best.status)


def _joined(*sentences: str) -> str:
    """Return the sentences that are not empty, one after the other."""
    return " ".join(filter(None, sentences))


def unlike(scan: Morphometry, twins: Sequence[Morphometry]) -> list[str]:
    """Return the familiar numbers in which all twins differ from the scan the same way, with their ratios, as words.

    They differ by more than `NEAR`; connectivities also by more than chance lets two counts of so many bodies and
    tunnels differ, twice the root of their sum.
    """
    apart = []
    for word, name in FAMILIAR.items():
        own = getattr(scan, name)
        ratios = np.array([getattr(each, name) / own for each in twins] if own else [])
        count = abs(1 - scan.euler) if name == "connectivity_density" else math.inf
        reach = np.maximum(NEAR, 2 * np.sqrt((1 + np.abs(ratios)) / max(count, 1)))
        if len(ratios) and ((ratios > 1 + reach).all() or (ratios < 1 - reach).all()):
            ratio = float(ratios.mean())
            apart.append(f"{word} of the other sign" if ratio < 0 else f"{word} {number(ratio, 2)}")
    return apart


def _unusual(misfit: Misfit | None) -> str:
    """Return how usual the scan's descriptors are for the model, as a sentence."""
    if misfit is None:
        return ""
    p = number(misfit.probability, 2)
    if misfit.probability >= UNBELIEVABLE:
        return f"The scan's descriptors are of a kind that the model makes (p = {p})."
    names = ", ".join(misfit.strangest) or "none by itself"
    direction = "The scan has a direction (fabric), and the model has none." if "fabric" in misfit.strangest else ""
    return _joined(f"The model does not make such descriptors (p = {p}); the strangest: {names}.", direction)
