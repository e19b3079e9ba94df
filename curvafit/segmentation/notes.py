"""What is said of a volume filled between known slices: which slices count, how sure it is, what is doubtful."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Numbers or labels that are told one by one.
FEW = 4
#: Least expected Dice of a volume that slices tell.
HALF = 0.5


def list_numbers(numbers: Sequence[int], most: int = FEW) -> str:
    """Return the first of some numbers as a list."""
    return ", ".join(map(str, numbers[:most])) + (", …" if len(numbers) > most else "")


def note_labelled(places: Sequence[int]) -> tuple[str, ...]:
    """Return a sentence on which slices are known where those with labels are."""
    which = f"The {len(places)} slices with labels are known: {list_numbers(places, 24)}."
    return (f"{which} One that is rightly empty must be named.",)


def doubt_places(there: np.ndarray, places: Sequence[int]) -> tuple[str, ...]:
    """Return a sentence where few slices have labels, and some of them are not among the known ones at `places`.

    `there` says of each slice whether it has labels, (Z,).
    """
    labelled = np.flatnonzero(there)
    strange = sorted(set(labelled.tolist()) - set(places))
    if not strange or 2 * len(labelled) > np.ptp(labelled) + 1:
        return ()
    few = f"Only {len(labelled)} of {len(there)} slices have labels, but {list_numbers(strange)} are not among the"
    return (f"{few} known ones: if those are what you annotated, another every or first is meant, or known.",)


def doubt_labels(values: np.ndarray, ignore: int | None = None) -> tuple[str, ...]:
    """Return a sentence where known slices have several labels, given their values, each once."""
    count = np.count_nonzero((values > 0) & (values != ignore))
    how = "reconstruct_labels, or --labels all, fills each by itself"
    return (f"The known slices have {count} labels, which are filled as one structure: {how}.",) if count > 1 else ()


def doubt_gaps(dice: float) -> tuple[str, ...]:
    """Return a sentence where a low Dice is expected between known slices."""
    low = "Known slices lie too far apart: what lies between them is more unknown than known."
    return (low,) if dice < HALF else ()


def note_ends(places: Sequence[int], length: int, image: bool = False) -> tuple[str, ...]:
    """Return sentences on the slices before the first known one and beyond the last."""
    before, beyond = places[0], length - 1 - places[-1]
    how = "told by the image alone" if image else "as that one is"
    first = f"Before the first known slice: {before} of the volume, {how}."
    last = f"Beyond the last known slice: {beyond} of the volume, {how}."
    return *((first,) if before else ()), *((last,) if beyond else ())


def describe_errors(dice: float, error: float, suggestions: Sequence[int], tested: str) -> str:
    """Say how good probabilities are, and on what, and what to annotate next, as the end of a sentence."""
    text = f"expect a Dice of {dice:.2f} between known slices"
    text = f"{text}; probabilities err by {error:.3f} near the surface of {tested}"
    following = ", ".join(map(str, suggestions))
    return f"{text}; annotate next: {following}" if following else text
