"""One object has the same numbers through every format, order of axes and unit that holds it."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
import zarr

import curvafit
from curvafit.core.units import convert_length
from curvafit.volumes import Volume, save

SHAPE, SPACING = (26, 24, 28), (0.003, 0.002, 0.0025)  # z, y, x, in mm
UNITS = {"um": 1e3, "nm": 1e6, "mm": 1.0}
NAMES = {"um": "micrometer", "nm": "nanometer", "mm": "millimeter"}


def body() -> np.ndarray:
    """A bent rod with a handle, of no symmetry, in voxels whose edges all differ."""
    z, y, x = (h * 1e3 * (np.arange(n) + 0.5) for n, h in zip(SHAPE, SPACING, strict=True))
    z, y, x = z[:, None, None], y[None, :, None], x[None, None]
    rod = np.hypot(y - 20 - 3 * np.sin(z / 12), x - 25) < 9
    ring = (np.hypot(np.hypot(y - 24, z - 40) - 17, x - 40)) < 7
    return (rod | ring).astype(np.uint8)


def files(folder: Path, mask: np.ndarray) -> Iterator[tuple[Path | str, dict[str, Any]]]:
    """Yield paths of files, and options of reading them; the foreign writers of this package's readers make them."""
    for unit, factor in UNITS.items():
        edges = tuple(factor * h for h in SPACING)
        yield save(Volume(mask, edges, unit), folder / f"{unit}.nii.gz"), {}
        yield save(Volume(mask, edges, unit), folder / f"{unit}.tif"), {}
        yield save(Volume(mask, edges, unit), folder / f"{unit}.ome.tif"), {}
        yield save(Volume(mask, edges, unit), folder / f"{unit}.mrc"), {}
        yield save(Volume(mask, edges, unit), folder / f"{unit}.zarr"), {}
        yield save(Volume(mask), folder / f"{unit}.npy"), {"spacing": edges, "unit": unit}
    mask.tofile(folder / "a.raw")
    yield folder / "a.raw", {"raw_shape": SHAPE, "spacing": SPACING, "unit": "mm"}
    for order in ("zyx", "xyz", "yzx"):
        turned = mask.transpose(["zyx".index(axis) for axis in order])
        edges = [1e3 * SPACING["zyx".index(axis)] for axis in order]
        with h5py.File(folder / f"{order}.h5", "w") as file:
            file["a"] = turned
            file["a"].attrs.update(element_size_um=edges, axistags=json.dumps({"axes": [{"key": k} for k in order]}))
        yield folder / f"{order}.h5", {}
        group = zarr.create_group(folder / f"{order}.zarr")
        group.create_array("0", data=np.ascontiguousarray(turned))
        steps = {"path": "0", "coordinateTransformations": [{"type": "scale", "scale": edges}]}
        axes = [{"name": axis, "type": "space", "unit": "micrometer"} for axis in order]
        group.attrs["ome"] = {"version": "0.5", "multiscales": [{"axes": axes, "datasets": [steps]}]}
        yield folder / f"{order}.zarr", {}
    nrrd = pytest.importorskip("nrrd")
    header = {"space": "RAS", "space directions": np.diag(SPACING[::-1]), "space units": ["mm"] * 3}
    nrrd.write(str(folder / "a.nrrd"), mask.T, {**header, "space origin": [1, 2, 3]})
    yield folder / "a.nrrd", {}
    sitk = pytest.importorskip("SimpleITK")
    stored = sitk.GetImageFromArray(mask)
    stored.SetSpacing(SPACING[::-1])
    sitk.WriteImage(stored, str(folder / "a.mha"))
    yield folder / "a.mha", {}
    (folder / "slices").mkdir()
    for k, plane in enumerate(mask):
        metadata = {"unit": "um", "spacing": 1e3 * SPACING[0]}
        how = {"imagej": True, "resolution": [1e-3 / h for h in SPACING[:0:-1]], "metadata": metadata}
        tifffile.imwrite(folder / "slices" / f"{k:03d}.tif", plane, **how)
    yield folder / "slices", {"spacing": SPACING, "unit": "mm"}
    pytest.importorskip("pydicom")
    from tests.volumes.test_read import write_dicom

    (folder / "dicom").mkdir()
    for k, plane in enumerate(mask.astype(np.uint16)):
        write_dicom(folder / "dicom" / f"{k}.dcm", plane, SPACING[0] * k, spacing=SPACING[1:])
    yield folder / "dicom", {}


def test_one_object_has_the_same_numbers_through_every_format(tmp_path: Path) -> None:
    mask = body()
    whole = curvafit.measure(Volume(mask, SPACING, "mm"), kind="mask")
    seen = set()
    for path, reading in files(tmp_path, mask):
        found = curvafit.measure(path, kind="mask", **reading)
        seen.add(Path(path).name.partition(".")[2] or Path(path).name)
        factor = convert_length(1.0, found.unit, "mm")
        for one, other in zip(found.quantities, whole.quantities, strict=True):
            value = one.value * factor**one.power
            assert value == pytest.approx(other.value, rel=1e-6, abs=1e-9 * abs(other.value), nan_ok=True), (
                path,
                one.name,
            )
    assert len(seen) >= 10
