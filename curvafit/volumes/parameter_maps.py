"""Parameters that vary in space, read from files: one volume a parameter, by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from curvafit.priors.coefficients import NAMES
from curvafit.volumes.formats import READERS, ScanError, read_archive
from curvafit.volumes.scan import read_values

#: What may vary: the six coefficients, the mass and ε, all in working units.
PARAMETERS = (*NAMES, "mass", "epsilon")


def read_maps(path: str | Path, shape: tuple[int, int, int] | None = None) -> dict[str, float | Tensor]:
    """Maps `(Z, Y, X)` float32 by parameter, or numbers.

    Parameters
    ----------
    path
        An NPZ file whose arrays bear the names of `PARAMETERS`, or a folder of volumes named so (`a20.nii.gz`,
        `mass.tif` …). An array of one number holds everywhere.
    shape
        Voxels of every map; that of the first one by default.

    Raises
    ------
    FileNotFoundError
        If there is no such file or folder.
    ValueError
        If a name is no parameter's, nothing is in it, a map has another shape or numbers that are not finite.
    """
    place = Path(path)
    if not place.exists():
        raise FileNotFoundError(f"expected a file or folder of maps, got no such file: {place}")
    found = _from_folder(place) if place.is_dir() else _from_npz(place)
    unknown = sorted(found.keys() - set(PARAMETERS))
    if unknown or not found:
        listed = ", ".join(unknown) or "none"
        raise ValueError(f"expected maps named {', '.join(PARAMETERS)}, got {listed} in {place}")
    for name, values in found.items():
        numbers = values.dtype.kind in "iuf"
        if not numbers or not np.isfinite(values).all() or np.abs(values).max(initial=0) > np.finfo(np.float32).max:
            raise ValueError(f"expected finite numbers in the map {name}, got others in {place}")
        if values.size > 1:
            shape = shape or values.shape  # type: ignore[assignment]
            if values.shape != shape or len(values.shape) != 3:
                raise ValueError(f"expected the map {name} of shape {shape}, got {values.shape} in {place}")
    return {
        name: float(values.reshape(())) if values.size == 1 else torch.from_numpy(values.astype(np.float32))
        for name, values in found.items()
    }


def map_shape(maps: Mapping[str, float | Tensor]) -> tuple[int, int, int] | None:
    """The common shape of the maps, None where all are numbers."""
    shapes = [tuple(values.shape) for values in maps.values() if isinstance(values, Tensor)]
    return shapes[0] if shapes else None  # type: ignore[return-value]


def _from_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        return read_archive(path)
    except (ValueError, OSError) as reason:
        raise ValueError(f"expected an NPZ file or a folder of maps, got {path} that is neither") from reason


def _from_folder(path: Path) -> dict[str, np.ndarray]:
    known = tuple(READERS)
    files = [p for p in sorted(path.iterdir()) if p.name.lower().endswith(known) and not p.name.startswith(".")]
    found: dict[str, np.ndarray] = {}
    for file in files:
        name = file.name.split(".")[0]
        if name in found:
            raise ScanError(f"expected one map {name}, got two in {path}")
        found[name] = read_values(file) if name in PARAMETERS else np.empty(0)
    return found
