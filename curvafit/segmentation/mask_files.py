"""A segmentation on disk: the mask as the scan's file has it, a picture and a record of what made it."""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from curvafit.drawing.plot import CONTOUR, DPI
from curvafit.drawing.shape_files import beside, check_outputs
from curvafit.files import move_together, staged
from curvafit.segmentation.segment import Segmentation
from curvafit.volumes.formats import pick_writer
from curvafit.volumes.formats.nifti import write_nifti_like
from curvafit.volumes.scan import Field, save

__all__ = ["FORMAT", "check_mask_target", "write_mask"]

#: What a record beside a mask says that it is.
FORMAT = "curvafit-mask-1"

_NIFTI = (".nii", ".nii.gz")


def check_mask_target(
    path: str | Path, unit: str | None = None, inputs: Iterable[str | Path] = (), overwrite: bool = False
) -> Path:
    """The path, if a mask in `unit` can be written there; asked before the work is done.

    `inputs` are the files, or folders, that are read: none may be written over. `overwrite` tells whether other files
    that no such command wrote may be.

    Raises
    ------
    ValueError
        If the suffix is no volume's, its format needs a unit, the place cannot be written to, or an input or another
        file stands where the mask, the record or the picture goes.
    """
    target = Path(path)
    pick_writer(target, unit or "mm")
    return check_outputs(target, FORMAT, inputs=inputs, overwrite=overwrite)


def write_mask(
    found: Segmentation,
    scan: Field,
    path: str | Path,
    *,
    like: str | Path | None = None,
    unit: str | None = None,
    record: dict[str, Any] | None = None,
    overwrite: bool = False,
) -> tuple[Path, Path, Path]:
    """Write the mask (0 and 1, uint8), a picture of the middle slices, and a record.

    Parameters
    ----------
    scan
        What was segmented: the picture's grey levels.
    like
        The scan's own file: where it and the target are NIfTI, the header is kept, all but the values' type and range.
    unit
        What the lengths in `like` are said to be in, if not what its header says.
    record
        What to add to the record.
    overwrite
        Whether files that no such call wrote may be replaced.

    Returns
    -------
    The paths of mask, picture (`.png`) and record (`.json`). All three are made in a temporary folder, then moved.
    """
    target = check_mask_target(path, scan.unit, () if like is None else (like,), overwrite)
    mask = found.mask.values.astype(np.uint8)
    with staged(target) as work:
        made = work / target.name
        if like is not None and all(str(each).lower().endswith(_NIFTI) for each in (like, target)):
            write_nifti_like(mask, Path(like), made, unit)
        else:
            save(Field(mask, scan.spacing, scan.unit, scan.affine), made, kind=FORMAT)
        picture, note = beside(made, ".png"), beside(made, ".json")
        _sections(scan, found).savefig(picture, dpi=DPI)
        parts = (made, picture, note)
        told = {**_record(found, scan, record or {}), "files": [part.name for part in parts]}
        note.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
        return move_together(parts, target.parent)  # type: ignore[return-value]


def _record(found: Segmentation, scan: Field, more: dict[str, Any]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "status": found.status,
        **more,
        "scan": scan.source,
        "shape": list(scan.shape),
        "spacing": list(scan.spacing),
        "unit": scan.unit,
        "coefficients": found.coefficients.as_dict(),
        "epsilon": found.epsilon,
        "weight": found.weight,
        "volume_fraction": float(found.mask.values.mean()),
        "notes": list(found.notes),
        "curvafit": version("curvafit"),
        "torch": version("torch"),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _sections(scan: Field, found: Segmentation) -> Figure:
    """The three middle slices: as they were above, with the mask's outline below."""
    grey, mask = scan.values.astype(np.float32), found.mask.values
    lowest, highest = np.percentile(grey, (0.5, 99.5))
    figure = Figure(figsize=(7.2, 5.0), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    names = ("z", "y", "x")
    for axis in range(3):
        rows, columns = (k for k in range(3) if k != axis)
        middle = grey.shape[axis] // 2
        plane, outline = np.take(grey, middle, axis), np.take(mask, middle, axis)
        ratio = scan.spacing[rows] / scan.spacing[columns]
        for row in (0, 1):
            shown = axes[row, axis]
            shown.imshow(
                plane, cmap="gray", vmin=lowest, vmax=max(highest, lowest + 1e-6), aspect=ratio, interpolation="nearest"
            )
            shown.set(xticks=[], yticks=[])
        if outline.any() and not outline.all():
            axes[1, axis].contour(outline, [0.5], colors=CONTOUR, linewidths=1.0)
        axes[0, axis].set_title(f"{names[axis]} = {middle}", fontsize=9)
        axes[1, axis].set_xlabel(names[columns])
        axes[1, axis].set_ylabel(names[rows], rotation=0, labelpad=6)
    return figure
