"""The picture of a map: its points coloured by family, some of its shapes around them (paper, Figure 10)."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import ConnectionPatch
from matplotlib.patheffects import withStroke
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from curvafit.atlas_map.layout import AtlasMap, families_of
from curvafit.core.files import write_atomically
from curvafit.drawing.plot import DPI, INK, QUIET, make_figure
from curvafit.drawing.render import render
from curvafit.inference.atlas import Atlas

#: Colours that stay apart for the colour-blind: of families (Okabe & Ito 2008), and of clusters (Tol's muted ones).
FAMILY_COLOURS = {
    "spheres": "#0072B2",
    "layers": "#E69F00",
    "tubes": "#009E73",
    "sponge": "#CC79A7",
    "tubular cavities": "#56B4E9",
    "bubbles": "#D55E00",
}
CLUSTER_COLOURS = ["#44AA99", "#882255", "#DDCC77", "#332288", "#CC6677", "#88CCEE", "#117733", "#999933", "#AA4499"]
#: Inches: the page, and the edge of a thumbnail's cell.
_WIDTH, _HEIGHT, _CELL = 14.0, 10.6, 1.92
#: Thumbnails along the top and the bottom, and along either side between them.
_ACROSS, _DOWN = 7, 3
#: Share of the shapes from which a family is named on the map.
_NAMED = 0.05


def map_picture(mapped: AtlasMap, field: Callable[[int], np.ndarray], path: str | Path) -> Path:
    """Write the map as a PNG, its settings among the PNG's texts.

    `field` returns the phase field `(Z, Y, X)` of a shape by its index in the atlas; it is called for those shown.
    """
    figure = map_figure(mapped, field)
    settings = json.dumps({"map": mapped.settings, "atlas": mapped.atlas.provenance})
    texts = {"Title": f"Atlas of {len(mapped)} shapes", "Description": settings}
    return write_atomically(Path(path), lambda place: figure.savefig(place, format="png", dpi=DPI, metadata=texts))


def map_figure(mapped: AtlasMap, field: Callable[[int], np.ndarray]) -> Figure:
    """Return a figure of the map, with thumbnails of some shapes around it; `field` as in `map_picture`."""
    figure = make_figure(_WIDTH, _HEIGHT)
    margin = _CELL + 0.28
    axes = figure.add_axes(
        (margin / _WIDTH, (margin + 0.62) / _HEIGHT, 1 - 2 * margin / _WIDTH, 1 - (2 * margin + 0.62) / _HEIGHT)
    )
    colours = [FAMILY_COLOURS[name] for name in mapped.families]
    size = float(np.clip(9000 / len(mapped), 14, 60))
    axes.scatter(*mapped.positions.T, c=colours, s=size, linewidths=0.5, edgecolors="white", zorder=2)
    axes.set(xticks=[], yticks=[])
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.05)
    axes.spines[:].set_visible(False)
    _name_families(axes, mapped)
    figure.draw_without_rendering()
    slots = slot_places()
    sample = farthest_points(mapped.positions, len(slots))
    places = axes.transData.transform(mapped.positions[sample]) / (figure.dpi * np.array([_WIDTH, _HEIGHT]))
    for k, slot in zip(sample, slots[assign_slots(places, slots)], strict=True):
        _thumbnail(figure, axes, field(k), slot, mapped.positions[k], colours[k])
    _legend(figure, mapped)
    return figure


def map_on(axes: Axes, atlas: Atlas, seen_as: str, embeddings: np.ndarray) -> np.ndarray:
    """Draw an atlas's shapes on the two directions in which their diagrams differ most.

    Return the places (n, 2) there of diagrams whose sliced `embeddings` (n, 288) are in working units.
    """
    of_atlas = atlas.embeddings(seen_as)
    mean = of_atlas.mean(0)
    # The main axes of the sliced quantiles, in which Euclidean distance is the sliced Wasserstein distance.
    _, spread, main = np.linalg.svd(of_atlas - mean, full_matrices=False)
    places, own = ((rows - mean) @ main[:2].T for rows in (of_atlas, embeddings))
    names = np.array(families_of(atlas)[0])
    for name, colour in FAMILY_COLOURS.items():
        if (names == name).any():
            axes.scatter(*places[names == name].T, s=9, c=colour, linewidths=0, alpha=0.75, label=name)
    ends = np.concatenate([np.percentile(places, (0.3, 99.7), axis=0), own])
    (left, bottom), (right, top) = low, high = ends.min(0), ends.max(0)
    x, y = 0.06 * (high - low)
    axes.set(xlim=(left - x, right + x), ylim=(bottom - y, top + y), xticks=[], yticks=[])
    legend = {"fontsize": 8, "frameon": False, "handletextpad": 0, "columnspacing": 0.9}
    axes.legend(loc="lower center", ncols=6, bbox_to_anchor=(0.5, -0.15), **legend)
    share = float((spread[:2] ** 2).sum() / (spread**2).sum())
    axes.set_title(f"its place among {len(atlas)} grown textures", fontsize=11)
    words = f"the directions hold {share:.0%} of their spread"
    axes.text(0.99, 0.015, words, transform=axes.transAxes, ha="right", fontsize=7.5, color="#5b616b")
    axes.spines[:].set_color("#dfe2e6")
    return own


def farthest_points(positions: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of `count` points (or all): the one nearest to the middle, then always the farthest one from
    those already chosen."""
    sample = [int(np.linalg.norm(positions - np.median(positions, axis=0), axis=1).argmin())]
    apart = np.linalg.norm(positions - positions[sample[0]], axis=1)
    while len(sample) < min(count, len(positions)):
        sample.append(int(apart.argmax()))
        apart = np.minimum(apart, np.linalg.norm(positions - positions[sample[-1]], axis=1))
    return np.array(sample)


def slot_places() -> np.ndarray:
    """Return the middles of the thumbnails' cells around the page, `(20, 2)` in figure coordinates."""
    low, high = (_CELL / 2 + 0.75) / _HEIGHT, 1 - (_CELL / 2 + 0.1) / _HEIGHT
    left, right = (_CELL / 2 + 0.1) / _WIDTH, 1 - (_CELL / 2 + 0.1) / _WIDTH
    across = [(x, y) for y in (low, high) for x in np.linspace(left, right, _ACROSS)]
    down = [(x, y) for x in (left, right) for y in np.linspace(low, high, _DOWN + 2)[1:-1]]
    return np.array(across + down)


def assign_slots(places: np.ndarray, slots: np.ndarray) -> np.ndarray:
    """Return a slot for each place such that the sum of the lines' lengths is least: then no two lines cross."""
    inches = np.array([_WIDTH, _HEIGHT])
    return linear_sum_assignment(cdist(places * inches, slots * inches))[1]


def _thumbnail(
    figure: Figure, axes: Axes, u: np.ndarray, slot: np.ndarray, place: np.ndarray, colour: str | tuple
) -> None:
    """Draw a shape in its cell, a ring in its colour around its point, and a line between them."""
    width, height = _CELL / _WIDTH, _CELL / _HEIGHT
    cell = figure.add_axes((slot[0] - width / 2, slot[1] - height / 2, width, height), zorder=3)
    cell.imshow(render(u, width=round(_CELL * DPI))[0], interpolation="antialiased")
    cell.set_axis_off()
    size = np.array([_WIDTH, _HEIGHT])
    away = axes.transData.transform(place) / figure.dpi - slot * size
    edge = slot + away / np.abs(away).max() * 0.47 * _CELL / size
    line = ConnectionPatch(tuple(edge), tuple(place), "figure fraction", axes.transData, color=colour)
    line.set(linewidth=1.1, alpha=0.75, zorder=1)
    figure.add_artist(line)
    axes.scatter(*place, s=95, facecolors="none", edgecolors=[colour], linewidths=1.8, zorder=4)


def _name_families(axes: Axes, mapped: AtlasMap) -> None:
    """Write the name of each larger family where its shapes lie densest."""
    for name in FAMILY_COLOURS:
        places = mapped.positions[np.array(mapped.families) == name]
        if len(places) < _NAMED * len(mapped):
            continue
        apart = cdist(places, places)
        near = np.argsort(apart, axis=1)[:, : math.ceil(len(places) / 4)]
        densest = np.take_along_axis(apart, near, axis=1).mean(1).argmin()
        x, y = places[near[densest]].mean(0)
        text = axes.text(x, y, name, ha="center", va="center", fontsize=15, color=INK, zorder=5, style="italic")
        text.set_path_effects([withStroke(linewidth=4, foreground="white", alpha=0.85)])


def _legend(figure: Figure, mapped: AtlasMap) -> None:
    """Write the families, with their numbers of shapes, and the settings below the map."""
    rows = [(name, colour, mapped.families.count(name)) for name, colour in FAMILY_COLOURS.items()]
    marks = [
        Line2D([], [], marker="o", linestyle="", color=colour, markersize=7, label=f"{name}  {count}")
        for name, colour, count in rows
        if count
    ]
    figure.legend(
        handles=marks, loc="lower left", ncols=len(marks), frameon=False, fontsize=11, handletextpad=0.2,
        bbox_to_anchor=(0.005, 0.026),
    )  # fmt: skip
    settings = mapped.settings
    caption = (
        f"{len(mapped)} shapes · Wasserstein distances of curvature diagrams · UMAP of "
        f"{settings['umap']['n_neighbors']} neighbours, seed {settings['umap']['random_state']} · "
        f"colour: where the area of a shape lies · curvafit {settings['versions']['curvafit']}"
    )
    figure.text(0.014, 0.012, caption, va="bottom", fontsize=9, color=QUIET)
