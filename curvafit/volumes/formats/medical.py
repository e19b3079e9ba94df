"""NRRD, MetaImage, MRC and folders of DICOM slices; all but MetaImage with a library of the extra `[io]`."""

from __future__ import annotations

import bz2
import gzip
import io
import math
import os
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from curvafit.core.extras import require
from curvafit.core.units import common_unit, convert_length
from curvafit.volumes.formats import base
from curvafit.volumes.formats.base import Raw, ScanError
from curvafit.volumes.formats.part import read_part

#: Suffixes of files that must be DICOM's.
_DICOM = (".dcm", ".dicom", ".ima")
#: NRRD's encodings that are read -> the function that makes a stream of a file.
_NRRD_ENCODINGS: dict[str, Callable[[Any], Any]] = {
    "raw": lambda file: file,
    **dict.fromkeys(("gzip", "gz"), gzip.open),
    **dict.fromkeys(("bzip2", "bz2"), bz2.open),
}
#: MetaImage's types -> numpy's.
_META_TYPES = {"MET_CHAR": "i1", "MET_SHORT": "i2", "MET_INT": "i4", "MET_LONG": "i4", "MET_LONG_LONG": "i8"}
_META_TYPES |= {name.replace("MET_", "MET_U"): f"u{kind[1]}" for name, kind in _META_TYPES.items()}
_META_TYPES |= {"MET_FLOAT": "f4", "MET_DOUBLE": "f8"}
#: What a MetaImage may write for True, and the most bytes of its header.
_TRUE, _HEADER = ("true", "t", "1"), 1 << 16
#: IMOD's stamp, from byte 152 on: its flags follow, the first of which says that bytes are signed.
_IMOD = 1146047817
#: From DICOM's and ITK's patient frame (left, posterior, superior) to NIfTI's (right, anterior, superior).
_LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def read_nrrd(path: Path, **_: object) -> Raw:
    """Read an NRRD file; lengths along space directions without a unit are in mm."""
    nrrd = require("nrrd", "io", "reading NRRD files")
    with path.open("rb") as file:
        header = nrrd.read_header(file)
        values = _nrrd_values(nrrd, header, file, path)
    axes = _other_axes(header)
    units = list(header.get("space units", header.get("units", ())))
    unit, factors = common_unit([each or next(filter(None, units), None) for each in units] or [None])
    if "space directions" in header:
        directions = np.asarray(header["space directions"], dtype=np.float64)
        directions = directions[~np.isnan(directions).any(axis=1)]
        affine = base.affine_of(directions.T, header.get("space origin", np.zeros(3)))
        if len(factors) == 3:  # one for each axis of the world, x first
            affine[:3] *= np.array(factors)[:, None]
        if str(header.get("space", "")).startswith("left-posterior"):
            affine = _LPS_TO_RAS @ affine
        spacing = tuple(np.linalg.norm(affine[:3, :3], axis=0)[::-1])
        return Raw(values, spacing, unit or "mm", affine, axes=axes)
    if "spacings" in header:
        sizes = np.array(header["spacings"], dtype=np.float64)
        sizes *= factors if len(factors) == len(sizes) else 1.0
        return Raw(values, tuple(sizes[::-1].tolist()), unit, axes=axes)
    return Raw(values, axes=axes)


def _nrrd_values(nrrd: Any, header: dict[str, Any], file: IO[bytes], path: Path) -> np.ndarray:
    """Return the values, z first, from an NRRD file open at the end of its header, or from the file that it names."""
    # pynrrd reads only the first part of a compressed stream, and not the checksum at its end.
    name = header.pop("data file", None) or header.pop("datafile", None)
    if name is not None:
        with base.check_regular(path.parent / str(name)).open("rb") as data:
            return _nrrd_values(nrrd, header, data, path)
    if header["dimension"] != len(header["sizes"]):
        raise base.Damaged(f"{len(header['sizes'])} sizes for {header['dimension']} axes")
    shape, encoding = [int(n) for n in header["sizes"]][::-1], str(header.get("encoding")).lower()
    no_values = {"dimension": 1, "sizes": np.zeros(1, int), "encoding": "raw", "type": header["type"]}
    dtype = nrrd.read_data({"endian": header.get("endian", "little"), **no_values}, io.BytesIO()).dtype
    if encoding not in _NRRD_ENCODINGS:
        raise ScanError(f"{path} has the encoding {encoding[:40]!r}: write it as raw, gzip or bzip2")
    for _ in range(int(header.get("line skip", header.get("lineskip", 0)))):
        file.readline()
    stream, start = _NRRD_ENCODINGS[encoding](file), int(header.get("byte skip", header.get("byteskip", 0)))
    if start < 0:
        stream.seek(-math.prod(shape) * dtype.itemsize, os.SEEK_END)
    else:
        stream.seek(start, os.SEEK_CUR)
    return base.read_numbers(stream, shape, dtype, path)


def _other_axes(header: dict[str, Any]) -> base.Axes:
    """Return the axis of the values, z first, that is not one of space, where there is just one."""
    count, kinds = int(header["dimension"]), [str(kind).lower() for kind in header.get("kinds", ())]
    if "space directions" in header:
        directions = np.asarray(header["space directions"], dtype=np.float64)
        other = [bool(np.isnan(each).any()) for each in directions]
    else:
        other = [kind not in ("domain", "space", "none", "???") for kind in kinds]
    axis = count - 1 - other.index(True) if sum(other) == 1 and len(other) == count else None
    return base.Axes(None, axis) if "time" in kinds else base.Axes(axis)


def read_metaimage(path: Path, **_: object) -> Raw:
    """Read a MetaImage (MHA, or MHD with the file of values that it names), whose unit is the millimetre."""
    with path.open("rb") as file:
        header = _meta_header(file)
        name = header["ElementDataFile"]
        if name.upper() == "LOCAL":
            return _meta_image(header, file, path)
    with base.check_regular(path.parent / name).open("rb") as file:
        return _meta_image(header, file, path)


def _meta_header(file: IO[bytes]) -> dict[str, str]:
    """Return the values of the lines `name = value`, by name, up to the line that says where the voxels are."""
    header: dict[str, str] = {}
    while "ElementDataFile" not in header and file.tell() < _HEADER and (line := file.readline(_HEADER)):
        name, _, value = line.decode("latin-1").partition("=")
        header[name.strip()] = value.strip()
    return header


def _meta_image(header: dict[str, str], file: IO[bytes], path: Path) -> Raw:
    """Return a MetaImage where ITK places it; channels are an axis after `NDims`, or else the first of four."""
    shape = [int(n) for n in header["DimSize"].split()]
    axes, channels = len(shape), int(header.get("ElementNumberOfChannels", 1))
    if header.get("ObjectType", "Image") != "Image" or str(axes) != header["NDims"] or min(shape) < 1:
        raise base.Damaged(f"an image of {header['NDims'][:20]} axes with the sizes {shape[:9]}")
    spacing = _meta_numbers(header, ("ElementSpacing", "ElementSize"), np.ones(axes))
    origin = _meta_numbers(header, ("Offset", "Position", "Origin"), np.zeros(axes))
    matrix = _meta_numbers(header, ("TransformMatrix", "Rotation", "Orientation"), np.eye(axes).ravel())
    shape = [*shape[::-1], *([channels] if channels != 1 else [])]
    values, affine = _meta_values(header, shape, file, path), None
    if axes in (3, 4):
        affine = _LPS_TO_RAS @ base.affine_of(matrix.reshape(axes, axes).T[:3, :3] * spacing[:3], origin[:3])
    channel_axis = axes if values.ndim > axes else 0 if axes == 4 else None
    return Raw(values, tuple(spacing[::-1].tolist()), "mm", affine, axes=base.Axes(channel_axis))


def _meta_values(header: dict[str, str], shape: list[int], file: IO[bytes], path: Path) -> np.ndarray:
    """Return the values from the file's position to its end."""
    # SimpleITK could read them, but it compares no checksum of a compressed file, and prints warnings itself.
    kind = header.get("ElementType", "")
    if kind not in _META_TYPES:
        raise ScanError(f"{path} has the element type {kind[:40]!r}, none of {', '.join(_META_TYPES)}")
    order = header.get("BinaryDataByteOrderMSB", header.get("ElementByteOrderMSB", "False"))
    dtype = np.dtype(_META_TYPES[kind]).newbyteorder(">" if order.lower() in _TRUE else "<")
    base.check_array(shape, dtype, path)
    if header.get("BinaryData", "True").lower() not in _TRUE:
        raise ScanError(f"{path} holds values in text, which are not read: write it with binary values")
    nbytes, head = math.prod(shape) * dtype.itemsize, int(header.get("HeaderSize", 0))
    size = os.fstat(file.fileno()).st_size
    file.seek(max(0, size - nbytes) if head < 0 else file.tell() + head)
    if header.get("CompressedData", "False").lower() not in _TRUE:
        return base.read_numbers(file, shape, dtype, path)
    rest = size - file.tell()
    if int(header.get("CompressedDataSize", rest)) != rest:
        raise base.Damaged(f"{header['CompressedDataSize']} compressed bytes by its header, {rest} in the file")
    inflate = zlib.decompressobj()
    content = inflate.decompress(file.read(), nbytes + 1)
    if len(content) != nbytes or not inflate.eof or inflate.unused_data:
        raise base.Damaged(f"{nbytes} bytes of values by its header, not so many in the file")
    return np.frombuffer(bytearray(content), dtype).reshape(shape)


def _meta_numbers(header: dict[str, str], names: Sequence[str], default: np.ndarray) -> np.ndarray:
    """Return the numbers of the first of these lines that the header has, or `default`, which has as many numbers."""
    for name in names:
        if name in header:
            numbers = np.array(header[name].split(), dtype=np.float64)
            if len(numbers) != len(default):
                raise base.Damaged(f"{name} of {len(numbers)} numbers, not {len(default)}")
            return numbers
    return default


def read_mrc(path: Path, **_: object) -> Raw:
    """Read an MRC file or a CCP4 map, whose voxel sizes are in Å."""
    mrcfile = require("mrcfile", "io", "reading and writing MRC files")
    with mrcfile.open(path, mode="r", header_only=True) as file:
        header, size = file.header, file.voxel_size
        shape, dtype = mrcfile.utils.data_shape_from_header(header), mrcfile.utils.data_dtype_from_header(header)
        start = header.nbytes + int(header.nsymbt)
        stamp, flags = np.frombuffer(header.extra2.tobytes()[40:48], header.mode.dtype)
    values, notes = base.map_numbers(path, start, [int(n) for n in shape], dtype), ()
    # Bytes are signed, as is standard, unless IMOD's stamp says otherwise, or the header's maximum is above theirs.
    if dtype == np.int8 and (not flags & 1 if stamp == _IMOD else header.dmax > 127):
        values = values.view(np.uint8)
        guess = "The bytes are taken for numbers from 0 to 255, as the header's maximum is above 127."
        notes = () if stamp == _IMOD else (guess,)
    raw = read_part(values, None, path, axes=base.Axes(0 if values.ndim == 4 else None))
    spacing = (float(size.z), float(size.y), float(size.x))
    return raw._replace(spacing=spacing if min(spacing) > 0 else None, unit="angstrom", notes=notes)


def check_mrc(unit: str, values: np.ndarray | None = None) -> None:
    """Raise ScanError if lengths have no unit or values no type of MRC's, and ImportError without the library, before
    `write_mrc`."""
    require("mrcfile", "io", "reading and writing MRC files")
    if unit == "voxel":
        raise ScanError("an MRC file holds voxel sizes in Å: give the unit, nm, um, mm or m")
    if values is not None and values.dtype.kind in "iu" and values.dtype.itemsize > 2:
        raise ScanError(f"an MRC file holds whole numbers of at most 16 bits or floats, got {values.dtype}")


def write_mrc(field: Any, path: Path) -> None:
    """Write a volume with its voxel sizes in Å; instead of float64, bool, uint8 write float32, int8, uint16."""
    kind = {"bool": "int8", "float64": "float32", "uint8": "uint16"}.get(field.values.dtype.name)
    values = field.values if kind is None else field.values.astype(kind)
    with require("mrcfile", "io", "reading and writing MRC files").new(path, values, overwrite=True) as file:
        file.voxel_size = tuple(convert_length(h, field.unit, "angstrom") for h in field.spacing[::-1])


def read_dicom(path: Path, *, key: str | None = None, **_: object) -> Raw:
    """Read a folder of slices in the order of their positions; `key` is the UID of a series, if there are several."""
    pydicom = require("pydicom", "io", "reading DICOM folders")
    inside = sorted(p for p in path.iterdir() if p.is_file() and not p.name.startswith("."))
    files = [p for p in inside if is_dicom(p) or p.suffix.lower() in _DICOM]
    with base.collect_complaints("pydicom"):
        images = [image for file in files if (image := _read_slice(pydicom, file)) is not None]
    series = sorted({str(image.get("SeriesInstanceUID", "")) for image in images})
    uid = base.pick_key(series, key, path)
    slices = [image for image in images if str(image.get("SeriesInstanceUID", "")) == uid]
    if frames := next((int(n) for image in slices if (n := image.get("NumberOfFrames") or 1) > 1), None):
        raise ScanError(f"a DICOM series must have a file a slice, got {frames} frames in a file of {path}")
    placed = ["ImagePositionPatient" in image and "ImageOrientationPatient" in image for image in slices]
    if any(placed) and not all(placed):
        raise ScanError(f"DICOM slices must all state a position, got {placed.count(False)} without one in {path}")
    if not any(placed):
        slices.sort(key=lambda image: image.InstanceNumber)
        note = "The slices state no position: they are stacked in the order of their numbers."
        return _stack_planes(slices)._replace(notes=(note,))
    rows, columns = np.array(slices[0].ImageOrientationPatient, dtype=float).reshape(2, 3)
    normal = np.cross(rows, columns)
    slices.sort(key=lambda image: float(np.dot(normal, np.array(image.ImagePositionPatient, dtype=float))))
    for name in ("ImageOrientationPatient", "PixelSpacing"):
        numbers = np.array([image[name].value for image in slices], dtype=float)
        if np.ptp(numbers, axis=0).max() > 1e-3 * np.abs(numbers).max():
            raise ScanError(f"DICOM slices must have one {name}, got several in {path}")
    z, origin = _slice_distance(slices, normal, path)
    y, x = (float(h) for h in slices[0].PixelSpacing)
    affine = base.affine_of(np.column_stack([rows * x, columns * y, normal * z]), origin)
    return _stack_planes(slices)._replace(spacing=(z, y, x), unit="mm", affine=_LPS_TO_RAS @ affine)


def _read_slice(pydicom: Any, file: Path) -> Any:
    """Return a slice with its pixels, or None for another kind of file, such as a folder's index or a report."""
    if not is_dicom(file):
        raise base.Damaged(f"{file.name} is not a DICOM file")
    image = pydicom.dcmread(file)
    if "PixelData" in image:
        return image
    kind = pydicom.uid.UID(str(image.file_meta.get("MediaStorageSOPClassUID", "")))
    if not kind or "Image Storage" in kind.name:
        raise base.Damaged(f"{file.name} has no pixels")
    return None


def is_dicom(path: Path) -> bool:
    """Return whether a file has DICOM's mark at byte 128."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def _stack_planes(slices: list[Any]) -> Raw:
    """Return the slices' pixels, with slope and intercept applied."""
    planes = []
    with base.collect_complaints("pydicom"):
        for image in slices:
            slope, intercept = float(image.get("RescaleSlope", 1)), float(image.get("RescaleIntercept", 0))
            plane = image.pixel_array
            planes.append(plane if (slope, intercept) == (1, 0) else (plane * slope + intercept).astype(np.float32))
    values = np.stack(planes)
    return Raw(values, axes=base.Axes(3 if values.ndim == 4 else None))


def _slice_distance(slices: list[Any], normal: np.ndarray, path: Path) -> tuple[float, np.ndarray]:
    """Return the distance of ordered slices, which must be even, and the position of the first."""
    positions = np.array([image.ImagePositionPatient for image in slices], dtype=float)
    if len(slices) < 2:
        raise ScanError(f"a DICOM series must have several slices, got {len(slices)} in {path}")
    steps = np.diff(positions @ normal)
    if steps.min() <= 0 or np.ptp(steps) > 0.05 * steps.mean():
        range_text = f"steps of {steps.min():.4g} to {steps.max():.4g} mm"
        raise ScanError(f"DICOM slices must be evenly spaced, got {range_text} in {path}")
    # A shear of 2 % turns normals by a degree; rounded positions differ by far less.
    aside = float(np.linalg.norm(np.cross(positions[-1] - positions[0], normal)))
    if aside > 0.02 * np.ptp(positions @ normal):
        raise ScanError(f"DICOM slices must lie above each other, the last is {aside:.3g} mm aside in {path} (a tilt)")
    return float(steps.mean()), positions[0]
