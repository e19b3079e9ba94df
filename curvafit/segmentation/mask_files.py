"""A segmentation on disk: the mask as the scan's file has it, a picture and a record of what made it."""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from curvafit.drawing.plot import DPI
from curvafit.drawing.sections import section_figure
from curvafit.drawing.shape_files import beside, check_outputs
from curvafit.files import move_together, staged
from curvafit.segmentation.segment import Segmentation
from curvafit.volumes.formats import pick_writer
from curvafit.volumes.formats.nifti import write_nifti_like
from curvafit.volumes.scan import Field, save

__all__ = ["FORMAT", "check_mask_target", "segmentation_figure", "write_mask"]

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
        rows = [(scan.values, None), (scan.values, found.mask.values)]
        section_figure(rows, scan.spacing).savefig(picture, dpi=DPI)
        parts = (made, picture, note)
        told = {**_record(found, scan, record or {}), "files": [part.name for part in parts]}
        note.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
        return move_together(parts, target.parent)  # type: ignore[return-value]


def segmentation_figure(found: Segmentation) -> Figure:
    """Return a figure of the phase field's middle slices with the mask's outline.

    Raises
    ------
    ValueError
        If the phase field is not finite.
    """
    return section_figure([(found.phase.values, found.mask.values)], found.phase.spacing)


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
