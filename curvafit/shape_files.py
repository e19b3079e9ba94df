"""A generated shape on disk: the volume or the surface, a picture and a record of what made it, beside each other."""

from __future__ import annotations

import datetime
import json
import os
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.generation.flow import Flow
from curvafit.mesh import SUFFIXES, capped_surface, write_surface
from curvafit.plot import surface_picture
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.scan import WRITABLE, Field, save

#: What a record beside a shape says that it is.
FORMAT = "curvafit-shape-1"


def check_target(path: str | Path) -> Path:
    """The path, if a shape can be written there by its suffix; asked before the work is done.

    Raises
    ------
    ValueError
        If the suffix is neither a volume's nor a surface's, the place cannot be written to, or another file
        stands where the record goes.
    """
    target = Path(path)
    known = (*WRITABLE, *SUFFIXES)
    if not target.name.lower().endswith(known):
        raise ValueError(f"expected a name ending in one of {', '.join(known)}, got {target.name!r}")
    if target.is_dir() and not target.name.lower().endswith(".zarr"):
        raise ValueError(f"expected the name of a file, got the folder {target}")
    check_folder(target.parent)
    note = _beside(target, ".json")
    if note.exists() and FORMAT not in note.read_text(encoding="utf-8", errors="replace")[:200]:
        raise ValueError(f"expected a name whose record {note.name} is not another file's, got {target.name!r}")
    return target


def check_folder(path: str | Path) -> Path:
    """The path, if it is a folder that can be written to, or can be made.

    Raises
    ------
    ValueError
        If a file is in the way, or the nearest folder there is cannot be written to.
    """
    folder = Path(path)
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not there.is_dir():
        raise ValueError(f"expected a folder to write to, got {folder}, where {there} is a file")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"expected a folder that can be written to, got {there}")
    return folder


def stem(path: str | Path) -> Path:
    """The path without its suffix, `.nii.gz` included."""
    target = Path(path)
    suffix = max(
        (known for known in (*WRITABLE, *SUFFIXES) if target.name.lower().endswith(known)), key=len, default=""
    )
    return target.with_name(target.name[: len(target.name) - len(suffix)])


def prior_voxel(path: str | Path) -> tuple[float, str]:
    """Edge of a working voxel and its unit, from a `fit.json`; a voxel where it does not say."""
    content = json.loads(Path(path).read_text(encoding="utf-8"))
    voxel, unit = content.get("working_voxel", 1.0), content.get("length_unit", "voxel")
    if not isinstance(voxel, (int, float)) or not voxel > 0 or not isinstance(unit, str):
        raise ValueError(f"expected a positive working_voxel and a length_unit in {path}, got {voxel!r} and {unit!r}")
    return float(voxel), unit


def write_shape(
    flow: Flow,
    path: str | Path,
    *,
    voxel: float = 1.0,
    unit: str = "voxel",
    record: dict[str, Any] | None = None,
) -> tuple[Path, Path, Path]:
    """Write a flow's field (a volume) or its closed surface (STL, PLY), by suffix, with a picture and a record.

    Parameters
    ----------
    voxel, unit
        Edge of a voxel, for spacing or vertices.
    record
        What to write into the JSON beside it; see `shape_record`.

    Returns
    -------
    The paths of shape, picture (`.png`) and record (`.json`). All three are made in a temporary folder, then moved.

    Raises
    ------
    ValueError
        If the suffix is unknown, or the field has no surface.
    """
    target = check_target(path)
    u, spacing = flow.field.numpy(), (voxel, voxel, voxel)
    target.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        made = work / target.name
        if target.name.lower().endswith(SUFFIXES):
            write_surface(capped_surface(u, Grid(u.shape, spacing, "periodic")), made)
        else:
            save(Field(u, spacing, unit), made)
        picture, note = _beside(made, ".png"), _beside(made, ".json")
        surface_picture(u, picture)
        note.write_text(json.dumps(record or {}, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        return tuple(_moved(part, target.parent) for part in (made, picture, note))  # type: ignore[return-value]
    finally:
        shutil.rmtree(work, ignore_errors=True)


def shape_record(flow: Flow, coefficients: Coefficients, mass: float, **more: Any) -> dict[str, Any]:
    """What is needed to make the shape again: parameters, sampling, seed, schedule, versions; and how it ended."""
    return {
        "format": FORMAT,
        "coefficients": coefficients.as_dict(),
        "mass": mass,
        "shape": list(flow.grid.shape),
        "spacing": list(flow.grid.spacing),
        "epsilon": WORKING_EPSILON,
        "boundary": flow.grid.boundary,
        "seed": flow.seed,
        "schedule": {"name": flow.schedule.name, "steps": flow.schedule.steps},
        "status": flow.status,
        "viable": flow.viability.viable,
        "volume_fraction": float(np.mean(flow.field.numpy() > 0)),
        **more,
        "curvafit": version("curvafit"),
        "torch": version("torch"),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _beside(target: Path, suffix: str) -> Path:
    """The path with another suffix; `.nii.gz` counts as one."""
    known = [each for each in (*WRITABLE, *SUFFIXES) if target.name.lower().endswith(each)]
    return target.with_name(target.name[: -max(map(len, known))] + suffix)


def _moved(part: Path, folder: Path) -> Path:
    """Put a finished file (or Zarr folder) in its place."""
    target = folder / part.name
    if target.is_dir():
        shutil.rmtree(target)
    os.replace(part, target)
    return target
