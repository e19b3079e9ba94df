"""TIFF, as a file or a folder of slices; the spacing is in ImageJ's, OME's or tifffile's description, or in tags."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from curvafit.core.units import convert_length, parse_unit
from curvafit.volumes.formats.base import Damaged, Raw, ScanError, check_array, check_regular, collect_complaints

if TYPE_CHECKING:
    import tifffile

#: Suffixes of a folder's slices.
SLICES = (".tif", ".tiff")
#: Bytes beyond which ImageJ's TIFF cannot point.
_IMAGEJ_LIMIT = 2**32 - 2**25
#: Most voxels per unit that TIFF's resolution can state.
_RESOLUTION_LIMIT = 2**31
#: Words of tifffile's messages where it skips a part of a file.
_LOST = re.compile("invalid (page )?offset|missing|corrupted|not match|failed to|out of range|raised", re.IGNORECASE)
_TAG_UNITS = {2: "inch", 3: "cm"}
_NO_DISTANCE = "The file states no distance of slices: it is taken as the pixel's."
#: Spacing (z, y, x) and unit, where the file states them, and notes on what is assumed.
_Spacing = tuple[tuple[float, ...] | None, str | None, tuple[str, ...]]
#: Resolutions that programs write when they know none (dots per inch; 25.4 is one dot per millimetre).
_SCREEN = (1, 25.4, 72, 96, 100, 150, 200, 300, 600)


def read_tiff(path: Path, **_: object) -> Raw:
    """Read the first series of a file, or raise Damaged where one of its strips or pages is missing."""
    import tifffile

    with collect_complaints("tifffile") as messages, tifffile.TiffFile(path) as file:
        series = file.series[0]
        check_array(series.shape, series.dtype or np.dtype("V1"), path)
        _check_pages(file, series)
        values = np.asarray(series.asarray())
        spacing, unit, guesses = _read_spacing(file)
        channels, guess = _channel_axis(series)
        count = len(file.series)
    tags = [text for text in messages if text.startswith("<TiffTag")]
    if losses := [text for text in messages if text not in tags and _LOST.search(text)]:
        raise Damaged(losses[0])
    notes = (f"The file holds {count} images: the first is used.",) if count > 1 else ()
    notes += (f"{len(tags)} of the file's tags cannot be read: what they state is not known.",) if tags else ()
    return Raw(values, spacing, unit, notes=(*notes, *guess), guesses=guesses, channels=channels)


def _channel_axis(series: tifffile.TiffPageSeries) -> tuple[int | None, tuple[str, ...]]:
    """Return the axis of colours or channels, and a note. In a series of three axes channels are taken for slices."""
    channel_axes = [axis for axis, name in enumerate(series.axes) if name in "SC" and series.shape[axis] != 1]
    axis = channel_axes[-1] if channel_axes else None
    if axis is None or series.axes[axis] == "S" or sum(n != 1 for n in series.shape) != 3:
        return axis, ()
    return None, (f"The file calls an axis of {series.shape[axis]} channels: it is taken for slices.",)


def read_slices(path: Path, **_: object) -> Raw:
    """Read a folder of 2D slices in the natural order of their names, with the pixel size of the first slice."""
    names = sorted((p for p in path.iterdir() if p.suffix.lower() in SLICES), key=lambda p: natural_key(p.name))
    first, slices = None, []
    for name in names:
        raw = read_tiff(check_regular(name))
        first, plane = first or raw, _squeeze_plane(raw)
        slices.append(plane)
        if plane.ndim != 2 + (raw.channels is not None) or plane.shape != slices[0].shape:
            raise ScanError(
                f"slices must be 2D and of one shape {slices[0].shape}, got {plane.shape} in {name.name} of {path}"
            )
    assert first is not None
    channels = None if first.channels is None else 3
    return first._replace(
        values=np.stack(slices), gaps=_skipped_numbers([name.stem for name in names]), channels=channels
    )


def _squeeze_plane(raw: Raw) -> np.ndarray:
    """Return a slice (Y, X), or (Y, X, channels)."""
    if raw.channels is None:
        return np.squeeze(raw.values)
    values = np.moveaxis(raw.values, raw.channels, -1)
    return values.reshape([*(n for n in values.shape[:-1] if n != 1), values.shape[-1]])


def _skipped_numbers(names: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence on numbers that are skipped, if the names of slices differ only in their last number."""
    parts = [re.fullmatch(r"(.*?)(\d{1,15})(\D*)", name) for name in names]
    if len(names) < 3 or None in parts or len({(part[1], part[3]) for part in parts if part}) > 1:
        return ()
    numbers = np.array([int(part[2]) for part in parts if part])
    steps = np.diff(numbers)
    at = int(steps.argmax())
    if steps.min() < 1 or steps[at] == np.median(steps):
        return ()
    return (f"The numbers of the slices skip some, after {names[at]} for one: what is there is stacked.",)


def _check_pages(file: tifffile.TiffFile, series: tifffile.TiffPageSeries) -> None:
    """Raise Damaged where pages, strips or tiles are missing or beyond the end: tifffile fills them with zeros."""
    metadata = file.imagej_metadata or {}
    if file.is_imagej and int(metadata.get("images", 1)) > math.prod(series.shape[:-2]):
        raise Damaged(f"{metadata['images']} images by its description, {math.prod(series.shape[:-2])} in the file")
    if series.dataoffset is not None:  # all values in one piece, whatever its pages are
        nbytes = math.prod(series.shape) * np.dtype(series.dtype).itemsize
        if series.dataoffset + nbytes > file.filehandle.size:
            raise Damaged(f"{nbytes} bytes of values by its header, fewer in the file")
        return
    for number, page in enumerate(series.pages):
        if page is None:
            raise Damaged(f"page {number} is not there")
        size = page.parent.filehandle.size  # a series may have its pages in several files
        places = list(zip(page.dataoffsets, page.databytecounts, strict=False))
        whole = all(start > 0 and count > 0 and start + count <= size for start, count in places)
        if not whole or len(places) < (1 if page.is_contiguous else math.prod(page.chunked)):
            raise Damaged(f"strips or tiles of page {number} are not there")


def write_tiff(field: Any, path: Path) -> None:
    """Write a TIFF with ImageJ's metadata, or with OME's where ImageJ lacks the type or cannot hold the size."""
    import tifffile

    values, (z, y, x) = _to_tiff(field), field.spacing
    fits = values.nbytes < _IMAGEJ_LIMIT and max(1 / x, 1 / y) < _RESOLUTION_LIMIT
    if values.dtype in (np.uint8, np.uint16, np.float32) and fits:
        exact = {"curvafit_spacing": f"{z!r},{y!r},{x!r}", "curvafit_unit": field.unit}
        unit = {"um": "micron", "voxel": "pixel"}.get(field.unit, field.unit)
        metadata = {"axes": "ZYX", "spacing": z, "unit": unit, **exact}
        tifffile.imwrite(
            path, values, photometric="minisblack", imagej=True, resolution=(1 / x, 1 / y), metadata=metadata
        )
    else:
        write_ome_tiff(field, path)


def write_ome_tiff(field: Any, path: Path) -> None:
    """Write a TIFF with OME's metadata."""
    import tifffile

    sizes = {f"PhysicalSize{axis}": h for axis, h in zip("ZYX", field.spacing, strict=True)}
    units = {f"PhysicalSize{axis}Unit": {"um": "µm", "voxel": "pixel"}.get(field.unit, field.unit) for axis in "ZYX"}
    metadata = {"axes": "ZYX", **sizes, **units}
    tifffile.imwrite(path, _to_tiff(field), photometric="minisblack", ome=True, metadata=metadata)


def _to_tiff(field: Any) -> np.ndarray:
    """Return the values as a TIFF holds them: bytes for a mask."""
    return field.values.view(np.uint8) if field.values.dtype == bool else field.values


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a key that sorts slice2 before slice10."""
    return tuple((0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name.casefold()))


def _read_spacing(file: tifffile.TiffFile) -> _Spacing:
    """Return spacing, unit and notes on what is assumed, from the description or, without one, the tags."""
    if file.is_ome and file.ome_metadata:
        return _from_ome(file.ome_metadata)
    description: dict[str, Any] = dict(file.imagej_metadata or (file.shaped_metadata or ({},))[0])
    if "curvafit_spacing" in description:
        return tuple(float(h) for h in description["curvafit_spacing"].split(",")), description["curvafit_unit"], ()
    if "PhysicalSizeX" in description:
        sizes = tuple(float(description.get(f"PhysicalSize{axis}", description["PhysicalSizeX"])) for axis in "ZYX")
        return sizes, description.get("unit", description.get("PhysicalSizeXUnit", "um")), ()
    if file.is_imagej:
        return _from_imagej(file, description)
    return _from_description(description) if "spacing" in description else _from_tags(file)


def _from_description(description: dict[str, Any]) -> _Spacing:
    """Return spacing, unit and a note from tifffile's JSON, where `spacing` is three numbers or one for all axes."""
    sizes = tuple(float(h) for h in np.atleast_1d(description["spacing"]))
    unit = description.get("unit")
    if len(sizes) == 3:
        return sizes, unit, ()
    note = f"The file states one voxel size, {sizes[0]:g} {unit or ''}".rstrip() + ": it is taken for all three axes."
    return sizes[:1] * 3, unit, (note,)


def _from_ome(text: str) -> _Spacing:
    """Return spacing and unit of OME's XML; an axis without a size has that of x."""
    pixels = next((node for node in ElementTree.fromstring(text).iter() if node.tag.endswith("Pixels")), None)
    if pixels is None or "PhysicalSizeX" not in pixels.attrib:
        return None, None, ()
    unit = pixels.get("PhysicalSizeXUnit", "um")
    sizes = []
    for axis in "ZYX":
        source = axis if f"PhysicalSize{axis}" in pixels.attrib else "X"
        size = float(pixels.attrib[f"PhysicalSize{source}"])
        sizes.append(convert_length(size, pixels.get(f"PhysicalSize{source}Unit", "um"), unit))
    return tuple(sizes), unit, ()


def _from_imagej(file: tifffile.TiffFile, description: dict[str, Any]) -> _Spacing:
    """Return spacing, unit and a note from ImageJ's description.

    `spacing` is the distance of slices, and the resolution tags count pixels per `unit`. Without a unit only the
    proportions have a meaning: lengths are then in pixels along x.
    """
    y, x = _pixels_per_unit(file)
    unit = description.get("unit")
    if parse_unit(unit)[0] == "voxel":
        sizes = (abs(float(description.get("spacing", 1 / x))) * x, x / y, 1.0)
        return (None if np.allclose(sizes, 1) else sizes), None, ()
    z = abs(float(description.get("spacing", 1 / x)))
    return (z, 1 / y, 1 / x), unit, () if "spacing" in description else (_NO_DISTANCE,)


def _from_tags(file: tifffile.TiffFile) -> _Spacing:
    """Return spacing, unit and a note from the resolution tags, unless they are a program's default."""
    y, x = _pixels_per_unit(file)
    tag = file.pages[0].tags.get("ResolutionUnit")  # type: ignore[union-attr]
    unit = _TAG_UNITS.get(int(tag.value)) if tag is not None else None
    if unit is None or min(x, y) <= 0:
        return None, None, ()
    dots = x * (2.54 if unit == "cm" else 1.0)
    if any(abs(dots - screen) < 0.51 for screen in _SCREEN):
        return None, None, ()
    _, factor = parse_unit(unit)
    return (factor / x, factor / y, factor / x), "mm", (_NO_DISTANCE,)


def _pixels_per_unit(file: tifffile.TiffFile) -> tuple[float, float]:
    """Return the resolution tags along (y, x), 1 where there are none."""
    values = []
    for name in ("YResolution", "XResolution"):
        tag = file.pages[0].tags.get(name)  # type: ignore[union-attr]
        top, bottom = tag.value if tag is not None else (1, 1)
        values.append(top / bottom if top and bottom else 1.0)
    return values[0], values[1]
