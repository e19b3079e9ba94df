"""A first look at the package on one page: a scan measured, filled from sparse slices, placed among textures, read."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from curvafit.atlas_map.picture import map_on
from curvafit.core.files import write_content
from curvafit.core.records import can_write, has_mark
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.drawing.plot import INK, diagram_on, gallery_figure, make_figure, section_on, shared_limits
from curvafit.geometry.distances import sliced_embedding
from curvafit.inference.atlas import load_atlas
from curvafit.inference.infer import infer
from curvafit.inference.posterior import load_posterior
from curvafit.report.page import (
    MARK,
    SYMBOLS,
    check_report,
    describe_scan,
    list_strips,
    picture_of,
    render_template,
    write_inference,
)
from curvafit.scan.measure import measure
from curvafit.scan.structure import find_structure
from curvafit.segmentation.reconstruct import reconstruct
from curvafit.segmentation.slices import WAYS, Slices
from curvafit.volumes.field import Field

if TYPE_CHECKING:
    from curvafit.inference.atlas import Atlas
    from curvafit.inference.fit import Fit
    from curvafit.inference.infer import Inference
    from curvafit.scan.measure import Measures

#: The page's name in its folder.
PAGE = "demo.html"
#: Of this many slices one is kept.
EVERY = 8
#: A parameter is read where its 90 % interval is at most this share of the prior's, and partly read up to the second.
_READ, _PARTLY = 0.35, 0.7
#: The symbols of the measures on the page.
_MEASURES = ("BV/TV", "Tb.Th", "Tb.Sp", "Conn.D", "BS/BV", "DA", "H", "K")


class Demo(NamedTuple):
    """The path of the page, and the results on it."""

    page: Path
    completion: Completion
    measures: Measures
    fit: Fit


class Completion(NamedTuple):
    """A mask, the mask filled from every `every`-th of its slices, both bool (Z, Y, X), and how well they agree.

    `dice` has the Dice coefficients, on the slices left out, of the filled volume (`"curvafit"`) and of the plain
    interpolations of `segmentation.slices.WAYS`.
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
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Demo:
    """Measure a scan, fill it from every 8th slice, infer its law, and write one page with the results into a folder.

    The structure is measured (`measure`). The volume is filled from the kept slices (`reconstruct`) and compared with
    those left out. The law is inferred (`infer(fast=True)`), and the curvature diagram placed among the atlas's.
    `fit.json` and `report.html` are written beside the page. `title` is the page's heading, plain text. Raises
    ValueError if the scan has no structure, or as `report.page.check_report`.
    """
    folder = check_report(directory, [scan.source] if scan.source else (), overwrite)
    page = folder / PAGE
    can_write(page, lambda path: has_mark(path, MARK), overwrite=overwrite)
    progress("measuring", 0.0)
    measures = measure(scan, progress=sub_progress(progress, 0.0, 0.1))
    atlas, posterior = load_atlas(), load_posterior()
    reading = sub_progress(progress, 0.1, 0.3)
    inference = infer(scan, fast=True, seed=seed, atlas=atlas, posterior=posterior, progress=reading)
    _, signed = find_structure(scan)
    mask = signed.values > 0
    volume = Field(mask.view(np.uint8), scan.spacing, scan.unit)
    filled = reconstruct(volume, every=EVERY, progress=sub_progress(progress, 0.3, 0.95))
    completion = score_completion(mask, filled.mask.values, EVERY, filled.status)
    progress("drawing the page", 0.95)
    text = demo_page(inference, measures, completion, atlas, posterior.box, title)
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

    The scan is placed on the map of `atlas`; `box` (7, 2) has the bounds of the posterior's prior (a11, log a02, a10,
    a01, a00, m₀, log thickness); `title` is the heading, plain text.
    """
    fit = inference.fit
    shapes = {
        f"every {completion.every}th slice": completion.known,
        "filled between them": completion.filled,
        "the scan, which was left out": completion.truth,
    }
    return render_template(
        "demo.html",
        version=version("curvafit"),
        title=title,
        scan=describe_scan(inference),
        shapes=picture_of(
            gallery_figure(shapes, columns=3, width=1500, azimuth=122), "Known slices, the filled volume, and the scan"
        ),
        slices=picture_of(_slice_figure(inference.scan, completion), "A left-out slice, as it is and as filled"),
        every=completion.every,
        score=f"{completion.dice['curvafit']:.3f}",
        rivals=", ".join(f"{way} {completion.dice[way]:.3f}" for way in WAYS),
        filled=completion.status,
        measures=_measure_rows(measures),
        blocks=_say_intervals(measures),
        map=picture_of(_map_figure(inference, atlas), "The scan's curvature diagram, and its place on the atlas's map"),
        reading=fit.status,
        parameters=_parameter_rows(fit.draws, box),
        strips=list_strips(fit),
        notes=dict.fromkeys((*inference.scan.notes, *fit.notes)),
    )


def _slice_figure(scan: Field, completion: Completion) -> Figure:
    """Return the slice midway between two known ones: its grey values, and where the filled slice differs."""
    every, n = completion.every, len(completion.truth)
    place = (n // 2 // every) * every + every // 2
    truth, filled = completion.truth[place], completion.filled[place]
    figure = make_figure(10.2, 3.9, layout="constrained")
    axes = figure.subplots(1, 3)
    plane = np.asarray(scan.values[place], dtype=np.float32)
    low, high = np.percentile(plane, (0.5, 99.5))
    aspect = scan.spacing[1] / scan.spacing[2]
    for each, mask, name in ((axes[0], truth, "the slice that was left out"), (axes[1], filled, "the filled slice")):
        section_on(each, plane, mask, (low, high), aspect)
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
    """Return a figure of the scan's diagram and its place among the atlas's, on the main axes of sliced quantiles."""
    assert inference.diagram is not None
    figure = make_figure(10.2, 4.6)
    λ, unit = inference.prepared.length, inference.fit.length_unit
    left = figure.add_axes((0.07, 0.13, 0.36, 0.78))
    diagram_on(left, inference.diagram, limits=shared_limits([inference.diagram], length=λ), unit=unit, length=λ)
    left.set_title("how much surface has which curvatures", fontsize=11)
    right = figure.add_axes((0.5, 0.13, 0.48, 0.78))
    seen_as = "field" if inference.fit.kind == "field" else "mask"
    own = map_on(right, atlas, seen_as, sliced_embedding(inference.diagram)[None])[0]
    right.scatter(*own, s=150, marker="*", c=INK, edgecolors="white", linewidths=1.2, zorder=5)
    right.annotate(
        "this scan", own, (7, 7), textcoords="offset points", fontsize=11, fontweight="bold", color=INK, zorder=6,
        path_effects=[withStroke(linewidth=3, foreground="white")],
    )  # fmt: skip
    return figure


def _measure_rows(measures: Measures) -> list[tuple[str, str, str, str]]:
    """Return name, symbol, value with its unit, and interval; no interval where the scan is too small for one."""
    rows = []
    for symbol in _MEASURES:
        value, interval, unit = measures[symbol].format(measures.unit)
        known = np.isfinite(measures[symbol].half)
        rows.append((measures[symbol].name, symbol, f"{value} {unit}".rstrip(), interval if known else ""))
    return rows


def _say_intervals(measures: Measures) -> str:
    """Return the sentence on the intervals of the measures."""
    count = int(np.prod(measures.blocks))
    if np.isfinite(measures["BV/TV"].half):
        return f"95 % intervals, by a jackknife over {count} blocks of one thickness and one spacing each."
    return f"No intervals: they need eight blocks of one thickness and one spacing each, and the scan holds {count}."


def _parameter_rows(draws: np.ndarray | None, box: np.ndarray) -> list[tuple[str, str, str, str]]:
    """Return each parameter's name, 90 % interval, the interval's share of the prior's, and whether it is read."""
    if draws is None:
        return []
    rows = []
    low, high = np.percentile(draws[:, : len(SYMBOLS)], (5, 95), axis=0)
    shares = (high - low) / (0.9 * np.ptp(box[: len(SYMBOLS)], axis=1))
    for name, a, b, share in zip(SYMBOLS, low, high, shares, strict=True):
        word = "read" if share <= _READ else "partly read" if share <= _PARTLY else "not read"
        rows.append((name, f"{a:.3g} to {b:.3g}", f"{share:.0%}", word))
    return rows
