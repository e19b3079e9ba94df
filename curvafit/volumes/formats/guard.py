"""The one way into all readers: any fault of a file becomes one sentence, and libraries print nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from curvafit.core.checks import quoted
from curvafit.core.runtime import one_line
from curvafit.volumes.formats import KEYED, pick_reader
from curvafit.volumes.formats.base import Damaged, Raw, ScanError, complaints
from curvafit.volumes.formats.part import Part
from curvafit.volumes.formats.streams import check_regular


def read_file(
    path: Path,
    key: str | None = None,
    raw_shape: Sequence[int] | None = None,
    dtype: str | None = None,
    part: Part | None = None,
) -> Raw:
    """Return the content of a file or a folder, by the reader that `pick_reader` chooses.

    From some formats only the part is read: see `Raw.whole`.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ScanError
        If the path is neither a file nor a folder, the suffix is unknown, the file is damaged, or a key is given for a
        format without keys.
    """
    if not path.exists():
        raise FileNotFoundError(one_line(f"expected a volume file, got no such file: {path}"))
    reader = pick_reader(check_regular(path), raw_shape is not None)
    if key is not None and reader not in KEYED:
        raise ScanError(f"expected a key only for NPZ, HDF5, Zarr and DICOM, got {quoted(key)} for {path}")
    return guarded(reader, path, key=key, raw_shape=raw_shape, dtype=dtype, part=part)


def guarded(reader: Callable[..., Raw], path: Path, **options: object) -> Raw:
    """Return what a reader returns, and turn a library's own exceptions into one sentence.

    Raises
    ------
    ScanError
        If the reader raises.
    """
    try:
        with complaints():
            return reader(path, **options)
    except ScanError:
        raise
    except MemoryError as reason:
        raise ScanError(f"expected a volume that fits into memory, got {path}, which does not") from reason
    except (Damaged, ValueError) as reason:
        cause, text = reason, str(reason)
    except Exception as reason:  # every library has its own way to say that a file is damaged
        cause, text = reason, f"{type(reason).__name__}: {reason}"
    text = " ".join(text[:2000].split())[:200]
    raise ScanError(f"expected a whole, readable file, got {path} that cannot be read ({text})") from cause
