"""A generated shape on disk: the volume or the surface, a picture and a record of what made it, beside each other."""

from __future__ import annotations

import dataclasses
import datetime
import warnings
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from curvafit.core.checks import check_positive, check_type
from curvafit.core.files import move_together, remove, temporary_folder
from curvafit.core.records import Format, can_write, sibling
from curvafit.core.runtime import hold_signals
from curvafit.core.units import parse_unit
from curvafit.drawing.plot import surface_figure, write_picture
from curvafit.generation.flow import Flow
from curvafit.geometry.mesh import SUFFIXES, Surface, solid_surface, write_surface
from curvafit.priors.coefficients import NAMES
from curvafit.priors.curvature import geometric_curvatures, jet
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING, Grid
from curvafit.priors.profile import profile_distance
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import WRITERS, pick_writer, save

#: What a record beside a shape says that it is.
FORMAT = Format("curvafit-shape-1", title="the record of a shape")


@dataclasses.dataclass(frozen=True)
class Output:
    """How a field becomes a file: the edge of a voxel and its unit, for spacing or vertices; ValueError for others.

    A surface is closed on the box's faces, watertight around the volume of {u > 0}. A volume may have the `affine` of
    another (see `Volume`), so that it lies where that one does.
    """

    voxel: float = 1.0
    unit: str = "voxel"
    affine: np.ndarray | None = dataclasses.field(default=None, compare=False)

    def __post_init__(self) -> None:
        check_type(self.unit, str, "a unit as text")
        unit, factor = parse_unit(self.unit)
        object.__setattr__(self, "unit", unit)
        edge = check_positive(self.voxel, "a positive voxel edge")
        object.__setattr__(self, "voxel", edge * factor)


def check_target(
    path: str | Path,
    output: Output | None = None,
    *,
    picture: bool = True,
    inputs: Iterable[str | Path] = (),
    overwrite: bool = False,
) -> Path:
    """Return the path if a shape can be written there, with its record and picture; call it before the work.

    `inputs` are files that are read, and so never written over; `overwrite` allows to replace files of another origin.
    An unknown suffix, a unit that the format cannot hold, and a name that cannot be written are a ValueError.
    """
    target = Path(path)
    suffixes = (*WRITERS, *SUFFIXES)
    if not target.name.lower().endswith(suffixes):
        raise ValueError(f"the name of a shape must end in one of {', '.join(suffixes)}, got {target.name!r}")
    if not target.name.lower().endswith(SUFFIXES):
        pick_writer(target, (output or Output()).unit)
    companions = [sibling(target, suffix) for suffix in ((".json", ".png") if picture else (".json",))]
    return can_write(target, FORMAT, more=companions, inputs=inputs, overwrite=overwrite)


def write_shape(
    flow: Flow,
    path: str | Path,
    *,
    output: Output | None = None,
    record: dict[str, Any] | None = None,
    picture: bool = True,
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write a flow's field as a volume or a surface, by suffix, with a record and a picture.

    Return the paths of the shape, the record (`.json`, see `shape_record`) and the picture (`.png`). All files are made
    in a temporary folder, then moved together. If the picture cannot be drawn, a warning says so. The picture of a
    shape that is replaced is deleted, also where none is drawn now. Raises ValueError as `check_target` does, or if the
    field has no surface.
    """
    target = check_target(path, output, picture=picture, overwrite=overwrite)
    image = sibling(target, ".png")
    replaces_image = picture or image.name in FORMAT.companions(target)
    with temporary_folder(target) as work:
        shape = write_field(flow.field, flow.grid, work / target.name, output)
        record_path = sibling(shape, ".json")
        files = [shape, record_path]
        if picture:
            try:
                write_picture(surface_figure(flow.field.numpy(), width=900), work / image.name)
                files.append(work / image.name)
            except (OSError, ValueError, MemoryError) as error:
                reason = getattr(error, "strerror", None) or error
                warnings.warn(f"no picture was drawn: {reason}", UserWarning, stacklevel=2)
        FORMAT.write(record_path, {**(record or {}), "files": [file.name for file in files]})
        with hold_signals():
            if replaces_image:
                remove(image)
            return move_together(files, target.parent)


def write_field(field: Tensor, grid: Grid, path: str | Path, output: Output | None = None) -> Path:
    """Write a field `(Z, Y, X)` as a volume or a surface, by suffix, without picture and record.

    Another file of that name is replaced, another folder is not. A PLY surface has its level set's principal curvatures
    `kappa1` and `kappa2` at the vertices, 0 on caps.
    """
    target, output = Path(path), output or Output()
    values, spacing = field.numpy(), (output.voxel, output.voxel, output.voxel)
    if not target.name.lower().endswith(SUFFIXES):
        return save(Volume(values, spacing, output.unit, output.affine), target, kind=FORMAT.name)
    box, data = Grid(grid.shape, spacing, grid.boundary), None
    mesh = solid_surface(values, box)
    if target.suffix.lower() == ".ply":
        data = _vertex_curvatures(mesh, field, box)
        middle = (np.array(values.shape) - 1) / 2
        offsets = np.abs(mesh.vertices / np.array(spacing) - middle)
        capped = np.any(offsets > middle + 0.5 - 1e-6, axis=1)  # faces are half a voxel beyond the outermost centres
        data = {name: np.where(capped, 0, κ) for name, κ in data.items()}
    return write_surface(mesh, target, unit=output.unit, data=data, grid=box)


def shape_record(
    flow: Flow,
    *,
    mass: float | Tensor | None = None,
    orientation: Tensor | None = None,
    output: Output = Output(),
    **more: Any,
) -> dict[str, Any]:
    """Return what is needed to make a shape again (parameters, sampling, seed, schedule, versions), and its status.

    By default the mass is that of the flow, the mean of its field. A parameter that varies in space is recorded as its
    least and its greatest value.
    """
    return {
        "format": FORMAT.name,
        "coefficients": dict(zip(NAMES, map(_number_or_range, flow.coefficients), strict=True)),
        "mass": _number_or_range(flow.mass if mass is None else mass), "shape": list(flow.grid.shape),
        "working_spacing": list(flow.grid.spacing), "epsilon": flow.epsilon,
        "boundary": flow.grid.boundary, "seed": flow.seed, "schedule": flow.schedule.as_dict(), "status": flow.status,
        "viable": flow.viability.viable, "volume_fraction": float(np.mean(flow.field.numpy() > 0)),
        "orientation": None if orientation is None else [[*map(_number_or_range, row)] for row in orientation],
        "voxel": output.voxel, "unit": output.unit, **more, "curvafit": version("curvafit"), "torch": version("torch"),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }  # fmt: skip


def _number_or_range(value: float | Tensor) -> float | dict[str, float]:
    if not isinstance(value, Tensor) or value.numel() == 1:
        return float(value)
    return {"least": float(value.min()), "greatest": float(value.max())}


def _vertex_curvatures(mesh: Surface, field: Tensor, grid: Grid) -> dict[str, np.ndarray]:
    """Return κ1, κ2 `(V,)` of a field's level sets at a mesh's vertices, interpolated linearly."""
    ε = WORKING_EPSILON / WORKING_SPACING * grid.spacing[0]
    κ1, κ2, _, _ = geometric_curvatures(jet(profile_distance(field, ε), grid))
    positions = (mesh.vertices / np.array(grid.spacing)).T
    mode = "grid-wrap" if grid.periodic else "nearest"
    sharpest = 1 / grid.spacing[0]  # a voxel does not resolve a smaller radius of curvature
    resolved = [torch.nan_to_num(κ).clamp(-sharpest, sharpest).numpy() for κ in (κ1, κ2)]
    curvatures = (map_coordinates(κ, positions, order=1, mode=mode) for κ in resolved)
    return dict(zip(("kappa1", "kappa2"), curvatures, strict=True))
