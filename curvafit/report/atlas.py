"""The page of an atlas: a map of its shapes by their curvature diagrams, a solid of each, and scans among them.

Lengths on the map are in thicknesses of the structure: a texture is the same whatever the scale it is scanned at.
"""

from __future__ import annotations

import base64
import io
import json
import zlib
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_hex
from PIL import Image
from scipy.signal import resample
from scipy.spatial.distance import cdist

from curvafit.core.checks import require
from curvafit.core.files import write_content
from curvafit.core.records import can_write, has_mark
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.units import format_number
from curvafit.data_synth.atlas import extract, open_all, shape_id, summarise
from curvafit.data_synth.store import Store
from curvafit.drawing.plot import DECADES, DENSITY, DIAGONAL, FAMILY_COLOURS, INK, SMOOTH, bin_diagram, shared_limits
from curvafit.drawing.rendering import CAP, SURFACE, render
from curvafit.geometry.diagrams import Diagram, family_of
from curvafit.geometry.distances import sliced_embedding
from curvafit.geometry.mesh import capped_surface
from curvafit.inference.atlas import Atlas
from curvafit.inference.fit import Fit
from curvafit.priors.grid import WORKING_SPACING, Grid
from curvafit.report import page
from curvafit.report.inference import name_source
from curvafit.scan.preparation import HALF, WORKING_THICKNESS

#: The fewest shapes that make a map, and the number of nearest shapes that are named beside one.
LEAST_SHAPES, NEIGHBOURS = 6, 5
#: The most shapes whose solids are in the page, and the most voxels along an edge of one: 40 kB a shape.
SOLIDS, EDGE = 150, 24
#: Width of a small picture in pixels, and bins along an axis of a diagram.
THUMBNAIL, BINS = 144, 48
#: The numbers of a shape, in words, in the order of the coefficients and then of the others.
COLUMNS = ("a₂₀, of κ₁²", "a₁₁, of κ₁κ₂", "a₀₂, of κ₂²", "a₁₀, of κ₁", "a₀₁, of κ₂", "a₀₀, constant",
           "m₀, mass", "share of the volume", "thickness in voxels")  # fmt: skip


def place_on_plane(embeddings: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project `others` `(n, D)` onto the two principal axes of sliced embeddings `(N, D)`; return positions `(n, 2)`
    and the fraction of variance along each axis. Distances there approximate sliced Wasserstein distances."""
    mean = embeddings.mean(0)
    _, singular, axes = np.linalg.svd(embeddings - mean, full_matrices=False)
    axes = axes[:2] * np.sign(axes[:2].sum(1, keepdims=True))  # an axis's sign is arbitrary: take one that stays
    return (others - mean) @ axes.T, singular[:2] ** 2 / max(float((singular**2).sum()), 1e-30)


def families_of(atlas: Atlas) -> tuple[str, ...]:
    """Return the family of each shape: the region of the curvature plane with most of its surface."""
    sampling = atlas.provenance["settings"]
    box_volume = float(np.prod(sampling["shape"]) * np.prod(sampling["spacing"]))
    # Volume over area is the half-thickness of plates, and too little to call a tube or a ball flat.
    return tuple(
        family_of(diagram, float(fraction) * box_volume / diagram.area)
        for diagram, fraction in zip(atlas.field_diagrams, atlas.volume_fractions, strict=True)
    )


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
    plotly = require("plotly.offline", "atlas", "the map of an atlas").get_plotlyjs()
    sources = open_all(stores)
    target, fit_files = Path(path), [Path(fit) for fit in fits if not isinstance(fit, Fit)]
    if target.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"the name of a map must end in .html, got {target.name!r}")
    inputs = [*(store.path for store in sources), *fit_files]
    can_write(target, lambda old: has_mark(old, page.MARK), inputs=inputs, overwrite=overwrite)
    names, scans = _read_fits(fits)
    atlas = extract(sources, progress=sub_progress(progress, 0.0, 0.6))
    if (n := len(atlas)) < LEAST_SHAPES:
        raise ValueError(f"a map needs at least {LEAST_SHAPES} shapes, got {n}")
    # Curvatures times the thickness, which all masks of an atlas share, do not depend on a scan's scale.
    thickness = WORKING_THICKNESS * WORKING_SPACING
    diagrams = [replace(diagram, points=diagram.points * thickness) for diagram in atlas.mask_diagrams]
    diagrams += map(scale_fit, scans)
    embeddings = np.stack([sliced_embedding(diagram) for diagram in diagrams])
    positions, fractions = place_on_plane(embeddings[:n], embeddings)
    all_distances = cdist(embeddings, embeddings[:n])
    np.fill_diagonal(all_distances, np.inf)  # a shape is no neighbour of itself
    neighbours = np.argsort(all_distances, axis=1, kind="stable")[:, :NEIGHBOURS]
    distances = np.take_along_axis(all_distances, neighbours, axis=1)
    far = distances[:, 0] > float(np.quantile(distances[:n, 0], 0.95))
    extents = np.array([shared_limits([diagram]) for diagram in diagrams])
    limits = float(np.quantile(extents[:, 0], 0.05)), float(np.quantile(extents[:, 1], 0.95))
    families, columns = families_of(atlas), _columns(atlas)
    solids = set(farthest_points(positions[:n], SOLIDS).tolist())
    shapes = _draw_shapes(sources, atlas, families, columns, solids, sub_progress(progress, 0.6, 1.0))
    shapes += [{"rows": _describe_fit(fit, bool(far[n + k]))} for k, fit in enumerate(scans)]
    for k, (shape, name) in enumerate(zip(shapes, [*atlas.ids, *names], strict=True)):
        shape |= {"name": name, "place": positions[k].round(4).tolist(), "near": neighbours[k].tolist()}
        shape |= {"distances": distances[k].round(3).tolist(), "diagram": _pack(_shades(diagrams[k], limits))}
    shades = [to_hex(DENSITY(level)) for level in np.linspace(0, 1, 9)]
    data = {"shapes": shapes, "count": n, "bins": BINS, "limits": limits, "variances": fractions.round(4).tolist()}
    data |= {"columns": {title: values.tolist() for title, values in columns.items()}, "families": FAMILY_COLOURS}
    data |= {"shades": shades, "colours": [to_hex(SURFACE), to_hex(CAP)], "diagonal": DIAGONAL, "ink": INK}
    made = {"command": command, "shapes": f"{n}, well-formed", "solids": f"of {len(solids)} shapes, at most {SOLIDS}"}
    for store in sources:
        facts = {"store": str(store.path), **summarise(store)}
        made |= {f"{store.name}: {name}": value for name, value in facts.items()}
    versions = atlas.provenance["measured_with"].items()
    made["measured with"] = ", ".join(f"{name} {version}" for name, version in versions)
    made["measured on"] = atlas.provenance["date"]
    text = page.render(
        "atlas.html", title=f"Atlas of {n} shapes", made={name: value for name, value in made.items() if value},
        plotly=plotly,
        data=json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        names=[*enumerate(names, n), *enumerate(atlas.ids)], scans=len(names), solids=len(solids),
        missing=n - len(solids),
    )  # fmt: skip
    return write_content(target, text)


def _read_fits(fits: Sequence[str | PathLike[str] | Fit]) -> tuple[list[str], list[Fit]]:
    """Return the names of scans and their fits; raise ValueError where a fit has no diagram."""
    scans = [fit if isinstance(fit, Fit) else Fit.load(fit) for fit in fits]
    names = [name_source(str(fit.provenance.get("scan") or "")) or f"scan {k}" for k, fit in enumerate(scans, 1)]
    for name, fit in zip(names, scans, strict=True):
        if fit.diagram is None:
            raise ValueError(f"the fit of {name} has no curvature diagram: {fit.status}")
    return names, scans


def _draw_shapes(
    sources: Sequence[Store], atlas: Atlas, families: Sequence[str], columns: dict[str, np.ndarray], solids: set[int],
    progress: Progress,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the page's entry for each shape: a table, a picture, and a solid for those whose index is in `solids`."""
    fields = {shape_id(store, index): (store, index) for store in sources for index in store.indices()}
    shapes = []
    for k, name in enumerate(atlas.ids):
        progress(f"drawing {len(atlas)} shapes", k / len(atlas))
        store, index = fields[name]
        u = store.field(index)
        figures = {title: format_number(float(values[k]), 4) for title, values in columns.items()}
        origin = {"seed": str(atlas.seeds[k]), "field": f"draw {index} of {store.name}"}
        rows = list(({"family": families[k]} | figures | origin).items())
        shapes.append({"rows": rows, "picture": _draw_small(u), "solid": make_solid(u) if k in solids else None})
    return shapes


def scale_fit(fit: Fit) -> Diagram:
    """Return a fit's curvature diagram in 1/thickness, as an atlas's shapes are compared.

    A mask or an image was resampled until its structure was `WORKING_THICKNESS` voxels thick; a phase field was not.
    Shapes of an atlas fill less than half of the box: a structure that fills more is compared by its background.
    """
    assert fit.diagram is not None
    voxels = fit.thickness / fit.working_voxel if fit.kind == "field" else WORKING_THICKNESS
    diagram = fit.diagram.mirrored if fit.morphometry.volume_fraction > HALF else fit.diagram
    return replace(diagram, points=diagram.points * voxels * WORKING_SPACING, unit="1/thickness")


def farthest_points(places: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of `count` points (or all): the one nearest to the middle, then always the farthest one from
    those already chosen."""
    chosen = [int(np.linalg.norm(places - np.median(places, axis=0), axis=1).argmin())]
    distances = np.linalg.norm(places - places[chosen[0]], axis=1)  # of each point from the nearest chosen one
    while len(chosen) < min(count, len(places)):
        chosen.append(int(distances.argmax()))
        distances = np.minimum(distances, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return np.array(chosen)


def _columns(atlas: Atlas) -> dict[str, np.ndarray]:
    """Return the values of shapes by their titles in `COLUMNS`, without a₂₀ where all shapes have the same."""
    values = (*atlas.coefficients.T, atlas.masses, atlas.volume_fractions, atlas.thicknesses)
    columns: dict[str, np.ndarray] = dict(zip(COLUMNS, values, strict=True))
    return columns if np.ptp(values[0]) > 0 else {title: columns[title] for title in COLUMNS[1:]}


def _describe_fit(fit: Fit, far: bool) -> list[tuple[str, str]]:
    """Return the page's table on a scan; `far`: it lies farther from shapes than 95 % of them from each other."""
    phase = "background, which fills less" if fit.morphometry.volume_fraction > HALF else "structure"
    distance = f"{'farther from shapes than 95 % of them from' if far else 'as near to shapes as they to'} each other"
    return [("family", fit.family), ("placed by its", phase), ("lies", distance), ("verdict", fit.status)]


# ---- one shape -------------------------------------------------------------------------------------------------------


def _pack(values: np.ndarray) -> str:
    """Return numbers for the page, compressed, in base64."""
    return base64.b64encode(zlib.compress(np.ascontiguousarray(values).tobytes(), 9)).decode("ascii")


def _shades(diagram: Diagram, limits: tuple[float, float]) -> np.ndarray:
    """Return a diagram as bytes `(BINS, BINS)`, κ2 by κ1: the logarithm of the area, 255 in the fullest bin."""
    areas = bin_diagram(diagram, np.linspace(*limits, BINS + 1), SMOOTH)
    levels = 1 + np.log10(np.maximum(areas, 1e-30) / max(float(areas.max()), 1e-30)) / DECADES
    return np.rint(255 * np.clip(levels, 0, 1)).astype(np.uint8)


def _draw_small(u: np.ndarray) -> str:
    """Return a small picture of a field: WebP in base64."""
    buffer = io.BytesIO()
    Image.fromarray(render(u, width=THUMBNAIL)[0]).save(buffer, "webp", quality=75, alpha_quality=75)
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def make_solid(u: np.ndarray) -> dict[str, Any]:
    """Return the capped surface of a periodic field `(Z, Y, X)` on at most `EDGE` voxels an edge.

    `points` (x, y, z) are in 1/1024 of a voxel; of `faces`, the last `caps` lie on the sides of the box.
    """
    values = np.clip(u, -1, 1).astype(np.float64)
    factor = min(1.0, EDGE / max(u.shape))
    for axis, n in enumerate(u.shape):
        if (count := max(4, round(n * factor))) < n:
            values = np.asarray(resample(values, count, axis=axis))  # by Fourier: the field is periodic
    mesh = capped_surface(values, Grid(values.shape, (1.0, 1.0, 1.0)))
    vertices = mesh.vertices + 0.5  # from the corner of the box, not from its first voxel's centre
    on_side = np.isclose(vertices, 0, atol=1e-2) | np.isclose(vertices, values.shape, atol=1e-2)
    caps = on_side[mesh.faces].all(axis=1).any(axis=-1)  # all three vertices on the same side
    faces = np.concatenate([mesh.faces[~caps], mesh.faces[caps]]).astype("<u2")
    points = np.rint(np.clip(vertices[:, ::-1], 0, None) * 1024).astype("<u2")
    return {"points": _pack(points.T), "faces": _pack(faces.T), "caps": int(caps.sum())}
