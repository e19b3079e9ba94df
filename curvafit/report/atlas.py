"""The page of an atlas: a map of its shapes by their curvature diagrams, a solid of each, and scans among them.

Lengths on the map are in thicknesses of the structure: a texture is the same whatever the scale it is scanned at.
"""

from __future__ import annotations

import base64
import io
import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import replace
from html import escape
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.signal import resample
from scipy.spatial.distance import cdist

from curvafit.core.checks import require
from curvafit.core.files import write_content
from curvafit.core.records import can_write, has_mark
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.units import format_number
from curvafit.data_synth.atlas import extract, open_all, shape_id, summarise
from curvafit.data_synth.store import Store
from curvafit.drawing.plot import DENSITY, DIAGONAL, FAMILY_COLOURS, INK, shared_limits
from curvafit.drawing.rendering import CAP, SURFACE, render
from curvafit.geometry.diagrams import FAMILIES, Diagram, family_shares, half_thickness, leading_family
from curvafit.geometry.distances import sliced_embedding
from curvafit.geometry.mesh import capped_surface
from curvafit.inference.atlas import Atlas
from curvafit.inference.fit import Fit
from curvafit.priors.grid import WORKING_SPACING, Grid
from curvafit.report import page
from curvafit.report.inference import name_source
from curvafit.scan.preparation import HALF, WORKING_THICKNESS

#: Below this, there is nothing to lay out; the nearest shapes that are named beside one.
LEAST_SHAPES, NEIGHBOURS = 6, 5
#: The most shapes whose solids are in the page, and the most voxels along an edge of one: 40 kB a shape.
SOLIDS, EDGE = 150, 24
#: Width of a small picture in pixels, bins along an axis of a diagram, and decades of its colours.
THUMBNAIL, BINS, DECADES = 144, 48, 3.0
#: The numbers of a shape, in words, in the order of the coefficients and then of the others.
COLUMNS = ("a₂₀, of κ₁²", "a₁₁, of κ₁κ₂", "a₀₂, of κ₂²", "a₁₀, of κ₁", "a₀₁, of κ₂", "a₀₀, constant",
           "m₀, mass", "share of the volume", "thickness in voxels")  # fmt: skip


def place_on_plane(embeddings: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where `others` `(n, 2)` lie on the two directions in which sliced embeddings `(N, D)` differ most, and the
    share of these' variance along each; Euclidean distance there is the sliced Wasserstein distance."""
    middle = embeddings.mean(0)
    _, spread, main = np.linalg.svd(embeddings - middle, full_matrices=False)
    main = main[:2] * np.sign(main[:2].sum(1, keepdims=True))  # a direction's sign has no meaning: take one that stays
    return (others - middle) @ main.T, spread[:2] ** 2 / max(float((spread**2).sum()), 1e-30)


def families_of(atlas: Atlas) -> tuple[str, ...]:
    """Return the family of each shape: where its surface has its area on the plane of curvatures."""
    sampling = atlas.provenance["settings"]
    box = float(np.prod(sampling["shape"]) * np.prod(sampling["spacing"]))
    return tuple(
        leading_family(family_shares(diagram, half_thickness(diagram, float(fraction) * box)))
        for diagram, fraction in zip(atlas.field_diagrams, atlas.volume_fractions, strict=True)
    )


def map_on(axes: Axes, atlas: Atlas, seen_as: str, embeddings: np.ndarray) -> np.ndarray:
    """Draw an atlas's shapes on the two directions in which their diagrams differ most.

    Return the places (n, 2) there of diagrams whose sliced `embeddings` (n, 288) are in working units.
    """
    of_atlas = atlas.embeddings(seen_as)
    both, shares = place_on_plane(of_atlas, np.concatenate([of_atlas, embeddings]))
    places, own = both[: len(of_atlas)], both[len(of_atlas) :]
    names = np.array(families_of(atlas))
    for name, colour in FAMILY_COLOURS.items():
        if (names == name).any():
            axes.scatter(*places[names == name].T, s=9, c=colour, linewidths=0, alpha=0.75, label=name)
    ends = np.concatenate([np.percentile(places, (0.3, 99.7), axis=0), own])
    (left, bottom), (right, top) = low, high = ends.min(0), ends.max(0)
    x, y = 0.06 * (high - low)
    axes.set(xlim=(left - x, right + x), ylim=(bottom - y, top + y), xticks=[], yticks=[])
    legend = {"fontsize": 8, "frameon": False, "handletextpad": 0, "columnspacing": 0.9}
    axes.legend(loc="lower center", ncols=6, bbox_to_anchor=(0.5, -0.15), **legend)
    axes.set_title(f"its place among {len(atlas)} grown textures", fontsize=11)
    words = f"the directions hold {shares.sum():.0%} of their spread"
    axes.text(0.99, 0.015, words, transform=axes.transAxes, ha="right", fontsize=7.5, color="#5b616b")
    axes.spines[:].set_color("#dfe2e6")
    return own


# ---- the page --------------------------------------------------------------------------------------------------------


def write_map(
    stores: Sequence[str | Path | Store],
    path: str | Path,
    *,
    fits: Sequence[str | PathLike[str] | Fit] = (),
    command: str = "",
    overwrite: bool = False,
    progress: Progress = silent,
) -> Path:
    """Write the map of the stores' well-formed shapes, with scans by their fits among them, as one HTML page.

    Raises ImportError without the extra `[atlas]`; FileNotFoundError or ValueError as `extract` and `Fit.load` do, for
    fewer than `LEAST_SHAPES` shapes, for a fit without a diagram, and where a file of another origin would be replaced
    without `overwrite`.
    """
    script = require("plotly.offline", "atlas", "the map of an atlas").get_plotlyjs()
    sources = open_all(stores)
    read = [fit for fit in fits if not isinstance(fit, Fit)]
    if (target := Path(path)).suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"the name of a map must end in .html, got {target.name!r}")
    inputs = [*(store.path for store in sources), *map(Path, read)]
    can_write(target, lambda there: has_mark(there, page.MARK), inputs=inputs, overwrite=overwrite)
    names, scans = _read_fits(fits)
    atlas = extract(sources, progress=sub_progress(progress, 0.0, 0.6))
    if (n := len(atlas)) < LEAST_SHAPES:
        raise ValueError(f"a map needs at least {LEAST_SHAPES} shapes, got {n}")
    λ = WORKING_THICKNESS * WORKING_SPACING
    diagrams = [replace(diagram, points=diagram.points * λ) for diagram in atlas.mask_diagrams]
    diagrams += map(scale_fit, scans)
    embeddings = np.stack([sliced_embedding(diagram) for diagram in diagrams])
    places, shares = place_on_plane(embeddings[:n], embeddings)
    away = cdist(embeddings, embeddings[:n])
    np.fill_diagonal(away, np.inf)
    near = np.argsort(away, axis=1, kind="stable")[:, :NEIGHBOURS]
    distances = np.take_along_axis(away, near, axis=1)
    typical = float(np.quantile(distances[:n, 0], 0.95))
    ends = np.array([shared_limits([diagram]) for diagram in diagrams])
    limits = float(np.quantile(ends[:, 0], 0.05)), float(np.quantile(ends[:, 1], 0.95))
    kinds, columns = families_of(atlas), _columns(atlas)
    turned = set(farthest_points(places[:n], SOLIDS).tolist())
    shapes = _draw_shapes(sources, atlas, kinds, columns, turned, sub_progress(progress, 0.6, 1.0))
    shapes += [{"rows": _describe_fit(fit, distances[n + k, 0] > typical)} for k, fit in enumerate(scans)]
    for k, shape in enumerate(shapes):
        shape |= {"name": [*atlas.ids, *names][k], "place": places[k].round(4).tolist(), "near": near[k].tolist()}
        shape |= {"distances": distances[k].round(3).tolist(), "diagram": _pack(_shades(diagrams[k], limits))}
    figure = _map_figure(shares, places, names, kinds, columns)
    shades = [to_hex(DENSITY(share)) for share in np.linspace(0, 1, 9)]
    data = {"shapes": shapes, "count": n, "map": json.loads(figure.to_json()), "bins": BINS, "limits": limits}
    data |= {"shades": shades, "colours": [to_hex(SURFACE), to_hex(CAP)], "diagonal": DIAGONAL}
    rows = {"command": command, "shapes": f"{n}, well-formed", "solids": f"of {len(turned)} shapes, at most {SOLIDS}"}
    for store in sources:
        facts = {"store": str(store.path), **summarise(store)}
        rows |= {f"{store.name}: {name}": words for name, words in facts.items()}
    rows["measured with"] = ", ".join(f"{name} {number}" for name, number in atlas.provenance["measured_with"].items())
    rows["measured on"] = atlas.provenance["date"]
    text = page.render(
        "atlas.html", title=f"Atlas of {n} shapes", made={name: words for name, words in rows.items() if words},
        plotly=script,
        data=json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        names=[*enumerate(names, n), *enumerate(atlas.ids)], scans=len(names), solids=len(turned),
        missing=n - len(turned),
    )  # fmt: skip
    return write_content(target, text)


def _read_fits(fits: Sequence[str | PathLike[str] | Fit]) -> tuple[list[str], list[Fit]]:
    """Return the names of scans and their fits; raise ValueError where a fit has no diagram."""
    scans = [fit if isinstance(fit, Fit) else Fit.load(fit) for fit in fits]
    names = [name_source(fit.provenance.get("scan")) or f"scan {k}" for k, fit in enumerate(scans, 1)]
    for name, fit in zip(names, scans, strict=True):
        if fit.diagram is None:
            raise ValueError(f"the fit of {name} has no curvature diagram: {fit.status}")
    return names, scans


def _draw_shapes(
    sources: Sequence[Store], atlas: Atlas, kinds: Sequence[str], columns: dict[str, np.ndarray], turned: set[int],
    progress: Progress,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return what the page shows of each shape: its numbers, a picture, and of those to be turned a solid."""
    fields = {shape_id(store, index): (store, index) for store in sources for index in store.indices()}
    shapes = []
    for k, name in enumerate(atlas.ids):
        progress(f"drawing {len(atlas)} shapes", k / len(atlas))
        store, index = fields[name]
        u, numbers = store.field(index), {words: format_number(float(x[k]), 4) for words, x in columns.items()}
        origin = {"seed": str(atlas.seeds[k]), "field": f"draw {index} of {store.name}"}
        shapes.append({
            "rows": list(({"family": kinds[k]} | numbers | origin).items()),
            "picture": _draw_small(u),
            "solid": make_solid(u) if k in turned else None,
        })  # fmt: skip
    return shapes


def scale_fit(fit: Fit) -> Diagram:
    """Return a fit's curvature diagram in 1/thickness, as an atlas's shapes are compared.

    A mask or an image was put on voxels of which the structure is eight thick; a phase field kept its own. Shapes of an
    atlas fill less than half, so of a structure that fills more it is the background's.
    """
    assert fit.diagram is not None
    voxels = fit.thickness / fit.working_voxel if fit.kind == "field" else WORKING_THICKNESS
    shown = fit.diagram.mirrored if fit.morphometry.volume_fraction > HALF else fit.diagram
    return replace(shown, points=shown.points * voxels * WORKING_SPACING, unit="1/thickness")


def farthest_points(places: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of `count` points (or all): the one nearest to the middle, then always the farthest one from
    those already chosen."""
    sample = [int(np.linalg.norm(places - np.median(places, axis=0), axis=1).argmin())]
    away = np.linalg.norm(places - places[sample[0]], axis=1)
    while len(sample) < min(count, len(places)):
        sample.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(places - places[sample[-1]], axis=1))
    return np.array(sample)


def _columns(atlas: Atlas) -> dict[str, np.ndarray]:
    """Return numbers of shapes by what they are in words; the gauge, mostly a₂₀ = 1, only where it varies."""
    numbers = (*atlas.coefficients.T, atlas.masses, atlas.volume_fractions, atlas.thicknesses)
    shown = range(0 if np.ptp(numbers[0]) > 0 else 1, len(COLUMNS))
    return {COLUMNS[k]: numbers[k] for k in shown}


def _describe_fit(fit: Fit, far: bool) -> list[tuple[str, str]]:
    """Return what is said of a scan; `far` is whether it lies farther from shapes than these from each other."""
    inverted = fit.morphometry.volume_fraction > HALF
    part = "background, which fills less" if inverted else "structure"
    distance = "farther from shapes than 95 % of them from" if far else "as near to shapes as they to"
    lies = f"{distance} each other"
    return [("family", fit.family), ("placed by its", part), ("lies", lies), ("verdict", fit.status)]


def _map_figure(
    shares: np.ndarray, places: np.ndarray, scans: Sequence[str], kinds: Sequence[str], columns: dict[str, np.ndarray]
) -> Any:
    """Return the map: points by family, or by a number; stars for scans; last a ring, for the chosen one."""
    n, names = len(kinds), np.array(kinds)
    figure = require("plotly.graph_objects", "atlas", "the map of an atlas").Figure()
    size = float(np.clip(130 / math.sqrt(n), 6, 13))
    mark = {"size": size, "opacity": 0.85, "line": {"width": 0.6, "color": "white"}}
    groups = {name: np.flatnonzero(names == name) for name in FAMILIES if name in names}
    dots: list[tuple[dict[str, Any], np.ndarray, dict[str, Any]]]
    dots = [({"name": f"{name}  {len(of)}"}, of, {"color": FAMILY_COLOURS[name]}) for name, of in groups.items()]
    for words, values in columns.items():
        bar = {"title": {"text": words, "side": "right"}, "thickness": 12, "outlinewidth": 0, "len": 0.8}
        shade = {"color": values, "colorscale": "Viridis", "colorbar": bar}
        dots.append(({"visible": False, "showlegend": False}, np.arange(n), shade))
    for options, of, shade in dots:
        x, y = places[of].T
        figure.add_scatter(
            x=x, y=y, customdata=of.tolist(), mode="markers", hoverinfo="none", marker=mark | shade, **options
        )
    x, y = places[n:].T
    star = {"symbol": "star", "size": 17, "color": INK, "line": {"width": 1.3, "color": "white"}}
    figure.add_scatter(
        x=x, y=y, customdata=list(range(n, len(places))), mode="markers+text", name="scans", marker=star,
        text=[f"<b>{escape(name)}</b>" for name in scans], textposition="top center", hoverinfo="none",
        showlegend=len(scans) > 0,
    )  # fmt: skip
    ring = {"symbol": "circle-open", "size": size + 9, "color": INK, "line": {"width": 2.4}}
    figure.add_scatter(x=[None], y=[None], mode="markers", showlegend=False, hoverinfo="skip", marker=ring)
    choices = []
    for k, words in enumerate(("family", *columns)):
        seen = [k == 0] * len(groups) + [place == k - 1 for place in range(len(columns))] + [True, True]
        choices.append({"label": f"colour: {words}", "method": "restyle", "args": [{"visible": seen}]})
    menu = {"buttons": choices, "x": 0, "y": 1.07, "xanchor": "left", "yanchor": "bottom", "bgcolor": "white"}
    first, second = (
        {"title": f"{word} main direction of the diagrams, in 1/thickness ({share:.0%} of variance)"}
        for word, share in zip(("first", "second"), shares, strict=True)
    )
    small = {"title_font_size": 13}
    figure.update_layout(
        margin={"l": 62, "r": 8, "t": 84, "b": 50}, template="simple_white", uirevision="kept", hovermode="closest",
        dragmode="pan", updatemenus=[menu], legend={"orientation": "h", "y": 1.0, "yanchor": "bottom"}, font_color=INK,
        xaxis=first | small, yaxis=second | small | {"scaleanchor": "x"},
    )  # fmt: skip
    return figure


# ---- one shape -------------------------------------------------------------------------------------------------------


def _pack(values: np.ndarray) -> str:
    """Return numbers for the page, compressed, in base64."""
    return base64.b64encode(zlib.compress(np.ascontiguousarray(values).tobytes(), 9)).decode("ascii")


def _shades(diagram: Diagram, limits: tuple[float, float]) -> np.ndarray:
    """Return a diagram as bytes `(BINS, BINS)`, κ2 by κ1: the logarithm of the area, 255 in the fullest bin."""
    edges = np.linspace(*limits, BINS + 1)
    shares, _, _ = np.histogram2d(*diagram.points.T, bins=[edges, edges], weights=diagram.weights)
    shares = gaussian_filter(shares, 0.8).T
    levels = 1 + np.log10(np.maximum(shares, 1e-30) / max(float(shares.max()), 1e-30)) / DECADES
    return np.rint(255 * np.clip(levels, 0, 1)).astype(np.uint8)


def _draw_small(u: np.ndarray) -> str:
    """Return a small picture of a field: WebP in base64."""
    buffer = io.BytesIO()
    Image.fromarray(render(u, width=THUMBNAIL)[0]).save(buffer, "webp", quality=75, alpha_quality=75)
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def make_solid(u: np.ndarray) -> dict[str, Any]:
    """Return the capped surface of a periodic field `(Z, Y, X)` on at most `EDGE` voxels an edge.

    `points` are (x, y, z) in 1/1024 of a voxel, and `faces` those of the surface and then `caps` of the box's sides.
    """
    values = np.clip(u, -1, 1).astype(np.float64)
    factor = min(1.0, EDGE / max(u.shape))
    for axis, n in enumerate(u.shape):
        if (count := max(4, round(n * factor))) < n:
            values = np.asarray(resample(values, count, axis=axis))
    mesh = capped_surface(values, Grid(values.shape, (1.0, 1.0, 1.0)))
    places = mesh.vertices + 0.5  # from the corner of the box, not from its first voxel's centre
    sides = np.isclose(places, 0, atol=1e-2) | np.isclose(places, values.shape, atol=1e-2)
    caps = sides[mesh.faces].all(axis=1).any(axis=-1)
    faces = np.concatenate([mesh.faces[~caps], mesh.faces[caps]]).astype("<u2")
    points = np.rint(np.clip(places[:, ::-1], 0, None) * 1024).astype("<u2")
    return {"points": _pack(points.T), "faces": _pack(faces.T), "caps": int(caps.sum())}
