"""Outputs of a run that succeeded, opened by readers that are not ours, and held against their records."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

_VOLUMES = (".nii.gz", ".nii", ".npy", ".ome.tif", ".tif", ".mrc", ".ome.zarr", ".zarr")


def flaws(path: Path) -> Iterator[tuple[str, str]]:
    """Column and sentence of what is wrong with an output."""
    try:
        found = content(path)
    except Exception as error:  # every reader has its own way to say that a file is torn
        yield "torn", f"{path.name} cannot be read: {type(error).__name__}: {error}"[:250]
        return
    if isinstance(found, np.ndarray) and found.dtype.kind == "f" and not np.isfinite(found).all():
        yield "wrong", f"{path.name} holds numbers that are not finite"
    if isinstance(found, dict) and found.get("format") == "curvafit-shape-1":
        yield from _shape_flaws(path, found)
    if isinstance(found, dict) and found.get("format") == "curvafit-mask-1":
        yield from _mask_flaws(path, found)


def content(path: Path) -> Any:
    """What a file holds: an array, or JSON's content; None where only its frame is checked."""
    name = path.name.lower()
    for suffix, read in _READERS.items():
        if name.endswith(suffix):
            return read(path)
    return None


def volumes_beside(record: Path) -> list[np.ndarray]:
    """The values of the volumes that a record may tell of; none where it tells of a surface."""
    stem = record.name.removesuffix(".json")
    places = [record.parent / (stem + suffix) for suffix in _VOLUMES]
    return [content(place) for place in places if place.exists()]


def _shape_flaws(path: Path, record: dict[str, Any]) -> Iterator[tuple[str, str]]:
    shape = tuple(n * times for n, times in zip(record["shape"], record["tile"], strict=True))
    found = volumes_beside(path)
    if found and not any(_fits(values > 0, shape, record["volume_fraction"]) for values in found):
        yield "torn", f"{path.name} tells of another volume than the one beside it"
    if record["viable"] and "not finite" in record["status"]:
        yield "wrong", f"{path.name} calls viable what is not finite"


def _mask_flaws(path: Path, record: dict[str, Any]) -> Iterator[tuple[str, str]]:
    masks = [values for values in volumes_beside(path) if set(np.unique(values)) <= {0, 1}]
    if not any(_fits(values, tuple(record["shape"]), record["volume_fraction"]) for values in masks):
        yield "torn", f"{path.name} tells of a mask of 0 and 1 that is not beside it"


def _fits(inside: np.ndarray, shape: tuple[int, ...], share: float) -> bool:
    return inside.shape == shape and math.isclose(float(inside.mean()), share, abs_tol=1e-6)


def _nifti(path: Path) -> np.ndarray:
    import nibabel

    image: Any = nibabel.load(path)
    if not np.isfinite(image.affine).all() or not min(image.header.get_zooms()) > 0:
        raise ValueError("an affine or a voxel size that is none")
    return np.asarray(image.dataobj).T


def _tiff(path: Path) -> np.ndarray:
    import tifffile

    return tifffile.imread(path)


def _mrc(path: Path) -> np.ndarray:
    import mrcfile

    with mrcfile.open(path) as file:
        return np.array(file.data)


def _zarr(path: Path) -> Any:
    """The first level of an image; the draws of a store are read, and their chunks with them."""
    import zarr

    node: Any = zarr.open(path, mode="r")
    if "0" in node:
        return np.asarray(node["0"][...])
    for _, draw in node["draws"].groups():
        for _, array in draw.arrays():
            np.asarray(array[...])
    return None


def _arrays(path: Path) -> None:
    with np.load(path, allow_pickle=False) as file:
        for name in file.files:
            _ = file[name]


def _json(path: Path) -> Any:
    def refuse(name: str) -> None:
        raise ValueError(f"{name} is not JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def _picture(path: Path) -> None:
    from matplotlib.image import imread

    if imread(path).size == 0:
        raise ValueError("an empty picture")


def _surface(path: Path) -> np.ndarray:
    import trimesh

    return np.asarray(trimesh.load_mesh(path).vertices)


def _checkpoint(path: Path) -> None:
    import torch

    torch.load(path, weights_only=True)


def _page(path: Path) -> None:
    if not path.read_text(encoding="utf-8").rstrip().endswith("</html>"):
        raise ValueError("the page ends early")


_READERS = {
    **dict.fromkeys((".nii", ".nii.gz"), _nifti),
    **dict.fromkeys((".tif", ".tiff"), _tiff),
    ".npy": lambda path: np.load(path, allow_pickle=False),
    ".npz": _arrays,
    ".mrc": _mrc,
    ".zarr": _zarr,
    ".json": _json,
    ".png": _picture,
    ".stl": _surface,
    ".ply": _surface,
    ".vtp": lambda path: ElementTree.parse(path).getroot().tag,
    ".pt": _checkpoint,
    ".html": _page,
}
