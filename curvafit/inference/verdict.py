"""What is said of a scan: whether the best of the laws that may have made it is believable, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import itemgetter

import numpy as np

from curvafit.core.units import format_number
from curvafit.geometry.morphology import Morphometry
from curvafit.inference.candidates import TITLES, Candidate, Misfit, best_candidate, join_tests, seed_noise_of

#: The probability below which a law is not believed to have made a scan.
UNBELIEVABLE = 0.05
#: What a verdict begins with where no law is the scan's, and where it is not known.
UNBELIEVED, UNDECIDED = "No believable twin", "Undecided"
#: Familiar numbers in which twins may differ from the scan, and the part by which all of them must to be named.
FAMILIAR = {"thickness": "thickness_mean", "spacing": "spacing_mean", "connectivity": "connectivity_density"}
NEAR = 0.15


def verdict(
    candidates: Sequence[Candidate], misfit: Misfit | None, scan: Morphometry, *, fast: bool = False
) -> tuple[str | None, str]:
    """Return the name of the best supported law of a scan, and the verdict on it; no name where nothing grew.

    The test alone decides (`Fit.misfit`). A law that is not believable is still named: it is the nearest that there is.
    `fast` says that nothing was grown.
    """
    if fast:
        return candidates[0].name, _join(_describe_misfit(misfit), "Nothing was grown to check the law (--fast).")
    best = best_candidate(candidates)
    if best is None or best.distance is None:
        return None, _join("No law: nothing grew from any candidate.", candidates[0].status)
    noise, title = seed_noise_of(candidates), TITLES[best.name]
    distances = f"its twins lie {best.distance:.1f} from the scan's curvature diagram"
    distances += f", {noise:.1f} from each other." if noise else "."
    if misfit is None:
        word, reason = UNDECIDED, "The law was not tested."
    elif misfit.probability < UNBELIEVABLE:
        word, reason = UNBELIEVED, _describe_misfit(misfit)
    else:
        word, reason = "Supported", _describe_misfit(misfit)
    other = find_differences(scan, best.twins)
    familiar = f"Twins over scan: {', '.join(other)}." if other else ""
    return best.name, _join(f"{word} ({title}): {distances}", reason, familiar, best.status)


def _join(*sentences: str) -> str:
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
    """Return how usual the scan is for the law, as a sentence."""
    if misfit is None:
        return ""
    p = format_number(misfit.probability, 2)
    if misfit.probability >= UNBELIEVABLE:
        if misfit.departure is None:
            return f"A quick reading does not rule this law out (p = {p})."
        return f"Shapes of this law look like the scan (p = {p})."
    random = misfit.level_cut is not None and join_tests(1.0, misfit.level_cut) < UNBELIEVABLE
    cut = "It looks more like a level cut of a random field, which no law made." if random else ""
    if misfit.departure is None:
        return _join(f"A quick reading rules this law out (p = {p}).", cut)
    strangest = [name for name, own in sorted(misfit.blocks.items(), key=itemgetter(1)) if own < UNBELIEVABLE]
    what = f"what differs most: {', '.join(strangest)}" if strangest else "no descriptor tells it alone"
    direction = "The scan has a direction (fabric), and the model has none." if "fabric" in strangest else ""
    return _join(f"Shapes of this law do not look like the scan (p = {p}); {what}.", direction, cut)
