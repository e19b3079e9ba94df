"""What the corpus freezes of an output, and how two such records are compared.

Whole numbers are held exactly: values of files as a hash, masks by voxel. Numbers that come of arithmetic with floats
are rounded to four digits; a record agrees within two units of the last one, as another processor adds in another order
and a hash of rounded numbers would break at the edge of rounding. For the same reason a mask agrees if at most
`STRAY` of its voxels differ.
"""

import base64
import csv
import json
import math
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np

KEPT = Path(__file__).with_name("frozen.json")
#: Share of a computed mask's voxels that may differ between processors.
STRAY = 2e-3
#: Relative difference of two rounded numbers.
CLOSE = 2e-3
#: Numbers within so much of zero, as a share of the largest one beside them or in all, count as alike.
SMALL, TINY = 0.05, 1e-6
#: Keys of records that differ from run to run.
PASSING = re.compile(
    r"seconds|date|version|time|host|path|command|python|created|hash|torch|numpy|platform|threads|curvafit"
)


def read() -> dict[str, Any]:
    """Return what is frozen, by row."""
    return json.loads(KEPT.read_text()) if KEPT.is_file() else {}


def write(rows: dict[str, Any]) -> None:
    """Freeze rows: a line for each output."""
    lines = []
    for name, outputs in rows.items():
        inner = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in outputs.items())
        lines.append(f" {json.dumps(name)}: {{\n{inner}\n }}")
    KEPT.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def exact(values: np.ndarray) -> str:
    """Return a hash of numbers, their type and shape."""
    little = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"))
    return f"{values.dtype.name} {list(values.shape)} {zlib.crc32(little.tobytes()):08x}"


def volume(values: np.ndarray) -> Any:
    """Return a mask or labels by voxel, or some numbers of a field."""
    if values.dtype.kind in "biu":
        found = np.unique(values)
        if len(found) <= 64:
            places = np.searchsorted(found, values).astype(np.uint8)
            packed = base64.b85encode(zlib.compress(places.tobytes(), 9)).decode()
            return {"type": values.dtype.name, "shape": list(values.shape), "labels": found.tolist(), "voxels": packed}
    values = np.squeeze(np.asarray(values, np.float64))
    blocks = [part.mean() for half in np.array_split(values, 2) for part in np.array_split(half, 2, axis=-1)]
    return {"shape": list(values.shape), "field": rounded([values.mean(), values.std(), *blocks])}


def rounded(value: Any) -> Any:
    """Return numbers to four digits, within lists and records; whole numbers and flags stay; texts go."""
    if isinstance(value, dict):
        inner = {str(key): rounded(each) for key, each in value.items() if not PASSING.search(str(key).lower())}
        return {key: each for key, each in inner.items() if each is not None}
    if isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim):
        rows = [rounded(each) for each in value]
        return rows if any(each is not None for each in rows) else None
    if isinstance(value, bool | int | np.integer):
        return int(value)
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return float(f"{number:.4g}") if math.isfinite(number) else str(number)


def files(folder: Path, before: set[Path]) -> dict[str, Any]:
    """Return the content of the files in a folder that are new."""
    stores = [path for path in folder.rglob("*.zarr") if path not in before]
    stores += [path.parent for path in folder.rglob("000000.npz") if path.parent not in before]
    found: dict[str, Any] = {}
    for path in sorted(set(folder.rglob("*")) - before):
        inside = any(store in path.parents for store in stores)
        if inside or (path.is_dir() and path not in stores):
            continue
        found[str(path.relative_to(folder))] = _content(path)
    return found


def _content(path: Path) -> Any:
    """Return what is frozen of a file: of pages and pictures that they are there."""
    from curvafit.volumes.read import load

    name = path.name.lower()
    if (path / "000000.npz").exists():
        return "folder"
    if name.endswith((".nii.gz", ".tif", ".npy", ".nrrd", ".mrc", ".zarr")):
        try:
            field = load(path)
        except ValueError:
            return "folder"
        affine = None if field.affine is None else rounded(field.affine.tolist())
        return {"spacing": rounded(field.spacing), "unit": field.unit, "affine": affine, **volume(field.values)}
    if name.endswith(".json"):
        return rounded(json.loads(path.read_text()))
    if name.endswith(".csv"):
        with path.open(newline="") as file:
            return [[cell if rounded(cell) is None else rounded(cell) for cell in row][:8] for row in csv.reader(file)]
    if name.endswith(".npz"):
        with np.load(path, allow_pickle=False) as arrays:
            content = {key: volume(arrays[key]) for key in sorted(arrays.files) if arrays[key].dtype.kind in "biuf"}
            if "header" in content:  # JSON, some of whose texts, as the processor's name, differ
                content["header"] = rounded(json.loads(arrays["header"].tobytes()))
            return content
    return "file"


def compare(kept: Any, got: Any, where: str = "", close: float = CLOSE, scale: float = 0.0) -> list[str]:
    """Return a sentence for each difference; none where the records agree to `close`, a relative difference."""
    if isinstance(kept, dict) and isinstance(got, dict):
        if "voxels" in kept and "voxels" in got:
            return _compare_masks(kept, got, where, close)
        said = [f"{where}/{key}: gone" for key in kept if key not in got]
        said += [f"{where}/{key}: new" for key in got if key not in kept]
        both = [key for key in kept if key in got]
        return said + [each for key in both for each in compare(kept[key], got[key], f"{where}/{key}", close)]
    if isinstance(kept, list) and isinstance(got, list):
        if len(kept) != len(got):
            return [f"{where}: {len(got)} values for {len(kept)}"]
        numbers = [abs(each) for each in kept if isinstance(each, float | int)]
        scale = max((each for each in numbers if math.isfinite(each)), default=0.0)
        pairs = enumerate(zip(kept, got, strict=True))
        return [each for k, (old, new) in pairs for each in compare(old, new, f"{where}[{k}]", close, scale)]
    if isinstance(kept, float) and isinstance(got, float | int):
        alike = math.isclose(kept, got, rel_tol=close, abs_tol=close * SMALL * scale + TINY)
    else:
        alike = kept == got
    return [] if alike else [f"{where}: {got} for {kept}"]


def _compare_masks(kept: dict[str, Any], got: dict[str, Any], where: str, close: float) -> list[str]:
    keys = sorted({*kept, *got} - {"voxels"})
    if said := [each for key in keys for each in compare(kept.get(key), got.get(key), f"{where}/{key}")]:
        return said
    old, new = (np.frombuffer(zlib.decompress(base64.b85decode(each["voxels"])), np.uint8) for each in (kept, got))
    stray = np.count_nonzero(old != new) / old.size
    return [f"{where}: {stray:.2%} of the voxels differ"] if stray > max(STRAY, close / 10) else []
