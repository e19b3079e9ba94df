"""Pictures: surfaces, slices with the structure's contour, curvature diagrams.

Each kind has a function that draws on matplotlib axes and one that makes a `Figure` of its own; neither touches
pyplot's global state. Arrays are z,y,x.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import QuadMesh
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import gaussian_filter

from curvafit.core.files import write_content
from curvafit.core.units import format_length, unit_name
from curvafit.drawing.rendering import DPI, QUIET, render_in_box
from curvafit.generation.result import Flow
from curvafit.geometry.diagrams import Diagram
from curvafit.volumes.volume import Volume

#: Colours that stay apart for the colour-blind (Okabe & Ito 2008).
CONTOUR, DIAGONAL, INK = "#E69F00", "#C8372D", "#22262B"
#: Of the families, from the same.
FAMILY_COLOURS = {
    "spheres": "#0072B2", "layers": "#E69F00", "tubes": "#009E73", "sponge": "#CC79A7", "tubular cavities": "#56B4E9",
    "bubbles": "#D55E00",
}  # fmt: skip
#: Colours of groups, which begin again after the last (Okabe & Ito 2008).
GROUPS = FIRST, SECOND, *_ = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
#: Area density in a diagram: light where little, dark where much.
DENSITY = LinearSegmentedColormap.from_list(
    "density", ["#E3ECF5", "#A9CBE3", "#5AA2CB", "#2B6FA8", "#1B3F7A", "#16193F"]
)
#: Colours of labels from 0 on, which begin again after the last.
LABELS = np.vstack([(0, 0, 0, 1), colormaps["tab20"](np.arange(20))])
#: Bins along each axis of a drawn diagram, the width in bins of the Gaussian that smooths it, and its colours' decades.
BINS, SMOOTH, DECADES = 72, 0.8, 3.0
#: The colour of draws, and the width in inches of one square of a corner plot.
_DRAWN, _SQUARE = "#2B6FA8", 1.25
#: Percent of the voxels that are drawn black, white; most voxels along an axis of which these are taken.
TAILS, THIN = (0.5, 99.5), 256
#: Symbols of the familiar numbers, of those that a figure of numbers shows first, and of those that can be negative.
FAMILIAR = ("BV/TV", "Tb.Th", "Tb.Sp", "Tb.N", "Conn.D", "DA")
FIRST_SHOWN, SIGNED = (*FAMILIAR, "H", "K"), ("χ", "Conn.D", "H", "K", "κ1", "κ2")
#: Most values of masks and labels, which are drawn from the least to the greatest.
FEW = 3

Limits = tuple[float, float]


# ---- surfaces --------------------------------------------------------------------------------------------------------


def surface_figure(u: np.ndarray, *, width: int = 720, **options) -> Figure:
    """Return a figure `width` pixels wide of one surface; `options` are those of `surface_on`."""
    figure = make_figure(width / DPI, width / DPI)
    surface_on(figure.add_axes((0, 0, 1, 1)), u, width=width, **options)
    return figure


def surface_on(axes: Axes, u: np.ndarray, *, width: int = 720, **options) -> None:
    """Draw the level set of a field (or the outline of a bool mask) in its box; `options` are those of `render`."""
    axes.set_axis_off()
    axes.imshow(render_in_box(u, width=width, **options), interpolation="antialiased")


def gallery_figure(fields: Mapping[str, np.ndarray], *, columns: int = 4, width: int = 1600, **options) -> Figure:
    """Return a figure `width` pixels wide of a table of surfaces, each above its name.

    `options` are those of `surface_on`.
    """
    if not fields:
        raise ValueError("there is no field to draw")
    columns = min(columns, len(fields))
    rows = math.ceil(len(fields) / columns)
    cell = width / columns / DPI
    figure = make_figure(cell * columns, 1.13 * cell * rows)
    for k, (name, u) in enumerate(fields.items()):
        row, column = divmod(k, columns)
        bottom = 1 - (row + 1) / rows
        axes = figure.add_axes((column / columns + 0.004, bottom + 0.11 / rows, 1 / columns - 0.008, 0.88 / rows))
        surface_on(axes, u, width=round(width / columns), **options)
        figure.text((column + 0.5) / columns, bottom + 0.05 / rows, name, ha="center", va="center", fontsize=12)
    return figure


# ---- curvature diagrams ----------------------------------------------------------------------------------------------


def diagram_figure(diagram: Diagram, *, limits: Limits | None = None) -> Figure:
    """Return a figure of one diagram, which must have area; see `diagram_on`."""
    if not diagram.area > 0:
        raise ValueError("the diagram is empty: it has no area to draw")
    figure = make_figure(4.2, 4.2, layout="constrained")
    diagram_on(figure.subplots(), diagram, limits=limits or shared_limits([diagram]))
    return figure


def diagram_on(axes: Axes, diagram: Diagram, *, limits: Limits) -> QuadMesh:
    """Draw the share of area over (κ1, κ2): κ1 to the right, κ2 up, colours by the logarithm.

    `limits`, in the diagram's unit, are those of both axes. Returns the picture, for a colour bar.
    """
    edges = np.linspace(*limits, BINS + 1)
    shares = bin_diagram(diagram.normalised, edges, SMOOTH)
    highest = max(float(shares.max()), 1e-9)
    norm = LogNorm(highest * 10**-DECADES, highest)
    shown = np.ma.masked_less(shares, highest * 10**-DECADES)  # bins below the scale stay white
    picture = axes.pcolormesh(edges, edges, shown, cmap=DENSITY, norm=norm, rasterized=True, zorder=2)
    frame_diagram(axes, limits, diagram.unit.removeprefix("1/"))
    return picture


def bin_diagram(diagram: Diagram, edges: np.ndarray, width: float) -> np.ndarray:
    """Return a diagram's area in bins (κ2, κ1) between `edges`, smoothed by a Gaussian of `width` bins."""
    areas, _, _ = np.histogram2d(*diagram.points.T, bins=[edges, edges], weights=diagram.weights)
    return gaussian_filter(areas, width).T


def frame_diagram(axes: Axes, limits: Limits, unit: str) -> None:
    """Draw the frame of a diagram: axes, the line κ1 = κ2 and the names of families; see `diagram_on`."""
    low, high = limits
    axes.add_patch(Polygon([(low, low), (low, high), (high, high)], color="#F3F4F6", zorder=0))
    axes.axhline(0, color=QUIET, linewidth=0.7, zorder=1)
    axes.axvline(0, color=QUIET, linewidth=0.7, zorder=1)
    axes.plot([low, high], [low, high], color=DIAGONAL, linewidth=1.4, zorder=3)
    axes.set(xlim=limits, ylim=limits, aspect="equal")
    axes.spines[:].set_color(QUIET)
    name = unit_name(unit)
    axes.set_xlabel(f"κ₁ (1/{name})", labelpad=2)
    axes.set_ylabel(f"κ₂ (1/{name})", labelpad=2)
    axes.locator_params(nbins=5)
    axes.tick_params(length=3, labelsize=9)
    _name_families(axes, limits)


def shared_limits(diagrams: Sequence[Diagram]) -> Limits:
    """Return one interval for both curvatures of all diagrams: it holds 0 and all but 0.6 % of the area at each end."""
    bounds = [0.0, 0.0]
    for diagram in diagrams:
        for kappa in diagram.points.T:
            low, high = np.quantile(kappa, [0.006, 0.994], weights=diagram.weights, method="inverted_cdf")
            bounds = [min(bounds[0], float(low)), max(bounds[1], float(high))]
    width = max(bounds[1] - bounds[0], 1e-9)
    return bounds[0] - 0.08 * width, bounds[1] + 0.08 * width


def _name_families(axes: Axes, limits: Limits) -> None:
    """Write the names of spheres, tubes and saddles beside the lines κ1 = κ2, κ2 = 0 and κ2 = -κ1, where they lie."""
    low, high = limits
    pad = 0.02 * (high - low)
    style = {"fontsize": 8.5, "color": "#5B616B", "style": "italic", "zorder": 4}
    style["path_effects"] = [withStroke(linewidth=2, foreground="white")]
    corner = high - 5 * pad
    axes.text(corner, corner + pad, "spheres", rotation=45, rotation_mode="anchor", ha="right", va="bottom", **style)
    axes.text(high - pad, 0.4 * pad, "tubes", ha="right", va="bottom", **style)
    if low < -0.15 * high:
        end = min(high, -low)
        axes.plot([0, end], [0, -end], color=QUIET, linewidth=0.7, linestyle=(0, (2, 3)), zorder=1)
        side = "right" if end > 0.6 * high else "left"
        axes.text(end + (-pad if side == "right" else pad), pad - end, "saddles", ha=side, va="bottom", **style)


# ---- three middle slices ---------------------------------------------------------------------------------------------


def field_figure(field: Volume) -> Figure:
    """Return a figure of a field's middle slices."""
    return section_figure({"": (field.values, None)}, field.spacing, field.unit)


def section_figure(
    rows: Mapping[str, tuple[np.ndarray, np.ndarray | None]], spacing: Sequence[float], unit: str
) -> Figure:
    """Return a figure of the middle slices across z, y and x, with the scale.

    `rows` holds for each row of pictures, by its title, values (Z, Y, X) and the mask that is outlined over them, or
    None. The spacing is voxel edges (z, y, x) in `unit`.
    """
    indices = [n // 2 for n in next(iter(rows.values()))[0].shape]
    sections = {}
    for title, (values, mask) in rows.items():
        if not values.size or (values.dtype.kind == "f" and not np.isfinite(values).all()):
            raise ValueError("a volume to draw needs voxels, all of finite values")
        planes = [np.take(values, index, axis) for axis, index in enumerate(indices)]
        outlines = None if mask is None else [np.take(mask, index, axis) for axis, index in enumerate(indices)]
        sections[title] = Sections(planes, outlines, grey_limits(values))
    return draw_sections(sections, spacing, unit, indices)


def colour_labels(plane: np.ndarray) -> np.ndarray:
    """Return a slice of labels as colours (Y, X, RGBA), one for each label."""
    return LABELS[np.where(plane, (plane - 1) % (len(LABELS) - 1) + 1, 0)]


class Sections(NamedTuple):
    """Slices across z, y and x, what is outlined over them, if anything is, and the levels of black and white."""

    planes: Sequence[np.ndarray]
    outlines: Sequence[np.ndarray] | None
    limits: Limits


def grey_limits(values: np.ndarray) -> Limits:
    """Return the levels of black and white of a volume: extremes where it has few values (masks), else percentiles."""
    thinned = values[tuple(slice(None, None, math.ceil(n / THIN)) for n in values.shape)].astype(np.float32)
    levels = np.unique(thinned)
    low, high = levels[[0, -1]] if len(levels) <= FEW else np.percentile(thinned, TAILS)
    return float(low), float(high)


def draw_sections(rows: Mapping[str, Sections], spacing: Sequence[float], unit: str, indices: Sequence[int]) -> Figure:
    """Return a figure of rows of slices by their titles, with the scale; `indices` are the numbers of the slices."""
    figure = make_figure(7.2, 2.5 * len(rows), layout="constrained")
    axes = figure.subplots(len(rows), 3, squeeze=False)
    for row, (title, sections) in zip(axes, rows.items(), strict=True):
        sections_on(row, sections, spacing)
        row[0].set_ylabel(title)
    for axis, name in enumerate("zyx"):
        rows_name, columns_name = (other for other in "zyx" if other != name)
        axes[0, axis].set_title(f"{name} = {indices[axis]}  ({rows_name} down, {columns_name} across)", fontsize=8)
    scale_on(axes[-1, 0], spacing[2], unit)
    return figure


def sections_on(row: Sequence[Axes], sections: Sections, spacing: Sequence[float]) -> None:
    """Draw slices across z, y and x beside each other; the spacing is of their voxels (z, y, x)."""
    planes, outlines, limits = sections
    for axis, axes in enumerate(row):
        down, across = (spacing[other] for other in range(3) if other != axis)
        section_on(axes, planes[axis], None if outlines is None else outlines[axis], limits, down / across)


def scale_on(axes: Axes, edge: float, unit: str) -> None:
    """Draw a bar of a round length below a slice whose voxels are `edge` wide."""
    left, right = axes.get_xlim()
    longest = abs(right - left) * edge / 3
    power = 10.0 ** math.floor(math.log10(longest))
    length = max((step * power for step in (1, 2, 5) if step * power <= longest), default=power)
    end, below = left + length / edge, axes.get_xaxis_transform()  # x in voxels, y as a fraction of the axes' height
    axes.plot([left, end], [-0.05, -0.05], color=INK, linewidth=2.5, transform=below, clip_on=False)
    style = {"transform": below, "va": "center", "fontsize": 8}
    axes.text(end + 0.02 * (right - left), -0.05, format_length(length, unit, 1), **style)


def section_on(axes: Axes, plane: np.ndarray, outline: np.ndarray | None, limits: Limits, aspect: float) -> None:
    """Draw a slice, grey or (Y, X, RGBA), with the outline of a mask; `limits` are the levels of black and white."""
    low, high = limits
    plane, high = plane.astype(np.float32), max(high, low + 1e-6)
    axes.imshow(plane, cmap="gray", vmin=low, vmax=high, aspect=aspect, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    if outline is not None and outline.any() and not outline.all() and min(outline.shape) > 1:
        axes.contour(outline, [0.5], colors=CONTOUR, linewidths=1.0)


# ---- draws -----------------------------------------------------------------------------------------------------------


def corner_figure(
    draws: np.ndarray, names: Sequence[str], limits: Sequence[tuple[float, float]], marks: Mapping[str, np.ndarray]
) -> Figure:
    """Return a corner plot of draws `(n, d)`: histograms of each parameter on the diagonal, pairs below it.

    `limits` are the ends of each parameter's axis; `marks` are at most three points `(d,)` to mark, by name.
    """
    d = draws.shape[1]
    figure = make_figure(_SQUARE * d + 0.7, _SQUARE * d + 0.6)
    grid = figure.add_gridspec(d, d, left=0.09, right=0.985, bottom=0.085, top=0.985, wspace=0.16, hspace=0.16)
    styles = list(zip(marks.items(), ((CONTOUR, "o"), (INK, "x"), (QUIET, "+")), strict=False))
    for row, column in [(i, j) for i in range(d) for j in range(i + 1)]:
        axes = figure.add_subplot(grid[row, column])
        axes.set_xlim(limits[column])
        axes.spines[:].set_color(QUIET)
        axes.tick_params(length=2, labelsize=7)
        axes.xaxis.set_major_locator(MaxNLocator(2, prune="both"))
        axes.set_xlabel(names[column], fontsize=11)
        if row == column:
            axes.hist(draws[:, row], bins=np.linspace(*limits[row], 31).tolist(), color=_DRAWN, linewidth=0)
            axes.set_yticks([])
            for (_, point), (colour, _) in styles:
                axes.axvline(point[column], color=colour, linewidth=1.6)
        else:
            axes.set_ylim(limits[row])
            dots = {"s": 3, "color": _DRAWN, "alpha": 0.35, "linewidth": 0, "rasterized": True}
            axes.scatter(draws[:, column], draws[:, row], **dots)
            axes.yaxis.set_major_locator(MaxNLocator(2, prune="both"))
            axes.set_ylabel(names[row], fontsize=11)
            for (name, point), (colour, symbol) in styles:
                look = {"color": colour, "markersize": 6, "markeredgewidth": 1.8, "label": name}
                axes.plot(point[column], point[row], symbol, **look)
        axes.label_outer()
    handles, labels = figure.axes[1].get_legend_handles_labels() if d > 1 else ([], [])  # axes 1 show the first pair
    if handles:
        figure.legend(handles, labels, loc="upper right", bbox_to_anchor=(0.98, 0.98), frameon=False, fontsize=11)
    return figure


# ---- figures of results ----------------------------------------------------------------------------------------------


def fit_figure(fit: Any, **options: Any) -> Figure:
    """Return a figure of the curvature diagram of a fit's scan; `options` are those of `diagram_figure`."""
    if fit.diagram is None:
        raise ValueError("this fit holds no curvature diagram to draw")
    return diagram_figure(fit.diagram, **options)


def flow_figure(flow: Flow, **options: Any) -> Figure:
    """Return a figure of a flow's surface; `options` are those of `surface_figure`."""
    return surface_figure(flow.field.numpy(), spacing=flow.grid.spacing, **options)


# ---- files -----------------------------------------------------------------------------------------------------------


def png(figure: Figure, dpi: int = DPI) -> bytes:
    """Return the figure as a PNG, of so many pixels per inch."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def svg(figure: Figure) -> bytes:
    """Return the figure as an SVG whose text is text, the same for the same figure."""
    buffer = io.BytesIO()
    with rc_context({"svg.hashsalt": "curvafit", "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", dpi=DPI, metadata={"Date": None})
    return buffer.getvalue()


def write_picture(figure: Figure, path: str | Path) -> Path:
    """Write a PNG under a temporary name, then move it to `path`."""
    return write_content(Path(path), png(figure))


def make_figure(width: float, height: float, **options: Any) -> Figure:
    """Return an empty white figure, in inches, that is none of pyplot's."""
    figure = Figure(figsize=(width, height), facecolor="white", **options)
    FigureCanvasAgg(figure)
    return figure


def plain(name: str) -> str:
    """Return a name that matplotlib does not take for a formula."""
    return name.replace("$", "\\$")
