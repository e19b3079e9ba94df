"""The main job: a scan in, its parameters out. This module holds the order of the steps; others hold the steps."""

from __future__ import annotations

import dataclasses
import datetime
import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from curvafit.generation.flow import Flow, generate
from curvafit.geometry.diagram import BIN_WIDTH, TAIL_SHARE, Diagram, diagram
from curvafit.geometry.family import family_of
from curvafit.geometry.morphometry import morphometry
from curvafit.geometry.pairwise import one_to_many
from curvafit.inference.atlas import Atlas, load_atlas
from curvafit.inference.fit import Fit
from curvafit.inference.match import Match, nearest
from curvafit.inference.measure import scan_diagram
from curvafit.inference.phases import check_options
from curvafit.inference.prepare import Prepared, prepare
from curvafit.inference.refine import refine
from curvafit.inference.refinement import Refinement
from curvafit.pictures import Pictured
from curvafit.priors.bounds import SEEDS, instance, whole
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.fit_file import Prior
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.profile import phase_field
from curvafit.progress import Progress, silent
from curvafit.units import number
from curvafit.volumes.field import Field
from curvafit.volumes.formats.part import Crop
from curvafit.volumes.source import Source, field_of

#: Longest edge, in working voxels, of the boxes in which shapes are regenerated for comparison.
REGENERATED_EDGE = 100
#: Number of nearest shapes, and of those from which refinement starts.
MATCHES, STARTS = 5, 3
#: The distances of a fit that an inference shows, by the names that people read.
_DISTANCES = (("match", "match"), ("fit", "fit"), ("two seeds", "seed_noise"))
_ARTICLES = {"field": "a phase field", "mask": "a mask", "image": "an image"}


@dataclass(frozen=True, repr=False, eq=False)
class Inference(Pictured):
    """An inference: a fit, and the fields and diagrams of its report.

    Attributes
    ----------
    scan, prepared
        The scan as read, and as prepared for measurement.
    diagram, match_diagram, fit_diagram
        Curvature diagrams of the scan, the regenerated match and the regenerated fit.
    matched, regenerated
        Phase fields `(Z, Y, X)` of the regenerated match and fit, None where no shape grew.
    fit
        The parameters with their uncertainties, distances and status.
    """

    scan: Field
    prepared: Prepared
    diagram: Diagram
    match_diagram: Diagram | None
    fit_diagram: Diagram | None
    matched: np.ndarray | None
    regenerated: np.ndarray | None
    fit: Fit

    def __repr__(self) -> str:
        fit = self.fit
        voxels = " x ".join(map(str, self.scan.values.shape))
        near = ", ".join(f"{name} {number(fit.distances.get(key), 2)}" for name, key in _DISTANCES)
        return f"Inference({fit.family} from {_ARTICLES[fit.kind]} of {voxels} voxels, distances: {near}. {fit.status})"

    @property
    def best(self) -> np.ndarray | None:
        """Return the regenerated shape of the better supported parameters."""
        return self.regenerated if self.fit.chosen == "fit" else self.matched

    def to_prior(self) -> Prior:
        """Return the fit as a law, so that an inference is taken wherever a law is."""
        return self.fit.to_prior()


def infer(
    scan: Source,
    *,
    kind: Literal["auto", "field", "mask", "image"] = "auto",
    periodic: bool = False,
    atlas: str | Path | Atlas | None = None,
    threshold: float | Literal["otsu"] = "otsu",
    dark: bool = False,
    roi: Source | None = None,
    label: int | None = None,
    crop: Crop | None = None,
    seed: int = 0,
    watch: Callable[[Prepared], None] | None = None,
    progress: Progress = silent,
    **reading: Any,
) -> Inference:
    """Infer the generation parameters (a, m₀) of a scanned volume.

    Parameters
    ----------
    scan
        The path of a volume file, a `Field`, or an array or tensor (Z, Y, X).
    kind
        `"field"`, `"mask"`, `"image"`, or `"auto"`: two values are a mask, plateaus near ±1 a phase field.
    periodic
        Whether the box repeats, as generated fields do and scans hardly ever.
    atlas
        The shapes to match against; by default the packaged ones.
    threshold, dark, roi
        How the structure is told from the background: see `curvafit.inference.prepare.prepare`.
    label, crop
        The voxels of one value as a mask; a box of voxels, of the scan and of `roi`: see `curvafit.load`.
    watch
        Called with the `Prepared` scan before the long part begins; an exception of it ends the inference.
    progress
        Called with a sentence and the share done.
    reading
        Options of reading a file, or the place of an array: spacing, unit and the others of `curvafit.load`.

    Raises
    ------
    ValueError, FileNotFoundError
        If the volume cannot be read or measured, or an argument is out of range.
    """
    check_options(kind, threshold, label)
    if atlas is not None:
        instance(atlas, (str, Path, Atlas), "an atlas, as the path of a file or as Atlas")
    seed = whole(seed, "a seed that is a whole number from 0", 0, SEEDS - 2)  # and the next one
    progress("reading the scan", 0.0)
    atlas = atlas if isinstance(atlas, Atlas) else load_atlas(atlas)
    volume = field_of(scan, label=label, crop=crop, **reading)
    region = None if roi is None else field_of(roi)
    region = region if region is None or crop is None else region.crop(crop)
    prepared = prepare(volume, kind=kind, periodic=periodic, threshold=threshold, dark=dark, roi=region)
    if watch is not None:
        watch(prepared)
    progress("measuring curvature", 0.05)
    measured = scan_diagram(prepared)
    seen_as = "field" if prepared.kind == "field" else "mask"
    progress("searching the atlas", 0.1)
    matches = nearest(measured, atlas, seen_as=seen_as, count=MATCHES)
    progress("refining the parameters", 0.2)
    refined = _refined(prepared, matches, seed, progress)
    progress("regenerating", 0.6)
    refined = _with_mass(refined, prepared, seed)
    twins = _regenerate(prepared, matches[0], refined, seed, progress)
    fit = _fit(prepared, measured, matches, refined, twins, _provenance(volume, atlas, seed))
    progress("done", 1.0)
    match, refit = twins["match"][0], twins["fit"][0]
    return Inference(volume, prepared, measured, match.diagram, refit.diagram, match.phase, refit.phase, fit)


@dataclass(frozen=True)
class _Twin:
    """A regenerated shape, measured as the scan is, or the flow that grew none."""

    flow: Flow
    phase: np.ndarray | None
    diagram: Diagram | None


def _refined(prepared: Prepared, matches: tuple[Match, ...], seed: int, progress: Progress) -> Refinement:
    phase = torch.from_numpy(np.ascontiguousarray(prepared.phase[prepared.windows[0]]))
    whole = phase.shape == prepared.grid.shape
    z, y, x = phase.shape
    grid = Grid((z, y, x), prepared.grid.spacing, prepared.grid.boundary if whole else "replicate")
    starts = [match.coefficients for match in matches[:STARTS]]
    return refine(
        phase,
        grid,
        WORKING_EPSILON,
        kind=prepared.kind,
        starts=starts,
        seed=seed,
        progress=lambda text, share: progress(text, 0.2 + 0.4 * share),
    )


def _with_mass(refined: Refinement, prepared: Prepared, seed: int) -> Refinement:
    """Return a refinement whose mass gives a regenerated shape the scan's volume fraction, to first order.

    The mass of a phase field is its mean and stays. A mask does not state a mass: the phases of a minimiser stop short
    of ±1 by an amount that depends on curvature.
    """
    if prepared.kind == "field":
        return refined
    flow = generate(refined.coefficients, refined.mass, _twin_grid(prepared), seed=seed, reject_early=True)
    if not flow.viability.viable:
        return refined
    region = np.ones_like(prepared.mask) if prepared.roi is None else prepared.roi
    missing = float(prepared.mask[region].mean()) - float((flow.field > 0).double().mean())
    return dataclasses.replace(refined, mass=float(np.clip(refined.mass + 2 * missing, -0.95, 0.95)))


def _twin_grid(prepared: Prepared) -> Grid:
    """Return a periodic box of the main window's size, for the regenerated shapes."""
    z, y, x = (min(edge.stop - edge.start, REGENERATED_EDGE) for edge in prepared.windows[0])
    return Grid((z, y, x), prepared.grid.spacing, "periodic")


def _regenerate(
    prepared: Prepared, match: Match, refined: Refinement, seed: int, progress: Progress
) -> dict[str, tuple[_Twin, _Twin]]:
    """Regenerate the nearest match and the refined parameters, with two seeds each."""
    grid = _twin_grid(prepared)
    twins = {}
    for step, (name, source) in enumerate((("match", match), ("fit", refined))):
        pair = []
        for k in range(2):
            progress(f"regenerating the {name}, seed {seed + k}", 0.6 + 0.2 * step + 0.1 * k)
            pair.append(_twin(source.coefficients, source.mass, grid, seed + k, prepared.kind))
        twins[name] = (pair[0], pair[1])
    return twins


def _twin(coefficients: Coefficients, mass: float, grid: Grid, seed: int, kind: str) -> _Twin:
    flow = generate(coefficients, mass, grid, seed=seed, reject_early=True)
    if not flow.viability.viable:
        return _Twin(flow, None, None)
    field = flow.field if kind == "field" else phase_field(flow.field > 0, grid, WORKING_EPSILON)
    return _Twin(flow, flow.field.numpy(), diagram(field, grid, WORKING_EPSILON))


def _fit(
    prepared: Prepared,
    measured: Diagram,
    matches: tuple[Match, ...],
    refined: Refinement,
    twins: dict[str, tuple[_Twin, _Twin]],
    provenance: dict[str, Any],
) -> Fit:
    distances = {name: _distance(measured, pair) for name, pair in twins.items()}
    noises = {name: _noise(pair) for name, pair in twins.items()}
    chosen, status = _verdict(distances, noises, refined, twins)
    distances["seed_noise"] = noises[chosen]
    better = refined if chosen == "fit" else matches[0]
    grid = prepared.grid
    return Fit(
        kind=prepared.kind,
        family=family_of(measured, prepared.thickness / 2 * grid.spacing[0]),
        coefficients=better.coefficients,
        mass=float(better.mass),
        chosen=chosen,
        uncertainty={name: float(value) for name, value in refined.uncertainty.items()},
        scale=prepared.scale,
        working_voxel=prepared.working_voxel,
        length_unit=prepared.unit,
        matches=matches,
        refined=_refinement_dict(refined),
        distances=distances,
        status=status,
        morphometry=morphometry(prepared.mask, prepared.working_voxel, prepared.unit, periodic=grid.periodic),
        notes=prepared.notes,
        provenance=provenance,
        diagram=measured.thinned(BIN_WIDTH, TAIL_SHARE),
    )


def _distance(measured: Diagram, pair: tuple[_Twin, _Twin]) -> float | None:
    diagrams = [twin.diagram for twin in pair if twin.diagram is not None]
    return float(one_to_many(measured, diagrams).mean()) if diagrams else None


def _noise(pair: tuple[_Twin, _Twin]) -> float | None:
    first, second = pair[0].diagram, pair[1].diagram
    return float(one_to_many(first, [second])[0]) if first is not None and second is not None else None


def _verdict(
    distances: dict[str, float | None], noises: dict[str, float | None], refined: Refinement, twins: dict
) -> tuple[str, str]:
    """Return which of match and fit is better supported, as a word and as a sentence."""
    match, fit = distances["match"], distances["fit"]
    if fit is None:
        reason = twins["fit"][0].flow.viability.reason
        return "match", f"The nearest match is better supported: the refined parameters make no shape ({reason})."
    if match is None:
        return "fit", "The refined parameters are better supported: the nearest match could not be regenerated."
    noise = noises["fit"] or noises["match"] or 0.0
    both = f"regenerated, the fit lies {fit:.1f} from the scan, the match {match:.1f}, two seeds {noise:.1f} apart"
    if fit <= match + noise:
        margin = "clearly" if fit < match - noise else "within seed noise"
        return "fit", f"The refined parameters are supported ({margin}): {both}. {refined.status}"
    return "match", f"The nearest match is better supported: {both}. {refined.status}"


def _refinement_dict(refined: Refinement) -> dict[str, Any]:
    return {
        "method": refined.method,
        "coefficients": refined.coefficients.as_dict(),
        "mass": float(refined.mass),
        "singular_values": [float(value) for value in refined.singular_values],
        "residual": float(refined.residual),
        "evaluations": int(refined.evaluations),
        "status": refined.status,
    }


def _provenance(volume: Field, atlas: Atlas, seed: int) -> dict[str, Any]:
    return {
        "curvafit": version("curvafit"),
        "scan": str(volume.source),
        "scan_shape": list(volume.values.shape),
        "scan_spacing": list(volume.spacing),
        "seed": seed,
        "schedule": "fast",
        "epsilon": WORKING_EPSILON,
        "atlas": {"format": atlas.format_version, "shapes": len(atlas.ids)},
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "torch": version("torch"),
        "numpy": version("numpy"),
    }
