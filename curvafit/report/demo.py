"""A first look at the package on one page: a scan measured, filled from sparse slices, placed among textures, read."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from curvafit.core.files import write_content
from curvafit.core.records import can_write, has_mark
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.units import unit_name
from curvafit.drawing.plot import INK, diagram_on, gallery_figure, png, shared_limits
from curvafit.geometry.diagram import FAMILIES, family_of, half_thickness
from curvafit.geometry.distances import sliced_embedding
from curvafit.inference.atlas import load_atlas
from curvafit.inference.infer import infer
from curvafit.inference.posterior import load_posterior
from curvafit.priors.coefficients import Coefficients
from curvafit.report.page import SYMBOLS, check_report, write_inference
from curvafit.scan.measure import measure
from curvafit.scan.structure import find_level
from curvafit.segmentation.reconstruct import reconstruct
from curvafit.segmentation.slices import WAYS, Slices
from curvafit.volumes.field import Field

if TYPE_CHECKING:
    from curvafit.inference.atlas import Atlas
    from curvafit.inference.fit import Draws, Fit
    from curvafit.inference.infer import Inference
    from curvafit.scan.measure import Measures

#: The page's name in its folder, and the mark by which it is known as ours.
PAGE, _MARK = "demo.html", '<meta name="generator" content="curvafit'
#: Colours of `FAMILIES` that stay apart for the colour-blind (Okabe & Ito 2008).
COLOURS = dict(zip(FAMILIES, ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00"), strict=True))
#: A parameter is read where its 90 % interval is at most this share of the prior's, and partly read up to the second.
_READ, _PARTLY = 0.35, 0.7
#: What each measure is called on the page.
_NUMBERS = {
    "BV/TV": "volume fraction",
    "Tb.Th": "mean thickness",
    "Tb.Sp": "mean spacing",
    "Conn.D": "connectivity density",
    "BS/BV": "surface to volume",
    "DA": "degree of anisotropy",
    "H": "mean curvature",
    "K": "Gaussian curvature",
}


class Demo(NamedTuple):
    """What a first look leaves: the page's path, and what stands on it."""

    page: Path
    completion: Completion
    measures: Measures
    fit: Fit


class Completion(NamedTuple):
    """A mask, what was filled from every `every`-th of its slices, and how well.

    `dice` has the Dice coefficient on the slices left out of the filled volume (`"curvafit"`) and of the plain
    interpolations of `segmentation.slices.WAYS`; masks are bool (Z, Y, X).
    """

    truth: np.ndarray
    filled: np.ndarray
    every: int
    dice: Mapping[str, float]
    status: str

    @property
    def known(self) -> np.ndarray:
        """The known slices alone, bool (Z, Y, X)."""
        mask = np.zeros_like(self.truth)
        mask[:: self.every] = self.truth[:: self.every]
        return mask


def write_demo(
    scan: Field,
    directory: str | Path,
    *,
    title: str,
    every: int = 8,
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Demo:
    """Measure, fill, place and read a scan, and write one page on it into a folder, with `fit.json` and `report.html`.

    The structure is measured (`measure`); every `every`-th of its slices is kept and the volume filled from them
    (`reconstruct`), to be compared with the slices left out; its curvature diagram is placed among the atlas's; its law
    is read (`infer(fast=True)`).

    Parameters
    ----------
    scan
        The scan.
    title
        The page's heading, plain text.

    Raises
    ------
    ValueError
        If the scan has no structure, or the folder cannot be written to; or as `report.check_report`.
    """
    folder = check_report(directory, [scan.source] if scan.source else (), overwrite)
    page = folder / PAGE
    can_write(page, lambda path: has_mark(path, _MARK), overwrite=overwrite)
    progress("measuring", 0.0)
    measures = measure(scan, progress=sub_progress(progress, 0.0, 0.1))
    inference = infer(scan, fast=True, seed=seed, progress=sub_progress(progress, 0.1, 0.3))
    mask = find_level(scan).mask
    volume = Field(mask.view(np.uint8), scan.spacing, scan.unit)
    law = inference.fit if inference.fit.best is not None else Coefficients.willmore()
    filled = reconstruct(volume, law, every=every, progress=sub_progress(progress, 0.3, 0.95))
    completion = score_completion(mask, filled.mask.values, every, filled.status)
    progress("drawing the page", 0.95)
    text = demo_page(inference, measures, completion, load_atlas(), load_posterior().box, title)
    write_inference(inference, folder, overwrite=overwrite)
    return Demo(write_content(page, text), completion, measures, inference.fit)


def score_completion(truth: np.ndarray, filled: np.ndarray, every: int, status: str) -> Completion:
    """Compare a volume filled from every `every`-th slice of a mask, and plain interpolations, with what was left out.

    Only slices between the first and the last known one count.
    """
    places = tuple(range(0, len(truth), every))
    slices = Slices(truth[::every], places, len(truth), (1.0, 1.0, 1.0))
    left_out = slices.between
    volumes = {"curvafit": filled, **{way: slices.level(way) > 0 for way in WAYS}}
    scores = {name: dice(volume[left_out], truth[left_out]) for name, volume in volumes.items()}
    return Completion(truth, filled, every, scores, status)


def dice(a: np.ndarray, b: np.ndarray) -> float:
    """Return the Dice coefficient of two masks; 1 where both are empty."""
    total = a.sum() + b.sum()
    return float(2 * (a & b).sum() / total) if total else 1.0


def demo_page(
    inference: Inference, measures: Measures, completion: Completion, atlas: Atlas, box: np.ndarray, title: str
) -> str:
    """Return the page: a self-contained HTML text.

    Parameters
    ----------
    inference
        What `infer` says of the scan.
    measures
        What `measure` says of it.
    completion
        Its mask filled from sparse slices (`score_completion`).
    atlas
        The atlas on whose map the scan is placed.
    box
        Bounds of the posterior's prior, (6, 2): a11, log a02, a10, a01, a00, m₀.
    title
        The page's heading, plain text.
    """
    template = Template(files("curvafit.report").joinpath("templates", "demo.html").read_text(encoding="utf-8"))
    fit, scan = inference.fit, inference.scan
    shape = " × ".join(map(str, scan.shape))
    return template.substitute(
        version=escape(version("curvafit")),
        title=escape(title),
        scan=escape(f"{Path(scan.source).name or 'a volume'}: {shape} voxels (z, y, x) of {_voxel(scan)}."),
        shapes=_image(_completion_figure(completion), "Known slices, the filled volume, and the scan"),
        slices=_image(_slice_figure(scan, completion), "A left-out slice, the filled one, their difference"),
        every=completion.every,
        score=f"{completion.dice['curvafit']:.3f}",
        rivals=escape(", ".join(f"{way} {completion.dice[way]:.3f}" for way in WAYS)),
        filled=escape(completion.status),
        measures=_measure_rows(measures),
        blocks=escape(_say_intervals(measures)),
        map=_image(_map_figure(inference, atlas), "The scan's curvature diagram, and its place on the atlas's map"),
        reading=escape(fit.status),
        parameters=_parameter_rows(fit.draws, box),
        weak="".join(f"<li>{escape(each)}</li>" for each in fit.weak_directions),
        notes="".join(f"<li>{escape(note)}</li>" for note in dict.fromkeys((*scan.notes, *fit.notes))),
    )


def _voxel(scan: Field) -> str:
    if len(set(scan.spacing)) == 1:
        return f"{scan.spacing[0]:.4g} {unit_name(scan.unit, scan.spacing[0])}"
    return " × ".join(f"{h:.4g}" for h in scan.spacing) + f" {unit_name(scan.unit, 2)}"


def _image(figure: Figure, alt: str) -> str:
    return f'<img alt="{escape(alt)}" src="data:image/png;base64,{base64.b64encode(png(figure)).decode("ascii")}">'


def _completion_figure(completion: Completion) -> Figure:
    """Return surfaces of the known slices, of the filled volume and of the truth, side by side."""
    shapes = {
        f"every {completion.every}th slice": completion.known,
        "filled between them": completion.filled,
        "the scan, which was left out": completion.truth,
    }
    return gallery_figure(shapes, columns=3, width=1500, azimuth=122)


def _slice_figure(scan: Field, completion: Completion) -> Figure:
    """Return the slice midway between two known ones: its grey values, and where the filled slice differs."""
    every, n = completion.every, len(completion.truth)
    place = (n // 2 // every) * every + every // 2
    truth, filled = completion.truth[place], completion.filled[place]
    figure = Figure(figsize=(10.2, 3.9), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    plane = np.asarray(scan.values[place], dtype=np.float32)
    low, high = np.percentile(plane, (0.5, 99.5))
    aspect = scan.spacing[1] / scan.spacing[2]
    for each, mask, name in ((axes[0], truth, "the slice that was left out"), (axes[1], filled, "the filled slice")):
        each.imshow(plane, cmap="gray", vmin=low, vmax=max(high, low + 1e-6), aspect=aspect)
        if mask.any() and not mask.all():
            each.contour(mask, [0.5], colors="#E69F00", linewidths=1.1)
        each.set_title(name, fontsize=11)
    difference = np.ones((*truth.shape, 3), np.float32)
    difference[truth & filled] = (0.72, 0.74, 0.78)
    difference[truth & ~filled] = (0.0, 0.45, 0.70)
    difference[~truth & filled] = (0.84, 0.37, 0.0)
    axes[2].imshow(difference, aspect=aspect, interpolation="nearest")
    axes[2].set_title("missing (blue), too much (orange)", fontsize=11)
    for each in axes:
        each.set(xticks=[], yticks=[])
    figure.suptitle(f"z = {place}, {every // 2} slices from the nearest known one", fontsize=9, color="#5b616b")
    return figure


def _map_figure(inference: Inference, atlas: Atlas) -> Figure:
    """Return the scan's diagram, and its place among the atlas's on the two main axes of their sliced quantiles."""
    assert inference.diagram is not None
    embeddings = atlas.embeddings("field" if inference.fit.kind == "field" else "mask")
    mean = embeddings.mean(0)
    # The main axes of the sliced quantiles, in which Euclidean distance is the sliced Wasserstein distance.
    _, spread, axes_of = np.linalg.svd(embeddings - mean, full_matrices=False)
    places = (embeddings - mean) @ axes_of[:2].T
    own = (np.asarray(sliced_embedding(inference.diagram)) - mean) @ axes_of[:2].T
    share = float((spread[:2] ** 2).sum() / (spread**2).sum())
    names = _families(atlas)
    figure = Figure(figsize=(10.2, 4.6), facecolor="white")
    FigureCanvasAgg(figure)
    λ, unit = inference.fit.length, inference.fit.length_unit
    left = figure.add_axes((0.07, 0.13, 0.36, 0.78))
    diagram_on(left, inference.diagram, limits=shared_limits([inference.diagram], length=λ), unit=unit, length=λ)
    left.set_title("how much surface has which curvatures", fontsize=11)
    right = figure.add_axes((0.5, 0.13, 0.48, 0.78))
    for name, colour in COLOURS.items():
        of = [k for k, each in enumerate(names) if each == name]
        if of:
            right.scatter(*places[of].T, s=9, c=colour, linewidths=0, alpha=0.75, label=name)
    right.scatter(*own, s=150, marker="*", c=INK, edgecolors="white", linewidths=1.2, zorder=5)
    right.annotate(
        "this scan", own, (7, 7), textcoords="offset points", fontsize=11, fontweight="bold", color=INK, zorder=6,
        path_effects=[withStroke(linewidth=3, foreground="white")],
    )  # fmt: skip
    low, high = np.percentile(places, (0.3, 99.7), axis=0)
    low, high = np.minimum(low, own), np.maximum(high, own)
    rim = 0.06 * (high - low)
    right.set(xlim=(low[0] - rim[0], high[0] + rim[0]), ylim=(low[1] - rim[1], high[1] + rim[1]), xticks=[], yticks=[])
    legend = {"fontsize": 8, "frameon": False, "handletextpad": 0, "columnspacing": 0.9}
    right.legend(loc="lower center", ncols=6, bbox_to_anchor=(0.5, -0.15), **legend)
    right.set_title(f"its place among {len(atlas)} grown textures ({share:.0%} of their spread)", fontsize=11)
    right.spines[:].set_color("#dfe2e6")
    return figure


def _families(atlas: Atlas) -> list[str]:
    """Return the family of each shape of an atlas."""
    box = float(np.prod(atlas.provenance["settings"]["shape"]) * np.prod(atlas.provenance["settings"]["spacing"]))
    pairs = zip(atlas.field_diagrams, atlas.volume_fractions, strict=True)
    return [family_of(diagram, half_thickness(diagram, float(share) * box)) for diagram, share in pairs]


def _measure_rows(measures: Measures) -> str:
    rows = []
    for symbol, name in _NUMBERS.items():
        quantity = measures[symbol]
        unit = "" if not quantity.power else f" {unit_name(measures.unit, 2)}{_POWERS[quantity.power]}"
        interval = "" if not np.isfinite(quantity.half) else f"± {quantity.half:.2g}"
        rows.append(
            f'<tr><th scope="row">{escape(name)}</th><td class="small">{escape(symbol)}</td>'
            f'<td class="n">{quantity.value:.3g}{escape(unit)}</td><td class="n">{interval}</td></tr>'
        )
    return "\n".join(rows)


_POWERS = {1: "", -1: "⁻¹", -2: "⁻²", -3: "⁻³"}


def _say_intervals(measures: Measures) -> str:
    """Return the sentence on the intervals of the measures."""
    count = int(np.prod(measures.blocks))
    if np.isfinite(measures["BV/TV"].half):
        return f"95 % intervals, by a jackknife over {count} blocks of one thickness and one spacing each."
    return f"No intervals: they need eight blocks of one thickness and one spacing each, and the scan holds {count}."


def _parameter_rows(draws: Draws | None, box: np.ndarray) -> str:
    """Return a row for each parameter: its 90 % interval, how wide it is of the prior's, and whether it is read."""
    if draws is None:
        return ""
    rows = []
    low, high = np.percentile(draws.parameters, (5, 95), axis=0)
    shares = (high - low) / (0.9 * (box[:, 1] - box[:, 0]))
    for name, a, b, share in zip(SYMBOLS, low, high, shares, strict=True):
        word = "read" if share <= _READ else "partly read" if share <= _PARTLY else "not read"
        rows.append(
            f'<tr><th scope="row">{escape(name)}</th><td class="n">{a:.3g} to {b:.3g}</td>'
            f'<td class="n">{share:.0%}</td><td>{word}</td></tr>'
        )
    return "\n".join(rows)
