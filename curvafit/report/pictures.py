"""The pictures of a report, each as an HTML figure with its image inside."""

from __future__ import annotations

import base64
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from curvafit.drawing.plot import diagram_figure, gallery_figure, png, shared_limits, slice_figure, surface_figure
from curvafit.units import length

if TYPE_CHECKING:
    from curvafit.inference.infer import Inference

_AXES = "zyx"
#: The three shapes of a report: which parameters made it, its title.
_SHAPES = ((None, "The scan"), ("match", "Nearest match, regrown"), ("fit", "Refined, regrown"))
#: What the better supported shape was grown from.
TWINS = {"match": "nearest match", "fit": "refined parameters"}


def inference_figure(inference: Inference, **options: Any) -> Figure:
    """Return a figure of the scan's surface beside its regrown twin, the better supported of the two.

    Where no twin grew, the scan is alone. `options` are those of `gallery_figure`.
    """
    shapes = {"the scan": scan_box(inference)}
    if inference.best is not None:
        shapes[f"regrown: {TWINS[inference.fit.chosen]}"] = inference.best
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
    """Return pictures of the scan's surface, the matched and the regenerated shape, in boxes of one size."""
    shapes = (scan_box(inference), inference.matched, inference.regenerated)
    return "".join(_shape(inference, name, title, u) for (name, title), u in zip(_SHAPES, shapes, strict=True))


def diagram_figures(inference: Inference) -> str:
    """Return the three curvature diagrams with shared axes, in the scan's unit."""
    diagrams = (inference.diagram, inference.match_diagram, inference.fit_diagram)
    λ, unit = inference.fit.length, inference.fit.length_unit
    limits = shared_limits([diagram for diagram in diagrams if diagram is not None], length=λ)
    parts = []
    for (name, title), diagram in zip(_SHAPES, diagrams, strict=True):
        caption = f"<b>{title}</b>{_badge(inference, name)}"
        if diagram is None:
            parts.append(_missing(caption))
        else:
            figure = diagram_figure(diagram, limits=limits, unit=unit, length=λ)
            parts.append(_figure(figure, f"Curvature diagram: {title}", caption))
    return "".join(parts)


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


def _shape(inference: Inference, name: str | None, title: str, u: np.ndarray | None) -> str:
    caption = f"<b>{title}</b>{_badge(inference, name)}"
    if u is None:
        return _missing(caption)
    fit = inference.fit
    edges = [length(n * fit.working_voxel, fit.length_unit, 3) for n in u.shape]
    box = f"edge {edges[0]}" if len(set(edges)) == 1 else " × ".join(edges)
    distance = "" if name is None else f"; distance {fit.distances[name]:.1f}"
    return _figure(surface_figure(u), f"Surface: {title}", f"{caption}<br>{escape(box + distance)}")


def _badge(inference: Inference, name: str | None) -> str:
    return ' <span class="badge">better supported</span>' if name == inference.fit.chosen else ""


def _figure(figure: Figure, alt: str, caption: str) -> str:
    data = base64.b64encode(png(figure)).decode("ascii")
    image = f'<img alt="{escape(alt)}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>\n"


def _missing(caption: str) -> str:
    box = '<div class="none">no shape grew from these parameters</div>'
    return f"<figure>{box}<figcaption>{caption}</figcaption></figure>\n"
