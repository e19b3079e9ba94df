"""Bombs, claims of headers, signals, full disks, rivals: what no random draw would find."""

from __future__ import annotations

import gzip
import json
import os
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import nibabel
import numpy as np
import pytest
import zarr
from damage import files_of
from disk import tree

from curvafit.volumes.read import load
from tests.golden.inputs import FOLDER

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="commands are forked from a warm process"),
]

#: Bytes that a command may map beyond what its libraries do, and zeros that a bomb swells to.
MEMORY, SWOLLEN = 1 << 30, 2 << 30
LAW = "generate --coefficients 1,2,6,-40,-40,400 --mass=-0.6 --shape 16"
QUICK = f"{LAW} --steps 30"
LONG = f"{LAW} --steps 120 --checkpoint run.pt --checkpoint-every 0 -o out.npy"
SYNTH = "synth -o out --atlas store.zarr --modality confocal --shape 6 --count 3 --workers 0"
BUILD = "atlas build out.zarr --shape 16 --around tubes --spread 0.05 --count 2 --workers 0"
SEGMENT = "segment scan.tif --prior tubes --steps 2"

Fork = Callable[..., list[dict[str, Any]]]


@pytest.fixture(scope="module")
def fork() -> Iterator[Fork]:
    """Run commands at once, each forked from a process that has loaded the libraries."""
    program = [sys.executable, "-W", "ignore", Path(__file__).with_name("forked.py")]
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdin is not None and server.stdout is not None

        def run(*commands: dict[str, Any]) -> list[dict[str, Any]]:
            print(json.dumps(commands), file=server.stdin, flush=True)
            return json.loads(server.stdout.readline())

        yield run
        server.stdin.close()


def command(folder: Path, line: str, **how: Any) -> dict[str, Any]:
    """A command in a folder that gets the inputs which it names."""
    folder.mkdir(exist_ok=True)
    for word in line.split():
        if (FOLDER / word).is_dir():
            shutil.copytree(FOLDER / word, folder / word, dirs_exist_ok=True)
        elif (FOLDER / word).is_file():
            shutil.copyfile(FOLDER / word, folder / word)
    return {"folder": str(folder), "words": shlex.split(line), **how}


def refusal(outcome: dict[str, Any]) -> str:
    """The one sentence of a command that is refused."""
    lines = [line for line in outcome["said"].splitlines() if not line.startswith(("[", "changes "))]
    assert outcome["code"] == 2 and len(lines) == 1 and lines[0].startswith("error: "), outcome
    return lines[0]


# ---- bombs and claims ------------------------------------------------------------------------------------------------


def nifti(*shape: int) -> bytes:
    header = nibabel.Nifti1Header()
    header["dim"], header["datatype"], header["bitpix"] = [3, *shape, 1, 1, 1, 1], 16, 32
    header["pixdim"], header["vox_offset"], header["magic"] = [1] * 8, 352, b"n+1"
    return header.binaryblock + bytes(4)


def npy(shape: str) -> bytes:
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def nrrd(sizes: str, coding: str) -> bytes:
    return f"NRRD0004\ntype: float\ndimension: 3\nsizes: {sizes}\nencoding: {coding}\nendian: little\n\n".encode()


def meta(packed: bool) -> bytes:
    return (
        f"ObjectType = Image\nNDims = 3\nBinaryData = True\nCompressedData = {packed}\nDimSize = 30000 30000 30000\n"
        "ElementSpacing = 1 1 1\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n"
    ).encode()


def hdf5(path: Path, shape: tuple[int, ...], **options: Any) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("volume", shape, "f4", **options)


def swollen(head: bytes) -> bytes:
    """A gzip stream of a head and of more zeros than there is memory."""
    return gzip.compress(head, mtime=0) + gzip.compress(bytes(64 << 20), 1, mtime=0) * (SWOLLEN >> 26)


def zipped(path: Path) -> None:
    """A member of an archive that swells beyond memory."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
        file.open("big.npy", "w", force_zip64=True) as part,
    ):
        part.write(npy("(512, 1024, 1024)"))
        for _ in range(SWOLLEN >> 24):
            part.write(bytes(1 << 24))


CLAIMS: dict[str, bytes | Callable[[Path], object]] = {
    "a.npy": npy("(10000, 10000, 10000)") + bytes(100),
    "b.npy": npy(f"({10**30}, 2, 2)") + bytes(100),
    "a.nii": nifti(32767, 32767, 32767) + bytes(99),
    "a.nii.gz": gzip.compress(nifti(32767, 32767, 32767) + bytes(99)),
    "a.mrc": struct.pack("<4i", 30000, 30000, 30000, 2) + bytes(192) + b"MAP \x44\x44\0\0" + bytes(808),
    "a.mha": meta(False) + bytes(100),
    "packed.mha": meta(True) + zlib.compress(bytes(100)),
    "a.nrrd": nrrd("30000 30000 30000", "raw") + bytes(100),
    "packed.nrrd": nrrd("30000 30000 30000", "gzip") + gzip.compress(bytes(100)),
    "loop.tif": b"II*\0\x08\0\0\0\0\0\x08\0\0\0",
    "a.h5": lambda path: hdf5(path, (2**40, 2**20, 8), chunks=(64, 64, 8)),
    "filled.h5": lambda path: hdf5(path, (3000,) * 3, chunks=(64,) * 3, fillvalue=2),
    "a.zarr": lambda path: zarr.create_array(path, shape=(10000,) * 3, chunks=(64,) * 3, dtype="f4"),
    "chunk.zarr": lambda path: zarr.create_array(path, shape=(10000,) * 3, chunks=(10000,) * 3, dtype="f4"),
    "sparse.tif": lambda path: path.touch() or os.truncate(path, 10**12),
    "sparse.npy": lambda path: path.touch() or os.truncate(path, 10**12),
}


def test_a_header_that_claims_what_no_memory_holds_is_refused(fork: Fork, tmp_path: Path) -> None:
    for name, write in CLAIMS.items():
        (tmp_path / name).write_bytes(write) if isinstance(write, bytes) else write(tmp_path / name)
    before = {path: path.stat().st_mtime for path in tmp_path.rglob("*")}
    for name in CLAIMS:
        (outcome,) = fork(command(tmp_path, f"segment {name} --prior tubes --steps 1 -o out.nii.gz", memory=MEMORY))
        assert refusal(outcome), name
    assert {path: path.stat().st_mtime for path in tmp_path.rglob("*")} == before


def test_a_bomb_is_refused(fork: Fork, tmp_path: Path) -> None:
    (tmp_path / "whole.nii.gz").write_bytes(swollen(nifti(1200, 1200, 1200)))
    (tmp_path / "tail.nii.gz").write_bytes(swollen(nifti(8, 8, 8)))
    (tmp_path / "a.nrrd").write_bytes(nrrd("8 8 8", "gzip") + swollen(b""))
    zipped(tmp_path / "a.npz")
    for name in ("whole.nii.gz", "tail.nii.gz", "a.nrrd", "a.npz"):
        (outcome,) = fork(command(tmp_path, f"segment {name} --prior tubes --steps 1 -o out.nii.gz", memory=MEMORY))
        assert refusal(outcome), name
    assert len(list(tmp_path.iterdir())) == 4


# ---- signals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("line", [LONG, SYNTH, BUILD, f"{SEGMENT} --tile 16 -o out.nii.gz"])
def test_a_run_that_is_ended_leaves_whole_files_and_goes_on(fork: Fork, tmp_path: Path, line: str) -> None:
    """By a signal at any change of a file: afterwards the same command ends as an unbroken one does."""
    (whole,) = fork(command(tmp_path / "whole", line))
    assert whole["code"] == 0 and whole["changes"] > 9, whole
    inputs = {word for word in line.split() if (FOLDER / word).exists()}
    for number, share in ((signal.SIGINT, 0.1), (signal.SIGKILL, 0.4), (signal.SIGTERM, 0.7), (signal.SIGINT, 0.95)):
        folder = tmp_path / f"{share}"
        (ended,) = fork(command(folder, line, change=1 + int(share * whole["changes"]), signal=number))
        assert ended["code"] in (0, -number, 128 + number) and "Traceback" not in ended["said"], ended
        new = [path for path in folder.rglob("*") if path.relative_to(folder).parts[0] not in inputs]
        if number != signal.SIGKILL:
            assert not [path for path in new if path.name.startswith(".") and "curvafit" not in path.name], (ended, new)
        values(folder)
        (again,) = fork(command(folder, line))
        assert again["code"] == 0, (share, ended, again)
        assert values(folder) == values(tmp_path / "whole")


def values(folder: Path) -> dict[str, bytes]:
    """The volumes that a command made, by name; all can be read, but for those that bear a temporary name."""
    names = [str(path.relative_to(folder)) for path in files_of(folder) if path.name.endswith((".npy", ".nii.gz"))]
    found = {name: load(folder / name).values.tobytes() for name in names if "/." not in f"/{name}"}
    for path in folder.glob("out.zarr/draws/*/field"):
        found[str(path.relative_to(folder))] = np.asarray(zarr.open_array(path, mode="r")[...]).tobytes()
    return found


# ---- full disks ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["out.npy", "out.nii.gz", "out.ome.tif", "out.mrc", "out.zarr", "out.stl"])
def test_a_disk_that_is_full_is_said_and_leaves_nothing(fork: Fork, tmp_path: Path, name: str) -> None:
    for size in (1, 4000):
        line = f"{QUICK} --spacing 1 --unit um --no-picture -o {name}"
        (outcome,) = fork(command(tmp_path, line, file=size))
        assert refusal(outcome)
        assert not list(tmp_path.iterdir()), size


@pytest.mark.parametrize("line", [f"{QUICK} -o mask.nii.gz --overwrite", "atlas extract store.zarr -o out.npz", SYNTH])
def test_a_disk_that_is_full_costs_nothing_that_was_there(fork: Fork, tmp_path: Path, line: str) -> None:
    started = command(tmp_path, line, file=400)
    before = tree(tmp_path)
    refusal(fork(started)[0])
    assert {name: content for name, content in tree(tmp_path).items() if not name.startswith("out/")} == before


# ---- rivals ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("line", [f"{QUICK} -o out.nii.gz", f"{QUICK} -o out.zarr", LONG, BUILD, SYNTH])
def test_two_at_once_both_end_or_one_says_why(fork: Fork, tmp_path: Path, line: str) -> None:
    """What they leave is what one alone does."""
    outcomes = fork(*[command(tmp_path / "two", line, lag=0.03) for _ in range(2)])
    assert 0 in [outcome["code"] for outcome in outcomes], outcomes
    for outcome in outcomes:
        if outcome["code"]:
            assert ".part" not in refusal(outcome)
    fork(command(tmp_path / "one", line))
    assert values(tmp_path / "two") == values(tmp_path / "one")
    assert not [path for path in (tmp_path / "two").rglob(".*") if path.is_file()]
