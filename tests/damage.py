"""Volume files of every format, and what can happen to their bytes."""

import gzip
import random
from collections.abc import Callable
from pathlib import Path

import h5py
import nrrd
import numcodecs
import numpy as np
import SimpleITK
import tifffile
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from curvafit.volumes import Volume, save

VALUES = (np.random.default_rng(0).random((9, 10, 11)) * 200).astype(np.uint16)
VALUES[2:5] = 0


def volume(suffix: str) -> Callable[[Path], object]:
    return lambda path: save(
        Volume(VALUES, (0.3, 0.2, 0.1), "um"), path.with_name(f"{path.stem.split('.')[0]}{suffix}")
    )


def hdf5(path: Path, **options: object) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("raw", data=VALUES, chunks=(4, 5, 6), **options)


def store(path: Path, **options: object) -> None:
    zarr.create_array(path, data=VALUES, chunks=(4, 5, 6), config={"write_empty_chunks": True}, **options)


def meta(path: Path, packed: bool) -> None:
    SimpleITK.WriteImage(SimpleITK.GetImageFromArray(VALUES), str(path), packed)


def tiff(path: Path, compression: str | None, predictor: bool = False) -> None:
    tifffile.imwrite(path, VALUES, photometric="minisblack", compression=compression, predictor=predictor)


def packed_nrrd(path: Path, encoding: str) -> None:
    nrrd.write(str(path), VALUES, {"encoding": encoding}, index_order="C")


#: Formats whose values have a checksum, or one over all of the file: no damage may be read as data.
CHECKED: dict[str, Callable[[Path], object]] = {
    "a.nii.gz": volume(".nii.gz"), "a.npz": lambda path: np.savez(path, raw=VALUES),
    "packed.npz": lambda path: np.savez_compressed(path, raw=VALUES),
    "gzip.nrrd": lambda path: packed_nrrd(path, "gzip"), "bzip2.nrrd": lambda path: packed_nrrd(path, "bzip2"),
    "packed.mha": lambda path: meta(path, True), "crc.zarr": lambda path: store(path, compressors=[Crc32cCodec()]),
}  # fmt: skip
#: Formats that say no more than how many values there are: what is cut or added is refused.
COUNTED: dict[str, Callable[[Path], object]] = {
    "a.nii": volume(".nii"), "a.npy": volume(".npy"), "a.mrc": volume(".mrc"),
    "raw.nrrd": lambda path: packed_nrrd(path, "raw"), "plain.mha": lambda path: meta(path, False),
}  # fmt: skip
#: Others, where a flipped bit may go unseen, but nothing may end in anything but values or a sentence.
OTHERS: dict[str, Callable[[Path], object]] = {
    "imagej.tif": volume(".tif"), "ome.ome.tif": volume(".ome.tif"), "lzw.tif": lambda path: tiff(path, "lzw", True),
    "deflate.tif": lambda path: tiff(path, "deflate"), "a.h5": hdf5,
    "packed.h5": lambda path: hdf5(path, compression="gzip", fletcher32=True), "v3.zarr": store,
    "v2.zarr": lambda path: store(path, zarr_format=2, compressors=[numcodecs.Blosc()]),
    "blosc.zarr": lambda path: store(path, compressors=[BloscCodec()]),
    "sharded.zarr": lambda path: store(path, shards=(8, 10, 12)),
}  # fmt: skip
FORMATS = {**CHECKED, **COUNTED, **OTHERS}


def files_of(path: Path) -> list[Path]:
    return sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]


def damaged(content: bytes, chance: random.Random) -> bytes:
    """A bit flipped, sixteen bytes zeroed, the end cut off, or something added."""
    kind, place = chance.choice(("flip", "flip", "zero", "cut", "grow")), chance.randrange(len(content))
    if kind == "flip":
        return content[:place] + bytes([content[place] ^ (1 << chance.randrange(8))]) + content[place + 1 :]
    if kind == "zero":
        return content[:place] + bytes(len(content[place : place + 16])) + content[place + 16 :]
    return content[:place] if kind == "cut" else content + chance.randbytes(place % 50 + 1)


def gzipped(content: bytes) -> bytes:
    return gzip.compress(content, mtime=0)
