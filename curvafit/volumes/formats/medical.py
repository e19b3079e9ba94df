"""NRRD, MHA/MHD, MRC and DICOM folders, through the libraries of the extra `[io]`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.units import convert_length
from curvafit.volumes.formats.base import Damaged, Raw, ScanError, complaints, extra, pick_key
from curvafit.volumes.formats.headers import meta_numbers, nrrd_values, read_meta
from curvafit.volumes.formats.streams import opened, read_numbers, skip

#: Suffixes of files that must be DICOM's.
_DICOM = (".dcm", ".dicom", ".ima")
#: From DICOM's and ITK's patient frame (left, posterior, superior) to NIfTI's (right, anterior, superior).
_LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def read_nrrd(path: Path, **_: object) -> Raw:
    """Read an NRRD file; lengths along space directions without a unit are in mm."""
    nrrd = extra("nrrd", "NRRD files")
    with path.open("rb") as file:
        header = nrrd.read_header(file)
        values = nrrd_values(nrrd, header, file, path)
    channels = _channel_axis(header)
    units = header.get("space units") or header.get("units")
    unit = next((u for u in units if u), None) if units is not None else None
    if "space directions" in header:
        directions = np.asarray(header["space directions"], dtype=np.float64)
        directions = directions[~np.isnan(directions).any(axis=1)]
        affine = np.eye(4)
        affine[:3, :3] = directions.T
        affine[:3, 3] = header.get("space origin", np.zeros(3))
        if str(header.get("space", "")).startswith("left-posterior"):
            affine = _LPS_TO_RAS @ affine
        return Raw(values, tuple(np.linalg.norm(directions, axis=1)[::-1]), unit or "mm", affine, channels=channels)
    if "spacings" in header:
        return Raw(values, tuple(float(h) for h in header["spacings"])[::-1], unit, channels=channels)
    return Raw(values, channels=channels)


def _channel_axis(header: dict[str, Any]) -> int | None:
    """Return the one axis, of the values with z first, that is not an axis of space; None without one."""
    axes = int(header["dimension"])
    if "space directions" in header:
        directions = np.asarray(header["space directions"], dtype=np.float64)
        other = [bool(np.isnan(each).any()) for each in directions]
    else:
        other = [str(kind).lower() not in ("domain", "space", "none", "???") for kind in header.get("kinds", ())]
    return axes - 1 - other.index(True) if sum(other) == 1 and len(other) == axes else None


def read_itk(path: Path, **_: object) -> Raw:
    """Read a MetaImage, whose unit is the millimetre; ITK reads values in text or in several files."""
    itk = extra("SimpleITK", "MHA and MHD files")
    header, values = read_meta(path)
    if values is None:
        return _itk_image(itk, path)
    axes = len(header["DimSize"].split())
    spacing = meta_numbers(header, "ElementSpacing", "ElementSize")
    spacing = np.ones(axes) if spacing is None else spacing
    matrix = meta_numbers(header, "TransformMatrix", "Rotation", "Orientation")
    origin = meta_numbers(header, "Offset", "Position", "Origin")
    directions = np.eye(axes) if matrix is None else matrix.reshape(axes, axes).T
    return _in_millimetres(values, spacing, directions, np.zeros(axes) if origin is None else origin)


def _itk_image(itk: Any, path: Path) -> Raw:
    display = itk.ProcessObject.GetGlobalWarningDisplay()
    itk.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        image = itk.ReadImage(str(path))
    finally:
        itk.ProcessObject.SetGlobalWarningDisplay(display)
    spacing, axes = np.array(image.GetSpacing()), image.GetDimension()
    directions = np.array(image.GetDirection()).reshape(axes, axes)
    return _in_millimetres(itk.GetArrayFromImage(image), spacing, directions, np.array(image.GetOrigin()))


def _in_millimetres(values: np.ndarray, spacing: np.ndarray, directions: np.ndarray, origin: np.ndarray) -> Raw:
    """Return values placed as ITK places them, with an affine where three axes, or three and channels, have a place.

    The axis of channels is the last one where ITK does not count it, otherwise the first of four.
    """
    affine, axes = None, len(spacing)
    if axes in (3, 4):
        affine = np.eye(4)
        affine[:3, :3] = directions[:3, :3] * spacing[:3]
        affine[:3, 3] = origin[:3]
        affine = _LPS_TO_RAS @ affine
    channels = axes if values.ndim > axes else 0 if axes == 4 else None
    return Raw(values, tuple(float(h) for h in spacing[::-1]), "mm", affine, channels=channels)


def read_mrc(path: Path, **_: object) -> Raw:
    """Read an MRC file or a CCP4 map, whose voxel sizes are in Å."""
    mrcfile = extra("mrcfile", "MRC files")
    with mrcfile.open(path, mode="r", header_only=True) as file:
        header, size = file.header, file.voxel_size
        shape, dtype = mrcfile.utils.data_shape_from_header(header), mrcfile.utils.data_dtype_from_header(header)
        start = header.nbytes + int(header.nsymbt)
    with opened(path) as stream:
        skip(stream, start)
        values = read_numbers(stream, [int(n) for n in shape], dtype, path)
    spacing = (float(size.z), float(size.y), float(size.x))
    return Raw(values, spacing if min(spacing) > 0 else None, "angstrom", channels=0 if values.ndim == 4 else None)


def check_mrc(unit: str) -> None:
    """Raise ScanError where `write_mrc` cannot write: lengths have no unit, or its library is missing."""
    extra("mrcfile", "MRC files")
    if unit == "voxel":
        raise ScanError("expected a unit of nm, um, mm or m for an MRC file, which holds voxel sizes in Å, got none")


def write_mrc(field: Any, path: Path) -> None:
    """Write a volume with its voxel sizes in Å; float64 becomes float32, bool int8 and uint8 uint16."""
    check_mrc(field.unit)
    kind = {"bool": "int8", "float64": "float32", "uint8": "uint16"}.get(field.values.dtype.name)
    values = field.values if kind is None else field.values.astype(kind)
    if values.dtype.name not in ("int8", "int16", "uint16", "float16", "float32"):
        raise ScanError(f"expected whole numbers of at most 16 bits or floats for an MRC file, got {values.dtype}")
    with extra("mrcfile", "MRC files").new(path, values, overwrite=True) as file:
        file.voxel_size = tuple(convert_length(h, field.unit, "angstrom") for h in field.spacing[::-1])


def read_dicom(path: Path, *, key: str | None = None, **_: object) -> Raw:
    """Read a folder of slices in the order of their positions; `key` is the UID of one series of several."""
    pydicom = extra("pydicom", "DICOM folders")
    files = sorted(p for p in path.iterdir() if p.is_file() and (is_dicom(p) or p.suffix.lower() in _DICOM))
    with complaints("pydicom"):
        images = [image for file in files if (image := _image(pydicom, file)) is not None]
    series = sorted({str(image.get("SeriesInstanceUID", "")) for image in images})
    uid = pick_key(series, key, path)
    slices = [image for image in images if str(image.get("SeriesInstanceUID", "")) == uid]
    rows, columns = np.array(slices[0].ImageOrientationPatient, dtype=float).reshape(2, 3)
    normal = np.cross(rows, columns)
    slices.sort(key=lambda image: float(np.dot(normal, np.array(image.ImagePositionPatient, dtype=float))))
    with complaints("pydicom"):
        values = np.stack([_rescaled(image) for image in slices])
    z, origin = _slice_distance(slices, normal, path)
    y, x = (float(h) for h in slices[0].PixelSpacing)
    affine = np.eye(4)
    affine[:3, :3] = np.column_stack([rows * x, columns * y, normal * z])
    affine[:3, 3] = origin
    return Raw(values, (z, y, x), "mm", _LPS_TO_RAS @ affine, channels=3 if values.ndim == 4 else None)


def _image(pydicom: Any, file: Path) -> Any:
    """Return a slice with its pixels, None for another kind of file such as a folder's index or a report."""
    if not is_dicom(file):
        raise Damaged(f"{file.name} is not a DICOM file")
    image = pydicom.dcmread(file)
    if "PixelData" in image:
        return image
    kind = pydicom.uid.UID(str(image.file_meta.get("MediaStorageSOPClassUID", "")))
    if not kind or "Image Storage" in kind.name:
        raise Damaged(f"{file.name} has no pixels")
    return None


def is_dicom(path: Path) -> bool:
    """Return whether a file has DICOM's mark at byte 128."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def _rescaled(image: Any) -> np.ndarray:
    slope, intercept = float(image.get("RescaleSlope", 1)), float(image.get("RescaleIntercept", 0))
    values = image.pixel_array
    return values if (slope, intercept) == (1, 0) else (values * slope + intercept).astype(np.float32)


def _slice_distance(slices: list[Any], normal: np.ndarray, path: Path) -> tuple[float, np.ndarray]:
    positions = np.array([image.ImagePositionPatient for image in slices], dtype=float)
    if len(slices) < 2:
        raise ScanError(f"expected a DICOM series of several slices, got {len(slices)} in {path}")
    steps = np.diff(positions @ normal)
    if steps.min() <= 0 or np.ptp(steps) > 0.05 * steps.mean():
        range_text = f"steps of {steps.min():.4g} to {steps.max():.4g} mm"
        raise ScanError(f"expected evenly spaced DICOM slices, got {range_text} in {path}")
    return float(steps.mean()), positions[0]
