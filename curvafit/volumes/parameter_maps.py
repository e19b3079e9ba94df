"""Parameters that vary in space, read from files: one volume for each parameter."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from curvafit.core.records import read_archive
from curvafit.priors.coefficients import NAMES
from curvafit.volumes.read import READERS, read_values
from curvafit.volumes.volume import ScanError

#: What may vary: the six coefficients, the mass and ε, all in working units.
PARAMETERS = (*NAMES, "mass", "epsilon")


def read_maps(path: str | Path, shape: tuple[int, int, int] | None = None) -> dict[str, float | Tensor]:
    """Return the map `(Z, Y, X)`, float32, or the number of each parameter.

    Raises FileNotFoundError if there is no such file or folder, and ValueError if it is empty or holds another name, or
    a map has another shape or values that are not finite.

    Parameters
    ----------
    path
        An NPZ file of arrays named as in `PARAMETERS`, or a folder of volumes with these names (`a20.nii.gz`,
        `mass.tif` …). An array of one number holds everywhere.
    shape
        Voxels of every map (z, y, x); by default the shape of the first map.
    """
    place = Path(path)
    if not place.exists():
        raise FileNotFoundError(f"no such file or folder of maps: {place}")
    try:
        arrays = None if place.is_dir() else read_archive(place)
    except (ValueError, OSError) as reason:
        raise ValueError(f"{place} is neither an NPZ file nor a folder of maps") from reason
    arrays = _read_folder(place) if arrays is None else arrays
    unknown = sorted(arrays.keys() - set(PARAMETERS))
    if unknown or not arrays:
        listed = ", ".join(unknown) or "none"
        raise ValueError(f"maps must be named {', '.join(PARAMETERS)}, got {listed} in {place}")
    for name, values in arrays.items():
        numbers = values.dtype.kind in "iuf"
        if not numbers or not np.isfinite(values).all() or np.abs(values).max(initial=0) > np.finfo(np.float32).max:
            raise ValueError(f"the map {name} must hold finite numbers, got others in {place}")
        if values.size > 1:
            shape = shape or values.shape  # type: ignore[assignment]
            if values.shape != shape or len(values.shape) != 3:
                raise ValueError(f"the map {name} must have the shape {shape}, got {values.shape} in {place}")
    return {
        name: float(values.reshape(())) if values.size == 1 else torch.from_numpy(values.astype(np.float32))
        for name, values in arrays.items()
    }


def map_shape(maps: Mapping[str, float | Tensor]) -> tuple[int, int, int] | None:
    """Return the common shape of the maps, None if all are numbers."""
    shapes = [tuple(values.shape) for values in maps.values() if isinstance(values, Tensor)]
    return shapes[0] if shapes else None  # type: ignore[return-value]


def _read_folder(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a folder's volume files by name; files of other names are not read, and get empty arrays."""
    suffixes = tuple(READERS)
    files = [p for p in sorted(path.iterdir()) if p.name.lower().endswith(suffixes) and not p.name.startswith(".")]
    arrays: dict[str, np.ndarray] = {}
    for file in files:
        name = file.name.split(".")[0]
        if name in arrays:
            raise ScanError(f"{path} holds two maps {name}")
        arrays[name] = read_values(file) if name in PARAMETERS else np.empty(0)
    return arrays
