"""Cases that were handed in: what volume files state of units, grey values, times and types is used or said."""

import json
from pathlib import Path

import h5py
import nibabel
import numpy as np
import pytest
import tifffile
import zarr
from calling import done
from disk import unreadable
from PIL import Image

import curvafit
from curvafit.segmentation.labels import reconstruct_labels
from curvafit.volumes import ScanError, Volume, load, save
from curvafit.volumes.write import check_labels


def numbers(shape: tuple[int, ...] = (4, 5, 6), dtype: str = "uint8") -> np.ndarray:
    return (np.arange(np.prod(shape)) % 200).reshape(shape).astype(dtype)


def imagej(path: Path, values: np.ndarray | None = None, **metadata: object) -> Path:
    values = numbers() if values is None else values
    metadata = {"axes": "ZYX", "unit": "nm", "spacing": 20.0} | metadata
    tifffile.imwrite(path, values, imagej=True, resolution=(0.1, 0.05), metadata=metadata)
    return path


def ome(path: Path, values: np.ndarray | None = None, axes: str = "ZYX", **sizes: object) -> Path:
    values, metadata = numbers() if values is None else values, {"axes": axes, **sizes}
    tifffile.imwrite(path, values, ome=True, photometric="minisblack", metadata=metadata)
    return path


def test_a_calibration(tmp_path: Path) -> None:
    """ImageJ's straight calibration is applied, labels stay whole numbers, and a curved one is said."""
    path, values = tmp_path / "grey.tif", numbers(dtype="uint16")
    for metadata, expected in (
        ({"cf": 0, "c0": -32768, "c1": 1}, values.astype(np.int64) - 32768),
        ({"cf": 0, "c0": 255, "c1": -1}, 255 - values.astype(np.int64)),
        ({"cf": 0, "c0": -10, "c1": 0.5, "zeroclip": True}, np.maximum(values / 2 - 10, 0)),
        ({"cf": 20, "c0": 5, "c1": 7}, values),
        ({"cf": 0, "c0": 0, "c1": 1}, values),
    ):
        field = load(imagej(path, values, vunit="Grey", **metadata))
        assert np.array_equal(field.values, expected) and field.notes == ()
        assert field.values.dtype.kind == ("f" if metadata["c1"] == 0.5 else "i" if expected.min() < 0 else "u")
    field = load(imagej(path, values, cf=4, c0=1.0, c1=2.0, vunit="OD"))
    assert np.array_equal(field.values, values) and "calibration" in field.notes[0]


def test_mrc_bytes(tmp_path: Path) -> None:
    """Bytes of MRC are signed or not by IMOD's stamp, or else by the header's maximum, with a note."""
    mrcfile = pytest.importorskip("mrcfile")
    path, values = tmp_path / "bytes.mrc", (numbers() + 50).astype(np.uint8)
    for flags, greatest, expected, notes in (
        (0, 127, values, 0), (1, 249, values.view(np.int8), 0), (None, 249, values, 1),
        (None, 127, values.view(np.int8), 0),
    ):  # fmt: skip
        with mrcfile.new(path, values.view(np.int8), overwrite=True) as file:
            file.voxel_size, file.header.dmax = 10.0, greatest
        if flags is not None:
            with path.open("r+b") as stream:
                stream.seek(152)
                stream.write((1146047817).to_bytes(4, "little") + flags.to_bytes(4, "little"))
        field = load(path)
        assert np.array_equal(field.values, expected) and field.values.dtype == expected.dtype
        assert sum("bytes" in note for note in field.notes) == notes


def test_times(tmp_path: Path) -> None:
    """A time that a file names is chosen by `time`, or by `channel` where there are no channels; x is never cut."""
    series, sizes = numbers((9, 4, 5, 6), "uint16"), {"PhysicalSizeX": 0.5, "PhysicalSizeZ": 2.0}
    both = np.stack([series[:3], 3 * series[:3]], 2)
    ome(tmp_path / "t.ome.tif", series, "TZYX", **sizes)
    ome(tmp_path / "tc.ome.tif", both, "TZCYX", **sizes)
    tifffile.imwrite(tmp_path / "t.tif", series, imagej=True, metadata={"axes": "TZYX"})
    for name, values, axes in (("t.zarr", series, "tzyx"), ("tc.zarr", np.moveaxis(both, 2, 1), "tczyx")):
        group = zarr.create_group(tmp_path / name, zarr_format=2)
        group.create_array("0", data=values)
        kinds = {"t": "time", "c": "channel"}
        listed = [{"name": axis, "type": kinds.get(axis, "space")} for axis in axes]
        group.attrs["multiscales"] = [{"version": "0.4", "axes": listed, "datasets": [{"path": "0"}]}]
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["data"] = np.moveaxis(series, 0, -1)
        file["data"].attrs["axistags"] = json.dumps({"axes": [{"key": axis} for axis in "zyxt"]})
        file["turned"] = series
        file["turned"].attrs["axistags"] = json.dumps({"axes": [{"key": axis} for axis in "txyz"]})
    image = nibabel.Nifti1Image(both.transpose(4, 3, 1, 0, 2), np.eye(4))
    nibabel.save(image, tmp_path / "tc.nii")
    for name in ("t.ome.tif", "t.tif", "t.zarr", "t.h5::data"):
        for option in ("time", "channel"):
            assert np.array_equal(load(tmp_path / name, **{option: 7}).values, series[7])
            part = load(tmp_path / name, **{option: 7}, lazy=True).read((slice(1, 3),) * 3)
            assert np.array_equal(part, series[7, 1:3, 1:3, 1:3])
        for wrong in ({}, {"time": 9}, {"channel": -1}, {"time": 1, "channel": 1}):
            unreadable(tmp_path / name, "time|channel", **wrong)
    for name in ("tc.ome.tif", "tc.zarr", "tc.nii"):
        field = load(tmp_path / name, time=2, channel=1)
        assert np.array_equal(field.values, both[2, :, 1])
        assert field.notes[:2] == ("Channel 1 is used.", "Time 2 is used.")
        for wrong in ({}, {"time": 1}, {"channel": 1}, {"time": 3, "channel": 0}):
            unreadable(tmp_path / name, "time|channel", **wrong)
    turned = load(tmp_path / "t.h5::turned", time=1)
    assert np.array_equal(turned.values, series[1].T)
    unreadable(save(Volume(numbers()), tmp_path / "plain.tif"), "no axis of times", time=0)


def test_ids_of_instances_in_other_blocks() -> None:
    """Ids are looked for in blocks, of which some have small ones alone: those of 64 bits keep every digit."""
    z, y, x = np.indices((14, 14, 300))
    labels = np.zeros(z.shape, np.uint64)
    for centre, name in ((20, 7), (280, 2**63 + 11)):
        labels[(z - 7) ** 2 + (y - 7) ** 2 + (x - centre) ** 2 < 25] = name
    found = curvafit.measure_instances(labels)
    assert [each.part for each in found] == [("instance", 7), ("instance", 2**63 + 11)]
    assert [each["V"].value for each in found] == [np.count_nonzero(labels == name) for name in (7, 2**63 + 11)]


LOG = """[System]
Scanner=Skyscan1172
[Acquisition]
Image Pixel Size (um)=3.99
[Reconstruction]
Reconstruction Program=NRecon
Pixel Size (um)=7.98
Section to Section Step=2
"""


def test_odd_slices(tmp_path: Path) -> None:
    """Hidden files, NRecon's preview and pictures of another kind among slices are left out; others must be alike."""
    values = numbers((6, 5, 7))
    for name in ("tif", "bmp", "png", "palette", "types", "sizes", "logs"):
        (tmp_path / name).mkdir()
        for k, plane in enumerate(values):
            place = tmp_path / name / f"s{k}"
            if name in ("bmp", "png", "palette"):
                image = Image.fromarray(plane)
                if name == "palette":
                    image = image.convert("P")
                    image.putpalette([255 - grey for grey in range(256) for _ in range(3)])
                image.save(place.with_suffix(".bmp" if name == "palette" else f".{name}"))
            else:
                odd = plane.astype(np.uint16) if (name, k) == ("types", 3) else plane
                edge = 0.5 if (name, k) == ("sizes", 4) else 2.0
                tifffile.imwrite(
                    place.with_suffix(".tif"), odd, imagej=True, resolution=(edge,) * 2, metadata={"unit": "um"}
                )
            (place.parent / f"._s{k}.tif").write_bytes(bytes.fromhex("0005160700020000") + bytes(200))
    for name in ("bmp", "logs"):
        (tmp_path / name / "s_rec.log").write_text(LOG)
    (tmp_path / "bmp" / "s__rec_spr.bmp").write_bytes(b"BM" + bytes(90))
    Image.fromarray(values[0]).save(tmp_path / "tif" / "preview.png")
    for name, expected, edge, note in (
        ("tif", values, 0.5, "preview.png"), ("bmp", values, 7.98, "s_rec.log"), ("png", values, None, "no spacing"),
        ("palette", 255 - values, None, "no spacing"),
    ):  # fmt: skip
        field = load(tmp_path / name)
        assert np.array_equal(field.values, expected) and field.dtype == np.uint8
        step = 2 if name == "bmp" else 1  # its log has every second section
        assert field.spacing == pytest.approx((step * (edge or 1.0), edge or 1.0, edge or 1.0))
        assert field.unit == ("um" if edge else "voxel")
        assert any(note in each for each in field.notes)
    assert any("_spr" in each for each in load(tmp_path / "bmp").notes)
    for options, counts in (({"unit": "mm"}, True), ({"spacing": 5, "unit": "um"}, False)):
        assert any("size is that of s_rec.log" in note for note in load(tmp_path / "bmp", **options).notes) == counts
    for name, word in (("types", "one type"), ("sizes", "one pixel size"), ("logs", "another pixel size")):
        unreadable(tmp_path / name, word)
    (tmp_path / "bmp" / "other.log").write_text("Pixel Size (um)=9")
    unreadable(tmp_path / "bmp", "logs")


def test_numbers_of_slices(tmp_path: Path) -> None:
    """Deep grey levels and few annotated slices are kept; slices of a scan that lacks some are stacked."""
    deep, labels = numbers((3, 5, 7), "uint16") * 200, np.zeros((31, 5, 7), np.uint8)
    labels[[0, 4, 30], 1:3] = np.uint8([1, 2, 3])[:, None, None]
    for name, which, planes in (
        ("deep", (7, 8, 9), deep), ("few", (3, 7, 33), labels[[0, 4, 30]]), ("even", (10, 20, 30), deep),
        ("lost", (1, 2, 5), deep),
    ):  # fmt: skip
        (tmp_path / name).mkdir()
        for number, plane in zip(which, planes, strict=True):
            Image.fromarray(plane).save(tmp_path / name / f"z{number:03d}.png")
    few = load(tmp_path / "few")
    assert np.array_equal(load(tmp_path / "deep").values, deep) and few.notes[0].startswith("3 slices lie")
    assert np.array_equal(few.values, labels)
    assert np.array_equal(load(tmp_path / "even").values, deep) and "step by 10" in load(tmp_path / "even").notes[0]
    assert "after z002" in load(tmp_path / "lost").notes[0]
    unreadable(tmp_path / "lost", "not whole", strict=True)


def test_odd_dicom(tmp_path: Path) -> None:
    """Slices of DICOM that are tilted, turned, zoomed or cut short are refused; without positions it is said."""
    pydicom = pytest.importorskip("pydicom")
    from tests.volumes.test_read import write_dicom

    for name, slices, changes, refusal in (
        ("upright", (), {}, None), ("frames", (0,), {"NumberOfFrames": 3}, "expected"),
        ("tilt", range(4), {"ImageOrientationPatient": [1, 0, 0, 0, 0.965926, -0.258819]}, "above each other"),
        ("turned", (2,), {"ImageOrientationPatient": [1, 0, 0, 0, 0, -1]}, "one ImageOrientationPatient"),
        ("zoomed", (3,), {"PixelSpacing": [0.25, 0.3]}, "one PixelSpacing"),
        ("unplaced", range(4), {"ImagePositionPatient": None, "ImageOrientationPatient": None}, None),
    ):  # fmt: skip
        (tmp_path / name).mkdir()
        for k, plane in enumerate(numbers((4, 6, 7), "uint16")):
            path = tmp_path / name / f"{9 - k}.dcm"
            write_dicom(path, plane, 2.5 * k)
            image = pydicom.dcmread(path)
            image.InstanceNumber = k
            for key, value in changes.items() if k in slices else ():
                delattr(image, key) if value is None else setattr(image, key, value)
            image.save_as(path)
        if refusal:
            unreadable(tmp_path / name, refusal)
    upright, unplaced = load(tmp_path / "upright"), load(tmp_path / "unplaced", spacing=(2.5, 0.5, 0.25), unit="mm")
    assert np.array_equal(unplaced.values, upright.values) and "no position" in unplaced.notes[0]
    assert unplaced.spacing == upright.spacing and upright.notes == ()


def test_units_nobody_knows(tmp_path: Path) -> None:
    """A unit that is not known is no damage: with spacing and unit it is not read, without it is named."""
    sizes = {"PhysicalSizeX": 2.0, "PhysicalSizeY": 2.0, "PhysicalSizeZ": 2.0}
    for path in (
        imagej(tmp_path / "a.tif", unit="um/px"),
        ome(tmp_path / "b.ome.tif", **sizes, **{f"PhysicalSize{axis}Unit": "ly" for axis in "XYZ"}),
    ):
        unreadable(path, rf"{path.name}.*(um/px|ly).*--spacing and --unit")
        assert load(path, spacing=0.5, unit="um").spacing == (0.5, 0.5, 0.5)
        with pytest.raises(ScanError, match="not known"):
            load(path, unit="um")
    for unit, spacing, name, notes in (("pm", 2e-3, "nm", 0), ("cm", 20, "mm", 0), ("reference frame", 2, "voxel", 1)):
        field = load(ome(tmp_path / "c.ome.tif", **sizes, **{f"PhysicalSize{axis}Unit": unit for axis in "XYZ"}))
        assert (field.spacing, field.unit) == (pytest.approx((spacing,) * 3), name)
        assert sum("reference frame" in note for note in field.notes) == notes
    field = load(ome(tmp_path / "zero.ome.tif", PhysicalSizeX=0.0, PhysicalSizeXUnit="mm"))
    assert (field.spacing, field.unit) == ((1, 1, 1), "voxel") and "no spacing" in field.notes[0]
    field = load(ome(tmp_path / "flat.ome.tif", PhysicalSizeX=2.0, PhysicalSizeY=2.0))
    assert field.spacing == (2, 2, 2) and "distance of slices" in field.notes[0]


def test_large_ids(tmp_path: Path) -> None:
    """Ids up to 2⁶⁴ - 1 survive in every format that holds them; the others refuse them before the work."""
    ids = numbers(dtype="uint64") // 30 * np.uint64(2**62) + np.uint64(2**62 - 1)
    for suffix in (".nii.gz", ".tif", ".npy", ".zarr"):
        field = load(save(Volume(ids, (3, 2, 1), "um"), tmp_path / f"ids{suffix}"))
        assert np.array_equal(field.values, ids) and field.values.dtype == np.uint64
        assert suffix == ".npy" or (field.spacing, field.unit) == ((3, 2, 1), "um")
        assert field.label(2**64 - 1).values.sum() == (ids == ids.max()).sum()
    np.savez(tmp_path / "ids.npz", ids=ids)
    with h5py.File(tmp_path / "ids.h5", "w") as file:
        file["ids"] = ids
    assert all(np.array_equal(load(tmp_path / name).values, ids) for name in ("ids.npz", "ids.h5"))
    for suffix in (".ome.tif", ".mrc"):
        with pytest.raises(ScanError, match="at most"):
            save(Volume(ids, 1, "um"), tmp_path / f"refused{suffix}")
        with pytest.raises(ScanError, match="at most"):
            check_labels(tmp_path / f"refused{suffix}", Volume(ids, 1, "um"))
        check_labels(tmp_path / f"small{suffix}", Volume(ids // np.uint64(2**62), 1, "um"))
    assert not list(tmp_path.glob("refused*"))
    # `min_scalar_type` gives the other of C's two types of 64 bits.
    values = (ids % np.uint64(7)).astype(np.min_scalar_type(2**40))
    assert np.array_equal(load(save(values, tmp_path / "other.zarr")).values, values)


def test_types_of_tiff(tmp_path: Path) -> None:
    """TIFF holds 64-bit labels in the least type that does, and float16 as float32."""
    for dtype, kept in (("int64", "uint8"), ("uint64", "uint8"), ("float16", "float32")):
        for name in ("a.tif", "a.ome.tif"):
            field = load(save(Volume(numbers(dtype=dtype), 1, "um"), tmp_path / name))
            assert field.values.dtype == kept and np.array_equal(field.values, numbers())
    low = numbers(dtype="int64") - 100000
    assert load(save(low, tmp_path / "low.ome.tif")).values.dtype == np.int32
    assert np.array_equal(load(save(low * 2**33, tmp_path / "low.tif")).values, low * 2**33)


def test_what_is_nearly_whole_counts_as_whole() -> None:
    """Labels within 1e-3 of whole numbers are labels, and probabilities within 1e-3 of [0, 1] are."""
    z, y, x = np.mgrid[:12, :14, :16]
    labels = np.where((z - 6) ** 2 + (y - 7) ** 2 + (x - 8) ** 2 < 20, 6.0000457763671875, 0.0)
    (body,) = curvafit.measure_instances(labels)
    assert body.part == ("instance", 6)
    assert Volume(labels).label(6).values.sum() == (labels > 0).sum()
    sparse = np.where((z % 3 == 0), labels, 0)
    whole, near = (reconstruct_labels(each, every=3) for each in (np.round(sparse), sparse))
    assert np.array_equal(whole.labels.values, near.labels.values)  # type: ignore[union-attr]
    with pytest.raises(ScanError, match="grey levels"):
        curvafit.measure_instances(labels * 1.1)
    likely = 1 / (1 + np.exp((z - 6) ** 2 + (y - 7) ** 2 + (x - 8) ** 2 - 20.0))
    stray = likely + np.where(z == 0, -1e-4, 0) + np.where((z == 6) & (y == 7), 1e-4, 0)
    masks = [curvafit.segment(each, "tubes", weight=0.1, probabilities=True).mask.values for each in (likely, stray)]
    assert np.count_nonzero(masks[0] != masks[1]) <= 2
    with pytest.raises(ScanError, match=r"\[0, 1\]"):
        curvafit.segment(likely * 1.01, "tubes", weight=0.1, probabilities=True)


IDS = (864691135000000017, 864691135000000033)


def bodies(ids: tuple[int, int], kind: type) -> np.ndarray:
    z, y, x = np.mgrid[:17, :28, :28]
    one, other = (y - 8 - 0.2 * z) ** 2 + (x - 8) ** 2 < 30, (y - 20) ** 2 + (x - 20 + 0.2 * z) ** 2 < 30
    return np.where(one, kind(ids[0]), np.where(other, kind(ids[1]), kind(0)))


@pytest.mark.parametrize(
    ("ids", "kind", "chosen"),
    [
        (IDS, np.uint64, ",".join(map(str, IDS))), ((2**64 - 2, 2**64 - 1), np.uint64, "all"), (IDS, np.int64, "all"),
        ((3, 7), np.uint64, "3,7"),
    ],
)  # fmt: skip
def test_64_bit_ids_stay(ids: tuple[int, int], kind: type, chosen: str, tmp_path: Path) -> None:
    truth, out = bodies(ids, kind), tmp_path / "out.npy"
    np.save(tmp_path / "labels.npy", np.where((np.arange(17) % 8 == 0)[:, None, None], truth, kind(0)))
    done("reconstruct", tmp_path / "labels.npy", "--every", 8, "--labels", chosen, "-o", out)
    found = np.load(out)
    assert found.dtype.kind in "iu" and np.unique(found).tolist() == [0, *ids]
    assert np.array_equal(found[::8], truth[::8])
    assert found.dtype == (kind if ids[0] > 255 else np.uint8)


TAGS = [(42113, "s", 0, "-9999", True)]


def test_what_was_not_measured(tmp_path: Path) -> None:
    """GDAL's value is said, also where the values' type does not hold it."""
    for name, kind in (("a", "int16"), ("b", "uint8")):
        values = numbers((4, 5, 6), kind)
        tifffile.imwrite(tmp_path / f"{name}.tif", values, extratags=TAGS, photometric="minisblack")
        field = load(tmp_path / f"{name}.tif", spacing=1.0)
        assert np.array_equal(field.values, values) and any("-9999" in note for note in field.notes)


def test_lengths_of_hdf5(tmp_path: Path) -> None:
    """CREMI's resolution and offset, a size for an axis of channels, names that disagree, and one that is not used."""
    values = numbers((3, 4, 5), "uint16")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, attributes in (
            ("cremi", {"resolution": (40.0, 4.0, 4.0), "offset": (80.0, 8.0, 0.0), "unit": "nm"}),
            ("four", {"element_size_um": (1.0, 0.5, 0.25, 0.125)}),
            ("odd", {"pixel_size_mm": 3.0}), ("both", {"axistags": json.dumps({"axes": [{"key": k} for k in "zyx"]})}),
        ):  # fmt: skip
            file[name] = values[None] if name == "four" else values
            file[name].attrs.update(attributes)
        file["both"].dims[0].label, file["both"].dims[2].label = "x", "z"
    cremi, four, odd = (load(tmp_path / f"a.h5::{name}") for name in ("cremi", "four", "odd"))
    assert cremi.spacing == (40, 4, 4) and cremi.unit == "nm" and cremi.affine[:3, 3].tolist() == [0, 8, 80]  # type: ignore[index]
    assert four.spacing == (0.5, 0.25, 0.125) and four.unit == "um"
    assert odd.unit == "voxel" and any("pixel_size_mm" in note for note in odd.notes)
    unreadable(tmp_path / "a.h5::both", "axistags")
