"""Small files that claim, or hold, what no memory holds; and files of a known suffix that are something else."""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .case import INFER, Case, Place, Setup

#: Zeros that a bomb swells to; more than the room that a case has.
SWOLLEN = 6 << 30


def _npy_header(shape: str, kind: str = "<f4") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (63 - (10 + len(text)) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode("latin-1")


def _nifti(shape: tuple[int, ...], *kind: int, room: int = 999, **more: Any) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(_nifti_header(shape, *kind, **more) + bytes(room)) and None


def _zipped(path: Path, members: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)


def _nifti_header(shape: tuple[int, ...], kind: int = 16, bits: int = 32, **more: Any) -> bytes:
    import nibabel

    header = nibabel.Nifti1Header()
    header["dim"] = [len(shape), *shape, *[1] * (7 - len(shape))]
    header["datatype"], header["bitpix"], header["pixdim"] = kind, bits, [1] * 8
    header["vox_offset"], header["magic"] = 352, b"n+1"
    for name, value in more.items():
        header[name] = value
    return header.binaryblock + bytes(4)


def _swollen_gzip(head: bytes) -> bytes:
    """A gzip stream of a head and of more zeros than memory has, made of one piece repeated."""
    buffer = io.BytesIO()
    with gzip.GzipFile(fileobj=buffer, mode="wb", mtime=0, compresslevel=1) as stream:
        stream.write(head)
        for _ in range(4):
            stream.write(bytes(1 << 20))
    members, piece = [buffer.getvalue()], gzip.compress(bytes(64 << 20), 1, mtime=0)
    return b"".join(members + [piece] * (SWOLLEN >> 26))


def _swollen_zip(path: Path, head: bytes) -> None:
    """A zip member whose deflated zeros swell beyond memory."""
    coder = zlib.compressobj(9, zlib.DEFLATED, -15)
    zeros, size, crc = bytes(1 << 24), len(head), zlib.crc32(head)
    parts = [coder.compress(head)]
    for _ in range((1 << 30) >> 24):
        parts.append(coder.compress(zeros))
        size, crc = size + len(zeros), zlib.crc32(zeros, crc)
    data = b"".join([*parts, coder.flush()])
    local = struct.pack("<4sHHHHHIIIHH", b"PK\3\4", 20, 0, 8, 0, 33, crc, len(data), size, 7, 0) + b"big.npy"
    entry = struct.pack(
        "<4sHHHHHHIIIHHHHHII", b"PK\1\2", 20, 20, 0, 8, 0, 33, crc, len(data), size, 7, 0, 0, 0, 0, 0, 0
    )
    end = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 1, 1, len(entry) + 7, len(local) + len(data), 0)
    path.write_bytes(local + data + entry + b"big.npy" + end)


def _zarr_json(shape: list[int], chunks: list[int], codecs: list[dict] | None = None) -> str:
    plain = [{"name": "bytes", "configuration": {"endian": "little"}}]
    return json.dumps({
        "zarr_format": 3, "node_type": "array", "shape": shape, "data_type": "float32",
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunks}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0.0, "codecs": plain + (codecs or []), "attributes": {},
    })  # fmt: skip


def _hdf5(shape: tuple[int, ...], **options: Any) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import h5py

        with h5py.File(path, "w") as file:
            file.create_dataset("volume", shape=shape, dtype="f4", **options)

    return write


def _tiff_tag(code: int, value: int) -> Callable[[Path], None]:
    """A TIFF one of whose numbers is another."""

    def write(path: Path) -> None:
        import tifffile

        tifffile.imwrite(path, np.ones((4, 5, 6), np.float32), photometric="minisblack")
        with tifffile.TiffFile(path) as file:
            tags: Any = file.pages[0].tags  # type: ignore[union-attr]
            place = tags[code].valueoffset
        with path.open("rb+") as stream:
            stream.seek(place)
            stream.write(struct.pack("<I", value))

    return write


def _mrc(path: Path) -> None:
    path.write_bytes(struct.pack("<4i", 30000, 30000, 30000, 2) + bytes(192) + b"MAP \x44\x44\0\0" + bytes(808))


def _mha(shape: str, compressed: bool, data: bytes = b"") -> bytes:
    size = f"CompressedDataSize = {len(data)}\n" if compressed else ""
    return (
        f"ObjectType = Image\nNDims = 3\nBinaryData = True\nCompressedData = {compressed}\n{size}DimSize = {shape}\n"
        "ElementSpacing = 1 1 1\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n"
    ).encode() + data


def _nrrd(sizes: str, coding: str, data: bytes = b"") -> bytes:
    head = f"NRRD0004\ntype: float\ndimension: 3\nsizes: {sizes}\nencoding: {coding}\nendian: little\n\n"
    return head.encode() + data


def _content(content: bytes | Callable[[], bytes]) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(content if isinstance(content, bytes) else content()) and None


def _store(*told: Any) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.mkdir()
        (path / "zarr.json").write_text(_zarr_json(*told))

    return write


def _sparse(size: int) -> Callable[[Path], None]:
    """A file of holes, which takes no room on a disk."""

    def write(path: Path) -> None:
        with path.open("wb") as stream:
            os.truncate(stream.fileno(), size)

    return write


_CUBE = "(10000, 10000, 10000)"
_MANY = [10000] * 3

BOMBS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "npy-claim": ("a.npy", _content(_npy_header(_CUBE) + bytes(100))),
    "npy-claim-int": ("a.npy", _content(_npy_header(f"({10**30}, 2, 2)") + bytes(100))),
    "npy-negative": ("a.npy", _content(_npy_header("(-5, -5, 5)") + bytes(500))),
    "npy-float-shape": ("a.npy", _content(_npy_header("(5.0, 5, 5)") + bytes(500))),
    "npy-object": ("a.npy", _content(_npy_header("(2, 2, 2)", "|O") + b"cos\nsystem\n(S'touch ran'\ntR.")),
    "npy-code": ("a.npy", _content(_npy_header("__import__('os').system('touch ran')") + bytes(100))),
    "npy-nest": ("a.npy", _content(_npy_header("(" * 3000 + "2" + ")" * 3000) + bytes(100))),
    "npy-void": ("a.npy", _content(_npy_header("(4, 4, 4)", "|V4") + bytes(256))),
    "npy-zero-size": ("a.npy", _content(_npy_header("(4, 4, 4)", "|S0"))),
    "npy-date": ("a.npy", _content(_npy_header("(4, 4, 4)", "<M8[ns]") + bytes(512))),
    "npy-many-axes": ("a.npy", _content(_npy_header("(" + "1," * 70 + ")") + bytes(4))),
    "npz-claim": ("a.npz", lambda path: _zipped(path, {"a.npy": _npy_header(_CUBE) + bytes(100)})),
    "npz-swollen": ("a.npz", lambda path: _swollen_zip(path, _npy_header("(500000, 30, 40)"))),
    "npz-object": ("a.npz", lambda path: _zipped(path, {"a.npy": _npy_header("(2, 2, 2)", "|O") + b"cos\n."})),
    "npz-empty": ("a.npz", lambda path: _zipped(path, {})),
    "npz-no-array": ("a.npz", lambda path: _zipped(path, {"a.txt": b"text"})),
    "npz-path": ("a.npz", lambda path: _zipped(path, {"../../a.npy": _npy_header("(2, 2, 2)") + bytes(32)})),
    "nii-claim": ("a.nii", _nifti((32767,) * 3, room=100)),
    "nii.gz-claim": ("a.nii.gz", _content(lambda: gzip.compress(_nifti_header((32767,) * 3) + bytes(99)))),
    "nii.gz-swollen": ("a.nii.gz", lambda path: path.write_bytes(_swollen_gzip(_nifti_header((1200,) * 3))) and None),
    "nii.gz-tail": ("a.nii.gz", lambda path: path.write_bytes(_swollen_gzip(_nifti_header((8,) * 3))) and None),
    "nii-negative": ("a.nii", _nifti((-5, 5, 5))),
    "nii-offset": ("a.nii", _nifti((5, 5, 5), vox_offset=np.inf)),
    "nii-offset-nan": ("a.nii", _nifti((5,) * 3, vox_offset=np.nan)),
    "nii-slope-nan": ("a.nii", _nifti((5,) * 3, scl_slope=np.inf)),
    "nii-pixdim-nan": ("a.nii", _nifti((5,) * 3, pixdim=[np.nan] * 8)),
    "nii-pixdim-zero": ("a.nii", _nifti((5,) * 3, pixdim=[0] * 8)),
    "nii-colour": ("a.nii", _nifti((5,) * 3, 128, 24)),
    "nii-complex": ("a.nii", _nifti((5,) * 3, 32, 64, room=1999)),
    "h5-claim": ("a.h5", _hdf5((10**5,) * 3, chunks=(64, 64, 64))),
    "h5-claim-larger": ("a.h5", _hdf5((2**40, 2**20, 8), chunks=(64, 64, 8))),
    "h5-fill": ("a.h5", _hdf5((3000,) * 3, chunks=(64,) * 3, fillvalue=2.5)),
    "zarr-claim": ("a.zarr", _store(_MANY, [64] * 3)),
    "zarr-claim-larger": ("a.zarr", _store([10**18] * 3, [64] * 3)),
    "zarr-many-chunks": ("a.zarr", _store([800] * 3, [1, 1, 1])),
    "zarr-chunk-claim": ("a.zarr", _store([8] * 3, _MANY)),
    "zarr-zero-chunks": ("a.zarr", _store([8] * 3, [0] * 3)),
    "zarr-negative": ("a.zarr", _store([-8] * 3, [4] * 3)),
    "zarr-codec": ("a.zarr", _store([8] * 3, [4] * 3, [{"name": "nonsense"}])),
    "tif-wide": ("a.tif", _tiff_tag(256, 2**31 - 1)),
    "tif-tall": ("a.tif", _tiff_tag(257, 2**31 - 1)),
    "tif-zero": ("a.tif", _tiff_tag(256, 0)),
    "tif-bits": ("a.tif", _tiff_tag(258, 3)),
    "tif-samples": ("a.tif", _tiff_tag(277, 60000)),
    "tif-codec": ("a.tif", _tiff_tag(259, 999)),
    "tif-bytes": ("a.tif", _tiff_tag(279, 2**32 - 1)),
    "tif-loop": ("a.tif", _content(b"II*\0\x08\0\0\0\0\0\x08\0\0\0")),
    "mrc-claim": ("a.mrc", _mrc),
    "mha-claim": ("a.mha", _content(_mha("30000 30000 30000", False, bytes(100)))),
    "mha-claim-packed": ("a.mha", _content(_mha("30000 30000 30000", True, zlib.compress(bytes(100))))),
    "mha-negative": ("a.mha", _content(_mha("-3 3 3", False, bytes(100)))),
    "mha-words": ("a.mha", _content(_mha("three three", False, bytes(100)))),
    "mha-elsewhere": ("a.mha", _content(_mha("3 3 3", False).replace(b"LOCAL", b"../../none.raw"))),
    "nrrd-claim": ("a.nrrd", _content(_nrrd("30000 30000 30000", "raw", bytes(100)))),
    "nrrd-claim-packed": ("a.nrrd", _content(_nrrd("30000 30000 30000", "gzip", gzip.compress(bytes(100))))),
    "nrrd-swollen": ("a.nrrd", _content(lambda: _nrrd("8 8 8", "gzip", _swollen_gzip(b"")))),
    "nrrd-negative": ("a.nrrd", _content(_nrrd("-8 8 -8", "raw", bytes(2048)))),
    "nrrd-text": ("a.nrrd", _content(_nrrd("8 8 8", "ascii", b"1 2 three"))),
    "nrrd-coding": ("a.nrrd", _content(_nrrd("8 8 8", "nonsense", bytes(2048)))),
    "raw-sparse": ("a.raw", _sparse(10**12)),
    "tif-sparse": ("a.tif", _sparse(10**12)),
    "npy-sparse": ("a.npy", _sparse(10**12)),
    "nii-sparse": ("a.nii", _sparse(10**12)),
}  # fmt: skip


def cases(seed: int) -> Iterator[Case]:
    """Every bomb as a scan; some as maps, atlas or prior."""
    for name, (file, write) in BOMBS.items():
        told = ("--raw-shape", "10000,10000,10000", "--dtype", "u1") if file.endswith(".raw") else ()
        command = ("segment", file, "--prior", "tubes", "--steps", "1", *told, "-o", "out.nii.gz")
        yield Case(f"bombs/scan/{name}", _writing(write, file), command, quick="swollen" not in name)
    for name in ("npz-claim", "npz-swollen", "npz-object", "npz-empty", "npz-no-array", "npy-claim", "npy-sparse"):
        write = BOMBS[name][1]
        command = ("generate", "--maps", "a.npz", "--shape", "10", "--steps", "4", "-o", "out.npy")
        yield Case(f"bombs/maps/{name}", _writing(write, "a.npz"), command)
        command = (*INFER, "a.npz", "-o", "found")
        yield Case(f"bombs/atlas/{name}", _writing(write, "a.npz"), command, quick=False)
    for size in (10**6, 10**12):
        command = ("generate", "--prior", "fit.json", "--shape", "10", "--steps", "4", "-o", "out.npy")
        yield Case(f"bombs/fit/{size}", _writing(_sparse(size), "fit.json"), command)
        command = ("atlas", "build", "out.zarr", "--design", "box.yaml", "--workers", "0")
        yield Case(f"bombs/design/{size}", _writing(_sparse(size), "box.yaml"), command)
        command = (
            "generate",
            "--preset",
            "tubes",
            "--shape",
            "10",
            "--steps",
            "4",
            "--checkpoint",
            "run.pt",
            "-o",
            "o.npy",
        )
        yield Case(f"bombs/checkpoint/{size}", _writing(_sparse(size), "run.pt"), command)


def _writing(write: Callable[[Path], None], file: str) -> Setup:
    def setup(place: Place) -> None:
        write(place.here / file)

    return setup
