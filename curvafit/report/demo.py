"""A first look at the package on one page: a scan filled from sparse slices, measured, placed among textures, read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from scipy import ndimage

from curvafit.core.files import write_content
from curvafit.core.records import can_write, has_mark
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.drawing.plot import INK, diagram_on, gallery_figure, make_figure, section_on, shared_limits
from curvafit.generation.flow import generate
from curvafit.generation.schedule import LEARNED
from curvafit.geometry.distances import sliced_embedding
from curvafit.inference.atlas import Atlas, load_atlas
from curvafit.inference.candidates import UNBELIEVABLE
from curvafit.inference.inference import Inference, infer
from curvafit.report.atlas import map_on
from curvafit.report.inference import check_report, describe, describe_scan, list_strips, write_inference
from curvafit.report.page import MARK, Chosen, picture_of, render
from curvafit.scan.measures import Measures
from curvafit.scan.structure import find_structure
from curvafit.scan.tiles import measure
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.slices import WAYS, Slices
from curvafit.segmentation.trials import dice
from curvafit.volumes.volume import ScanError, Volume

#: Of this many slices one is kept.
EVERY = 8
#: The nearest textures that are grown, by name, and their voxels a side.
PLACES, EDGE = ("nearest", "second", "third"), 64


class Completion(NamedTuple):
    """A mask, the mask filled from one in `EVERY` of its slices, both bool (Z, Y, X), and how well they agree.

    `axis` is the one across the slices. `dice` has the Dice coefficients, on the slices left out, of the filled volume
    (`"curvafit"`) and of the plain interpolations of `segmentation.slices.WAYS`.
    """

    truth: np.ndarray
    filled: np.ndarray
    axis: int
    dice: Mapping[str, float]

    @property
    def known(self) -> np.ndarray:
        """The known slices alone, bool (Z, Y, X)."""
        mask = np.zeros_like(self.truth)
        known = (slice(None),) * self.axis + (slice(None, None, EVERY),)
        mask[known] = self.truth[known]
        return mask


def write_demo(
    scan: Volume, directory: str | Path, *, seed: int = 0, overwrite: bool = False, progress: Progress = silent
) -> tuple[Path, Completion]:
    """Measure a scan, fill it from every 8th slice, find textures like it, and write one page on it into a folder.

    The structure is measured (`measure`). The volume is filled from slices across its shortest axis (`reconstruct`) and
    compared with those left out. The law is inferred (`infer(growth=None)`), the curvature diagram placed among the
    atlas's, and the nearest textures are grown. `fit.json` and `report.html` are written beside the page. Raises
    ValueError if the scan has no structure, or as `report.inference.check_report`.
    """
    folder = check_report(directory, [scan.source] if scan.source else (), overwrite)
    target = folder / "demo.html"
    can_write(target, lambda path: has_mark(path, MARK), overwrite=overwrite)
    progress("measuring", 0.0)
    measures = measure(scan, progress=sub_progress(progress, 0.0, 0.1))
    atlas = load_atlas()
    reading = sub_progress(progress, 0.1, 0.3)
    inference = infer(scan, growth=None, seed=seed, atlas=atlas, progress=reading)
    if inference.diagram is None:
        raise ScanError(f"expected a scan with a structure: {inference.fit.status}")
    _, field = find_structure(scan)
    mask = field.values > 0
    axis = int(np.argmin(np.array(scan.shape) * scan.spacing))
    volume = Volume(mask.view(np.uint8), scan.spacing, scan.unit)
    filled = reconstruct(volume, every=EVERY, axis=axis, progress=sub_progress(progress, 0.3, 0.6))
    completion = score_completion(mask, filled.mask.values, axis)
    textures: list[np.ndarray] = []
    for match in inference.fit.matches:
        if len(textures) < len(PLACES):
            progress("growing the nearest textures", 0.6 + 0.35 * len(textures) / len(PLACES))
            flow = generate(match.coefficients, match.mass, EDGE, seed=match.seed, schedule=LEARNED)
            if flow.viability.viable:
                textures.append(flow.field.numpy())
    progress("drawing the page", 0.95)
    text = demo_page(inference, measures, completion, textures, atlas)
    write_inference(inference, folder, overwrite=overwrite)
    return write_content(target, text), completion


def score_completion(truth: np.ndarray, filled: np.ndarray, axis: int = 0) -> Completion:
    """Score a volume filled from one in `EVERY` slices of a mask, and plain interpolations, on the slices left out.

    Only slices between the first and the last known one count.
    """
    mask, network = np.moveaxis(truth, axis, 0), np.moveaxis(filled, axis, 0)
    known = Slices(mask[::EVERY], tuple(range(0, len(mask), EVERY)), len(mask), (1.0, 1.0, 1.0))
    volumes = {"curvafit": network, **{way: known.level(way) > 0 for way in WAYS}}
    scores = {name: dice(volume[known.between], mask[known.between]) for name, volume in volumes.items()}
    return Completion(truth, filled, axis, scores)


def demo_page(
    inference: Inference, measures: Measures, completion: Completion, textures: Sequence[np.ndarray], atlas: Atlas
) -> str:
    """Return the page: a self-contained HTML text.

    The scan is placed on the map of `atlas`; `textures` are the phase fields of the nearest of its shapes.
    """
    fit = inference.fit
    gallery = {f"{rank} texture": u for rank, u in zip(PLACES, textures, strict=False)}
    shapes, slices = _shape_figure(completion, inference.scan.spacing), _slice_figure(inference.scan, completion)
    blocks = int(np.prod(measures.blocks)) if np.isfinite(measures["BV/TV"].half) else 0
    quantities = map(measures.__getitem__, ("BV/TV", "Tb.Th", "Tb.Sp", "Conn.D", "BS/BV", "DA", "H", "K"))
    (_, network), *plain = ((name, f"{score:.3f}") for name, score in completion.dice.items())
    return render(
        "demo.html", title=f"{describe(inference)}.", made={}, scan=describe_scan(inference), every=EVERY,
        axis="zyx"[completion.axis],
        shapes=picture_of(shapes, "Known slices, the filled volume, and the scan"),
        slices=picture_of(slices, "A left-out slice, as it is and as filled"),
        scores=[("the network", Chosen(network)), *((f"plain interpolation, {name}", score) for name, score in plain)],
        measures=[(each.name, each.symbol, *each.format(measures.unit)) for each in quantities],
        blocks=blocks, count=len(atlas),
        map=picture_of(_map_figure(inference, atlas), "The scan's curvature diagram, and its place on the atlas's map"),
        near=picture_of(gallery_figure(gallery, columns=3, width=1500), "The nearest textures") if gallery else None,
        misfit=fit.misfit, reading=fit.status,
        believed=fit.misfit is not None and fit.misfit.probability >= UNBELIEVABLE,
        strips=list_strips(fit), notes=dict.fromkeys((*inference.scan.notes, *fit.notes)),
    )  # fmt: skip


def _shape_figure(completion: Completion, spacing: tuple[float, float, float]) -> Figure:
    """Return a figure of the known slices, the filled volume and the scan, cut in half to show what is inside."""
    shape, axis = completion.truth.shape, completion.axis
    # The slices lie horizontally: the axis across them becomes z, and their longer side x.
    order = (axis, *sorted({0, 1, 2} - {axis}, key=lambda k: shape[k] * spacing[k]))
    known, filled, scan = (mask.transpose(order) for mask in (completion.known, completion.filled, completion.truth))
    (box,) = ndimage.find_objects(scan.view(np.uint8))  # without empty margins
    masks = {f"every {EVERY}th slice": known, "filled between them": filled, "the scan": scan}
    halves = {name: mask[box][:, (box[1].stop - box[1].start) // 2 :] for name, mask in masks.items()}
    return gallery_figure(halves, columns=3, width=1500, spacing=tuple(spacing[k] for k in order))


def _slice_figure(scan: Volume, completion: Completion) -> Figure:
    """Return a figure of a slice midway between two known ones: its grey values, and where the filled slice differs."""
    axis, count = completion.axis, scan.shape[completion.axis]
    index = (count // 2 // EVERY) * EVERY + EVERY // 2
    index -= EVERY if index > (count - 1) // EVERY * EVERY else 0  # after the last known slice: take the gap before it
    volumes = (np.asarray(scan.values), completion.truth, completion.filled)
    grey, truth, filled = (volume.take(index, axis) for volume in volumes)
    down, across = (h for k, h in enumerate(scan.spacing) if k != axis)
    if down * truth.shape[0] > across * truth.shape[1]:  # put the longer side across: it takes less of the page
        grey, truth, filled, down, across = grey.T, truth.T, filled.T, across, down
    grey, aspect = grey.astype(np.float32), down / across
    figure = make_figure(10.2, 0.7 + 3.4 * aspect * truth.shape[0] / truth.shape[1], layout="constrained")
    panels = figure.subplots(1, 3)
    low, high = np.percentile(grey, (0.5, 99.5))
    titles = ("a slice that was left out", "filled, on the same slice", "missing (blue), too much (orange)")
    for axes, mask in zip(panels, (truth, filled), strict=False):
        section_on(axes, grey, mask, (low, high), aspect)
    difference = np.ones((*truth.shape, 3), np.float32)
    difference[truth & filled] = (0.72, 0.74, 0.78)
    difference[truth & ~filled] = (0.0, 0.45, 0.70)
    difference[~truth & filled] = (0.84, 0.37, 0.0)
    panels[2].imshow(difference, aspect=aspect, interpolation="nearest")
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title, fontsize=11)
        axes.set(xticks=[], yticks=[])
    position = f"{'zyx'[axis]} = {index}, {EVERY // 2} slices from the nearest known one"
    figure.suptitle(position, fontsize=9, color="#5b616b")
    return figure


def _map_figure(inference: Inference, atlas: Atlas) -> Figure:
    """Return a figure of the scan's curvature diagram, and of its position on the map of the atlas."""
    diagram = inference.diagram
    assert diagram is not None
    figure = make_figure(10.2, 4.6)
    λ, unit = inference.prepared.length, inference.fit.length_unit
    diagram_axes = figure.add_axes((0.07, 0.13, 0.36, 0.78))
    diagram_on(diagram_axes, diagram, limits=shared_limits([diagram], length=λ), unit=unit, length=λ)
    diagram_axes.set_title("how much surface has which curvatures", fontsize=11)
    map_axes = figure.add_axes((0.5, 0.13, 0.48, 0.78))
    seen_as = "field" if inference.fit.kind == "field" else "mask"
    position = map_on(map_axes, atlas, seen_as, sliced_embedding(diagram)[None])[0]
    map_axes.scatter(*position, s=150, marker="*", c=INK, edgecolors="white", linewidths=1.2, zorder=5)
    map_axes.annotate(
        "this scan", position, (7, 7), textcoords="offset points", fontsize=11, fontweight="bold", color=INK, zorder=6,
        path_effects=[withStroke(linewidth=3, foreground="white")],
    )  # fmt: skip
    return figure
