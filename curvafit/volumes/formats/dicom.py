"""DICOM: folders of slices, files of many frames, and a file of a series, by pydicom of the extra `[io]`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from curvafit.core.checks import require
from curvafit.volumes.formats import base
from curvafit.volumes.formats.base import LPS_TO_RAS, ScanError, Stated

#: Suffixes of files that must be DICOM's.
SUFFIXES = (".dcm", ".dicom", ".ima")
#: Attributes that are not used but noted: name, the value that calls for a note (None: any), and the note.
_NOTED = (
    ("PixelPaddingValue", None, "By the file, {} stands where nothing was measured."),
    ("PhotometricInterpretation", "MONOCHROME1", "The file shows low values bright: its values are as stored."),
    ("PhotometricInterpretation", "PALETTE COLOR", "The values are numbers of colours in the file's palette."),
    ("ModalityLUTSequence", None, "The file's table of values, ModalityLUTSequence, is not used: they are as stored."),
    ("LossyImageCompression", "01", "The file's values were compressed with loss."),
    ("BurnedInAnnotation", "YES", "The file says that text is burnt into its values."),
    ("ImagerPixelSpacing", None, "The file's ImagerPixelSpacing, {} mm, is that at the detector: it is not used."),
)


class _Plane(NamedTuple):
    """A slice: values (Y, X) or (Y, X, samples), number, position, directions of rows and columns, and pixel size."""

    values: np.ndarray
    number: int
    position: np.ndarray | None
    directions: np.ndarray | None
    spacing: np.ndarray | None


def read_dicom(path: Path, *, key: str | None = None, **_: object) -> Stated:
    """Read slices in the order of their positions; `key` is the UID of a series, if a folder has several.

    A file of many frames is read alone; for a file of a single slice all of its series in the folder is read.
    """
    pydicom = require("pydicom", "io", "reading DICOM")
    folder = path if path.is_dir() else path.parent
    visible = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    files = [p for p in visible if is_dicom(p) or p.suffix.lower() in SUFFIXES]
    notes: list[str] = []
    with base.collect_complaints("pydicom"):
        if path.is_file():
            image = _read_image(pydicom, path)
            if image is None:
                raise base.Damaged("it has no pixels")
            key = str(image.get("SeriesInstanceUID", ""))
            files = [path] if _count_frames(image) > 1 else files
        images = [image for file in files if (image := _read_image(pydicom, file)) is not None]
        uid = base.pick_key(sorted({str(image.get("SeriesInstanceUID", "")) for image in images}), key, path)
        images = [image for image in images if str(image.get("SeriesInstanceUID", "")) == uid]
        planes = [plane for image in images for plane in _list_planes(image)]
    if path.is_file() and len(images) > 1:
        notes.append(f"The {len(images)} files of its series in the folder are read.")
    for name, noted_value, sentence in _NOTED:
        value = images[0].get(name)
        notes += [sentence.format(value)] if value not in (None, "") and noted_value in (None, value) else []
    stated = _stack(planes, path)
    return stated._replace(notes=(*notes, *stated.notes))


def is_dicom(path: Path) -> bool:
    """Return whether a file has DICOM's mark at byte 128."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def _stack(planes: list[_Plane], path: Path) -> Stated:
    """Stack slices in the order of their positions, or of their numbers where none has a position."""
    if len(planes) < 2:
        raise ScanError(f"a DICOM series must have several slices, got {len(planes)} in {path}")
    positioned = [plane.position is not None and plane.directions is not None for plane in planes]
    if any(positioned) and not all(positioned):
        raise ScanError(f"DICOM slices must all state a position, got {positioned.count(False)} without one in {path}")
    for name, attribute in (("directions", "ImageOrientationPatient"), ("spacing", "PixelSpacing")):
        arrays = [array for plane in planes if (array := getattr(plane, name)) is not None]
        if arrays and np.ptp(np.array(arrays), axis=0).max() > 1e-3 * np.abs(arrays).max():
            raise ScanError(f"DICOM slices must have one {attribute}, got several in {path}")
    if not any(positioned):
        planes = sorted(planes, key=lambda plane: plane.number)
        notes = ["The slices state no position: they are stacked in the order of their numbers."]
        if (spacing := planes[0].spacing) is not None:
            notes.append(f"Their PixelSpacing, {spacing.tolist()} mm, is not used without a distance of them.")
        return _concatenate(planes, notes=tuple(notes))
    along_rows, along_columns = planes[0].directions  # type: ignore[misc]
    normal = np.cross(along_rows, along_columns)
    planes = sorted(planes, key=lambda plane: float(np.dot(normal, plane.position)))  # type: ignore[arg-type]
    z, origin = _slice_distance(np.array([plane.position for plane in planes]), normal, path)
    if planes[0].spacing is None:
        return _concatenate(planes)
    y, x = (float(h) for h in planes[0].spacing)
    affine = base.affine_of(np.column_stack([along_rows * x, along_columns * y, normal * z]), origin)
    return _concatenate(planes, steps=(z, y, x), units=("mm",) * 3, affine=LPS_TO_RAS @ affine)


def _concatenate(planes: list[_Plane], **stated: Any) -> Stated:
    values = np.stack([plane.values for plane in planes])
    return Stated(values, "zyxs"[: values.ndim], **stated)


def _read_image(pydicom: Any, file: Path) -> Any:
    """Return the image in a file, or None for a DICOM file of another kind, such as a folder's index or a report."""
    if not is_dicom(file):
        raise base.Damaged(f"{file.name} is not a DICOM file")
    image = pydicom.dcmread(file)
    if "PixelData" in image:
        return image
    kind = pydicom.uid.UID(str(image.file_meta.get("MediaStorageSOPClassUID", "")))
    if not kind or "Image Storage" in kind.name:
        raise base.Damaged(f"{file.name} has no pixels")
    return None


def _count_frames(image: Any) -> int:
    return int(image.get("NumberOfFrames") or 1)


def _list_planes(image: Any) -> Iterator[_Plane]:
    """Yield the slices of an image, with slope and intercept applied."""
    pixels, count = image.pixel_array, _count_frames(image)
    pixels = pixels if count > 1 else pixels[None]
    dose_scaling = float(image.get("DoseGridScaling") or 1)
    step = image.get("SpacingBetweenSlices")
    offsets = np.array(image.get("GridFrameOffsetVector") or [float(step) * k for k in range(count) if step], float)
    for number, values in enumerate(pixels):
        attributes = _FrameAttributes(image, number if count > 1 else None)
        slope = float(attributes.get("RescaleSlope") or dose_scaling)
        intercept = float(attributes.get("RescaleIntercept") or 0)
        values = values if (slope, intercept) == (1, 0) else (values * slope + intercept).astype(np.float32)
        position, directions, spacing = (
            None if (stated := attributes.get(name)) is None else np.array(stated, dtype=float)
            for name in ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing")
        )
        directions = None if directions is None else directions.reshape(2, 3)
        if count > 1 and not attributes.by_frame:  # the position is that of the first frame
            known = position is not None and directions is not None and len(offsets) == count
            position = position + (offsets[number] - offsets[0]) * np.cross(*directions) if known else None  # type: ignore[misc]
        order = number if count > 1 else int(image.get("InstanceNumber") or 0)
        yield _Plane(values, order, position, directions, spacing)


class _FrameAttributes:
    """The attributes of a frame: its own, those that all frames share, and those of the image."""

    def __init__(self, image: Any, number: int | None) -> None:
        by_frame, shared = image.get("PerFrameFunctionalGroupsSequence"), image.get("SharedFunctionalGroupsSequence")
        groups = [*([by_frame[number]] if by_frame and number is not None else []), *(shared or [])]
        sequences = [element.value for group in groups for element in group if element.VR == "SQ"]
        self._datasets = [*(sequence[0] for sequence in sequences if sequence), image]
        self.by_frame = bool(by_frame)

    def get(self, name: str) -> Any:
        return next((dataset[name].value for dataset in self._datasets if name in dataset), None)


def _slice_distance(positions: np.ndarray, normal: np.ndarray, path: Path) -> tuple[float, np.ndarray]:
    """Return the distance of slices at ordered positions (n, 3), which must be even, and the position of the first."""
    steps = np.diff(positions @ normal)
    if steps.min() <= 0 or np.ptp(steps) > 0.05 * steps.mean():
        range_text = f"steps of {steps.min():.4g} to {steps.max():.4g} mm"
        raise ScanError(f"DICOM slices must be evenly spaced, got {range_text} in {path}")
    # A shear of 2 % turns normals by a degree; rounded positions differ by far less.
    shear = float(np.linalg.norm(np.cross(positions[-1] - positions[0], normal)))
    if shear > 0.02 * np.ptp(positions @ normal):
        raise ScanError(f"DICOM slices must lie above each other, the last is {shear:.3g} mm aside in {path} (a tilt)")
    return float(steps.mean()), positions[0]
