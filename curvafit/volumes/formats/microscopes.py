"""Microscopes' own files, CZI, LIF and ND2, by bioio and its readers of the extra `[microscopes]`."""

from __future__ import annotations

from pathlib import Path

from curvafit.core.extras import require
from curvafit.volumes.formats import base
from curvafit.volumes.formats.base import Stated

#: Suffix -> the package that reads it.
SUFFIXES = {".czi": "bioio_czi", ".lif": "bioio_lif", ".nd2": "bioio_nd2"}


def read_microscope(path: Path, *, key: str | None = None, **_: object) -> Stated:
    """Read a scene (`key`), by default the only one, with the voxel size in um that its file states."""
    for module in (SUFFIXES[path.suffix.lower()], "bioio"):
        bioio = require(module, "microscopes", f"reading {path.suffix}")
    image = bioio.BioImage(path)
    image.set_scene(base.pick_key(list(image.scenes), key, path))
    axes, sizes = base.name_axes(image.dims.order), image.physical_pixel_sizes
    if not (sizes.X and sizes.Y):
        return Stated(image.dask_data, axes)
    guesses = () if sizes.Z or image.dims.Z == 1 else (base.NO_DISTANCE,)
    edges = {"z": sizes.Z or sizes.X, "y": sizes.Y, "x": sizes.X}
    return Stated(image.dask_data, axes, [edges.get(axis) for axis in axes], ("um",) * len(axes), guesses=guesses)
