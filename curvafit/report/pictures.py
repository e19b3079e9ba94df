"""The pictures of a report, each as an HTML figure with its image inside."""

from __future__ import annotations

import base64
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from curvafit.core.units import length, number
from curvafit.drawing.plot import (
    bands_figure,
    corner_figure,
    diagram_figure,
    gallery_figure,
    png,
    shared_limits,
    slice_figure,
    surface_figure,
)
from curvafit.inference.candidates import TITLES, UNBELIEVED, UNDECIDED, Candidate
from curvafit.inference.table import parameters_of

if TYPE_CHECKING:
    from curvafit.geometry.diagram import Diagram
    from curvafit.inference.infer import Inference

_AXES = "zyx"
#: The parameters as a corner plot names them.
SYMBOLS = ("a₁₁", "log a₀₂", "a₁₀", "a₀₁", "a₀₀", "m₀")


def inference_figure(inference: Inference, **options: Any) -> Figure:
    """Return a figure of the scan's surface beside its regrown twin.

    Where no twin grew, the scan is alone. `options` are those of `gallery_figure`.
    """
    shapes = {"the scan": scan_box(inference)}
    if inference.best is not None:
        shapes[f"regrown: {TITLES[str(inference.fit.chosen)]}"] = inference.best
    return gallery_figure(shapes, **{"columns": 2, "width": 900, **options})


def slice_figures(inference: Inference) -> str:
    """Return slices across z, y and x through the main window's middle: the scan's grey values, the contour on top."""
    values, prepared = inference.scan.values, inference.prepared
    sample = np.asarray(values[:: max(1, values.shape[0] // 64)], dtype=np.float32)
    low, high = (float(v) for v in np.percentile(sample, (0.5, 99.5)))
    limits = (low, high) if high > low else (float(sample.min()), float(sample.max()))
    middle = [(edge.start + edge.stop) // 2 for edge in prepared.windows[0]]
    return "".join(_slice(inference, axis, middle[axis], limits) for axis in range(3))


def surface_figures(inference: Inference) -> str:
    """Return pictures of the scan's surface and of what grew from each candidate, in boxes of one size."""
    shapes = [(None, scan_box(inference)), *((each, inference.shape_of(each.name)) for each in shown(inference))]
    return "".join(_shape(inference, candidate, u) for candidate, u in shapes)


def diagram_figures(inference: Inference) -> str:
    """Return curvature diagrams with shared axes, in the scan's unit: the scan's, the chosen law's, the match's."""
    diagrams = [("The scan", inference.diagram), *_grown_diagrams(inference)]
    λ, unit = inference.fit.length, inference.fit.length_unit
    limits = shared_limits([diagram for _, diagram in diagrams if diagram is not None], length=λ)
    parts = []
    for title, diagram in diagrams:
        caption = f"<b>{escape(title)}</b>"
        if diagram is None:
            parts.append(_missing(caption))
        else:
            figure = diagram_figure(diagram, limits=limits, unit=unit, length=λ)
            parts.append(_figure(figure, f"Curvature diagram: {title}", caption))
    return "".join(parts)


def corner(inference: Inference) -> str:
    """Return the corner plot of the posterior's draws in working units, the chosen law and the match marked."""
    draws = inference.fit.draws
    if draws is None:
        return ""
    marks = {}
    for each in inference.fit.candidates:
        if each.name in (inference.fit.chosen, "match"):
            marks[title_of(each)] = _place(each)
    figure = corner_figure(draws.parameters, SYMBOLS, _limits(draws.parameters, marks), marks)
    return _figure(figure, "Draws of the parameters, two by two", "")


def bands(inference: Inference) -> str:
    """Return the scan's descriptors on the bands of simulated ones, block by block; nothing where none were made."""
    misfit = inference.fit.misfit
    if inference.simulated is None or misfit is None:
        return ""
    titles = {name: f"{name}, p = {number(misfit.blocks.get(name), 2)}" for name in inference.simulated}
    figure = bands_figure({titles[name]: block for name, block in inference.simulated.items()})
    return _figure(
        figure,
        "The scan's descriptors on the bands of simulated shapes",
        "Orange: the scan. Bands: 50 and 90 % of shapes grown from draws of the posterior, seen as the scan is. "
        "Lengths in working units; quantiles from the least to the greatest.",
    )


def shown(inference: Inference) -> list[Candidate]:
    """Return the candidates in the order in which a page shows them: the chosen one first."""
    fit = inference.fit
    return sorted(fit.candidates, key=lambda each: each.name != fit.chosen)


def title_of(candidate: Candidate) -> str:
    """Return a candidate's title, with a capital."""
    title = TITLES.get(candidate.name, candidate.name)
    return title[0].upper() + title[1:]


def _grown_diagrams(inference: Inference) -> list[tuple[str, Diagram | None]]:
    """Return the titles and diagrams of the chosen law's first shape and of the nearest match's."""
    chosen = [each for each in shown(inference) if each.name in (inference.fit.chosen, "match")]
    twins = [(title_of(each), inference.twins.get(each.name, ())) for each in chosen]
    return [
        (f"{title}, regrown", next((twin.diagram for twin in grown if twin.diagram), None)) for title, grown in twins
    ]


def _place(candidate: Candidate) -> np.ndarray:
    """Return a law's place among the draws."""
    return parameters_of(candidate.coefficients, candidate.mass)


def _limits(draws: np.ndarray, marks: dict[str, np.ndarray]) -> list[tuple[float, float]]:
    """Return the axes of the parameters: all draws but the outermost, and all marks."""
    rows = np.concatenate([np.percentile(draws, (0.5, 99.5), axis=0), *(mark[None] for mark in marks.values())])
    low, high = rows.min(0), rows.max(0)
    rim = 0.06 * np.maximum(high - low, 1e-6)
    return list(zip((low - rim).tolist(), (high + rim).tolist(), strict=True))


def scan_box(inference: Inference) -> np.ndarray:
    """Return the main window's phase field, cut to the regenerated boxes' size so that all three have one scale."""
    phase = inference.prepared.phase[inference.prepared.windows[0]]
    other = inference.best
    if other is None:
        return phase
    starts = [(n - min(n, m)) // 2 for n, m in zip(phase.shape, other.shape, strict=True)]
    return phase[tuple(slice(s, s + m) for s, m in zip(starts, other.shape, strict=True))]


def window_framed(inference: Inference) -> bool:
    """Return whether the main window is smaller than what the slices show."""
    shape = inference.prepared.phase.shape
    return any(edge.stop - edge.start < n for edge, n in zip(inference.prepared.windows[0], shape, strict=True))


def _slice(inference: Inference, axis: int, index: int, limits: tuple[float, float]) -> str:
    """Return one slice: the scan and the structure are placed by their voxels' edges, in the scan's unit."""
    scan, prepared = inference.scan, inference.prepared
    down, across = (k for k in range(3) if k != axis)
    place = prepared.origin[axis] + (index + 0.5) * prepared.scale[axis]
    row = int(np.clip(place, 0, scan.values.shape[axis] - 1))
    start, step = np.array(prepared.origin) * scan.spacing, np.array(prepared.scale) * scan.spacing
    stop = start + step * prepared.phase.shape
    first = start + step * [edge.start for edge in prepared.windows[0]]
    last = start + step * [edge.stop for edge in prepared.windows[0]]
    size = np.array(scan.values.shape) * scan.spacing
    framed = (first[across], last[across], last[down], first[down]) if window_framed(inference) else None
    figure = slice_figure(
        np.asarray(scan.values.take(row, axis), dtype=np.float32),
        prepared.phase.take(index, axis),
        image_extent=(0.0, size[across], size[down], 0.0),
        extent=(start[across], stop[across], stop[down], start[down]),
        limits=limits,
        unit=scan.unit,
        axes_names=(_AXES[down], _AXES[across]),
        window=framed,
    )
    depth = length((row + 0.5) * scan.spacing[axis], scan.unit)
    caption = f"<b>Across {_AXES[axis]}</b>, slice {row} of {scan.values.shape[axis]}, at {escape(depth)}"
    return _figure(figure, f"Slice across {_AXES[axis]} with the surface's outline", caption)


def _shape(inference: Inference, candidate: Candidate | None, u: np.ndarray | None) -> str:
    fit = inference.fit
    title = "The scan" if candidate is None else f"{title_of(candidate)}, regrown"
    chosen = candidate is not None and candidate.name == fit.chosen
    word = "the nearest" if fit.status.startswith((UNBELIEVED, UNDECIDED)) else "best supported"
    caption = f"<b>{escape(title)}</b>" + f' <span class="badge">{word}</span>' * chosen
    if u is None:
        return _missing(caption)
    edges = [length(n * fit.working_voxel, fit.length_unit, 3) for n in u.shape]
    box = f"edge {edges[0]}" if len(set(edges)) == 1 else " × ".join(edges)
    distance = "" if candidate is None or candidate.distance is None else f"; distance {candidate.distance:.1f}"
    return _figure(surface_figure(u), f"Surface: {title}", f"{caption}<br>{escape(box + distance)}")


def _figure(figure: Figure, alt: str, caption: str) -> str:
    data = base64.b64encode(png(figure)).decode("ascii")
    image = f'<img alt="{escape(alt)}" src="data:image/png;base64,{data}">'
    below = f"<figcaption>{caption}</figcaption>" if caption else ""
    return f"<figure>{image}{below}</figure>\n"


def _missing(caption: str) -> str:
    box = '<div class="none">no shape grew from these parameters</div>'
    return f"<figure>{box}<figcaption>{caption}</figcaption></figure>\n"
