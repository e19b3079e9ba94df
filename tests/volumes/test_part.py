"""Channels, labels and crops are the same voxels at the same place in every format; `lay` finds them in every pose."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import nibabel
import numpy as np
import pytest
import tifffile
import zarr
from disk import unreadable
from hypothesis import given, settings
from hypothesis import strategies as st

from curvafit.scan.structure import read_region
from curvafit.volumes import ScanError, Volume, load, save
from curvafit.volumes.volume import lay, parse_box

SHAPE = (6, 7, 8)
VALUES = np.arange(np.prod(SHAPE), dtype=np.float32).reshape(SHAPE)
#: Three channels: what is read of the second must be VALUES.
CHANNELS = np.stack([VALUES + 1000, VALUES, VALUES - 1000])
TURNED = np.array([[0, -0.2, 0, 5.0], [0.1, 0, 0, -7.0], [0, 0, 0.3, 11.0], [0, 0, 0, 1]])


# ---- channels --------------------------------------------------------------------------------------------------------


LAST = np.moveaxis(CHANNELS, 0, -1)


def tiff(values: np.ndarray, axes: str | None = None, **options: object) -> Callable[[Path], None]:
    options = {"photometric": "minisblack", **options, **({"metadata": {"axes": axes}} if axes else {})}
    return lambda path: tifffile.imwrite(path, values, **options)  # type: ignore[arg-type]


def write_rgb_slices(path: Path) -> None:
    path.mkdir()
    for z, plane in enumerate(LAST.astype(np.uint16)):
        tiff(plane, photometric="rgb")(path / f"{z}.tif")


def nifti(values: np.ndarray) -> Callable[[Path], None]:
    return lambda path: nibabel.save(nibabel.Nifti1Image(values.T, np.diag([0.1, 0.2, 0.3, 1])), path)


def nrrd(values: np.ndarray, **header: object) -> Callable[[Path], None]:
    return lambda path: pytest.importorskip("nrrd").write(str(path), values, header, index_order="C")


def metaimage(values: np.ndarray, vector: bool, edges: tuple[float, ...]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        itk = pytest.importorskip("SimpleITK")
        image = itk.GetImageFromArray(values, isVector=vector)
        image.SetSpacing(edges)
        itk.WriteImage(image, str(path))

    return write


def write_ome_zarr(path: Path) -> None:
    axes = [{"name": "c", "type": "channel"}, *({"name": n, "type": "space", "unit": "millimeter"} for n in "zyx")]
    scale = [{"type": "scale", "scale": [1, 0.3, 0.2, 0.1]}]
    image = {"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": scale}]}
    group = zarr.create_group(path, attributes={"ome": {"version": "0.5", "multiscales": [image]}})
    group.create_array("0", data=CHANNELS, chunks=(1, 4, 4, 4))


DIRECTIONS = np.array([[np.nan] * 3, [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]])
PLACED = {"space": "right-anterior-superior", "space directions": DIRECTIONS, "space origin": [0, 0, 0]}
CHANNELLED: dict[str, tuple[str, Callable[[Path], None]]] = {
    "ome-tiff": ("scan.ome.tif", tiff(CHANNELS, "CZYX", ome=True)),
    "imagej": ("scan.tif", tiff(np.moveaxis(CHANNELS, 0, 1), "ZCYX", imagej=True)),
    "rgb": ("rgb.tif", tiff(LAST.astype(np.uint16), photometric="rgb")), "rgb slices": ("slices", write_rgb_slices),
    "nifti": ("scan.nii", nifti(CHANNELS)), "nifti.gz": ("scan.nii.gz", nifti(CHANNELS)),
    "vector nifti": ("scan.nii", nifti(CHANNELS[:, None])),
    "nrrd": ("scan.nrrd", nrrd(LAST, **PLACED, kinds=["vector", *["domain"] * 3])),
    "nrrd kinds": ("scan.nrrd", nrrd(CHANNELS, kinds=[*["domain"] * 3, "list"])),
    "mha": ("scan.mha", metaimage(LAST, True, (0.1, 0.2, 0.3))),
    "mha times": ("scan.mha", metaimage(CHANNELS, False, (1.0,) * 4)), "ome-zarr": ("scan.ome.zarr", write_ome_zarr),
    "hdf5": ("scan.h5", lambda path: h5py.File(path, "w").create_dataset("raw", data=LAST).file.close()),
    "npy": ("scan.npy", lambda path: np.save(path, CHANNELS)),
    "npy, fortran": ("scan.npy", lambda path: np.save(path, np.asfortranarray(CHANNELS))),
    "npz": ("scan.npz", lambda path: np.savez(path, LAST)),
}  # fmt: skip


@pytest.mark.parametrize("kind", CHANNELLED)
def test_a_channel_is_read_of_every_format(tmp_path: Path, kind: str) -> None:
    name, write = CHANNELLED[kind]
    path = tmp_path / name
    write(path)
    whole = load(path, channel=1)
    assert np.array_equal(whole.values, VALUES)
    assert "Channel 1 is used." in whole.notes
    if whole.unit == "mm" and whole.spacing != (1, 1, 1):
        assert whole.spacing == pytest.approx((0.3, 0.2, 0.1))
    part = load(path, channel=1, crop="1:5,:,-3:-1")
    assert np.array_equal(part.values, VALUES[1:5, :, -3:-1])
    assert part.spacing == whole.spacing and part.affine is not None
    unreadable(path, "channel", channel=3)
    unreadable(path, "channel")


def test_a_file_of_one_channel_has_none_to_choose(tmp_path: Path) -> None:
    path = save(Volume(VALUES), tmp_path / "scan.nii.gz")
    unreadable(path, "channel", channel=0)
    np.save(tmp_path / "scan.npy", CHANNELS)
    for wrong in (-1, 1.5, True, "1"):
        with pytest.raises(ValueError, match="channel"):
            load(tmp_path / "scan.npy", channel=wrong)  # type: ignore[arg-type]
    np.save(tmp_path / "five.npy", np.zeros((2, 2, *SHAPE)))
    unreadable(tmp_path / "five.npy", "channel|5D", channel=0)


def test_channels_without_slices_are_said_to_be_taken_for_them(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "scan.tif", VALUES, ome=True, photometric="minisblack", metadata={"axes": "CYX"})
    field = load(tmp_path / "scan.tif")
    assert np.array_equal(field.values, VALUES)
    assert "The file calls an axis of 6 channels: it is taken for slices." in field.notes


# ---- crops -----------------------------------------------------------------------------------------------------------

WRITTEN = ("scan.nii", "scan.nii.gz", "scan.tif", "scan.npy", "scan.zarr", "scan.h5", "scan.raw", "scan.npz")


def written(path: Path) -> tuple[Path, dict]:
    """The volume in a file of this name, and the options that read it."""
    if path.suffix == ".h5":
        h5py.File(path, "w").create_dataset("raw", data=VALUES, chunks=(2, 3, 4)).file.close()
    elif path.suffix == ".raw":
        VALUES.tofile(path)
        return path, {"raw_shape": SHAPE, "dtype": "f4"}
    elif path.suffix == ".npz":
        np.savez(path, raw=VALUES)
    else:
        save(Volume(VALUES, (0.3, 0.2, 0.1), "mm", TURNED[:, [1, 0, 2, 3]] if ".nii" in path.name else None), path)
    return path, {}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_crop_is_where_it_was_in_the_whole_or_refused(tmp_path: Path, name: str) -> None:
    path, options = written(tmp_path / name)
    whole = load(path, **options)
    box = (slice(2, 5), slice(1, 4), slice(3, None))
    for part in (load(path, crop="2:5,1:4,3:", **options), load(path, crop=box, **options), whole.crop(box)):
        assert np.array_equal(part.values, VALUES[box])
        assert (part.spacing, part.unit) == (whole.spacing, whole.unit)
        assert "Voxels 2:5, 1:4, 3:8 (z, y, x) are used." in part.notes
        image = nibabel.load(save(part, tmp_path / "part.nii"))
        full = nibabel.load(save(whole, tmp_path / "whole.nii"))
        assert image.affine @ [0, 1, 2, 1] == pytest.approx(full.affine @ [3, 2, 4, 1], rel=1e-5)
        assert np.asanyarray(image.dataobj)[0, 1, 2] == np.asanyarray(full.dataobj)[3, 2, 4]
    for crop in ("0:7,:,:", ":,3:3,:", ":,:,5:2", ":,:,-9:"):
        unreadable(path, "crop", crop=crop, **options)


edges = st.integers(-9, 9) | st.none()
texts = st.tuples(*[st.tuples(edges, edges)] * 3)


@given(texts)
@settings(max_examples=100, deadline=None)
def test_a_crop_is_what_python_s_slices_are_or_refused(ends) -> None:
    text = ",".join(":".join("" if edge is None else str(edge) for edge in pair) for pair in ends)
    slices = tuple(slice(*pair) for pair in ends)
    assert parse_box(text) == slices == parse_box(slices)
    of_numpy = tuple(slice(*(None if edge is None else np.int64(edge) for edge in pair)) for pair in ends)
    assert parse_box(of_numpy) == slices
    try:
        part = Volume(VALUES).crop(text)
    except ScanError as error:
        assert "crop" in str(error)
        return
    assert np.array_equal(part.values, VALUES[slices]) and part.values.size


def test_what_is_no_crop_is_refused() -> None:
    for crop in ("", "1:2", "1:2,3:4", "1:2,3:4,5", "a:b,:,:", "::2,:,:", (slice(0, 4, 2),) * 3, 3.5):
        with pytest.raises(ScanError, match="crop"):
            load(VALUES, crop=crop)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["scan.nii", "scan.npy", "scan.raw", "scan.zarr", "scan.h5"])
def test_no_more_than_the_crop_needs_memory_and_a_cut_file_is_refused(tmp_path: Path, name: str, monkeypatch) -> None:
    path, options = written(tmp_path / name)
    monkeypatch.setattr("curvafit.volumes.formats.base.memory", lambda: VALUES.nbytes // 2)
    part = load(path, crop="0:2,:,:", **options)
    assert np.array_equal(part.values, VALUES[:2])
    if name != "scan.raw":
        unreadable(path, "memory", **options)
    if path.suffix in (".nii", ".npy", ".raw"):  # a file that is cut is refused whatever the crop
        path.write_bytes(path.read_bytes()[:-8])
        unreadable(path, "cannot be read|bytes", crop="0:2,:,:", **options)


@pytest.mark.parametrize("label", range(4))
def test_a_label_is_a_mask(tmp_path: Path, label: int) -> None:
    labels = np.random.default_rng(0).integers(0, 4, SHAPE).astype(np.uint8)
    path = save(labels, tmp_path / "labels.nii.gz")
    for mask in (load(path, label=label), load(labels, label=label), Volume(labels).label(label)):
        assert mask.values.dtype == bool and np.array_equal(mask.values, labels == label)
        assert f"The structure is label {label}." in mask.notes


def test_a_label_that_is_not_there_is_told_those_that_are() -> None:
    labels = np.where(VALUES > 200, 7, np.where(VALUES < 56, 0, 3))
    for label, crop, word in ((5, None, "0, 3, 7"), (7, ":3,:,:", "0, 3"), (0.5, None, "label")):
        with pytest.raises(ValueError, match=word):
            load(labels, label=label, crop=crop)  # type: ignore[arg-type]


# ---- places ----------------------------------------------------------------------------------------------------------


EXTENT, H = (5, 6, 7), 0.02
LABELS = np.random.default_rng(0).integers(0, 2**40, EXTENT) * 2**20 + 1
AFFINE = np.array([[H, 0, 0, 1], [0, H, 0, 2], [0, 0, H, 3], [0, 0, 0, 1.0]])
SCAN = Volume(np.zeros(EXTENT, np.uint8), H, "mm", AFFINE)


def world(values: np.ndarray, matrix: np.ndarray, origin: np.ndarray, unit: str = "mm") -> Volume:
    """Return values whose voxel i (x, y, z) lies at `matrix` i + `origin`."""
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = matrix, origin
    return Volume(values, tuple(np.linalg.norm(matrix, axis=0)[::-1]), unit, affine)


@pytest.mark.parametrize("axes", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("signs", list(itertools.product((1, -1), repeat=3)))
def test_a_volume_is_itself_in_every_pose(axes: tuple[int, ...], signs: tuple[int, ...]) -> None:
    turned = LABELS.transpose(axes)[tuple(slice(None, None, sign) for sign in signs)]
    steps = H * np.eye(3)[2 - np.array(axes)]  # where one along each axis of an unmirrored array leads, x first
    lengths = (np.array(signs) < 0) * (np.array(EXTENT)[list(axes)] - 1)
    columns = (np.array(signs)[:, None] * steps)[::-1].T
    field = world(turned, columns, AFFINE[:3, 3] + lengths @ steps)
    laid, notes = lay(field, SCAN, "the region", "the scan", exact=True)
    assert (laid.values == LABELS).all() and laid.values.dtype == LABELS.dtype
    assert bool(notes) == (axes != (0, 1, 2) or signs != (1, 1, 1))


def test_a_shift_leaves_zeros_beyond_and_a_unit_converts() -> None:
    origin = AFFINE[:3, 3] + [H, 0, 0]
    for field in (world(LABELS, H * np.eye(3), origin), world(LABELS, 1000 * H * np.eye(3), 1000 * origin, "um")):
        laid, (note,) = lay(field, SCAN, "the region", "the scan")
        assert (laid.values[..., 1:] == LABELS[..., :-1]).all() and not laid.values[..., 0].any()
        assert (laid.unit, laid.spacing) == ("mm", (H, H, H))
        assert "beyond" in note
        with pytest.raises(ScanError, match="covers"):
            lay(field, SCAN, "the image", "the slices", exact=True)
    with pytest.raises(ScanError, match="covers 0%"):
        lay(world(LABELS, H * np.eye(3), AFFINE[:3, 3] + 7 * H), SCAN, "the region", "the scan")


@pytest.mark.parametrize("factor", [2, 0.5])
def test_labels_on_other_voxels_are_those_of_the_nearest(factor: float) -> None:
    """The corners of the two boxes coincide: a coarse voxel is eight fine ones, of fine ones each second counts."""
    fine = LABELS.repeat(2, 0).repeat(2, 1).repeat(2, 2)
    values, shape = (LABELS, fine.shape) if factor == 2 else (fine, EXTENT)
    scan = Volume(np.zeros(shape, np.uint8), H, "mm", AFFINE)
    corner = AFFINE[:3, 3] + (factor - 1) / 2 * H
    laid, (note,) = lay(world(values, factor * H * np.eye(3), corner), scan, "the region", "the scan")
    assert (laid.values == (fine if factor == 2 else LABELS)).all()
    assert "nearest" in note
    with pytest.raises(ScanError, match="resample"):
        lay(world(values, factor * H * np.eye(3), corner), scan, "the image", "the slices", exact=True)


def test_a_turn_by_a_few_degrees_takes_the_nearest() -> None:
    """A ball about the middle stays the ball."""
    z, y, x = np.indices((21,) * 3) - 10
    ball = (z**2 + y**2 + x**2 < 50).astype(np.uint8)
    c, s = np.cos(0.2), np.sin(0.2)
    turn = H * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    middle = AFFINE[:3, 3] + 10 * H
    field, scan = world(ball, turn, middle - turn @ [10, 10, 10]), Volume(ball, H, "mm", AFFINE)
    laid, _ = lay(field, scan, "the region", "the scan")
    assert np.count_nonzero(laid.values != ball) < 0.1 * ball.sum()  # of 1357 voxels 420 lie at the surface


@pytest.mark.parametrize("placed", ["field", "scan", "neither", "voxels"])
def test_without_a_place_equal_shapes_go_voxel_by_voxel(placed: str) -> None:
    """A place in voxels says nothing of one in mm where the voxels are not as long."""
    field = Volume(LABELS, H, "mm", AFFINE if placed == "field" else None)
    scan = Volume(np.zeros(EXTENT), H, "mm", None if placed in ("field", "neither") else AFFINE)
    if placed == "voxels":
        field = Volume(LABELS, 1.0, "voxel", np.eye(4))
    laid, notes = lay(field, scan, "the region", "the scan")
    assert laid.values is field.values
    assert ["voxel by voxel" in note for note in notes] == [True] * (placed != "neither")
    with pytest.raises(ScanError, match="shape"):
        lay(Volume(LABELS[1:], field.spacing, field.unit, field.affine), scan, "the region", "the scan")


@pytest.mark.parametrize("placed", ["both", "scan", "region", "neither"])
def test_a_region_of_a_cropped_scan_is_cropped_alike(placed: str) -> None:
    """By the affines, or with the scan where one of them has none; a crop has an affine of its own."""
    scan = replace(SCAN, affine=AFFINE if placed in ("both", "scan") else None)
    region = Volume(LABELS, H, "mm", AFFINE if placed in ("both", "region") else None)
    if placed == "both":
        turned = AFFINE @ np.diag([-1.0, 1, 1, 1])
        turned[0, 3] += (EXTENT[2] - 1) * H
        region = Volume(LABELS[..., ::-1], H, "mm", turned)
    crop = "1:4,2:,:-1"
    laid, notes = read_region(region, scan.crop(crop), scan, crop)
    assert (laid.values == LABELS[1:4, 2:, :-1]).all()
    assert bool(notes) == (placed != "neither")
