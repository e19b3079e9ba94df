"""A segmentation on disk: the mask with the header of the scan's file, a picture and a record."""

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
from curvafit.segmentation.result import Segmentation
from curvafit.volumes.formats import pick_writer
from curvafit.volumes.formats.nifti import write_nifti_like
from curvafit.volumes.scan import Field, save

__all__ = ["FORMAT", "check_mask_target", "segmentation_figure", "write_mask"]

#: `format` of the record beside a mask.
FORMAT = "curvafit-mask-1"

_NIFTI = (".nii", ".nii.gz")


def check_mask_target(
    path: str | Path, unit: str | None = None, inputs: Iterable[str | Path] = (), overwrite: bool = False
) -> Path:
    """Return the path, or raise ValueError where a mask in `unit` cannot be written there; called before the work.

    `inputs` are the files, or folders, that are read: none may be overwritten. `overwrite` says whether files of other
    origin may be replaced.

    Raises
    ------
    ValueError
        If the suffix is not a volume's, its format needs a unit, the folder cannot be written to, or the mask, the
        record or the picture would replace an input or another file.
    """
    target = Path(path)
    pick_writer(target, unit or "mm")
    return check_outputs(target, FORMAT, more=[beside(target, ".png")], inputs=inputs, overwrite=overwrite)


def write_mask(
    segmentation: Segmentation,
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
        The scan, for the picture's grey levels.
    like
        The scan's file. If this file and the target are NIfTI, the mask gets the same header but for type and range.
    unit
        The unit of the lengths in `like`, by default the one of its header.
    record
        Entries to add to the record.
    overwrite
        Whether files of other origin may be replaced.

    Returns
    -------
    The paths of mask, picture (`.png`) and record (`.json`), which appear together once all three are whole.
    """
    target = check_mask_target(path, scan.unit, () if like is None else (like,), overwrite)
    mask = segmentation.mask.values.view(np.uint8)
    with staged(target) as work:
        temporary = work / target.name
        if like is not None and all(str(each).lower().endswith(_NIFTI) for each in (like, target)):
            write_nifti_like(mask, Path(like), temporary, unit)
        else:
            save(Field(mask, scan.spacing, scan.unit, scan.affine), temporary, kind=FORMAT)
        picture, note = beside(temporary, ".png"), beside(temporary, ".json")
        rows = [(scan.values, None), (scan.values, segmentation.mask.values)]
        section_figure(rows, scan.spacing).savefig(picture, dpi=DPI)
        parts = (temporary, picture, note)
        content = {**_record(segmentation, scan, record or {}), "files": [part.name for part in parts]}
        note.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        return move_together(parts, target.parent)  # type: ignore[return-value]


def segmentation_figure(segmentation: Segmentation) -> Figure:
    """Return a figure of the phase field's middle slices with the mask's outline.

    Raises
    ------
    ValueError
        If the phase field is not finite.
    """
    return section_figure([(segmentation.phase.values, segmentation.mask.values)], segmentation.phase.spacing)


def _record(segmentation: Segmentation, scan: Field, more: dict[str, Any]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "status": segmentation.status,
        **more,
        "scan": scan.source,
        "shape": list(scan.shape),
        "spacing": list(scan.spacing),
        "unit": scan.unit,
        "coefficients": None if segmentation.coefficients is None else segmentation.coefficients.as_dict(),
        "epsilon": segmentation.epsilon,
        "weight": segmentation.weight,
        "volume_fraction": float(segmentation.mask.values.mean()),
        "notes": list(segmentation.notes),
        "curvafit": version("curvafit"),
        "torch": version("torch"),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
