"""A small volume in every format that can be read, and where in its bytes damage can be noticed."""

from __future__ import annotations

import gzip
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SHAPE = (9, 10, 12)
SPACING = (0.3, 0.2, 0.1)

#: First and last (not included) byte of the parts in which a flipped bit can be noticed.
Parts = list[tuple[int, int]]


class Format(NamedTuple):
    """How a volume is written, and which of its bytes something vouches for."""

    write: Callable[[np.ndarray, Path], None]
    vouched: Callable[[Path], Parts]
    kind: str = "uint16"


def truth(kind: str = "uint16") -> np.ndarray:
    """Values without a pattern, so that no two slices are alike."""
    return np.random.default_rng(7).integers(1, 60000, SHAPE).astype(kind)


def nobody(_: Path) -> Parts:
    """Nothing vouches for any byte."""
    return []


def whole(path: Path) -> Parts:
    """Something vouches for every byte."""
    return [(0, path.stat().st_size)]


def _nifti(values: np.ndarray, path: Path) -> None:
    import nibabel

    image = nibabel.Nifti1Image(values.T, np.diag([*SPACING[::-1], 1.0]))
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)


def _nifti_sizes(_: Path) -> Parts:
    """Voxels along each axis, type and bits a voxel: the file's size must agree with them."""
    return [(42, 48), (70, 74)]


def _tiff(**options: Any) -> Callable[[np.ndarray, Path], None]:
    def write(values: np.ndarray, path: Path) -> None:
        import tifffile

        tifffile.imwrite(path, values, photometric="minisblack", metadata={"axes": "ZYX"}, **options)

    return write


def _tiff_strips(path: Path) -> Parts:
    """Deflated strips, each with Adler's checksum."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        pages: list[Any] = list(file.pages)
        pairs = [(start, n) for page in pages for start, n in zip(page.dataoffsets, page.databytecounts, strict=True)]
    return [(start, start + n) for start, n in pairs]


def _npz(compressed: bool) -> Callable[[np.ndarray, Path], None]:
    def write(values: np.ndarray, path: Path) -> None:
        (np.savez_compressed if compressed else np.savez)(path, volume=values)

    return write


def _zip_members(path: Path) -> Parts:
    """The members' data, each with a CRC."""
    with zipfile.ZipFile(path) as file, path.open("rb") as stream:
        found = []
        for member in file.infolist():
            stream.seek(member.header_offset + 26)
            name, extra = struct.unpack("<HH", stream.read(4))
            start = member.header_offset + 30 + name + extra
            found.append((start, start + member.compress_size))
    return found


def _hdf5(**options: Any) -> Callable[[np.ndarray, Path], None]:
    def write(values: np.ndarray, path: Path) -> None:
        import h5py

        chunks = (3, 5, 12) if options else None
        with h5py.File(path, "w", libver=("earliest", "v108")) as file:
            dataset = file.create_dataset("volume", data=values, chunks=chunks, **options)
            dataset.attrs["spacing"], dataset.attrs["unit"] = SPACING, "mm"

    return write


def _hdf5_chunks(path: Path) -> Parts:
    """Chunks that are deflated, or end in Fletcher's checksum."""
    import h5py

    with h5py.File(path, "r") as file:
        dataset: Any = file["volume"]
        found = [dataset.id.get_chunk_info(k) for k in range(dataset.id.get_num_chunks())]
    return [(each.byte_offset, each.byte_offset + each.size) for each in found]


def _nrrd(coding: str) -> Callable[[np.ndarray, Path], None]:
    def write(values: np.ndarray, path: Path) -> None:
        import nrrd

        header = {"encoding": coding, "space directions": np.diag(SPACING[::-1]), "space origin": [0, 0, 0]}
        nrrd.write(str(path), values, {"space": "right-anterior-superior", **header}, index_order="C")

    return write


def _after(mark: bytes, skip: int = 0) -> Callable[[Path], Parts]:
    """What comes after a mark, which ends the header."""

    def find(path: Path) -> Parts:
        content = path.read_bytes()
        return [(content.index(mark) + len(mark) + skip, len(content))]

    return find


def _meta(compressed: bool) -> Callable[[np.ndarray, Path], None]:
    def write(values: np.ndarray, path: Path) -> None:
        import SimpleITK

        image = SimpleITK.GetImageFromArray(values)
        image.SetSpacing(SPACING[::-1])
        SimpleITK.WriteImage(image, str(path), useCompression=compressed)

    return write


def _mrc(values: np.ndarray, path: Path) -> None:
    import mrcfile

    with mrcfile.new(path, values, overwrite=True) as file:
        file.voxel_size = tuple(10 * h for h in SPACING[::-1])


def _gzipped_tail(path: Path) -> Parts:
    """All but the marks of time and system in gzip's header, which mean nothing."""
    return [(10, path.stat().st_size)]


def _npy(values: np.ndarray, path: Path) -> None:
    np.save(path, values)


#: Formats of one file, by the name of that file.
FORMATS: dict[str, Format] = {
    "plain.nii": Format(_nifti, _nifti_sizes),
    "packed.nii.gz": Format(_nifti, _gzipped_tail),
    "packed_float.nii.gz": Format(_nifti, _gzipped_tail, "float32"),
    "plain.tif": Format(_tiff(), nobody),
    "lzw.tif": Format(_tiff(compression="lzw", rowsperstrip=5), nobody),
    "deflate.tif": Format(_tiff(compression="deflate", rowsperstrip=5), _tiff_strips),
    "predicted.tif": Format(_tiff(compression="deflate", predictor=True), _tiff_strips),
    "image.ome.tif": Format(_tiff(ome=True), nobody),
    "plain.npy": Format(_npy, nobody),
    "plain.npz": Format(_npz(False), _zip_members),
    "packed.npz": Format(_npz(True), _zip_members),
    "plain.h5": Format(_hdf5(), nobody),
    "packed.h5": Format(_hdf5(compression="gzip"), _hdf5_chunks),
    "summed.h5": Format(_hdf5(fletcher32=True), _hdf5_chunks),
    "plain.nrrd": Format(_nrrd("raw"), nobody),
    "packed.nrrd": Format(_nrrd("gzip"), _after(b"\n\n", 10)),
    "plain.mha": Format(_meta(False), nobody),
    "packed.mha": Format(_meta(True), _after(b"ElementDataFile = LOCAL\n")),
    "plain.mrc": Format(_mrc, lambda _: [(0, 12)]),
}


def write_all(folder: Path) -> None:
    """Every format's file, bare numbers, Zarr stores and a folder of DICOM slices."""
    for name, each in FORMATS.items():
        each.write(truth(each.kind), folder / name)
    (folder / "bare.raw").write_bytes(truth().tobytes())
    (folder / "bare.nii.gz").write_bytes(gzip.compress(b"", mtime=0))
    for name in STORES:
        write_store(name, folder / name)
    write_dicom(folder / "series")


#: Zarr stores: version, options, and whether something vouches for the bytes of a chunk.
STORES: dict[str, tuple[int, dict[str, Any], bool]] = {
    "v3_plain.zarr": (3, {"compressors": None}, False),
    "v3_zstd.zarr": (3, {"codec": "zstd"}, False),
    "v3_zstd_sum.zarr": (3, {"codec": "zstd-sum"}, True),
    "v3_crc32c.zarr": (3, {"codec": "crc32c"}, True),
    "v3_gzip.zarr": (3, {"codec": "gzip"}, True),
    "v3_shards.zarr": (3, {"codec": "crc32c", "shards": (6, 10, 12)}, True),
    "v2_plain.zarr": (2, {"compressors": None}, False),
    "v2_zlib.zarr": (2, {"codec": "zlib"}, True),
    "v2_blosc.zarr": (2, {"codec": "blosc"}, False),
    "v2_group.zarr": (2, {"codec": "zlib", "group": True}, True),
    "v3_group.zarr": (3, {"codec": "crc32c", "group": True}, True),
}


def write_store(name: str, path: Path) -> None:
    """A Zarr store of twelve chunks."""
    import zarr

    version, options, _ = STORES[name]
    options = dict(options)
    place = {"store": str(path)}
    if options.pop("group", False):
        group = zarr.create_group(store=str(path), zarr_format=version, attributes={"title": "a group"})
        place = {"store": group.store, "name": "volume"}
    if "codec" in options:
        options["compressors"] = _codec(options.pop("codec"))
    array = zarr.create_array(
        **place, shape=SHAPE, chunks=(3, 5, 6), dtype="uint16", zarr_format=version, overwrite=False,
        attributes={"spacing": list(SPACING), "unit": "mm"}, **options,
    )  # fmt: skip
    array[...] = truth()


def _codec(name: str) -> Any:
    import numcodecs
    from zarr.codecs import Crc32cCodec, GzipCodec, ZstdCodec

    return {
        "zstd": ZstdCodec(level=3),
        "zstd-sum": ZstdCodec(level=3, checksum=True),
        "crc32c": Crc32cCodec(),
        "gzip": GzipCodec(),
        "zlib": numcodecs.Zlib(),
        "blosc": numcodecs.Blosc(),
    }[name]


def write_dicom(folder: Path) -> None:
    """One series, a file a slice."""
    import pydicom

    folder.mkdir()
    for k, plane in enumerate(truth()):
        image = pydicom.Dataset()
        image.file_meta = pydicom.dataset.FileMetaDataset()
        image.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
        image.file_meta.MediaStorageSOPClassUID = image.SOPClassUID = pydicom.uid.CTImageStorage
        image.file_meta.MediaStorageSOPInstanceUID = image.SOPInstanceUID = f"1.2.3.4.{k + 1}"
        image.SeriesInstanceUID, image.InstanceNumber = "1.2.3", k + 1
        image.Rows, image.Columns = plane.shape
        image.PixelSpacing, image.ImageOrientationPatient = [SPACING[1], SPACING[2]], [1, 0, 0, 0, 1, 0]
        image.ImagePositionPatient = [0, 0, round(SPACING[0] * k, 6)]
        image.RescaleSlope, image.RescaleIntercept = 1, 0
        image.SamplesPerPixel, image.PhotometricInterpretation = 1, "MONOCHROME2"
        image.BitsAllocated, image.BitsStored, image.HighBit, image.PixelRepresentation = 16, 16, 15, 0
        image.PixelData = plane.tobytes()
        image.save_as(folder / f"slice{k:02d}.dcm", enforce_file_format=True)
