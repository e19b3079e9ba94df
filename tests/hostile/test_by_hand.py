"""Bombs, claims of headers, signals, full disks: what no random draw would find."""

import contextlib
import gzip
import os
import signal
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import nibabel
import numpy as np
import pytest
import zarr
from calling import call, refused
from damage import files_of

from curvafit.volumes.read import load
from tests.golden import FOLDER
from tests.hostile.test_properties import bounds, copy_inputs

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs limits of memory and signals"),
    pytest.mark.filterwarnings("default"),
]

#: Bytes that a command may map beyond what its libraries do, and zeros that a bomb swells to.
MEMORY, SWOLLEN = 1 << 30, 2 << 30
LAW = "generate --coefficients 1,2,6,-40,-40,400 --mass=-0.6 --shape 16"
QUICK = f"{LAW} --steps 30"
LONG = f"{LAW} --steps 120 --checkpoint run.pt --checkpoint-every 0 -o out.npy"
SYNTH = "synth -o out --atlas store.zarr --modality confocal --shape 6 --count 3 --workers 0"
BUILD = "atlas build out.zarr --shape 16 --around tubes --spread 0.05 --count 2 --workers 0"
SEGMENT = "segment scan.tif --prior tubes --steps 2"


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
BOMBS: dict[str, bytes | Callable[[Path], object]] = {
    "whole.nii.gz": lambda path: path.write_bytes(swollen(nifti(1200, 1200, 1200))),
    "tail.nii.gz": lambda path: path.write_bytes(swollen(nifti(8, 8, 8))),
    "bomb.nrrd": lambda path: path.write_bytes(nrrd("8 8 8", "gzip") + swollen(b"")),
    "bomb.npz": zipped,
}


def test_what_no_memory_holds_is_refused(tmp_path: Path) -> None:
    """A header that claims it, and a file that swells to it."""
    for name, write in (CLAIMS | BOMBS).items():
        (tmp_path / name).write_bytes(write) if isinstance(write, bytes) else write(tmp_path / name)
    before = {path: path.stat().st_mtime for path in tmp_path.rglob("*")}
    with contextlib.chdir(tmp_path):
        for name in CLAIMS | BOMBS:
            with bounds(MEMORY):
                result = call(*f"segment {name} --prior tubes --steps 1 -o out.nii.gz".split())
            refused(result, progress=True)
    assert {path: path.stat().st_mtime for path in tmp_path.rglob("*")} == before


# ---- full disks ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["out.npy", "out.nii.gz", "out.ome.tif", "out.mrc", "out.zarr", "out.stl"])
def test_a_disk_that_is_full_is_said_and_leaves_nothing(tmp_path: Path, name: str) -> None:
    for size in (1, 4000):
        with contextlib.chdir(tmp_path), bounds(file=size):
            result = call(*f"{QUICK} --spacing 1 --unit um --no-picture -o {name}".split())
        refused(result, progress=True)
        assert not list(tmp_path.iterdir()), size


# ---- signals ---------------------------------------------------------------------------------------------------------

#: A command with the changes of files in its folder counted: at one of them it gets a signal.
PROGRAM = """
import os, sys
from curvafit.__main__ import main
change, number, done = int(sys.argv[1]), int(sys.argv[2]), 0
folder, sys.argv = os.getcwd(), ["curvafit", *sys.argv[3:]]

def watch(event, arguments):
    global done
    opened = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
    changed = event in ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.link", "os.symlink")
    if not (opened or changed) or isinstance(arguments[0], int):
        return
    name = os.fsdecode(arguments[0])
    if not os.path.isabs(name) or name.startswith(folder):
        done += 1
        if done == change:
            os.kill(os.getpid(), number)

sys.addaudithook(watch)
try:
    main()
finally:
    print("changes", done, flush=True)
"""


def run(folder: Path, line: str, change: int = 0, number: int = 0) -> tuple[int, str]:
    """The code and the words of a command in a folder that gets the inputs which it names."""
    folder.mkdir(exist_ok=True)
    copy_inputs(line, folder)
    words = [sys.executable, "-W", "ignore", "-c", PROGRAM, *map(str, (change, number)), *line.split()]
    ended = subprocess.run(words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    return ended.returncode, ended.stdout


@pytest.mark.parametrize("line", [LONG, SYNTH, BUILD, f"{SEGMENT} --tile 16 -o out.nii.gz"])
def test_a_run_that_is_ended_leaves_whole_files_and_goes_on(tmp_path: Path, line: str) -> None:
    """By a signal at any change of a file: afterwards the same command ends as an unbroken one does."""
    code, said = run(tmp_path / "whole", line)
    changes = int(said.rpartition("changes ")[2])
    assert code == 0 and changes > 9, said
    inputs = {word for word in line.split() if (FOLDER / word).exists()}
    for number, share in ((signal.SIGINT, 0.1), (signal.SIGKILL, 0.4), (signal.SIGTERM, 0.7), (signal.SIGINT, 0.95)):
        folder = tmp_path / f"{share}"
        code, said = run(folder, line, 1 + int(share * changes), number)
        assert code in (0, -number, 128 + number) and "Traceback" not in said, said
        new = [path for path in folder.rglob("*") if path.relative_to(folder).parts[0] not in inputs]
        if number != signal.SIGKILL:
            assert not [path for path in new if path.name.startswith(".") and "curvafit" not in path.name], (said, new)
        values(folder)
        assert (again := run(folder, line))[0] == 0, (share, said, again)
        assert values(folder) == values(tmp_path / "whole")


def values(folder: Path) -> dict[str, bytes]:
    """The volumes that a command made, by name; all can be read, but for those that bear a temporary name."""
    names = [str(path.relative_to(folder)) for path in files_of(folder) if path.name.endswith((".npy", ".nii.gz"))]
    found = {name: load(folder / name).values.tobytes() for name in names if "/." not in f"/{name}"}
    for path in folder.glob("out.zarr/draws/*/field"):
        found[str(path.relative_to(folder))] = np.asarray(zarr.open_array(path, mode="r")[...]).tobytes()
    return found
