"""Folders of slices, 2D images: TIFF, BMP, PNG or JPEG; those of NRecon with the voxel size of its log."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from curvafit.core.units import convert_length, is_unit
from curvafit.volumes.formats import base
from curvafit.volumes.formats.base import ScanError, Stated
from curvafit.volumes.formats.tiff import read_tiff

#: Suffixes of slices.
SLICES = (".tif", ".tiff", ".bmp", ".png", ".jpg", ".jpeg")
#: The share by which pixel sizes may differ that are one.
_SAME = 0.01
#: Annotated slices are at most this share of a volume of so many slices, and have so many labels.
_MOST, _LONGEST, _LABELS = 0.5, 10_000, 32


def read_slices(path: Path, **_: object) -> Stated:
    """Read a folder of 2D slices in the natural order of their names, with the pixel size that they or a log state.

    Labels in fewer than half of the slices, at uneven distances, lie where their numbers say, among empty ones.
    """
    names, notes = _list_slices(path)
    first, planes = None, []
    for name in names:
        stated = (read_tiff if name.suffix.lower() in SLICES[:2] else _read_picture)(base.check_regular(name))
        first, plane = first or stated, _squeeze_plane(stated)
        planes.append(plane)
        if plane.ndim != 2 + ("s" in first.axes) or plane.shape != planes[0].shape:
            got = f"{plane.shape} in {name.name} of {path}"
            raise ScanError(f"slices must be 2D and of one shape {planes[0].shape}, got {got}")
        if plane.dtype != planes[0].dtype:
            both = f"{planes[0].dtype} in {names[0].name} and {plane.dtype} in {name.name}"
            raise ScanError(f"slices must be of one type, got {both} of {path}")
        if not _are_same(stated, first):
            raise ScanError(f"slices must have one pixel size, got another in {name.name} of {path}")
    assert first is not None
    logged = _read_logs(path)
    if logged is not None:
        size, step, log = logged
        own = first._replace(units=[unit or first.custom for unit in first.units])
        if first.steps is not None and not _are_same(own, Stated(None, "zyx", [size] * 3, ["um"] * 3)):
            raise ScanError(f"{names[0].name} states another pixel size than the {size:g} um of {log} in {path}")
        first = first._replace(steps=[step * size, size, size], units=["um"] * 3, guesses=())
        notes += (f"The voxel size is that of {log}.",)
    values, axes = np.stack(planes), "zyxs"[: planes[0].ndim + 1]
    values, gaps = _place_slices(values, [name.stem for name in names])
    return first._replace(array=values, axes=axes, gaps=gaps, notes=(*first.notes, *notes))


def _list_slices(path: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Return the slices of a folder in order, and a note on images that are none."""
    files = [p for p in path.iterdir() if p.suffix.lower() in SLICES and not p.name.startswith(".")]
    kind = Counter(p.suffix.lower()[:4] for p in files).most_common(1)[0][0]
    names = [p for p in files if p.suffix.lower()[:4] == kind and not p.stem.lower().endswith("_spr")]
    aside = sorted(p.name for p in set(files) - set(names))
    if not names:
        raise ScanError(f"the folder {path} holds no slices but a preview, {aside[0]}")
    listed = ", ".join(aside[:3]) + (", …" if len(aside) > 3 else "")
    notes = (f"Not taken for slices: {listed}.",) if aside else ()
    notes += ("JPEG keeps grey values only roughly.",) if kind in (".jpg", ".jpe") else ()
    return sorted(names, key=lambda p: natural_key(p.name)), notes


def _read_picture(path: Path) -> Stated:
    """Read a BMP, PNG or JPEG; equal colours are grey, and transparency is left out."""
    import imagecodecs
    from PIL import Image

    if path.suffix.lower() == ".png":  # Pillow would cut deep colours to bytes
        values = np.asarray(imagecodecs.png_decode(path.read_bytes()))
    else:
        with Image.open(path) as image:
            values = np.asarray(image.convert({"P": "RGB", "PA": "RGBA", "1": "L"}.get(image.mode, image.mode)))
    if values.ndim == 2:
        return Stated(values, "yx")
    values = values[..., : 3 if values.shape[2] > 2 else 1]
    grey = bool((values == values[..., :1]).all())
    return Stated(values[..., 0], "yx") if grey else Stated(values, "yxs")


def _are_same(one: Stated, other: Stated) -> bool:
    """Return whether two slices state the same pixel size, in any unit, or none."""
    if one.steps is None or other.steps is None:
        return one.steps is other.steps
    lengths = [
        [h if not is_unit(unit) or unit in (None, "voxel") else convert_length(h, unit, "um") for h, unit in each]
        for each in (list(zip(stated.steps or (), stated.units, strict=True))[-2:] for stated in (one, other))
    ]
    return np.allclose(*lengths, rtol=_SAME)


def _read_logs(path: Path) -> tuple[float, float, str] | None:
    """Return the pixel size in um of NRecon's logs in a folder, pixels from slice to slice, and the name of one; None
    where there is none."""
    sizes: dict[float, tuple[float, str]] = {}
    for log in sorted(p for p in path.iterdir() if p.suffix.lower() == ".log" and p.is_file()):
        text = log.read_text(encoding="latin-1")
        for name in ("Pixel Size", "Image Pixel Size"):  # of the reconstruction, or else of the projections
            if found := re.search(rf"^\s*{name} \(um\)\s*=\s*([\d.]+)", text, re.MULTILINE):
                step = re.search(r"^\s*Section to Section Step\s*=\s*(\d+)", text, re.MULTILINE)
                sizes[float(found[1])] = (float(step[1]) if step else 1.0, log.name)
                break
    if len(sizes) > 1:
        listed = " and ".join(f"{size:g} um in {log}" for size, (_, log) in list(sizes.items())[:2])
        raise ScanError(f"the logs in {path} state voxel sizes of {listed}: leave that of these slices there alone")
    return next(((size, *rest) for size, rest in sizes.items()), None)


def _squeeze_plane(stated: Stated) -> np.ndarray:
    """Return a slice (Y, X), or (Y, X, samples)."""
    if "s" not in stated.axes:
        return np.squeeze(stated.array)
    values = np.moveaxis(stated.array, stated.axes.index("s"), -1)
    return values.reshape([*(n for n in values.shape[:-1] if n != 1), values.shape[-1]])


def _place_slices(values: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return slices as a volume, and a sentence on numbers that are skipped, if the names differ in their last one."""
    parts = [re.fullmatch(r"(.*?)(\d{1,15})(\D*)", name) for name in names]
    if len(names) < 2 or None in parts or len({(part[1], part[3]) for part in parts if part}) > 1:
        return values, ()
    numbers = np.array([int(part[2]) for part in parts if part])
    steps, count = np.diff(numbers), int(np.ptp(numbers)) + 1
    at = int(steps.argmax())
    if steps.min() < 1 or steps[at] == 1:
        return values, ()
    if steps[at] == steps.min() and len(names) > 2:
        return values, (f"The numbers of the slices step by {steps[at]}: what is there is stacked.",)
    if len(names) >= _MOST * count or count > _LONGEST or len(np.unique(values)) > _LABELS:
        return values, (f"The numbers of the slices skip some, after {names[at]} for one: what is there is stacked.",)
    base.check_array((count, *values.shape[1:]), values.dtype, "a folder of slices")
    placed = np.zeros((count, *values.shape[1:]), values.dtype)
    placed[numbers - numbers[0]] = values
    note = f"{len(names)} slices lie where their numbers say, from {numbers[0]} on"
    return placed, (f"{note}; {count - len(names)} others are empty.",)


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a key that sorts slice2 before slice10."""
    return tuple((0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name.casefold()))
