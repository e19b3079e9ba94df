"""What is said of a scan: whether the best of the laws that may have made it is believable, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import itemgetter

import numpy as np

from curvafit.core.units import format_number
from curvafit.geometry.morphometry import Morphometry
from curvafit.inference.candidates import CLOSE, TITLES, Misfit, best_candidate, seed_noise_of
from curvafit.inference.fit import Fit

#: Up to so many seeds' distances, twins with the scan's familiar numbers are near; further ones are no twins.
FURTHEST = 5.0
#: What a verdict begins with where no law is the scan's, and where it is not known.
UNBELIEVED, UNDECIDED = "No believable twin", "Undecided"
#: Twins of two seeds further from each other than this (1 / working unit) define no texture; presets' lie .3 to 1.3.
TELLING = 2.0
#: Familiar numbers in which twins may differ from the scan, and the part by which all of them must to be named.
FAMILIAR = {"thickness": "thickness_mean", "spacing": "spacing_mean", "connectivity": "connectivity_density"}
NEAR = 0.15
#: A scan made by the model lies as far out as this with probability 0.01: beyond, no twin is believable.
UNBELIEVABLE = 0.01


def verdict(fit: Fit, *, fast: bool = False) -> tuple[str | None, str]:
    """Return the name of a fit's best supported law, and the verdict on the scan; no name where nothing grew.

    A law that is not believable is still named: it is the nearest that there is, and the verdict says that it is not
    the scan's. `fast` says that nothing was grown.
    """
    candidates, misfit = fit.candidates, fit.misfit
    if fast:
        return candidates[0].name, _join(_describe_misfit(misfit), "Nothing was grown to check the law (--fast).")
    best = best_candidate(candidates)
    if best is None or best.distance is None:
        return None, _join("No law: nothing grew from any candidate.", candidates[0].status)
    noise = seed_noise_of(candidates)
    title = TITLES[best.name]
    distances = f"its twins lie {best.distance:.1f} from the scan's curvature diagram"
    distances += f", {noise:.1f} from each other." if noise else "."
    ratio, other = 0.0 if not noise else best.distance / noise, find_differences(fit.morphometry, best.twins)
    familiar = f"Twins over scan: {', '.join(other)}." if other else ""
    strange = misfit is not None and misfit.probability < UNBELIEVABLE
    allowed = 1 if ratio <= CLOSE else 0
    if strange or ratio > FURTHEST or len(other) > allowed:
        far = f"Twins should lie some {noise:.1f} from it." if ratio > CLOSE else ""
        reason = _describe_misfit(misfit) if strange else far
        return best.name, _join(f"{UNBELIEVED}: of the nearest law ({title}), {distances}", reason, familiar)
    word, doubt = "Supported", ""
    if ratio > CLOSE:
        word, doubt = "Near", "They have its thickness, spacing and connectivity, and another law may come nearer."
    elif noise is None:
        word, doubt = UNDECIDED, "No law grew twice, so it is not known how far apart two seeds lie."
    elif noise > TELLING:
        word = UNDECIDED
        doubt = "Seeds so far apart tell no texture: this law makes none, or the volume holds too little."
    elif familiar:
        word, doubt = "Near", "That is near enough."
    return best.name, _join(f"{word} ({title}): {distances}", doubt, familiar, _describe_misfit(misfit), best.status)


def _join(*sentences: str) -> str:
    """Return the sentences that are not empty, one after the other."""
    return " ".join(filter(None, sentences))


def find_differences(scan: Morphometry, twins: Sequence[Morphometry]) -> list[str]:
    """Return words on the familiar numbers that are greater, or smaller, in all twins than in the scan, by over `NEAR`.

    Connectivities are counts of bodies and tunnels: by chance two counts differ by up to twice the root of their sum.
    """
    words = []
    for word, name in FAMILIAR.items():
        own = getattr(scan, name)
        ratios = np.array([getattr(each, name) / own for each in twins] if own else [])
        count = abs(1 - scan.euler) if name == "connectivity_density" else math.inf
        reach = np.maximum(NEAR, 2 * np.sqrt((1 + np.abs(ratios)) / max(count, 1)))
        if len(ratios) and ((ratios > 1 + reach).all() or (ratios < 1 - reach).all()):
            ratio = float(ratios.mean())
            words.append(f"{word} of the other sign" if ratio < 0 else f"{word} {format_number(ratio, 2)}")
    return words


def _describe_misfit(misfit: Misfit | None) -> str:
    """Return how usual the scan's descriptors are for the model, as a sentence."""
    if misfit is None:
        return ""
    p = format_number(misfit.probability, 2)
    if misfit.probability >= UNBELIEVABLE:
        return f"The scan's descriptors are of a kind that the model makes (p = {p})."
    strangest = [name for name, own in sorted(misfit.blocks.items(), key=itemgetter(1)) if own < UNBELIEVABLE]
    names = ", ".join(strangest) or "none by itself"
    direction = "The scan has a direction (fabric), and the model has none." if "fabric" in strangest else ""
    return _join(f"The model does not make such descriptors (p = {p}); the strangest: {names}.", direction)
