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
#: Attributes that are said, not used: name, the value that is worth it, None for any, and the note.
_SAID = (
    ("PixelPaddingValue", None, "By the file, {} stands where nothing was measured."),
    ("PhotometricInterpretation", "MONOCHROME1", "The file shows low values bright: its values are as stored."),
    ("PhotometricInterpretation", "PALETTE COLOR", "The values are numbers of colours in the file's palette."),
    ("ModalityLUTSequence", None, "The file's table of values, ModalityLUTSequence, is not used: they are as stored."),
    ("LossyImageCompression", "01", "The file's values were compressed with loss."),
    ("BurnedInAnnotation", "YES", "The file says that text is burnt into its values."),
    ("ImagerPixelSpacing", None, "The file's ImagerPixelSpacing, {} mm, is that at the detector: it is not used."),
)


class _Plane(NamedTuple):
    """A slice: its values (Y, X) or (Y, X, samples), its number, and where it lies, None where nothing says that."""

    values: np.ndarray
    number: int
    position: np.ndarray | None
    directions: np.ndarray | None
    spacing: np.ndarray | None


def read_dicom(path: Path, *, key: str | None = None, **_: object) -> Stated:
    """Read slices in the order of their positions; `key` is the UID of a series, if a folder has several.

    A file of many frames is read by itself; one of a slice stands for its series in the folder.
    """
    pydicom = require("pydicom", "io", "reading DICOM")
    folder = path if path.is_dir() else path.parent
    inside = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    files = [p for p in inside if is_dicom(p) or p.suffix.lower() in SUFFIXES]
    notes: list[str] = []
    with base.collect_complaints("pydicom"):
        if path.is_file():
            one = _read_image(pydicom, path)
            if one is None:
                raise base.Damaged("it has no pixels")
            key = str(one.get("SeriesInstanceUID", ""))
            files = [path] if _count_frames(one) > 1 else files
        images = [image for file in files if (image := _read_image(pydicom, file)) is not None]
        uid = base.pick_key(sorted({str(image.get("SeriesInstanceUID", "")) for image in images}), key, path)
        images = [image for image in images if str(image.get("SeriesInstanceUID", "")) == uid]
        planes = [plane for image in images for plane in _list_planes(image)]
    if path.is_file() and len(images) > 1:
        notes.append(f"The {len(images)} files of its series in the folder are read.")
    for name, worth, sentence in _SAID:
        value = images[0].get(name)
        notes += [sentence.format(value)] if value not in (None, "") and worth in (None, value) else []
    stated = _stack(planes, path)
    return stated._replace(notes=(*notes, *stated.notes))


def is_dicom(path: Path) -> bool:
    """Return whether a file has DICOM's mark at byte 128."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def _stack(planes: list[_Plane], path: Path) -> Stated:
    """Return the slices in the order of their positions, or of their numbers where none has a position."""
    if len(planes) < 2:
        raise ScanError(f"a DICOM series must have several slices, got {len(planes)} in {path}")
    placed = [plane.position is not None and plane.directions is not None for plane in planes]
    if any(placed) and not all(placed):
        raise ScanError(f"DICOM slices must all state a position, got {placed.count(False)} without one in {path}")
    for name in ("directions", "spacing"):
        stated = [each for plane in planes if (each := getattr(plane, name)) is not None]
        if stated and np.ptp(np.array(stated), axis=0).max() > 1e-3 * np.abs(stated).max():
            words = {"directions": "ImageOrientationPatient", "spacing": "PixelSpacing"}
            raise ScanError(f"DICOM slices must have one {words[name]}, got several in {path}")
    if not any(placed):
        planes = sorted(planes, key=lambda plane: plane.number)
        notes = ["The slices state no position: they are stacked in the order of their numbers."]
        if planes[0].spacing is not None:
            notes.append(
                f"Their PixelSpacing, {planes[0].spacing.tolist()} mm, is not used without a distance of them."
            )
        return _pile(planes)._replace(notes=tuple(notes))
    rows, columns = planes[0].directions  # type: ignore[misc]
    normal = np.cross(rows, columns)
    planes = sorted(planes, key=lambda plane: float(np.dot(normal, plane.position)))  # type: ignore[arg-type]
    z, origin = _slice_distance(np.array([plane.position for plane in planes]), normal, path)
    if planes[0].spacing is None:
        return _pile(planes)
    y, x = (float(h) for h in planes[0].spacing)
    affine = base.affine_of(np.column_stack([rows * x, columns * y, normal * z]), origin)
    return _pile(planes)._replace(steps=(z, y, x), units=("mm",) * 3, affine=LPS_TO_RAS @ affine)


def _pile(planes: list[_Plane]) -> Stated:
    values = np.stack([plane.values for plane in planes])
    return Stated(values, "zyxs"[: values.ndim])


def _read_image(pydicom: Any, file: Path) -> Any:
    """Return an image with its pixels, or None for another kind of file, such as a folder's index or a report."""
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
    step, dose = image.get("SpacingBetweenSlices"), float(image.get("DoseGridScaling") or 1)
    offsets = np.array(image.get("GridFrameOffsetVector") or [float(step) * k for k in range(count) if step], float)
    for number, values in enumerate(pixels):
        look = _Attributes(image, number if count > 1 else None)
        slope, intercept = float(look("RescaleSlope") or dose), float(look("RescaleIntercept") or 0)
        values = values if (slope, intercept) == (1, 0) else (values * slope + intercept).astype(np.float32)
        position, directions, spacing = (
            None if (stated := look(name)) is None else np.array(stated, dtype=float)
            for name in ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing")
        )
        directions = None if directions is None else directions.reshape(2, 3)
        if count > 1 and not look.by_frame:  # frames without a place of their own
            known = position is not None and directions is not None and len(offsets) == count
            position = position + (offsets[number] - offsets[0]) * np.cross(*directions) if known else None  # type: ignore[misc]
        order = number if count > 1 else int(image.get("InstanceNumber") or 0)
        yield _Plane(values, order, position, directions, spacing)


class _Attributes:
    """The attributes of a frame: its own, those that all frames share, and those of the image."""

    def __init__(self, image: Any, number: int | None) -> None:
        own, shared = image.get("PerFrameFunctionalGroupsSequence"), image.get("SharedFunctionalGroupsSequence")
        groups = [*([own[number]] if own and number is not None else []), *(shared or [])]
        self.places = [
            sequence[0] for group in groups for each in group if each.VR == "SQ" and (sequence := each.value)
        ]
        self.places.append(image)
        self.by_frame = bool(own)

    def __call__(self, name: str) -> Any:
        return next((place[name].value for place in self.places if name in place), None)


def _slice_distance(positions: np.ndarray, normal: np.ndarray, path: Path) -> tuple[float, np.ndarray]:
    """Return the distance of ordered slices, which must be even, and the position of the first."""
    steps = np.diff(positions @ normal)
    if steps.min() <= 0 or np.ptp(steps) > 0.05 * steps.mean():
        range_text = f"steps of {steps.min():.4g} to {steps.max():.4g} mm"
        raise ScanError(f"DICOM slices must be evenly spaced, got {range_text} in {path}")
    # A shear of 2 % turns normals by a degree; rounded positions differ by far less.
    aside = float(np.linalg.norm(np.cross(positions[-1] - positions[0], normal)))
    if aside > 0.02 * np.ptp(positions @ normal):
        raise ScanError(f"DICOM slices must lie above each other, the last is {aside:.3g} mm aside in {path} (a tilt)")
    return float(steps.mean()), positions[0]
