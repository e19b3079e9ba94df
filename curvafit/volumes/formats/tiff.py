"""TIFF, whose spacing is in ImageJ's, OME's or tifffile's description, or in tags; folders of slices, 2D images."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from curvafit.core.units import convert_length, is_unit, parse_unit
from curvafit.volumes.formats import base
from curvafit.volumes.formats.base import ScanError, Stated

if TYPE_CHECKING:
    import tifffile

#: Whole numbers below which the greatest one are a mask or labels: they are shown from 0 to that.
LABELS = 64
#: Bytes beyond which ImageJ's TIFF cannot point.
_IMAGEJ_LIMIT = 2**32 - 2**25
#: Most voxels per unit that TIFF's resolution can state.
_RESOLUTION_LIMIT = 2**31
#: Words of tifffile's messages where it skips a part of a file.
_LOST = re.compile("invalid (page )?offset|missing|corrupted|not match|failed to|out of range|raised", re.IGNORECASE)
_TAG_UNITS = {2: "inch", 3: "cm"}
#: Steps along (z, y, x), their units, and guesses, as fields of `Stated`; empty where nothing is stated.
_Spacing = dict[str, Any]
#: Resolutions that programs write when they know none (dots per inch; 25.4 is one dot per millimetre).
_SCREEN = (1, 25.4, 72, 96, 100, 150, 200, 300, 600)
#: Suffixes of slices.
SLICES = (".tif", ".tiff", ".bmp", ".png", ".jpg", ".jpeg")
#: Relative difference up to which pixel sizes count as equal.
_SAME = 0.01
#: Bounds of a volume of which only some slices are annotated: the share of these, its slices, and its labels.
_MOST, _LONGEST, _LABELS = 0.5, 10_000, 32


def read_tiff(path: Path, **_: object) -> Stated:
    """Read the first series of a file, or raise Damaged where one of its strips or pages is missing."""
    import tifffile

    with base.collect_complaints("tifffile") as messages, tifffile.TiffFile(path) as file:
        series = file.series[0]
        base.check_array(series.shape, series.dtype or np.dtype("V1"), path)
        _check_pages(file, series)
        spacing = _read_spacing(file)
        axes = base.name_axes(series.axes)
        values, calibration_notes = _calibrate(np.asarray(series.asarray()), file.imagej_metadata or {})
        count, nodata = len(file.series), series.pages[0].tags.get(42113)  # type: ignore[union-attr]
    tag_errors = [text for text in messages if text.startswith("<TiffTag")]
    # GDAL's value for what was not measured, tag 42113, may not fit the values' type.
    if losses := [text for text in messages if text not in tag_errors and _LOST.search(text) and "GDAL" not in text]:
        raise base.Damaged(losses[0])
    notes = (f"The file holds {count} images: the first is used.",) if count > 1 else ()
    if nodata is not None:
        notes += (f"By the file, {nodata.value} stands where nothing was measured.",)
    if tag_errors:
        notes += (f"{len(tag_errors)} of the file's tags cannot be read: what they state is not known.",)
    return Stated(values, axes, notes=(*notes, *calibration_notes), **spacing)


def _calibrate(values: np.ndarray, metadata: Mapping[str, Any]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return values with ImageJ's linear calibration, c0 + c1 v, applied, or with a note on one that is not linear."""
    function, c0, c1 = metadata.get("cf", 0), metadata.get("c0"), metadata.get("c1")
    if function not in (0, 20):  # 20 is none
        return values, (f"ImageJ's calibration of grey values, its function {function}, is not applied.",)
    if values.dtype.kind not in "iu" or c0 is None or not c1 or (c0, c1) == (0, 1) or function == 20:
        return values, ()
    grey = np.maximum(values * np.float64(c1) + float(c0), 0 if metadata.get("zeroclip") else -np.inf)
    is_whole = float(c0).is_integer() and float(c1).is_integer()  # labels stay whole numbers
    return grey.astype(base.smallest_type(grey) if is_whole else np.float32), ()


def _check_pages(file: tifffile.TiffFile, series: tifffile.TiffPageSeries) -> None:
    """Raise Damaged where pages, strips or tiles are missing or beyond the end: tifffile fills them with zeros."""
    metadata, count = file.imagej_metadata or {}, math.prod(series.shape[:-2])
    if file.is_imagej and int(metadata.get("images", 1)) > count:
        raise base.Damaged(f"{metadata['images']} images by its description, {count} in the file")
    if series.dataoffset is not None:  # all values are contiguous, whatever the pages say
        nbytes = math.prod(series.shape) * np.dtype(series.dtype).itemsize
        if series.dataoffset + nbytes > file.filehandle.size:
            raise base.Damaged(f"{nbytes} bytes of values by its header, fewer in the file")
        return
    for number, page in enumerate(series.pages):
        if page is None:
            raise base.Damaged(f"page {number} is not there")
        size = page.parent.filehandle.size  # a series may have its pages in several files
        segments = list(zip(page.dataoffsets, page.databytecounts, strict=False))
        in_file = all(start > 0 and length > 0 and start + length <= size for start, length in segments)
        if not in_file or len(segments) < (1 if page.is_contiguous else math.prod(page.chunked)):
            raise base.Damaged(f"strips or tiles of page {number} are not there")


def write_tiff(field: Any, path: Path) -> None:
    """Write a TIFF with the first metadata that hold its type and size: ImageJ's, OME's, or tifffile's own."""
    import tifffile

    values, (z, y, x) = _to_tiff(field.values), field.spacing
    within_limits = values.nbytes < _IMAGEJ_LIMIT and max(1 / x, 1 / y) < _RESOLUTION_LIMIT
    if values.dtype in (np.uint8, np.uint16, np.float32) and within_limits:
        exact = {"curvafit_spacing": f"{z!r},{y!r},{x!r}", "curvafit_unit": field.unit}  # resolutions are rounded
        unit = {"um": "micron", "voxel": "pixel"}.get(field.unit, field.unit)
        most = int(values.max(initial=0)) if values.dtype.kind == "u" else 0
        shown = {"min": 0, "max": most} if 0 < most < LABELS else {}  # else ImageJ shows a mask of 0 and 1 black
        metadata = {"axes": "ZYX", "spacing": z, "unit": unit, **exact, **shown}
        options = {"imagej": True, "resolution": (1 / x, 1 / y), "metadata": metadata}
        tifffile.imwrite(path, values, photometric="minisblack", **options)
    elif values.dtype.kind == "f" or values.dtype.itemsize < 8:
        write_ome_tiff(field, path)
    else:
        tifffile.imwrite(path, values, photometric="minisblack", metadata={"spacing": (z, y, x), "unit": field.unit})


def write_ome_tiff(field: Any, path: Path) -> None:
    """Write a TIFF with OME's metadata."""
    import tifffile

    sizes = {f"PhysicalSize{axis}": h for axis, h in zip("ZYX", field.spacing, strict=True)}
    units = {f"PhysicalSize{axis}Unit": {"um": "µm", "voxel": "pixel"}.get(field.unit, field.unit) for axis in "ZYX"}
    metadata = {"axes": "ZYX", **sizes, **units}
    tifffile.imwrite(path, _to_tiff(field.values), photometric="minisblack", ome=True, metadata=metadata)


def check_ome_tiff(values: np.ndarray) -> None:
    """Raise ScanError if values are whole numbers that need 64 bits, before `write_ome_tiff`."""
    if (dtype := _to_tiff(values).dtype).kind in "iu" and dtype.itemsize > 4:
        raise ScanError(f"an OME-TIFF holds whole numbers of at most 32 bits, got {dtype}: name it .tif")


def _to_tiff(values: np.ndarray) -> np.ndarray:
    """Return values as a TIFF holds them: bytes for a mask, float32 for float16, the least type for 64-bit numbers."""
    if values.dtype == bool:
        return values.view(np.uint8)
    if values.dtype.kind in "iu" and values.dtype.itemsize > 4:
        return values.astype(base.smallest_type(values))
    return values.astype(np.float32) if values.dtype == np.float16 else values


def _read_spacing(file: tifffile.TiffFile) -> _Spacing:
    """Return steps, units and guesses, from the description or, without one, the resolution tags."""
    if file.is_ome and file.ome_metadata:
        nodes = ElementTree.fromstring(file.ome_metadata).iter()
        return _from_sizes(next((node.attrib for node in nodes if node.tag.endswith("Pixels")), {}))
    description: dict[str, Any] = dict(file.imagej_metadata or (file.shaped_metadata or ({},))[0])
    if "curvafit_spacing" in description:
        steps = [float(h) for h in description["curvafit_spacing"].split(",")]
        return {"steps": steps, "units": (description["curvafit_unit"],) * 3}
    if "PhysicalSizeX" in description:
        return _from_sizes(description)
    if file.is_imagej:
        return _from_imagej(file, description)
    if "spacing" not in description:
        return _from_tags(file)
    # tifffile's JSON has three numbers, or one for all axes
    sizes, unit = [float(h) for h in np.atleast_1d(description["spacing"])], description.get("unit")
    if len(sizes) == 3:
        return {"steps": sizes, "units": (unit,) * 3}
    note = f"The file states one voxel size, {sizes[0]:g} {unit or ''}".rstrip() + ": it is taken for all three axes."
    return {"steps": sizes[:1] * 3, "units": (unit,) * 3, "guesses": (note,)}


def _from_sizes(pixels: Mapping[str, Any]) -> _Spacing:
    """Return steps, units and guesses from OME's sizes, where 0 is unknown; an axis without a size gets that of x."""
    sizes = {axis: float(pixels.get(f"PhysicalSize{axis}", 0)) for axis in "ZYX"}
    if not sizes["X"]:
        return {}
    axes = [axis if sizes[axis] else "X" for axis in "ZYX"]
    units = [pixels.get("unit", pixels.get(f"PhysicalSize{axis}Unit", "um")) for axis in axes]
    guesses = (base.NO_DISTANCE,) if not sizes["Z"] and int(pixels.get("SizeZ", 1)) > 1 else ()
    if "reference frame" in units:
        guesses += ("The file states sizes in a reference frame, not in a unit of length: they are taken for voxels.",)
    return {"steps": [sizes[axis] for axis in axes], "units": units, "guesses": guesses}


def _from_imagej(file: tifffile.TiffFile, description: dict[str, Any]) -> _Spacing:
    """Return steps, units and a guess from ImageJ's description (the distance of slices) and the resolution tags."""
    y, x = _pixels_per_unit(file)
    z = abs(float(description.get("spacing") or 0))
    units = [description.get(f"{axis}unit", description.get("unit")) for axis in "zyx"]
    units = units if z else [units[2], *units[1:]]  # the distance of slices is then taken as the pixel's
    if all(is_unit(unit) and parse_unit(unit)[0] == "voxel" for unit in units):
        steps = (z * x if z else 1.0, x / y, 1.0)  # without a unit only ratios have a meaning: in pixels along x
        return {} if np.allclose(steps, 1) else {"steps": steps}
    return {"steps": (z or 1 / x, 1 / y, 1 / x), "units": units, "guesses": () if z else (base.NO_DISTANCE,)}


def _from_tags(file: tifffile.TiffFile) -> _Spacing:
    """Return steps, units and a guess from the resolution tags, unless they are a program's default."""
    y, x = _pixels_per_unit(file)
    tag = file.pages[0].tags.get("ResolutionUnit")  # type: ignore[union-attr]
    unit = _TAG_UNITS.get(int(tag.value)) if tag is not None else None
    if unit is None or min(x, y) <= 0:
        return {}
    dots_per_inch = x * (2.54 if unit == "cm" else 1.0)
    if any(abs(dots_per_inch - screen) < 0.51 for screen in _SCREEN):
        return {}
    return {"steps": (1 / x, 1 / y, 1 / x), "units": (unit,) * 3, "guesses": (base.NO_DISTANCE,)}


def _pixels_per_unit(file: tifffile.TiffFile) -> tuple[float, float]:
    """Return the resolution tags along (y, x), 1 where there are none."""
    resolutions = []
    for name in ("YResolution", "XResolution"):
        tag = file.pages[0].tags.get(name)  # type: ignore[union-attr]
        numerator, denominator = tag.value if tag is not None else (1, 1)
        resolutions.append(numerator / denominator if numerator and denominator else 1.0)
    return resolutions[0], resolutions[1]


# ---- folders of slices: TIFF, BMP, PNG or JPEG; those of NRecon with the voxel size of its log -----------------------


def read_slices(path: Path, spacing: object = None, **_: object) -> Stated:
    """Read a folder of 2D slices in the natural order of their names, with the pixel size that they or a log state.

    Slices with labels of fewer than half of a volume, at uneven distances, are put at their numbers among empty ones.
    """
    files, notes = _list_slices(path)
    first, planes = None, []
    for file in files:
        stated = (read_tiff if file.suffix.lower() in SLICES[:2] else _read_picture)(base.check_regular(file))
        first = first or stated
        plane = _squeeze_plane(stated)
        planes.append(plane)
        if plane.ndim != 2 + ("s" in first.axes) or plane.shape != planes[0].shape:
            got = f"{plane.shape} in {file.name} of {path}"
            raise ScanError(
                f"slices of a folder must be 2D and of one shape, got {got}; to read volumes, name the files"
            )
        if plane.dtype != planes[0].dtype:
            got = f"{planes[0].dtype} in {files[0].name} and {plane.dtype} in {file.name} of {path}"
            raise ScanError(f"slices must be of one type, got {got}")
        if not _have_same_size(stated, first):
            raise ScanError(f"slices must have one pixel size, got another in {file.name} of {path}")
    assert first is not None
    if (logged := _read_logs(path)) is not None:
        size, step, log = logged
        with_units = first._replace(units=[unit or first.custom for unit in first.units])
        if first.steps is not None and not _have_same_size(with_units, Stated(None, "zyx", [size] * 3, ["um"] * 3)):
            raise ScanError(f"{files[0].name} states another pixel size than the {size:g} µm of {log} in {path}")
        first = first._replace(steps=[step * size, size, size], units=["um"] * 3, guesses=())
        notes += (f"The voxel size is that of {log}.",) if spacing is None else ()
    axes = "zyxs"[: planes[0].ndim + 1]
    values, gaps = _place_slices(np.stack(planes), [file.stem for file in files])
    return first._replace(array=values, axes=axes, gaps=gaps, notes=(*first.notes, *notes))


def _list_slices(path: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Return the images of a folder that are slices, in order, and notes on other images and on JPEG."""
    files = [p for p in path.iterdir() if p.suffix.lower() in SLICES and not p.name.startswith(".")]
    # The most common format counts, by four characters: .tif and .tiff are one. NRecon's preview is named _spr.
    suffix = Counter(p.suffix.lower()[:4] for p in files).most_common(1)[0][0]
    slices = [p for p in files if p.suffix.lower()[:4] == suffix and not p.stem.lower().endswith("_spr")]
    ignored = sorted(p.name for p in set(files) - set(slices))
    if not slices:
        raise ScanError(f"the folder {path} holds no slices but a preview, {ignored[0]}")
    listed = ", ".join(ignored[:3]) + (", …" if len(ignored) > 3 else "")
    notes = (f"Not taken for slices: {listed}.",) if ignored else ()
    notes += ("JPEG keeps grey values only roughly.",) if suffix in (".jpg", ".jpe") else ()
    return sorted(slices, key=lambda p: natural_key(p.name)), notes


def _read_picture(path: Path) -> Stated:
    """Read a BMP, PNG or JPEG, without transparency; colours become grey values if all channels are equal."""
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
    is_grey = bool((values == values[..., :1]).all())
    return Stated(values[..., 0], "yx") if is_grey else Stated(values, "yxs")


def _have_same_size(first: Stated, second: Stated) -> bool:
    """Return whether two slices state the same pixel size, in any units, or both state none."""
    if first.steps is None or second.steps is None:
        return first.steps is second.steps
    return np.allclose(_pixel_size(first), _pixel_size(second), rtol=_SAME)


def _pixel_size(stated: Stated) -> list[float]:
    """Return a slice's pixel edges (y, x), in um if their units are known."""
    edges = list(zip(stated.steps or (), stated.units, strict=True))[-2:]
    return [h if not is_unit(unit) or unit in (None, "voxel") else convert_length(h, unit, "um") for h, unit in edges]


def _read_logs(path: Path) -> tuple[float, float, str] | None:
    """Return pixel size in um, distance of slices in pixels, and name of NRecon's log in a folder; None without one."""
    sizes: dict[float, tuple[float, str]] = {}
    for log in sorted(p for p in path.iterdir() if p.suffix.lower() == ".log" and p.is_file()):
        text = log.read_text(encoding="latin-1")
        for name in ("Pixel Size", "Image Pixel Size"):  # of the reconstruction, or else of the projections
            if match := re.search(rf"^\s*{name} \(um\)\s*=\s*([\d.]+)", text, re.MULTILINE):
                step = re.search(r"^\s*Section to Section Step\s*=\s*(\d+)", text, re.MULTILINE)
                sizes[float(match[1])] = (float(step[1]) if step else 1.0, log.name)
                break
    if len(sizes) > 1:
        listed = " and ".join(f"{size:g} µm in {log}" for size, (_, log) in list(sizes.items())[:2])
        raise ScanError(f"the logs in {path} state voxel sizes of {listed}: leave only the log of these slices there")
    return next(((size, *rest) for size, rest in sizes.items()), None)


def _squeeze_plane(stated: Stated) -> np.ndarray:
    """Return a slice (Y, X), or (Y, X, samples)."""
    if "s" not in stated.axes:
        return np.squeeze(stated.array)
    values = np.moveaxis(stated.array, stated.axes.index("s"), -1)
    return values.reshape([*(n for n in values.shape[:-1] if n != 1), values.shape[-1]])


def _place_slices(values: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return slices (n, Y, X) as a volume, with empty ones at skipped numbers if they hold labels, and a note."""
    # A slice's number is the last one of its name; names that differ in more state none.
    matches = [re.fullmatch(r"(.*?)(\d{1,15})(\D*)", name) for name in names]
    if len(names) < 2 or None in matches or len({(match[1], match[3]) for match in matches if match}) > 1:
        return values, ()
    numbers = np.array([int(match[2]) for match in matches if match])
    steps, count = np.diff(numbers), int(np.ptp(numbers)) + 1
    gap = int(steps.argmax())
    if steps.min() < 1 or steps[gap] == 1:
        return values, ()
    if steps[gap] == steps.min() and len(names) > 2:
        return values, (f"The numbers of the slices step by {steps[gap]}: what is there is stacked.",)
    if len(names) >= _MOST * count or count > _LONGEST or len(np.unique(values)) > _LABELS:
        return values, (f"The numbers of the slices skip some, after {names[gap]} for one: what is there is stacked.",)
    base.check_array((count, *values.shape[1:]), values.dtype, "a folder of slices")
    placed = np.zeros((count, *values.shape[1:]), values.dtype)
    placed[numbers - numbers[0]] = values
    note = f"{len(names)} slices lie where their numbers say, from {numbers[0]} on"
    return placed, (f"{note}; {count - len(names)} others are empty.",)


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a key that sorts slice2 before slice10."""
    return tuple((0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name.casefold()))
