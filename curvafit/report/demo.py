"""A first look at the package on one page: a scan filled from sparse slices, then measured and read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy import ndimage

from curvafit.core.files import write_content
from curvafit.core.records import can_write, has_mark
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.drawing.plot import diagram_figure, gallery_figure
from curvafit.inference.inference import Inference, infer
from curvafit.report.inference import check_report, describe, describe_scan, write_inference
from curvafit.report.measures import check_measures, write_measures
from curvafit.report.page import MARK, Chosen, outlines_figure, picture_of, render
from curvafit.scan.measures import Measures
from curvafit.scan.structure import find_structure
from curvafit.scan.tiles import measure
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.slices import WAYS, Slices
from curvafit.segmentation.trials import dice
from curvafit.volumes.volume import ScanError, Volume

#: Of this many slices one is kept.
EVERY = 8
#: The numbers on the page.
SHOWN = ("BV/TV", "Tb.Th", "Tb.Sp", "Conn.D", "BS/BV")


def write_demo(
    scan: Volume, directory: str | Path, *, overwrite: bool = False, progress: Progress = silent
) -> tuple[Path, dict[str, float]]:
    """Fill a scan from every 8th slice, measure and read it, and write a page on it into a folder.

    The volume is filled from slices across its shortest axis (`reconstruct`) and compared with those left out. The
    pages of `write_measures` and of `write_inference` (`infer(growth=None)`) are written beside it. Return the page's
    path and the scores of `score`. Raises ValueError if the scan has no structure, or where a file would be lost, as
    `report.page.check_result_folder`.
    """
    inputs = [scan.source] if scan.source else []
    folder = check_report(directory, inputs, overwrite)
    check_measures(directory, inputs, overwrite)
    can_write(folder / "demo.html", lambda path: has_mark(path, MARK), overwrite=overwrite)
    measures = measure(scan, progress=sub_progress(progress, 0.0, 0.2))
    inference = infer(scan, growth=None, progress=sub_progress(progress, 0.2, 0.5))
    if inference.diagram is None:
        raise ScanError(f"expected a scan with a structure: {inference.fit.status}")
    mask = find_structure(scan)[1].values > 0
    axis = int(np.argmin(np.array(scan.shape) * scan.spacing))
    volume = Volume(mask.view(np.uint8), scan.spacing, scan.unit)
    filled = reconstruct(volume, every=EVERY, axis=axis, progress=sub_progress(progress, 0.5, 0.9)).mask.values
    scores = score(mask, filled, axis)
    progress("drawing the pages", 0.9)
    text = demo_page(inference, measures, shape_figure(mask, filled, axis, scan.spacing), scores, axis)
    write_measures([measures], folder, overwrite=overwrite)
    write_inference(inference, folder, overwrite=overwrite)
    return write_content(folder / "demo.html", text), scores


def score(mask: np.ndarray, filled: np.ndarray, axis: int) -> dict[str, float]:
    """Return the Dice coefficients, on the slices left out between the first and the last known one, of a mask with
    that filled from one in `EVERY` slices across an axis (`"curvafit"`), and with plain interpolations (`WAYS`)."""
    mask, network = np.moveaxis(mask, axis, 0), np.moveaxis(filled, axis, 0)
    known = Slices(mask[::EVERY], tuple(range(0, len(mask), EVERY)), len(mask), (1.0, 1.0, 1.0))
    volumes = {"curvafit": network, **{way: known.level(way) > 0 for way in WAYS}}
    return {name: dice(volume[known.between], mask[known.between]) for name, volume in volumes.items()}


def demo_page(inference: Inference, measures: Measures, shapes: Figure, scores: dict[str, float], axis: int) -> str:
    """Return the page, with links to those of the measures and the inference, as the text of an HTML file."""
    fit = inference.fit
    (_, network), *plain = ((name, f"{value:.3f}") for name, value in scores.items())
    outlines = outlines_figure([""], [measures.outline], measures.unit)
    numbers = ((measures[symbol].name, *measures[symbol].format(measures.unit)) for symbol in SHOWN)
    return render(
        "demo.html", title=f"{describe(inference)}.", made={}, scan=describe_scan(inference), every=EVERY,
        axis="zyx"[axis], shapes=picture_of(shapes, "Known slices, the filled volume, and the scan"),
        scores=[("the network", Chosen(network)), *((f"plain interpolation, {name}", value) for name, value in plain)],
        numbers=[(name, " ".join(filter(None, number))) for name, *number in numbers],
        outlines=picture_of(outlines, "Three slices with the outline of what was measured"),
        diagram=picture_of(diagram_figure(measures.diagram), "The scan's curvature diagram"),
        verdict=fit.misfit or fit.status,
        notes=dict.fromkeys((*inference.scan.notes, *fit.notes)),
    )  # fmt: skip


def shape_figure(mask: np.ndarray, filled: np.ndarray, axis: int, spacing: tuple[float, float, float]) -> Figure:
    """Return a figure of one in `EVERY` slices of a mask across an axis, of the volume filled from them, and of the
    mask, all cut in half to show what is inside."""
    known = np.zeros_like(mask)
    slices = (slice(None),) * axis + (slice(None, None, EVERY),)
    known[slices] = mask[slices]
    # The slices lie horizontally: the axis across them becomes z, and their longer side x.
    order = (axis, *sorted({0, 1, 2} - {axis}, key=lambda k: mask.shape[k] * spacing[k]))
    (box,) = ndimage.find_objects(mask.transpose(order).view(np.uint8))  # without empty margins
    masks = {f"every {EVERY}th slice": known, "filled between them": filled, "the scan": mask}
    halves = {name: each.transpose(order)[box] for name, each in masks.items()}
    halves = {name: each[:, each.shape[1] // 2 :] for name, each in halves.items()}
    return gallery_figure(halves, columns=3, width=1500, spacing=tuple(spacing[k] for k in order))
