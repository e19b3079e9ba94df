"""The main job: a scan in, its parameters out. This module holds the order of the steps; others hold the steps."""

from __future__ import annotations

import datetime
import platform
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from curvafit.core.checks import SEEDS, check_choice, check_int, check_type
from curvafit.core.pictures import Pictured
from curvafit.core.runtime import Progress, log_stages, sub_progress
from curvafit.core.units import format_number
from curvafit.generation.schedule import LEARNED, SCHEDULES, Schedule
from curvafit.geometry.diagrams import BIN_WIDTH, TAIL_SHARE, Diagram, family_of
from curvafit.geometry.morphology import morphometry
from curvafit.inference.atlas import VERSION, Atlas, Match, load_atlas, mirror_match, nearest
from curvafit.inference.candidates import TITLES, Candidate, Twin, best_candidate, twin
from curvafit.inference.estimate import check_law, estimate_law, measure_descriptors, refine_matches
from curvafit.inference.fit import KINDS, Fit
from curvafit.inference.posterior import Posterior, load_posterior
from curvafit.inference.simulate import ROUNDS
from curvafit.inference.stationary import drift, stationarity
from curvafit.inference.verdict import verdict
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.law import Law
from curvafit.priors.profile import phase_field
from curvafit.scan.measures import scan_diagram
from curvafit.scan.preparation import HALF, NOISE, Prepared, coarser_level, prepare, read_scan, why_no_texture
from curvafit.scan.quality import sample_mask
from curvafit.scan.structure import check_options, is_rounded, read_region
from curvafit.volumes.boxes import Crop
from curvafit.volumes.read import Source
from curvafit.volumes.volume import Volume

#: Number of nearest shapes, and of those from which stationarity starts.
MATCHES, STARTS = 5, 3
#: The seeds of the shapes that test a law come so much later than those of its twins.
TWINS = 1000


@dataclass(frozen=True, repr=False, eq=False)
class Inference(Pictured):
    """An inference: a fit, and the scan, diagram and grown shapes of its report.

    Attributes
    ----------
    scan, prepared
        The scan as read, and as prepared for measurement.
    diagram
        Curvature diagram of the scan; None of noise.
    twins
        Shapes grown from each candidate's law, by the candidate's name.
    fit
        The law with its uncertainty, the candidates and the verdict.
    simulated
        By block of descriptors, the scan's numbers `(k,)` and those of shapes grown from draws of the posterior
        `(n, k)`; None where none were.
    """

    scan: Volume
    prepared: Prepared
    diagram: Diagram | None
    twins: dict[str, tuple[Twin, ...]]
    fit: Fit
    simulated: dict[str, tuple[np.ndarray, np.ndarray]] | None = None

    def __repr__(self) -> str:
        fit = self.fit
        voxels = " x ".join(map(str, self.scan.values.shape))
        near = ", ".join(f"{each.name} {format_number(each.distance, 2)}" for each in fit.candidates)
        return f"Inference({fit.family} from {KINDS[fit.kind]} of {voxels} voxels, distances: {near}. {fit.status})"

    @property
    def best(self) -> np.ndarray | None:
        """Return the first shape grown from the chosen law."""
        return self.shape_of(self.fit.chosen)

    def shape_of(self, name: str | None) -> np.ndarray | None:
        """Return the first shape grown from a candidate's law; None where none grew."""
        return next((each.phase for each in self.twins.get(name or "", ()) if each.phase is not None), None)

    def to_law(self) -> Law:
        """Return the fit as a law, so that an inference is taken wherever a law is."""
        return self.fit.to_law()


def infer(
    scan: Source,
    *,
    kind: Literal["auto", "field", "mask", "image"] = "auto",
    periodic: bool = False,
    atlas: str | Path | Atlas | None = None,
    posterior: str | Path | Posterior | None = None,
    method: Literal["posterior", "match"] = "posterior",
    fast: bool = False,
    threshold: float | Literal["otsu"] = "otsu",
    dark: bool = False,
    roi: Source | None = None,
    label: int | None = None,
    crop: Crop | None = None,
    seed: int = 0,
    simulations: int = 16,
    rounds: int = ROUNDS,
    twins: int = 3,
    test: bool = True,
    schedule: Schedule | str = LEARNED,
    progress: Progress | None = None,
    **reading: Any,
) -> Inference:
    """Infer the generation parameters (a, m₀) of a scanned volume.

    A posterior of the parameters is read from the scan's descriptors; laws drawn from it, the nearest shape of the
    atlas and, of a phase field, its stationarity are grown, and what grows is compared with the scan.

    With `method="match"` a law is inferred as the paper's author would: the shape of the atlas whose curvature diagram
    is nearest in Wasserstein distance (geomloss), then gradient refinement from it by Levenberg and Marquardt's method
    (optimistix): of a phase field by its stationarity, of a mask or image by its descriptors.

    Raises ValueError or FileNotFoundError if the volume cannot be read or measured, or an argument is out of range.

    Parameters
    ----------
    scan
        The path of a volume file, a `Volume`, or an array or tensor (Z, Y, X).
    kind
        `"field"`, `"mask"`, `"image"`, or `"auto"`: two values are a mask, plateaus near ±1 a phase field.
    periodic
        Whether the box repeats, as generated fields do and scans hardly ever.
    atlas
        The shapes to match against; by default the packaged ones.
    posterior
        What reads the descriptors; by default the packaged one (`curvafit atlas train` makes others).
    method
        `"posterior"`, or `"match"`: nearest match, then gradient refinement. A match alone has no intervals.
    fast
        Grow nothing: seconds instead of minutes, but nothing is checked by a twin.
    threshold, dark, roi
        How structure and background are split: see `curvafit.scan.prepare`.
    label, crop
        The voxels of one value as a mask; a box of voxels, of the scan and of `roi`: see `curvafit.load`.
    simulations, rounds
        How many draws of the posterior are grown, and then rounds of three shapes whose parameters the shapes before
        them suggest.
    twins
        How many shapes of the best law are grown.
    test
        Whether further shapes of the best law are grown to test whether it can have made the scan.
    schedule
        Steps of each shape.
    progress
        Called with a sentence and the share done; by default the logger `curvafit` gets each stage once, at level INFO.
    reading
        Options of reading a file, or the place of an array: spacing, unit and the others of `curvafit.load`.
    """
    check_options(kind, threshold, label)
    check_choice(method, ("posterior", "match"), "method posterior or match")
    if atlas is not None:
        check_type(atlas, (str, Path, Atlas), "an atlas, as the path of a file or as Atlas")
    if posterior is not None:
        check_type(posterior, (str, Path, Posterior), "a posterior, as the path of a file or as Posterior")
    seed = check_int(seed, "a seed that is a whole number from 0", 0, SEEDS - 2)  # and the next one
    progress = progress or log_stages()
    progress("reading the scan", 0.0)
    atlas = atlas if isinstance(atlas, Atlas) else load_atlas(atlas)
    posterior = posterior if isinstance(posterior, Posterior) else load_posterior(posterior)
    how = {"kind": kind, "periodic": periodic, "threshold": threshold, "dark": dark, "roi": roi}
    volume, shape, prepared = _read_and_prepare(scan, label, crop, how, reading)
    progress("measuring curvature", 0.05)
    measured = None if prepared.noise else scan_diagram(prepared)
    reason = NOISE if measured is None else why_no_texture(prepared, measured)
    fit = _describe(prepared, measured, _provenance(volume, shape, atlas, posterior, seed), reason)
    if measured is None or reason:
        return Inference(volume, prepared, measured, {}, fit)
    progress("measuring descriptors", 0.1)
    described, simulated, law = measure_descriptors(prepared), None, {}
    if described is not None and method == "posterior":
        part = sub_progress(progress, 0.15, 0.5)
        options = {"simulations": 0 if fast else simulations, "rounds": rounds, "schedule": schedule}
        law, simulated = estimate_law(described, posterior, seed=seed, progress=part, **options)
    progress("searching the atlas", 0.5)
    # An atlas holds shapes that fill less than half: of one that fills more the background is looked up.
    seen_as, inverted = "field" if prepared.kind == "field" else "mask", prepared.volume_fraction > HALF
    query = measured.mirrored if inverted else measured
    matches = nearest(query, atlas, seen_as=seen_as, count=MATCHES, exact=method == "match")
    matches = tuple(map(mirror_match, matches)) if inverted else matches
    read = law.get("candidates", ())
    if described is not None and method == "match":
        read = (refine_matches(described, posterior, matches),)
    laws, grown = _list_laws(prepared, read, matches, seed, sub_progress(progress, 0.5, 0.6)), {}
    if not fast:
        part = sub_progress(progress, 0.6, 0.8 if test else 1.0)
        laws, grown = _grow(laws, measured, prepared, count=twins, schedule=schedule, seed=seed, progress=part)
    law |= {"candidates": laws, "matches": matches}
    if test and not fast and described is not None and (best := best_candidate(laws)) is not None:
        part = sub_progress(progress, 0.8, 1.0)
        options = {"seed": seed + TWINS, "schedule": schedule, "progress": part}
        law["misfit"] = check_law(best, prepared, described, posterior, **options)
    law["chosen"], law["status"] = verdict(laws, law.get("misfit"), fit.morphometry, fast=fast)
    if (best := next((each for each in laws if each.name == law["chosen"]), None)) is not None:
        # A voxel of the law's shapes is as long on the scan as makes them as thick as its structure.
        known = prepared.kind != "field" and best.thickness is not None
        ratio = prepared.thickness / best.thickness if known else 1.0  # type: ignore[operator]
        law |= {"working_voxel": ratio * prepared.working_voxel, "scale": tuple(ratio * h for h in prepared.scale)}
        step = law["working_voxel"] / prepared.working_voxel
        law["drift"] = drift(*_main_window(prepared, step), WORKING_EPSILON, best.coefficients)
    progress("done", 1.0)
    return Inference(volume, prepared, measured, grown, replace(fit, **law), simulated)


def _list_laws(
    prepared: Prepared, read: tuple[Candidate, ...], matches: tuple[Match, ...], seed: int, progress: Progress
) -> tuple[Candidate, ...]:
    """Return the laws to grow: of a phase field its stationarity, those read from descriptors, the nearest match."""
    laws = (*read, Candidate("match", matches[0].coefficients, matches[0].mass, {}, matches[0].thickness))
    if prepared.kind != "field" or is_rounded(prepared.phase):
        return laws
    starts = [each.coefficients for each in (*read[:1], *matches[:STARTS])]
    field = _main_window(prepared)
    return (stationarity(*field, WORKING_EPSILON, starts=starts, seed=seed, progress=progress), *laws)


def _main_window(prepared: Prepared, step: float = 1.0) -> tuple[torch.Tensor, Grid]:
    """Return the phase field of the main window and its grid, on voxels of `step` working voxels."""
    where = prepared.windows[0]
    if step == 1:
        return torch.from_numpy(np.ascontiguousarray(prepared.phase[where])), prepared.part(where)
    mask, boundary = sample_mask(prepared.mask[where], [step] * 3, prepared.grid.periodic), prepared.grid.boundary
    grid = Grid(mask.shape, prepared.grid.spacing, boundary)
    return phase_field(torch.from_numpy(mask), grid, WORKING_EPSILON), grid


def _grow(
    laws: tuple[Candidate, ...],
    measured: Diagram,
    prepared: Prepared,
    *,
    count: int,
    schedule: Schedule | str,
    seed: int,
    progress: Progress,
) -> tuple[tuple[Candidate, ...], dict[str, tuple[Twin, ...]]]:
    """Grow a twin of each law, and `count` of the best (`best_candidate`)."""
    twins: dict[str, tuple[Twin, ...]] = {}

    def grow(law: Candidate, share: float) -> Candidate:
        start = seed + len(twins.get(law.name, ()))
        progress(f"growing: {TITLES[law.name]}, seed {start}", share)
        twins[law.name] = (*twins.get(law.name, ()), twin(law, prepared, start, schedule))
        return law.compare(measured, twins[law.name])

    laws = tuple(grow(law, 0.7 * k / len(laws)) for k, law in enumerate(laws))
    most = 2 * count  # another twin may make another law the best
    for k in range(most):
        best = best_candidate(laws)
        if best is not None and len(twins[best.name]) < count:
            laws = tuple(grow(law, 0.7 + 0.3 * k / most) if law is best else law for law in laws)
    return laws, twins


def _read_and_prepare(
    scan: Source, label: int | None, crop: Crop | None, options: Mapping[str, Any], reading: Mapping[str, Any]
) -> tuple[Volume, tuple[int, int, int], Prepared]:
    """Return a scan, or a large one's middle at the level that suits its structure, the level's shape, and prepared."""
    whole = options["roi"] is not None or options["periodic"]
    volume, shape = read_scan(scan, label=label, crop=crop, whole=whole, **reading)
    if (roi := options["roi"]) is not None:
        region, laid = read_region(roi, volume, scan, crop, **reading)
        volume, options = replace(volume, notes=volume.notes + laid), {**options, "roi": region}
    prepared = prepare(volume, one_scale=True, **options)
    if crop is None and label is None and volume.shape != shape:
        level = coarser_level(scan, shape, prepared, **reading)
        if level is not None:
            other, size = read_scan(scan, **{**reading, "key": level})
            note = f"Read at the level {level} of its pyramid, which shows more of this large scan than the finest."
            other = replace(other, notes=(*other.notes, note))
            coarser = prepare(other, one_scale=True, **options)
            if coarser.kind == prepared.kind:  # the means of a mask are an image
                return other, size, coarser
    return volume, shape, prepared


def _describe(prepared: Prepared, measured: Diagram | None, provenance: dict[str, Any], status: str) -> Fit:
    """Return the fit of a scan before its law is sought: what was measured."""
    grid = prepared.grid
    return Fit(
        kind=prepared.kind,
        family="noise" if measured is None else family_of(measured, prepared.thickness / 2 * grid.spacing[0]),
        scale=prepared.scale,
        working_voxel=prepared.working_voxel,
        length_unit=prepared.unit,
        thickness=prepared.thickness * prepared.working_voxel,
        status=status,
        morphometry=morphometry(prepared.mask, prepared.working_voxel, prepared.unit, periodic=grid.periodic),
        notes=prepared.notes,
        provenance=provenance,
        diagram=None if measured is None else measured.thin(BIN_WIDTH, TAIL_SHARE),
    )


def _provenance(
    volume: Volume, shape: tuple[int, ...], atlas: Atlas, posterior: Posterior, seed: int
) -> dict[str, Any]:
    return {
        "curvafit": version("curvafit"),
        "scan": str(volume.source),
        "scan_shape": list(shape),
        "scan_spacing": list(volume.spacing),
        "seed": seed,
        "schedule": SCHEDULES[LEARNED].as_dict(),
        "epsilon": WORKING_EPSILON,
        "atlas": {"format": VERSION, "shapes": len(atlas.ids)},
        "posterior": {name: value for name, value in posterior.provenance.items() if name != "table"},
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "torch": version("torch"),
        "numpy": version("numpy"),
    }
