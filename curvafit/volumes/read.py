"""Reading of volumes: `load` takes any source of one, `read_maps` files of parameters that vary in space.

The suffix of a file chooses its reader. What a file states is used, or refused with a ScanError, or mentioned in a
note. Volumes have axes in the order z, y, x, one channel and time, and lengths in one unit. Libraries print nothing.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from curvafit.core.checks import SEEDS, check_int, quoted
from curvafit.core.files import is_url, is_zarr
from curvafit.core.records import read_archive
from curvafit.core.runtime import one_line
from curvafit.core.units import METRES, common_unit, convert_length, format_length, is_unit, parse_unit
from curvafit.priors.coefficients import NAMES
from curvafit.volumes.formats import arrays, base, dicom, headers, meshes, nifti, tiff, zarr
from curvafit.volumes.formats.base import ScanError, Stated
from curvafit.volumes.volume import Crop, StoredArray, Volume, check_finite, parse_box, positive_triple

#: A volume as a caller gives it.
Source = str | os.PathLike[str] | Volume | np.ndarray | torch.Tensor
#: Suffix -> reader(path, key=, raw_shape=, dtype=, spacing=, unit=).
READERS: dict[str, Callable[..., Stated]] = {
    **dict.fromkeys((".nii", ".nii.gz"), nifti.read_nifti),
    **dict.fromkeys((".tif", ".tiff"), tiff.read_tiff),
    ".npy": arrays.read_npy,
    ".npz": arrays.read_npz,
    **dict.fromkeys((".h5", ".hdf5"), arrays.read_hdf5),
    ".ims": arrays.read_imaris,
    **dict.fromkeys((".raw", ".bin", ".vol"), arrays.read_raw),
    ".zarr": zarr.read_zarr,
    **dict.fromkeys((".nrrd", ".nhdr"), headers.read_nrrd),
    **dict.fromkeys((".mha", ".mhd"), headers.read_metaimage),
    **dict.fromkeys((".mrc", ".map", ".rec"), headers.read_mrc),
    **dict.fromkeys(dicom.SUFFIXES, dicom.read_dicom),
    **dict.fromkeys(arrays.MICROSCOPES, arrays.read_microscope),
    ".isq": headers.read_isq,
    ".aim": headers.read_aim,
    **dict.fromkeys(meshes.SUFFIXES, meshes.read_mesh),
}
#: Largest cosine of the angle between axes that count as orthogonal: a shear of 2 % turns normals by a degree.
RIGHT = 0.02
#: Names of an orientation's direction θ and strength μ.
ORIENTATION = ("theta_z", "theta_y", "theta_x", "mu")
#: What may vary in space: the six coefficients, the mass and an orientation, in working units.
PARAMETERS = (*NAMES, "mass", *ORIENTATION)
#: Readers of formats that can hold several arrays, by key.
KEYED = (arrays.read_npz, arrays.read_hdf5, arrays.read_imaris, arrays.read_microscope)
KEYED += (zarr.read_zarr, dicom.read_dicom)
#: What to do with a slice that is a file.
SLICED = ": put a scan's slices into a folder of their own, and name the folder"


def load(
    source: Source,
    *,
    key: str | None = None,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    channel: int | None = None,
    time: int | None = None,
    label: int | None = None,
    crop: Crop | None = None,
    raw_shape: Sequence[int] | None = None,
    dtype: str | None = None,
    strict: bool = False,
    lazy: bool = False,
) -> Volume:
    """Return the volume of a file, of a folder of slices, or of an array.

    Raises FileNotFoundError if there is no such file, and ScanError, which is a ValueError, if the suffix is unknown,
    the file is damaged or truncated, the key is missing, the volume is not 3D, not finite, constant or larger than
    memory, the spacing is not positive, the file has no such channel, label or crop, or an option does not apply.

    Parameters
    ----------
    source
        A path; a `Volume`, which has its own spacing and unit; or an array or tensor (Z, Y, X). Files are NIfTI, TIFF,
        NPY, NPZ, HDF5, Imaris, RAW, Zarr, MHA/MHD, Scanco's ISQ and AIM; with `curvafit[io]` also NRRD, MRC and DICOM,
        and closed meshes (STL, PLY, OBJ, OFF) as masks of their inside; with `curvafit[microscopes]` CZI, LIF and ND2;
        with `curvafit[remote]` the URL (https, s3) of a Zarr store. Folders hold slices as TIFF, BMP, PNG, JPEG or
        DICOM. `file.h5::key` names an array within a file; `key` does the same.
    spacing, unit
        Voxel edges (z, y, x), or one for all, and nm, um, mm or m, in place of what the file says; for an array the
        default is one voxel, for a mesh 1/128 of its longest side. A `unit` alone converts the lengths of a file that
        names their unit, and names that of others.
    channel, time
        The channel and the time to read, counted from 0, from a file of several. Colours and components of vectors are
        channels, and so are times in a file without channels.
    label
        The voxels that have this value, as a mask.
    crop
        A box of voxels, `"z0:z1,y0:y1,x0:x1"` or three slices; the affine says where the box lies. From Zarr, HDF5,
        Imaris, NPY, RAW, ISQ, AIM, MRC and uncompressed NIfTI only the box is read.
    raw_shape, dtype
        Voxels (z, y, x) and numpy type of a RAW file, which does not state them.
    strict
        Refuse a volume with values that are not stored: chunks of Zarr or HDF5, which otherwise get the fill value, or
        slices that a folder's numbers skip. Without `strict` a note names them.
    lazy
        Read voxels only when they are used, from formats of which a box can be read; values are not checked then.
    """
    sampling: dict[str, Any] = {"spacing": spacing, "unit": unit}
    reading = {"key": key, "channel": channel, "time": time, "raw_shape": raw_shape, "dtype": dtype, "strict": strict}
    box = None if crop is None else parse_box(crop)
    if isinstance(source, str | os.PathLike):
        volume = _open(source, **sampling, **reading)
    elif isinstance(source, Volume):
        _refuse(sampling, "a file or an array", "a Volume, which has its own")
        _refuse(reading, "the path of a file", "a Volume, which is read already")
        volume = source
    elif isinstance(source, np.ndarray | torch.Tensor):
        _refuse(reading, "the path of a file", "an array")
        edges = positive_triple(1.0 if spacing is None else spacing)
        volume = Volume(_to_numpy(source), edges, "voxel" if unit is None else unit)
        check_finite(volume.values, "an array")
    else:
        raise ScanError(f"a volume must be the path of a file, a Volume, an array or a tensor, got {quoted(source)}")
    volume = volume if box is None else volume.crop(box)
    if not lazy and (volume.in_file or isinstance(source, str | os.PathLike)):
        volume = volume.load()
    return volume if label is None else volume.label(label)


def _open(
    path: str | os.PathLike[str],
    key: str | None,
    raw_shape: Sequence[int] | None,
    dtype: str | None,
    strict: bool,
    **options: Any,
) -> Volume:
    """Return the volume of a file, whose values are read only when they are used, if the format allows it."""
    location, key = split_key(path, key)
    reading = {"key": key, "raw_shape": raw_shape, "dtype": dtype}
    stated = read_file(location, **reading, spacing=options["spacing"], unit=options["unit"])  # type: ignore[arg-type]
    if strict and stated.gaps:
        raise ScanError(f"{location} is not whole: {stated.gaps[0]}")
    if not isinstance(stated.array, np.ndarray) or isinstance(stated.array, np.memmap):
        stated = stated._replace(array=FileArray(location, reading, stated.array))
    return to_volume(stated, f"{location}::{key}" if key else str(location), **options)


class FileArray:
    """The array of a file, which each process opens for itself."""

    def __init__(self, path: Path | str, reading: Mapping[str, Any], array: Any) -> None:
        self.path, self.reading, self.shape, self.dtype = path, reading, tuple(array.shape), array.dtype
        self._array = array

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_array": None}

    def __getitem__(self, index: Any) -> np.ndarray:
        # A mapped file that is truncated meanwhile would crash the process: it is opened, and checked, each time.
        if self._array is None or isinstance(getattr(self._array, "array", self._array), np.memmap):
            self._array = read_file(self.path, **self.reading).array
        with _name_damage(self.path):
            return np.asarray(self._array[index])

    @property
    def digest(self) -> str:
        """A text that changes with the content, from the total size of the files and the latest time of change."""
        if isinstance(self.path, str):  # a URL
            return f"{self.path} {self.reading}"
        files = [path for path in self.path.rglob("*") if path.is_file()] if self.path.is_dir() else [self.path]
        stats = [path.stat() for path in files]
        size, time = sum(stat.st_size for stat in stats), max(stat.st_mtime_ns for stat in stats)
        return f"{self.path.resolve()} {self.reading}: {size} bytes at {time}"


def read_file(path: Path | str, key: str | None = None, **options: Any) -> Stated:
    """Return what a file, a folder, or a store at a URL states; errors of the reading library become a ScanError.

    Of the `options` of `load`, a RAW file takes raw_shape and dtype, and a mesh the spacing and unit of its voxels.
    """
    if isinstance(path, str):
        with _name_damage(path):
            return zarr.read_remote(path, key)
    if not path.exists():
        raise FileNotFoundError(one_line(f"no such file: {path}"))
    reader = pick_reader(base.check_regular(path), options.get("raw_shape") is not None)
    if key is not None and reader not in KEYED:
        raise ScanError(
            f"a key applies to NPZ, HDF5, Imaris, Zarr, DICOM, CZI, LIF and ND2 only, got {quoted(key)} for {path}"
        )
    with _name_damage(path):
        return reader(path, key=key, **options)


@contextmanager
def _name_damage(path: Path | str) -> Iterator[None]:
    """Turn a library's error into a ScanError that names the file, and silence its warnings."""
    try:
        with base.collect_complaints():
            yield
    except (ScanError, ImportError):  # a library that is not installed says so itself
        raise
    except MemoryError as reason:
        raise ScanError(f"{path} does not fit into memory") from reason
    except Exception as reason:  # every library has its own errors for a damaged file
        prefix = "" if isinstance(reason, base.Damaged | ValueError) else f"{type(reason).__name__}: "
        text = " ".join(f"{prefix}{reason}"[:2000].split())[:200]
        raise ScanError(f"{path} cannot be read, it is damaged or something else ({text})") from reason


def pick_reader(path: Path, shape_given: bool = False) -> Callable[..., Stated]:
    """Return the reader of a file by its suffix, or of a folder by its content."""
    if path.is_dir():
        return _pick_folder(path)
    name = re.sub(r";\d+$", "", path.name.lower())  # VMS numbers the versions of a file: SCAN.AIM;1
    for suffix in sorted(READERS, key=len, reverse=True):
        if name.endswith(suffix):
            return READERS[suffix]
    if shape_given:
        return arrays.read_raw
    hint = SLICED if path.suffix.lower() in tiff.SLICES else ""
    raise ScanError(f"a volume's name must end in one of {', '.join(READERS)}, got {path.name!r}{hint}")


def _refuse(options: dict[str, Any], expected: str, got: str) -> None:
    """Raise ScanError where an option would have no effect."""
    for name, value in options.items():
        if value is not None and value is not False:
            raise ScanError(f"{name} applies to {expected} only, got it with {got}")


def _to_numpy(source: np.ndarray | torch.Tensor) -> np.ndarray:
    """Return an array or tensor as an array."""
    if isinstance(source, np.ndarray):
        return source
    tensor = source.detach().cpu()
    return (tensor.float() if tensor.dtype == torch.bfloat16 else tensor).numpy()


def split_key(path: str | os.PathLike[str], key: str | None) -> tuple[Path | str, str | None]:
    """Return the file, or the URL, of a path such as `file.h5::key`, and the key, which `key` overrides."""
    path = os.fspath(path)
    name, separator, stated_key = path.rpartition("::")
    if not separator or Path(path).exists():
        name, stated_key = path, None
    return (name if is_url(name) else Path(name)), key or stated_key or None


def _pick_folder(path: Path) -> Callable[..., Stated]:
    """Return the reader of a folder: of a Zarr store, or of slices, as images or DICOM."""
    if is_zarr(path) or path.suffix == ".zarr":
        return zarr.read_zarr
    visible = [p for p in path.iterdir() if not p.name.startswith(".")]
    if any(p.suffix.lower() in tiff.SLICES for p in visible):
        return tiff.read_slices
    if any(p.is_file() and dicom.is_dicom(p) for p in visible):
        return dicom.read_dicom
    raise ScanError(f"the folder {path} holds neither slices (TIFF, BMP, PNG, JPEG, DICOM) nor a Zarr store")


# ---- from what a file states to a volume -----------------------------------------------------------------------------


def to_volume(
    stated: Stated,
    source: str,
    *,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    channel: int | None = None,
    time: int | None = None,
) -> Volume:
    """Return the volume that a file states; the options are those of `load`.

    Raises ScanError where the array has no three axes of space, or several channels or times and no choice of one;
    where axes are not at right angles; or where lengths are in no known unit and the caller gives none.
    """
    array = stated.array
    order, numbers, axis_notes = _find_axes(array.shape, stated.axes, channel, time, source)
    index = tuple(numbers.get(axis, slice(0, n)) for axis, n in enumerate(array.shape))
    if isinstance(array, np.ndarray):
        # The axes with a number in `index` are gone: those of `order` are counted without them.
        zyx = array[index].transpose([sorted(order).index(axis) for axis in order])
        array = np.ascontiguousarray(zyx, dtype=array.dtype.newbyteorder("="))
    else:
        array = StoredArray(array, index, order)
    edges, edge_unit, scale, length_notes = _find_lengths(stated, order, spacing, unit, source)
    affine, origin = stated.affine, _take_zyx(stated.origin, order, stated.axes)
    if affine is not None:
        affine = np.diag([scale[2]] * 3 + [1.0]) @ affine  # an affine is in the unit of x
        if spacing is not None or stated.steps is None:
            lengths = np.linalg.norm(affine[:3, :3], axis=0)
            affine[:3, :3] *= edges[::-1] / np.where(lengths > 0, lengths, 1)  # its columns get the edges' lengths
    elif origin is not None and any(origin):
        affine = base.affine_of(np.diag(edges[::-1]), (scale * origin)[::-1])
    notes = (*stated.gaps, *stated.notes, *axis_notes, *length_notes)
    notes += stated.guesses if spacing is None and unit is None else ()
    if edge_unit in ("mm", "m") and (widest := float(max(edges * array.shape))) * METRES[edge_unit] > 1:
        notes += (f"The scan would be {widest:.4g} {edge_unit} wide: is the voxel in µm?",)
    volume = Volume(array, tuple(edges.tolist()), edge_unit, affine, source, notes)
    if affine is not None and spacing is None:
        _check_angles(affine[:3, :3], source)
    return volume


def _find_axes(
    shape: Sequence[int], axes: str, channel: int | None, time: int | None, source: str
) -> tuple[tuple[int, int, int], dict[int, int], tuple[str, ...]]:
    """Return the axes z, y and x of an array, the index to take along every other axis, and notes.

    Unnamed axes are z, y and x in this order. If there is one more, and a channel is chosen, the shorter of the first
    and the last one holds channels. Without an axis z, that of times, or else of channels, is taken for z. `channel`
    chooses a time if the file has times but no channels.
    """
    long = [axis for axis, n in enumerate(shape) if n != 1]
    named = {axes[axis]: axis for axis in long if axes[axis] != "?"}
    unnamed = [axis for axis in long if axes[axis] == "?"]
    lacking, notes = [letter for letter in "zyx" if letter not in named], ()
    if len(unnamed) == len(lacking) + 1 and channel is not None and not {"c", "s"} & named.keys():
        named["c"] = unnamed.pop(0 if shape[unnamed[0]] <= shape[unnamed[-1]] else -1)
    if len(unnamed) == len(lacking):
        named |= dict(zip(lacking, unnamed, strict=True))
    elif lacking == ["z"] and not unnamed and (letter := "t" if "t" in named else "c") in named:
        named["z"] = named.pop(letter)
        content = "times" if letter == "t" else "channels"
        notes = (f"The file calls an axis of {shape[named['z']]} {content}: it is taken for slices.",)
    space = [named[letter] for letter in "zyx" if letter in named]
    others = {"channel": named.get("s", named.get("c")), "time": named.get("t")}
    if others["channel"] is None and channel is not None and time is None:
        others = {"channel": others["time"], "time": None}
    chosen = {"channel": channel, "time": time}
    numbers = _pick_numbers(shape, others, chosen, source, len(long))
    if len(space) != 3 or len(long) != 3 + len(numbers) or 0 in shape:
        got = "no values" if 0 in shape else f"{len(long) - len(numbers)}D of shape {tuple(shape)}"
        hint = "; a channel, counted from 0, picks one volume of several" if (len(long), len(numbers)) == (4, 0) else ""
        raise ScanError(f"a volume must be 3D, got {got} in {source}{SLICED if got[:2] == '2D' else hint}")
    if undecided := {name: shape[axis] for name, axis in others.items() if axis is not None and numbers[axis] is None}:
        content = " of ".join(f"{count} {name}s" for name, count in undecided.items())
        choices = " and ".join(f"a {name} from 0 to {count - 1}" for name, count in undecided.items())
        raise ScanError(f"{source} holds {content}: choose {choices}")
    notes += tuple(f"{name.title()} {number} is used." for name, number in chosen.items() if number is not None)
    single = {axis: 0 for axis, n in enumerate(shape) if n == 1}
    return (space[0], space[1], space[2]), {**single, **numbers}, notes  # type: ignore[dict-item]


def _pick_numbers(
    shape: Sequence[int], axes: Mapping[str, int | None], chosen: Mapping[str, int | None], source: str, count: int
) -> dict[int, int | None]:
    """Map the axes of channels and times, if there are any, to the chosen index or None; ScanError if out of range."""
    numbers: dict[int, int | None] = {}
    for name, axis in axes.items():
        number = chosen[name]
        if number is not None:
            check_int(number, f"a {name} that is a whole number from 0", -SEEDS, SEEDS)
            if axis is None:
                hint = " (a channel picks one of several without names)" if name == "time" and count == 4 else ""
                raise ScanError(f"{source} names no axis of {name}s, got {name} {number}{hint}")
            if not 0 <= number < shape[axis]:
                raise ScanError(f"{name} must be from 0 to {shape[axis] - 1} for {source}, got {number}")
        if axis is not None:
            numbers[axis] = number
    return numbers


def _take_zyx(values: Sequence[Any] | None, order: Sequence[int], axes: str) -> Any:
    """Return the values along z, y and x, from values along these three or along all axes of an array."""
    if values is None or len(values) != len(axes):
        return values
    z = axes.index("z") if "z" in axes else order[0]  # a stated z counts, even if another axis is taken for it
    return values[z], values[order[1]], values[order[2]]


def _find_lengths(
    stated: Stated, order: Sequence[int], spacing: Sequence[float] | float | None, unit: str | None, source: str
) -> tuple[np.ndarray, str, np.ndarray, tuple[str, ...]]:
    """Return voxel edges (z, y, x), their unit, factors (3,) from the file's units to it, and a note.

    A caller's unit without a spacing converts the lengths of a file that names their unit, and is taken for others.
    """
    axis_units = _take_zyx(stated.units, order, stated.axes)
    common, factors = common_unit([axis_unit or stated.custom for axis_unit in axis_units])
    if not is_unit(common) and (spacing is None or unit is None):
        raise ScanError(f"{source} states lengths in {quoted(common)}, which is not known: give --spacing and --unit")
    try:
        name, factor = parse_unit(common if unit is None else unit)
        edges = None if spacing is None else np.array(positive_triple(spacing))
        steps = None if stated.steps is None or spacing is not None else _take_zyx(stated.steps, order, stated.axes)
        steps = None if steps is None else positive_triple(steps)
    except ValueError as reason:
        raise ScanError(f"{reason} for {source}") from None
    names_length = is_unit(common) and parse_unit(common)[0] != "voxel" and any(axis_units)
    if unit is not None and names_length and name == "voxel" and spacing is None:
        raise ScanError(f"lengths of {source} are in {common}, which no --unit voxel converts: give --spacing too")
    conversion = convert_length(1.0, common, name) if unit is not None and names_length else factor
    scale, note = np.array(factors) * float(f"{conversion:.15g}"), ()
    if edges is not None:
        if unit is None and name == "voxel" and edges.min() != 1:  # edges of which the smallest is 1 are ratios
            raise ScanError(f"expected the unit of the spacing {quoted(spacing)} of {source}, such as mm, got none")
        edges = edges if unit is None else factor * edges
        if stated.steps is not None and len(stated.steps) == 3 and names_length and name != "voxel":
            own = np.array(factors) * convert_length(1.0, common, name) * _take_zyx(stated.steps, order, stated.axes)
            if not np.allclose(own, edges, rtol=1e-3):
                written = " x ".join(format_length(edge, name, 4) for edge in own)
                note = (f"The spacing is the one given; the file states {written} (z, y, x).",)
    elif steps is not None:
        edges = scale * steps
    else:
        edges = np.full(3, 1.0 if unit is None else factor)
        meaning = "counted in voxels" if name == "voxel" else f"those of voxels of 1 {name}"
        note = (f"The file states no spacing: lengths are {meaning}.",)
    return edges, name, scale, note


def _check_angles(matrix: np.ndarray, source: str) -> None:
    """Raise ScanError where the axes of voxels, the columns of a matrix (3, 3), are not at right angles."""
    directions = matrix / np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    cosine = np.abs(directions.T @ directions - np.eye(3)).max()
    if not np.isfinite(cosine):
        raise ScanError(f"the axes of {source} are no numbers: give --spacing")
    if cosine > RIGHT:
        angle = f"{np.degrees(np.arccos(min(cosine, 1.0))):.3g}°"
        raise ScanError(f"the axes of {source} meet at {angle}, not at right angles: resample it, or give --spacing")


# ---- parameters that vary in space -----------------------------------------------------------------------------------


def read_maps(path: str | Path, shape: tuple[int, int, int] | None = None) -> dict[str, float | Tensor]:
    """Return a map `(Z, Y, X)`, float32, or a number for each parameter in a file.

    Raises FileNotFoundError if there is no such file, and ValueError if it is empty or holds another name, or a map has
    another shape or values that are not finite.

    Parameters
    ----------
    path
        An NPZ file of arrays named as in `PARAMETERS`. An array of one number holds everywhere.
    shape
        Voxels of every map (z, y, x); by default the shape of the first map.
    """
    source = Path(path)
    try:
        content = read_archive(source)
    except FileNotFoundError:
        raise FileNotFoundError(f"no such file of maps: {source}") from None
    except (ValueError, OSError) as reason:
        raise ValueError(f"{source} is not an NPZ file of maps") from reason
    unknown = sorted(content.keys() - set(PARAMETERS))
    if unknown or not content:
        listed = ", ".join(unknown) or "none"
        raise ValueError(f"maps must be named {', '.join(PARAMETERS)}, got {listed} in {source}")
    for name, values in content.items():
        is_numeric = values.dtype.kind in "iuf"
        if not is_numeric or not np.isfinite(values).all() or np.abs(values).max(initial=0) > np.finfo(np.float32).max:
            raise ValueError(f"the map {name} must hold finite numbers, got others in {source}")
        if values.size > 1:
            shape = shape or values.shape  # type: ignore[assignment]
            if values.shape != shape or len(values.shape) != 3:
                raise ValueError(f"the map {name} must have the shape {shape}, got {values.shape} in {source}")
    return {
        name: float(values.reshape(())) if values.size == 1 else torch.from_numpy(values.astype(np.float32))
        for name, values in content.items()
    }


def map_shape(maps: Mapping[str, float | Tensor]) -> tuple[int, int, int] | None:
    """Return the common shape of the maps, None if all are numbers."""
    shapes = [tuple(values.shape) for values in maps.values() if isinstance(values, Tensor)]
    return shapes[0] if shapes else None  # type: ignore[return-value]
