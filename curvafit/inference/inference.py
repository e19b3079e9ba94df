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
from curvafit.core.runtime import Pictured, Progress, log_stages, sub_progress
from curvafit.core.units import format_number
from curvafit.generation.schedule import LEARNED, schedule
from curvafit.geometry.diagrams import BIN_WIDTH, TAIL_SHARE, Diagram, family_of
from curvafit.geometry.morphology import Morphometry, morphometry
from curvafit.inference.atlas import VERSION, Atlas, Match, load_atlas, mirror_match, nearest
from curvafit.inference.candidates import TITLES, Candidate, Growth, Twin, best_candidate, twin, verdict
from curvafit.inference.estimate import Estimate, estimate_law, measure_descriptors, refine_matches
from curvafit.inference.fit import KINDS, Fit
from curvafit.inference.posterior import Posterior, load_posterior
from curvafit.inference.stationary import stationarity
from curvafit.priors.grid import WORKING_EPSILON
from curvafit.priors.kernels.threads import map_threads
from curvafit.priors.law import Law
from curvafit.scan.measures import scan_diagram
from curvafit.scan.preparation import HALF, NOISE, Prepared, prepare, read_scan, why_no_texture
from curvafit.scan.structure import check_options, is_rounded, read_region
from curvafit.volumes.read import Source
from curvafit.volumes.volume import Volume

#: Number of nearest shapes, and how many of them stationarity starts from.
MATCHES, STARTS = 5, 3
#: Whether a method refines the nearest match, in place of draws from the posterior.
REFINED = {"posterior": False, "match": True}


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
    """

    scan: Volume
    prepared: Prepared
    diagram: Diagram | None
    twins: dict[str, tuple[Twin, ...]]
    fit: Fit

    def __repr__(self) -> str:
        fit = self.fit
        size = " x ".join(map(str, self.scan.values.shape))
        distances = ", ".join(f"{law.name} {format_number(law.distance, 2)}" for law in fit.candidates)
        return f"Inference({fit.family} from {KINDS[fit.kind]} of {size} voxels, distances: {distances}. {fit.status})"

    @property
    def best(self) -> np.ndarray | None:
        """Return the first shape grown from the chosen law."""
        return self.shape_of(self.fit.chosen)

    def shape_of(self, name: str | None) -> np.ndarray | None:
        """Return the first shape grown from a candidate's law; None where none grew."""
        return next((twin.phase for twin in self.twins.get(name or "", ()) if twin.phase is not None), None)

    def to_law(self) -> Law:
        """Return the fit as a law, so that an inference is taken wherever a law is."""
        return self.fit.to_law()


def infer(
    scan: Source,
    *,
    kind: Literal["auto", "field", "mask", "image"] = "auto",
    periodic: bool = False,
    threshold: float | Literal["otsu"] = "otsu",
    dark: bool = False,
    roi: Source | None = None,
    atlas: str | Path | Atlas | None = None,
    posterior: str | Path | Posterior | None = None,
    method: Literal["posterior", "match"] = "posterior",
    growth: Growth | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    **reading: Any,
) -> Inference:
    """Infer the generation parameters (a, m₀) of a scanned volume.

    A posterior of the parameters is read from the scan's descriptors, and the scan is tested: does it look as shapes of
    laws do? With `growth`, shapes of the law in the posterior's middle, of the nearest shape of the atlas and, of a
    phase field, of its stationarity are grown; the law is the one whose shapes are nearest to the scan.

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
    threshold, dark, roi
        How structure and background are split: see `curvafit.scan.prepare`.
    atlas, posterior
        The shapes to match against, and what reads the descriptors; by default the packaged ones.
    method
        `"posterior"`, or `"match"`: nearest match, then gradient refinement. A match alone has no intervals.
    growth
        Which shapes are grown to compare laws: `Growth()` takes a minute. By default nothing is grown: the result takes
        seconds, and its law is `Not tested`.
    seed, progress
        Seed of draws and shapes. `progress` is called with a sentence and the share done; by default the logger
        `curvafit` gets each stage once, at level INFO.
    reading
        Options of reading a file or an array: spacing, unit, label, crop and the others of `curvafit.load`. A `crop`
        applies to the scan and to `roi`.
    """
    check_options(kind, threshold, reading.get("label"))
    check_choice(method, REFINED, "method posterior or match")
    seed = check_int(seed, "a seed that is a whole number from 0", 0, SEEDS - 2)  # and the next one
    progress = progress or log_stages()
    progress("reading the scan", 0.0)
    check_type(atlas, (str, Path, Atlas, type(None)), "an atlas, as the path of a file or as Atlas")
    check_type(posterior, (str, Path, Posterior, type(None)), "a posterior, as the path of a file or as Posterior")
    atlas = atlas if isinstance(atlas, Atlas) else load_atlas(atlas)
    posterior = posterior if isinstance(posterior, Posterior) else load_posterior(posterior)
    structure = {"kind": kind, "periodic": periodic, "threshold": threshold, "dark": dark, "roi": roi}
    volume, shape, prepared = _read_and_prepare(scan, structure, reading)
    progress("measuring curvature", 0.05)
    diagram = None if prepared.noise else scan_diagram(prepared)
    figures = morphometry(prepared.mask, prepared.working_voxel, prepared.unit, periodic=prepared.grid.periodic)
    status = NOISE if diagram is None else why_no_texture(prepared, diagram)
    estimate, chosen = Estimate(), None
    twins: dict[str, tuple[Twin, ...]] = {}
    if diagram is not None and not status:
        options = {"refined": REFINED[method], "seed": seed, "progress": progress}
        estimate = _estimate(prepared, diagram, atlas, posterior, **options)
        if growth is not None:
            estimate, twins = _grow(estimate, diagram, prepared, growth, seed, progress)
        chosen, status = verdict(estimate.candidates, estimate.misfit, figures, grown=growth is not None)
        progress("done", 1.0)
    provenance = _describe_provenance(volume, shape, atlas, posterior, growth, seed)
    fit = _build_fit(prepared, diagram, figures, estimate, chosen, status, provenance)
    return Inference(volume, prepared, diagram, twins, fit)


def _estimate(
    prepared: Prepared, diagram: Diagram, atlas: Atlas, posterior: Posterior, *, refined: bool, seed: int,
    progress: Progress,
) -> Estimate:  # fmt: skip
    """Estimate the law of a scan; the candidates to grow are, in this order, the law by which a phase field is
    stationary, that read from the descriptors, and the nearest match of the atlas."""
    progress("measuring descriptors", 0.1)
    described = measure_descriptors(prepared)
    progress("searching the atlas", 0.3)
    matches, estimate = _find_matches(prepared, diagram, atlas, exact=refined), Estimate()
    if described is not None:
        progress("reading the posterior", 0.4)
        law = (described, posterior)
        estimate = refine_matches(*law, matches) if refined else estimate_law(*law, seed)
    match = Candidate("match", matches[0].coefficients, matches[0].mass, {}, matches[0].thickness)
    laws = (*estimate.candidates, match)
    if prepared.kind == "field" and not is_rounded(prepared.phase):
        starts = [law.coefficients for law in (*estimate.candidates, *matches[:STARTS])]
        options = {"starts": starts, "seed": seed, "progress": sub_progress(progress, 0.5, 0.6)}
        window = prepared.window
        phase = torch.from_numpy(np.ascontiguousarray(prepared.phase[window]))
        laws = (stationarity(phase, prepared.part(window), WORKING_EPSILON, **options), *laws)
    return replace(estimate, candidates=laws, matches=matches)


def _find_matches(prepared: Prepared, diagram: Diagram, atlas: Atlas, *, exact: bool) -> tuple[Match, ...]:
    """Return the shapes of the atlas that are nearest to a scan."""
    seen_as = "field" if prepared.kind == "field" else "mask"
    # The shapes of an atlas fill less than half of their box: of a structure that fills more, the background is sought.
    inverted = prepared.volume_fraction > HALF
    query = diagram.mirrored if inverted else diagram
    matches = nearest(query, atlas, seen_as=seen_as, count=MATCHES, exact=exact)
    return tuple(map(mirror_match, matches)) if inverted else tuple(matches)


def _grow(
    estimate: Estimate, diagram: Diagram, prepared: Prepared, growth: Growth, seed: int, progress: Progress
) -> tuple[Estimate, dict[str, tuple[Twin, ...]]]:
    """Grow a twin of each law, and `growth.twins` of the best; return the compared laws, and the twins by law."""
    laws = {law.name: law for law in estimate.candidates}
    twins: dict[str, tuple[Twin, ...]] = dict.fromkeys(laws, ())
    stage = sub_progress(progress, 0.6, 1.0)

    def grow(numbered: list[tuple[str, int]]) -> None:
        shapes = map_threads(lambda one: twin(laws[one[0]], prepared, seed + one[1], growth.schedule), numbered)
        for (name, _), shape in zip(numbered, shapes, strict=True):
            twins[name] = (*twins[name], shape)
            stage(f"grown: {TITLES[name]}, shape {len(twins[name])}", min(1.0, sum(map(len, twins.values())) / total))
        laws.update({name: laws[name].compare(diagram, twins[name]) for name in {name for name, _ in numbered}})

    total = max(1, len(laws) + growth.twins - 1)
    grow([(name, 0) for name in laws])
    for number, law in enumerate(estimate.others, 2):
        if (middle := laws[law.name]).distance is not None:
            break
        twins[law.name] = ()
        laws[law.name] = replace(law, status=f"Nothing grew from the middle: this is draw {number} from there.")
        grow([(law.name, 0)])
        laws[law.name] = middle if laws[law.name].distance is None else laws[law.name]
    for _ in range(2):  # the second time, further twins may have made another law the best
        best = best_candidate(tuple(laws.values()))
        if best is not None:
            grow([(best.name, k) for k in range(len(twins[best.name]), growth.twins)])
    return replace(estimate, candidates=tuple(laws.values())), twins


def _read_and_prepare(
    scan: Source, options: Mapping[str, Any], reading: Mapping[str, Any]
) -> tuple[Volume, tuple[int, int, int], Prepared]:
    """Read and prepare a scan; of a large one its middle. Returns the scan as read, the shape of all of it, and the
    prepared scan."""
    roi = options["roi"]
    volume, shape = read_scan(scan, whole=roi is not None or options["periodic"], **reading)
    if roi is not None:
        position = {name: value for name, value in reading.items() if name not in ("label", "crop")}
        region, region_notes = read_region(roi, volume, scan, reading.get("crop"), **position)
        volume, options = replace(volume, notes=volume.notes + region_notes), {**options, "roi": region}
    return volume, shape, prepare(volume, one_scale=True, **options)


def _build_fit(
    prepared: Prepared, diagram: Diagram | None, figures: Morphometry, estimate: Estimate, chosen: str | None,
    status: str, provenance: dict[str, Any],
) -> Fit:  # fmt: skip
    grid, thickness = prepared.grid, next((law.thickness for law in estimate.candidates if law.name == chosen), None)
    # The voxel of a phase field follows from its interface width; a mask shows none, so its thickness decides.
    ratio = 1.0 if thickness is None or prepared.kind == "field" else prepared.thickness / thickness
    return Fit(
        kind=prepared.kind,
        family="noise" if diagram is None else family_of(diagram, prepared.thickness / 2 * grid.spacing[0]),
        scale=tuple(ratio * scale for scale in prepared.scale),  # type: ignore[arg-type]
        working_voxel=ratio * prepared.working_voxel,
        length_unit=prepared.unit,
        thickness=prepared.thickness * prepared.working_voxel,
        status=status,
        morphometry=figures,
        notes=prepared.notes,
        provenance=provenance,
        diagram=None if diagram is None else diagram.thin(BIN_WIDTH, TAIL_SHARE).normalised,
        candidates=estimate.candidates,
        chosen=chosen,
        draws=estimate.draws,
        view=estimate.view,
        combinations=estimate.combinations,
        misfit=estimate.misfit,
        matches=estimate.matches,
    )


def _describe_provenance(
    volume: Volume, shape: tuple[int, ...], atlas: Atlas, posterior: Posterior, growth: Growth | None, seed: int
) -> dict[str, Any]:
    return {
        "curvafit": version("curvafit"),
        "scan": str(volume.source),
        "scan_shape": list(shape),
        "scan_spacing": list(volume.spacing),
        "seed": seed,
        "schedule": schedule(LEARNED if growth is None else growth.schedule).as_dict(),
        "epsilon": WORKING_EPSILON,
        "atlas": {"format": VERSION, "shapes": len(atlas.ids)},
        "posterior": {name: value for name, value in posterior.provenance.items() if name != "table"},
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "torch": version("torch"),
        "numpy": version("numpy"),
    }
