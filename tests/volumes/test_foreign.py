"""Files that other programs wrote hold the same values at the same places in the world here, and back out again."""

import json
import locale
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import h5py
import nibabel
import numpy as np
import pytest
import tifffile
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from curvafit.core.units import convert_length
from curvafit.volumes import Volume, load, save

sitk = pytest.importorskip("SimpleITK")
mrcfile, nrrd = pytest.importorskip("mrcfile"), pytest.importorskip("nrrd")
LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
TYPES = ("uint8", "int16", "uint16", "float32", "float64")
ORDERS = ("zyx", "zxy", "yzx", "yxz", "xzy", "xyz")


class Case:
    """A random array (z, y, x) of a seed, its steps, origin and turned axes (columns of `affine`, x first)."""

    def __init__(self, seed: int, turned: bool = True) -> None:
        self.rng = np.random.default_rng(seed)
        self.shape = tuple(self.rng.integers(2, 7, 3).tolist())
        self.values = self.rng.integers(0, 120, self.shape).astype(self.rng.choice(TYPES))
        self.values.flat[0] += 1 + self.values.max()  # it varies
        self.steps = np.round(self.rng.uniform(0.2, 3, 3), 3)  # z, y, x
        self.origin = np.round(self.rng.uniform(-40, 40, 3), 3)
        axes, upper = np.linalg.qr(self.rng.normal(size=(3, 3)))
        self.axes = axes * np.sign(np.diag(upper)) * self.rng.choice([-1, 1], 3) if turned else np.eye(3)
        self.order = str(self.rng.choice(ORDERS))
        self.affine = np.eye(4)
        self.affine[:3, :3], self.affine[:3, 3] = self.axes * self.steps[::-1], self.origin[::-1]

    def stored(self) -> np.ndarray:
        """The array with its axes in another order."""
        return np.ascontiguousarray(self.values.transpose(["zyx".index(axis) for axis in self.order]))

    def along(self, numbers: Any) -> list[float]:
        """Numbers along z, y and x, in that order."""
        return [float(numbers["zyx".index(axis)]) for axis in self.order]


def check(found: Volume, values: np.ndarray, affine: np.ndarray, unit: str, rel: float = 1e-5) -> None:
    """Each voxel's value lies where the foreign reader has it, in its unit, in the world (x to the right, y, z)."""
    assert found.affine is not None
    factor = convert_length(1.0, found.unit, unit)
    indices = np.argwhere(np.ones(values.shape, dtype=bool))[:, ::-1]
    world = affine[:3, :3] @ indices.T + affine[:3, 3:]
    back = np.linalg.solve(factor * found.affine[:3, :3], world - factor * found.affine[:3, 3:])
    assert np.abs(back - np.rint(back)).max() < 1e-2
    x, y, z = np.rint(back).astype(int)
    assert min(x.min(), y.min(), z.min()) >= 0 and found.shape == (z.max() + 1, y.max() + 1, x.max() + 1)
    np.testing.assert_array_equal(found.values[z, y, x], values.ravel())
    lengths = np.linalg.norm(factor * found.affine[:3, :3], axis=0)
    np.testing.assert_allclose(lengths[::-1], factor * np.array(found.spacing), rtol=rel)


def placed(field: Volume) -> Volume:
    """The volume, at the origin if it states no place."""
    return replace(field, affine=np.diag([*field.spacing[::-1], 1.0])) if field.affine is None else field


def image_of(case: Case) -> Any:
    """The case as an image of ITK, whose world is left, posterior, superior in mm."""
    image = sitk.GetImageFromArray(case.values)
    image.SetSpacing(case.steps[::-1].tolist())
    image.SetOrigin(case.origin[::-1].tolist())
    image.SetDirection(case.axes.ravel().tolist())
    return image


def itk_affine(image: Any) -> np.ndarray:
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return LPS @ affine


def by_itk(suffix: str) -> Callable[[Case, Path], None]:
    def check_file(case: Case, folder: Path) -> None:
        path = folder / f"a{suffix}"
        sitk.WriteImage(image_of(case), str(path))
        seen = sitk.ReadImage(str(path))
        check(load(path), sitk.GetArrayFromImage(seen), itk_affine(seen), "mm")

    return check_file


def nifti(case: Case, folder: Path) -> None:
    """Any unit, and places by either form."""
    unit, ours = [("mm", "mm"), ("micron", "um"), ("meter", "m")][case.rng.integers(3)]
    image = nibabel.Nifti1Image(case.values.T, case.affine)
    image.header.set_xyzt_units(unit)
    if case.rng.random() < 0.5:
        image.set_qform(case.affine, code=1)
        image.set_sform(None, code=0)
    nibabel.save(image, folder / "a.nii.gz")
    seen = nibabel.load(folder / "a.nii.gz")
    check(load(folder / "a.nii.gz"), np.asanyarray(seen.dataobj).T, seen.affine, ours)  # type: ignore[attr-defined]


#: Worlds, and the signs by which they are right, anterior, superior.
WORLDS = {"left-posterior-superior": (-1, -1, 1), "RAS": (1, 1, 1), "left-anterior-superior": (-1, 1, 1)}


def nrrd_file(case: Case, folder: Path) -> None:
    """Worlds of all names, and a unit for each axis."""
    space = str(case.rng.choice(list(WORLDS)))
    header = {"space": space, "space directions": case.affine[:3, :3].T, "space origin": case.affine[:3, 3]}
    nrrd.write(str(folder / "a.nrrd"), case.values.T, {**header, "space units": ["um"] * 3})
    values, seen = nrrd.read(str(folder / "a.nrrd"))
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = np.transpose(seen["space directions"]), seen["space origin"]
    check(load(folder / "a.nrrd"), values.T, np.diag([*WORLDS[space], 1.0]) @ affine, "um")


def mrc(case: Case, folder: Path) -> None:
    """Columns, rows and sections along any axes, which start somewhere or have an origin; lengths in Å."""
    values = case.stored().astype(np.float32)
    with mrcfile.new(folder / "a.mrc", values) as file:
        file.header.maps, file.header.mapr, file.header.mapc = ("xyz".index(axis) + 1 for axis in case.order)
        sizes = dict(zip(case.order, values.shape, strict=True))
        file.header.mx, file.header.my, file.header.mz = (sizes[axis] for axis in "xyz")
        file.header.cella = tuple(sizes[axis] * h for axis, h in zip("xyz", case.steps[::-1], strict=True))
        if placed_by_origin := case.rng.random() < 0.5:
            file.header.origin = tuple(case.origin[::-1])
        else:
            start = case.rng.integers(-9, 9, 3)
            file.header.nxstart, file.header.nystart, file.header.nzstart = start
    corner = case.origin[::-1] if placed_by_origin else None
    if corner is None:
        starts = dict(zip(case.order[::-1], start, strict=True))  # of columns, rows and sections
        corner = np.array([starts[axis] for axis in "xyz"]) * case.steps[::-1]
    affine = np.diag([*case.steps[::-1], 1.0])
    affine[:3, 3] = corner
    check(placed(load(folder / "a.mrc")), case.values.astype(np.float32), affine, "angstrom")


def ome_tiff(case: Case, folder: Path) -> None:
    """Sizes in a unit of each axis, and channels and times in any place."""
    units = dict(zip("ZYX", case.rng.choice(["µm", "nm", "mm"], 3), strict=True))
    metadata = {f"PhysicalSize{axis}": h for axis, h in zip("ZYX", case.steps, strict=True)}
    metadata |= {f"PhysicalSize{axis}Unit": unit for axis, unit in units.items()}
    axes = str(case.rng.choice(["ZYX", "CZYX", "ZCYX", "TZCYX"]))
    shape = [dict(zip("ZYXCT", (*case.shape, 2, 2), strict=True))[axis] for axis in axes]
    values = np.zeros(shape, case.values.dtype)
    values[tuple(1 if axis in "CT" else slice(None) for axis in axes)] = case.values
    path = folder / "a.ome.tif"
    tifffile.imwrite(path, values, photometric="minisblack", metadata={"axes": axes, **metadata})
    found = load(path, channel=1 if "C" in axes else None, time=1 if "T" in axes else None)
    np.testing.assert_array_equal(found.values, case.values)
    edges = [convert_length(h, units[axis], found.unit) for axis, h in zip("ZYX", case.steps, strict=True)]
    np.testing.assert_allclose(found.spacing, edges, rtol=1e-6)


def ome_zarr(case: Case, folder: Path) -> None:
    """Axes in any order, with scales and places in a unit of each, of both versions."""
    old, units = case.rng.random() < 0.5, dict(zip("zyx", ("micrometer", "nanometer", "millimeter"), strict=True))
    group = zarr.create_group(folder / "a.zarr", zarr_format=2 if old else 3)
    group.create_array("0", data=case.stored())
    axes = [{"name": axis, "type": "space", "unit": units[axis]} for axis in case.order]
    steps = [{"type": "scale", "scale": case.along(case.steps)}]
    steps += [{"type": "translation", "translation": case.along(case.origin)}]
    image = {"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": steps}], "version": "0.4"}
    group.attrs.update({"multiscales": [image]} if old else {"ome": {"version": "0.5", "multiscales": [image]}})
    found = load(folder / "a.zarr")
    by = [convert_length(1.0, units[axis], found.unit) for axis in "zyx"]
    affine = np.diag([*(case.steps * by)[::-1], 1.0])
    affine[:3, 3] = (case.origin * by)[::-1]
    check(found, case.values, affine, found.unit)


def hdf5(case: Case, folder: Path) -> None:
    """Axes by ilastik's tags or the dimensions' labels, and sizes in um."""
    with h5py.File(folder / "a.h5", "w") as file:
        data = file.create_dataset("a", data=case.stored())
        if case.rng.random() < 0.5:
            tags = [
                {"key": axis, "resolution": h, "description": "um"}
                for axis, h in zip(case.order, case.along(case.steps), strict=True)
            ]
            data.attrs["axistags"] = json.dumps({"axes": tags})
        else:
            data.attrs["element_size_um"] = case.along(case.steps)
            for axis, name in enumerate(case.order):
                data.dims[axis].label = name
    found = load(folder / "a.h5")
    check(placed(found), case.values, np.diag([*case.steps[::-1], 1.0]), "um")


def dicom(case: Case, folder: Path) -> None:
    """A series that ITK writes slice by slice, and reads back."""
    values = case.values.astype(np.int16)
    image = image_of(case)
    axes = case.axes if np.linalg.det(case.axes) > 0 else case.axes * [1, 1, -1]  # slices go up their normal
    (folder / "d").mkdir()
    writer, uid = sitk.ImageFileWriter(), f"1.2.826.0.1.3680043.2.1125.{uuid4().int % 10**9}"
    writer.KeepOriginalImageUIDOn()
    for k in case.rng.permutation(len(values)):
        plane = sitk.GetImageFromArray(values[k : k + 1])
        plane.SetSpacing(image.GetSpacing())
        first = case.affine[:3, 3] + k * axes[:, 2] * case.steps[0]
        text = "\\".join(f"{x:.8f}" for x in first)
        plane.SetMetaData("0020|0032", text)
        plane.SetMetaData("0020|0037", "\\".join(f"{x:.8f}" for x in axes[:, :2].T.ravel()))
        plane.SetMetaData("0020|000e", uid)
        plane.SetMetaData("0020|0013", str(k))
        plane.SetMetaData("0008|0060", "CT")
        writer.SetFileName(str(folder / "d" / f"{k}.dcm"))
        writer.Execute(plane)
    files = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder / "d"))
    seen = sitk.ReadImage(files)
    check(load(folder / "d"), sitk.GetArrayFromImage(seen), itk_affine(seen), "mm", 1e-3)


@pytest.fixture(autouse=True)
def kept_locale() -> Iterator[None]:
    """GDCM takes the environment's locale, in which Python would read its own sources as ASCII."""
    before = locale.setlocale(locale.LC_ALL)
    yield
    locale.setlocale(locale.LC_ALL, before)


READERS = {
    "nii.gz of ITK": by_itk(".nii.gz"),
    "nrrd of ITK": by_itk(".nrrd"),
    "mha": by_itk(".mha"),
    "mhd": by_itk(".mhd"),
}
READERS |= {"nii.gz": nifti, "nrrd": nrrd_file, "mrc": mrc, "ome.tif": ome_tiff, "zarr": ome_zarr, "h5": hdf5}
READERS |= {"dicom": dicom}


@pytest.mark.parametrize("name", READERS)
def test_a_foreign_file_has_its_values_where_its_own_reader_has_them(name: str, tmp_path_factory) -> None:
    turned = name not in ("mrc", "ome.tif", "zarr", "h5")

    @settings(max_examples=25, deadline=None, derandomize=True)
    @given(st.integers(0, 2**32 - 1))
    def run(seed: int) -> None:
        READERS[name](Case(seed, turned), tmp_path_factory.mktemp("foreign"))

    run()


@pytest.mark.parametrize("suffix", ["nii.gz", "nii", "zarr", "mrc", "ome.tif", "tif"])
def test_what_is_written_is_where_it_was_for_a_foreign_reader(suffix: str, tmp_path: Path) -> None:
    """NIfTI holds turned axes, Zarr and MRC a corner, TIFF the sizes of voxels alone."""
    for seed in range(12):
        case = Case(seed, turned=suffix.startswith("nii"))
        path = save(Volume(case.values, tuple(case.steps.tolist()), "um", case.affine), tmp_path / f"{seed}.{suffix}")
        if suffix.startswith("nii"):
            image: Any = nibabel.load(path)
            values, affine = np.asanyarray(image.dataobj).T, image.affine
            assert image.header.get_xyzt_units()[0] == "micron"
        elif suffix == "zarr":
            group = zarr.open_group(path, mode="r")
            scale, *more = group.attrs["ome"]["multiscales"][0]["datasets"][0]["coordinateTransformations"]  # type: ignore[index,call-overload]
            values, affine = np.asarray(group["0"]), np.diag([*scale["scale"][::-1], 1.0])
            affine[:3, 3] = more[0]["translation"][::-1]
        elif suffix == "mrc":
            with mrcfile.open(path) as file:
                values, sizes, corner = file.data.copy(), file.voxel_size, file.header.origin
            affine = np.diag([*(float(sizes[axis]) / 1e4 for axis in "xyz"), 1.0])
            affine[:3, 3] = [float(corner[axis]) / 1e4 for axis in "xyz"]
        else:
            values = tifffile.imread(path)
            affine = case.affine * [1, 1, 1, 0] + np.diag([0, 0, 0, 1])
            with tifffile.TiffFile(path) as file:
                stated = file.ome_metadata or file.imagej_metadata
            assert stated and str(case.steps[0]) in str(stated)
        np.testing.assert_array_equal(values, case.values)
        np.testing.assert_allclose(affine[:3, :3], case.affine[:3, :3], rtol=1e-5, atol=1e-6)
        if not suffix.endswith("tif"):
            np.testing.assert_allclose(affine[:3, 3], case.affine[:3, 3], rtol=1e-5, atol=1e-6)
        again = load(path)
        scale = convert_length(1.0, "um", again.unit)
        assert again.spacing == pytest.approx(scale * case.steps, rel=1e-6)
