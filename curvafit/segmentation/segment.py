"""Segmentation without a network: a scan's evidence and the energy F_ε of the surface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from curvafit.priors.bounds import real
from curvafit.priors.coefficients import Coefficients
from curvafit.progress import Progress, part, silent
from curvafit.segmentation.engine import BENDING, HALO, STEPS, bending, started, weighed
from curvafit.segmentation.evidence import classes_of, grey_levels, of_classes
from curvafit.segmentation.result import Segmentation, ending, filled, result_of
from curvafit.segmentation.weighing import Weighing, weighing
from curvafit.segmentation.working import Law, WorkingGrid, laws_of
from curvafit.volumes.formats.part import Crop
from curvafit.volumes.source import Source, field_of

__all__ = ["segment"]

#: A law that is tried beside the prior's.
WILLMORE = Coefficients.willmore()
#: What is said of classes that may be noise.
FAINT = "The classes differ by less than the noise, as where the structure is rare: better give a threshold."
#: Share of the time that trying laws out takes.
TRIALS = 0.7
#: Least and greatest weight.
WEIGHTS = (1e-9, 1e9)


def segment(
    scan: Source,
    prior: Law,
    *,
    weight: float | None = None,
    threshold: float | str = "otsu",
    dark: bool = False,
    epsilon: float | None = None,
    steps: int = STEPS,
    crop: Crop | None = None,
    progress: Progress = silent,
    **reading: Any,
) -> Segmentation:
    """Find the structure of a scan: lower -log p(scan | mask) + λ F_ε from a smoothed, thresholded start.

    Which law is lowered, and with which weight, is decided by grey levels that are left out: those that a fit trusts
    and the Willmore energy are tried, and where none tells them better than the start does, the start is the answer.
    A network's probabilities are for `refine`: none of them can be left out, since they tell each other.

    Parameters
    ----------
    scan
        Grey levels of two phases with noise: the path of a file, a `Field`, or an array or tensor (Z, Y, X).
    prior
        `Coefficients` with lengths in the scan's unit; or a preset's name, in working units of which the smallest voxel
        edge is 0.01; or the path of a `fit.json`, whose unit is converted.
    weight
        λ, in nats per unit of F_ε, for the first law; by default it is chosen, with the law, by voxels left out. Small
        bumps on a plane cost (a20 + a02) / 2 times their Willmore energy (linear terms aside, since ∫κ1κ2 = 0).
    threshold, dark
        The grey level between the phases, or `"otsu"`; whether the structure is the dark one.
    epsilon
        ε in the scan's unit; by default twice the smallest voxel edge. Thinner structures do not survive.
    steps
        Steps of Adam.
    crop
        A box of voxels: see `curvafit.load`.
    progress
        Called with a sentence and the share done.
    reading
        Options of reading a file, or the place of an array: spacing, unit and the others of `curvafit.load`.

    Raises
    ------
    ValueError
        If an argument is out of range or does not fit the scan, or the prior's unit cannot be converted.
    FileNotFoundError
        If there is no such `fit.json`.
    """
    scan = field_of(scan, crop=crop, **reading)
    laws, notes = laws_of(prior, scan)
    place = WorkingGrid.of(scan, epsilon, halo=HALO)
    if weight is not None:
        weight = real(weight, "a positive weight", *WEIGHTS)
    if not (isinstance(threshold, str) and threshold == "otsu"):
        real(threshold, "a threshold that is a number or 'otsu'")
    values = grey_levels(scan, threshold)
    classes = classes_of(values, scan, threshold, dark)
    law, nats = laws[0], bending(laws[0]) / BENDING * (weight or 0.0)
    chosen: Weighing | None = None
    if weight is None:
        overlap = threshold == "otsu" and classes.faint
        chosen = weighing(
            values, scan, classes, (*laws, *({WILLMORE} - set(laws))),
            epsilon=epsilon, steps=steps, measured=overlap, progress=part(progress, 0.0, TRIALS),
        )  # fmt: skip
        law, nats, classes, progress = chosen.law, chosen.nats, chosen.classes, part(progress, TRIALS, 1.0)
    evidence = of_classes(values, scan, classes)
    if classes.faint and threshold == "otsu" and (chosen is None or chosen.law is None):
        notes = (*notes, FAINT)
    notes = (*notes, f"{evidence.note[0].upper()}{evidence.note[1:]}.", *place.notes)
    if law is None:
        u = place.back(started(evidence.level, place))
        status = filled(u > 0)
    else:
        flow = weighed(evidence, law, nats, place, steps, progress)
        u = place.back(flow.field)
        status = ending(flow, u > 0)
    λ = weight if weight is not None or law is None else nats * BENDING / bending(law)
    if chosen is not None:
        status = f"{_gain(chosen, laws)}; {status}"
    return result_of(scan, u > 0, u, weight=λ, law=law, epsilon=place.epsilon, status=status, notes=notes)


def _gain(chosen: Weighing, laws: Sequence[Coefficients]) -> str:
    """Return what was chosen and what it gains, as the beginning of a sentence."""
    share = f"{100 * chosen.gain:+.2g} ± {100 * chosen.noise:.2g} % of the voxels left out are on their side"
    if chosen.law is None:
        return f"no prior helps here: with the best {share}"
    law = "the prior helps" if chosen.law in laws else "the Willmore energy helps, more than the prior"
    return f"{law}, at {chosen.nats:g} nats: {share}"
