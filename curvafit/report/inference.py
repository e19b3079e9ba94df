"""The report of an inference: a page, `fit.json` and the regenerated volume."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from curvafit.core.records import Format
from curvafit.core.units import format_length, format_number, format_percent, format_sampling, power_name, unit_name
from curvafit.drawing import plot
from curvafit.geometry.diagrams import Diagram
from curvafit.inference.candidates import SUPPORTED, TITLES, UNBELIEVABLE, Candidate, seed_noise_of
from curvafit.inference.inference import Inference
from curvafit.inference.posterior import KNOWN
from curvafit.inference.table import parameters_of
from curvafit.priors.law import FORMAT
from curvafit.report import page
from curvafit.scan.measures import QUANTITIES, Outline
from curvafit.volumes.volume import Box, Volume
from curvafit.volumes.write import save

#: What an inference writes into its folder.
FILES = ("fit.json", "report.html", "regenerated.nii.gz")
#: Each parameter as it is written, what it multiplies, and the power of 1/length that it carries in physical units.
_TERMS = {
    "a20": ("a₂₀", "κ₁²", 0), "a11": ("a₁₁", "κ₁κ₂", 0), "a02": ("a₀₂", "κ₂²", 0), "a10": ("a₁₀", "κ₁", 1),
    "a01": ("a₀₁", "κ₂", 1), "a00": ("a₀₀", "1", 2), "mass": ("m₀", "mass", 0),
}  # fmt: skip
#: The parameters as a corner plot names them.
SYMBOLS = ("a₁₁", "log a₀₂", "a₁₀", "a₀₁", "a₀₀", "m₀")
#: tan 22.5°: a family's points (κ1, κ2) lie within this angle of its ideal direction, as κ2 = 0 of tubes.
_NARROW = math.tan(math.pi / 8)
#: For each round family: which points (κ1, κ2) belong to it, and the curvature that is 1/radius.
_ROUND: dict[str, Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "spheres": lambda k1, k2: (k2 > _NARROW * k1, (k1 + k2) / 2),
    "tubes": lambda k1, k2: ((k1 > 0) & (np.abs(k2) < _NARROW * k1), k1),
    "tubular cavities": lambda k1, k2: ((k2 < 0) & (np.abs(k1) < -_NARROW * k2), -k2),
    "bubbles": lambda k1, k2: ((k1 < 0) & (-k1 > -_NARROW * k2), -(k1 + k2) / 2),
}
#: Returns the folder if `write_inference` can write there, else raises ValueError; call it before the work.
check_report = partial(page.check_result_folder, Format(FORMAT), FILES)


def write_inference(inference: Inference, directory: str | Path, *, command: str = "", overwrite: bool = False) -> Path:
    """Write `fit.json`, `report.html` and, if a shape was regenerated, `regenerated.nii.gz` into a folder.

    Return the report's path. What is replaced, and `command`, which the fit's provenance has, are as in
    `write_measures`.
    """
    if command:
        provenance = {**inference.fit.provenance, "command": command}
        inference = dataclasses.replace(inference, fit=dataclasses.replace(inference.fit, provenance=provenance))
    target = check_report(directory, overwrite=overwrite, command=command)
    with page.fill_folder(target, FILES) as work:
        (work / "fit.json").write_text(inference.fit.to_json(), encoding="utf-8")
        (work / "report.html").write_text(report_html(inference), encoding="utf-8")
        if inference.best is not None:
            edge = inference.fit.working_voxel
            save(Volume(inference.best, (edge, edge, edge), inference.fit.length_unit), work / "regenerated.nii.gz")
    return target / "report.html"


def report_html(inference: Inference) -> str:
    """Return the report of an inference as the text of its page."""
    fit, scan = inference.fit, inference.scan
    slices = page.outlines_figure([name_source(scan.source) or "the scan"], [_outline(inference)], scan.unit)
    made = {str(name).replace("_", " "): _to_words(value) for name, value in fit.provenance.items()}
    matches = []
    for match in fit.matches:
        parameters = map(format_number, (*match.coefficients, match.mass))
        matches.append((match.id, format_number(match.distance, 2), *parameters, str(match.seed)))
    return page.render(
        "report.html", title=f"{describe(inference)}.", made=made, version=fit.provenance.get("curvafit", ""), fit=fit,
        status=fit.status, voxel=format_length(inference.prepared.working_voxel, fit.length_unit, 3),
        scan=describe_scan(inference), matches=matches,
        slices=page.picture_of(slices, "Three slices with the outline of the structure"),
        shapes=_shapes(inference) if inference.twins else [],
        diagrams=[] if inference.diagram is None else _diagrams(inference), distances=_distances(inference),
        unit=format_length(fit.length, fit.length_unit, 3), twins=0 if fit.best is None else len(fit.best.twins),
        numbers=_number_rows(inference), known=KNOWN, law=_law(inference), corner=_corner(inference),
        symbols=[symbol for symbol, _, _ in _TERMS.values()], level=UNBELIEVABLE,
        supported=fit.status.startswith(SUPPORTED),
    )  # fmt: skip


# ---- words and numbers -----------------------------------------------------------------------------------------------


def describe(inference: Inference) -> str:
    """Return the sentence that a report opens with: family, size, share of the volume."""
    fit, numbers = inference.fit, inference.fit.morphometry
    radius = None if inference.diagram is None else family_radius(inference.diagram, fit.family)
    if fit.family in _ROUND:
        physical = numbers.thickness_mean / 2 if radius is None else radius * inference.prepared.length
        size = f"radius {format_length(physical, fit.length_unit)}"
    else:
        struts = "struts " if fit.family == "sponge" else ""
        size = f"{struts}{format_length(numbers.thickness_mean, fit.length_unit)} thick"
    phase = "in a phase that is " if fit.family in ("tubular cavities", "bubbles") else ""
    return f"{fit.family.capitalize()}, {size}, {phase}{format_percent(numbers.volume_fraction)} of the volume"


def family_radius(diagram: Diagram, family: str) -> float | None:
    """Return the area-weighted median radius of a round family, in the diagram's unit; None for another family."""
    if family not in _ROUND:
        return None
    inside, kappa = _ROUND[family](*np.asarray(diagram.points).T)
    inside = inside & (kappa > 0)
    if not inside.any():
        return None
    weights = np.asarray(diagram.weights)[inside]
    return float(1 / np.quantile(kappa[inside], 0.5, weights=weights, method="inverted_cdf"))


def describe_scan(inference: Inference) -> str:
    """Return what was read: name, kind, voxels and their size."""
    scan, kind = inference.scan, inference.fit.kind
    sampling = format_sampling(scan.shape, scan.spacing, scan.unit)
    return f"{name_source(scan.source) or 'a volume'}: {'phase ' * (kind == 'field')}{kind} of {sampling} (z, y, x)."


def name_source(source: str | None) -> str:
    """Return the name of a scan's file, with the key of its array."""
    path, _, key = (source or "").partition("::")
    return "::".join(filter(None, (Path(path).name, key)))


def _distances(inference: Inference) -> list[tuple[str, float | None, str]]:
    """Return (name, distance, CSS class) of each candidate's shape from the scan, and last of two seeds' shapes."""
    if not inference.twins:
        return []
    chosen = inference.fit.chosen
    laws = [(_title(law), law.distance, "best" if law.name == chosen else "") for law in _chosen_first(inference)]
    return [*laws, ("Two seeds", seed_noise_of(inference.fit.candidates), "noise")]


def _number_rows(inference: Inference) -> list[list[str]]:
    """Return rows of familiar numbers: the scan's, the twins' mean with its range, and the ratio of mean and scan."""
    scan, best = inference.fit.morphometry, inference.fit.best
    twins, unit = () if best is None else best.twins, scan.unit
    keys = {"BV/TV": "volume_fraction", "Tb.Th": "thickness_mean", "Tb.Sp": "spacing_mean"}
    keys |= {"Conn.D": "connectivity_density", "BS/BV": "surface_to_volume"}
    rows = []
    for name, symbol, power, _ in (quantity for quantity in QUANTITIES if quantity[1] in keys):
        value, twin_values = float(getattr(scan, keys[symbol])), [float(getattr(twin, keys[symbol])) for twin in twins]
        row = [name, symbol, f"{format_number(value, 4)} {power_name(unit, power)}".rstrip()]
        if twin_values:
            average, least, most = fmean(twin_values), min(twin_values), max(twin_values)
            extremes = f" ({format_number(least, 4)} to {format_number(most, 4)})" if len(twin_values) > 1 else ""
            row += [format_number(average, 4) + extremes, format_number(average / value, 2) if value else "–"]
        rows.append(row)
    return rows


def parameter_table(inference: Inference) -> list[tuple[str, ...]]:
    """Return a row for each parameter: name, chosen value, deviation, the posterior's median, 50 % and 90 % interval,
    physical value and its unit; without a law there are no rows."""
    fit, best, physical = inference.fit, inference.fit.best, inference.fit.coefficients_physical
    if best is None or physical is None:
        return []
    intervals = fit.intervals() or {}
    rows = []
    for name, value in {**best.coefficients.as_dict(), "mass": best.mass}.items():
        posterior = ("", "", "")
        if interval := intervals.get(name):
            ranges = (" to ".join(map(format_number, interval[level])) for level in ("50", "90"))
            posterior = (format_number(interval["median"]), *ranges)
        σ = best.uncertainty.get(name)
        deviation = "" if σ is None else "fixed" if σ == 0 else format_number(σ, 2)
        scaled = "" if name == "mass" else format_number(physical.as_dict()[name])
        unit = power_name(fit.length_unit, -_TERMS[name][2])
        rows.append((name, format_number(value), deviation, *posterior, scaled, unit))
    return rows


def _law(inference: Inference) -> dict[str, Any] | None:
    """Return the chosen law's table and what explains it on the page; None without a law."""
    fit, best = inference.fit, inference.fit.best
    if best is None:
        return None
    rows = [
        (*_TERMS[name][:2], page.Chosen(value), *cells, page.Chosen(physical), unit)
        for name, value, *cells, physical, unit in parameter_table(inference)
    ]
    width = ("0.02", "", "", "", "", format_number(fit.epsilon_physical), unit_name(fit.length_unit, 2))
    coefficients = best.coefficients.as_dict()  # only their ratios matter: a law fixes one of them, its gauge
    fixed = [name for name in ("a20", "a02") if abs(coefficients[name] - 1) < 1e-9]
    return {
        "rows": [*rows, ("ε", "interface", *width)],
        "gauge": f"here {_TERMS[fixed[0]][0]} = 1" if fixed else "all six may be multiplied by one factor",
        "voxel": format_length(fit.working_voxel, fit.length_unit, 3),
        "title": TITLES.get(best.name, best.name),
    }


def _to_words(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_to_words(entry)}" for name, entry in value.items())
    return ", ".join(map(_to_words, value)) if isinstance(value, (list, tuple)) else str(value)


def _chosen_first(inference: Inference) -> list[Candidate]:
    return sorted(inference.fit.candidates, key=lambda candidate: candidate.name != inference.fit.chosen)


def _title(candidate: Candidate) -> str:
    title = TITLES.get(candidate.name, candidate.name)
    return title[0].upper() + title[1:]


# ---- pictures --------------------------------------------------------------------------------------------------------


def inference_figure(inference: Inference, **options: Any) -> Figure:
    """Return a figure of the scan's surface beside its regrown twin.

    Where no twin grew, the scan is alone. `options` are those of `gallery_figure`.
    """
    shapes = {"the scan": scan_box(inference)}
    if inference.best is not None:
        shapes[f"regrown: {TITLES[str(inference.fit.chosen)]}"] = inference.best
    return plot.gallery_figure(shapes, **{"columns": 2, "width": 900, **options})


def _outline(inference: Inference) -> Outline:
    """Cut three slices through the middle of what was measured, with the structure on the working grid."""
    prepared = inference.prepared
    padded = np.pad(prepared.mask, 1)  # nothing is inside beyond the grid

    def find_inside(box: Box) -> np.ndarray:
        indices = [
            np.clip(np.floor((np.arange(side.start, side.stop) + 0.5 - first) / step).astype(int), -1, n) + 1
            for side, first, step, n in zip(box, prepared.origin, prepared.scale, prepared.mask.shape, strict=True)
        ]
        return padded[np.ix_(*indices)]

    middle = np.array(prepared.origin) + np.array(prepared.scale) * prepared.mask.shape / 2
    return Outline.cut(inference.scan, find_inside, places=[int(place) for place in middle])


def _shapes(inference: Inference) -> list[page.Picture]:
    """Return pictures of the surfaces of the scan and of each candidate's shape, in boxes of one size."""
    fit = inference.fit
    verdict = "best supported" if fit.status.startswith(SUPPORTED) else "the nearest"
    pictures = [_shape(inference, "The scan", scan_box(inference))]
    for candidate in _chosen_first(inference):
        distance = "" if candidate.distance is None else f"; distance {candidate.distance:.1f}"
        badge = verdict if candidate.name == fit.chosen else ""
        u = inference.shape_of(candidate.name)
        pictures.append(_shape(inference, f"{_title(candidate)}, regrown", u, distance, badge))
    return pictures


def _shape(inference: Inference, title: str, u: np.ndarray | None, note: str = "", badge: str = "") -> page.Picture:
    """Return a picture of one surface, without data if there is no shape; `note` follows the size of its box."""
    if u is None:
        return page.picture_of(None, "", title=title, badge=badge)
    edges = [format_length(n * inference.fit.working_voxel, inference.fit.length_unit, 3) for n in u.shape]
    box = f"edge {edges[0]}" if len(set(edges)) == 1 else " × ".join(edges)
    return page.picture_of(plot.surface_figure(u), f"Surface: {title}", title=title, text=box + note, badge=badge)


def scan_box(inference: Inference) -> np.ndarray:
    """Return the main window's phase field, cut to the size of the regenerated shape so that both have one scale."""
    phase = inference.prepared.phase[inference.prepared.window]
    if inference.best is None:
        return phase
    shape = inference.best.shape
    starts = [(n - min(n, m)) // 2 for n, m in zip(phase.shape, shape, strict=True)]
    return phase[tuple(slice(start, start + m) for start, m in zip(starts, shape, strict=True))]


def _diagrams(inference: Inference) -> list[page.Picture]:
    """Return curvature diagrams of the scan, the chosen law and the match, with shared axes, in the scan's unit."""
    working = {"The scan": inference.diagram}
    for candidate in _chosen_first(inference) if inference.twins else ():
        if candidate.name in (inference.fit.chosen, "match"):
            regrown = (twin.diagram for twin in inference.twins.get(candidate.name, ()) if twin.diagram)
            working[f"{_title(candidate)}, regrown"] = next(regrown, None)
    λ, unit = inference.prepared.length, f"1/{inference.fit.length_unit}"
    diagrams = {title: d and dataclasses.replace(d, points=d.points / λ, unit=unit) for title, d in working.items()}
    limits = plot.shared_limits([diagram for diagram in diagrams.values() if diagram is not None])
    pictures = []
    for title, diagram in diagrams.items():
        figure = None if diagram is None else plot.diagram_figure(diagram, limits=limits)
        pictures.append(page.picture_of(figure, f"Curvature diagram: {title}", title=title))
    return pictures


def _corner(inference: Inference) -> page.Picture | None:
    """Return a corner plot of the posterior's draws, in working units, with marks for the chosen law and the match."""
    fit = inference.fit
    if fit.draws is None or fit.best is None:
        return None
    draws = fit.draws[:, : len(SYMBOLS)]
    laws = [candidate for candidate in fit.candidates if candidate.name in (fit.chosen, "match")]
    marks = {_title(law): parameters_of(law.coefficients, law.mass) for law in laws}
    # The axes show 99 % of the draws, and all marks.
    extremes = np.concatenate([np.percentile(draws, (0.5, 99.5), axis=0), *(mark[None] for mark in marks.values())])
    low, high = extremes.min(0), extremes.max(0)
    margin = 0.06 * np.maximum(high - low, 1e-6)
    limits = list(zip((low - margin).tolist(), (high + margin).tolist(), strict=True))
    return page.picture_of(plot.corner_figure(draws, SYMBOLS, limits, marks), "Draws of the parameters, two by two")
