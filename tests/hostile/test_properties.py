"""Any option of any command with any value, any damage of any file that a command reads: one law holds.

The exit code is 0, 1 or 2. With 2 there is one sentence on the error stream, nothing on the other one, and the folder
is as it was; with 0 what is new can be read. What stood in the folder before stays, and no temporary name is left.

`CURVAFIT_HOSTILE=300 python -m pytest tests/hostile` draws so many examples for each command, new ones every time.

Then bombs, claims of headers, signals, full disks: what no random draw would find.
"""

import contextlib
import gzip
import json
import os
import random
import re
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import nibabel
import numpy as np
import pytest
import typer
import zarr
from calling import call, refused
from damage import damaged, files_of
from disk import tree
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from curvafit.cli.app import app
from curvafit.volumes.read import load
from tests.golden import FOLDER
from tests.golden.rows import COMMANDS

resource = pytest.importorskip("resource", reason="needs limits of memory and time")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs limits of memory and time"),
    pytest.mark.filterwarnings("default"),
]

# ---- the law -------------------------------------------------------------------------------------------------------

#: Bytes that a command may map, and seconds of processor that it may take.
ROOM, SECONDS = 3 << 30, 60
#: Commands that keep finished parts where they fail.
KEEPING = ("atlas build", "synth")
#: Commands that may end with 1: a store with damage, a flow without a surface.
JUDGING = ("atlas verify", "generate")
#: A name that the program gives to what it has not finished.
TEMPORARY = re.compile(r"\.(?!curvafit-tiles)[^/]*|.*\.part|tmp[a-z0-9_]{8}")


def obey(folder: Path, words: Sequence[str]) -> int:
    """Run a command in a folder, assert the law, and return the exit code."""
    kept, names = tree(folder), set(folder.rglob("*"))
    with contextlib.chdir(folder), bounds():
        result = call(*words)
    said = f"curvafit {' '.join(words)!r}: {result.exit_code}, {result.output[-900:]!r}"
    assert result.exception is None or isinstance(result.exception, SystemExit), (said, repr(result.exception))
    assert result.exit_code in (0, 2) or (result.exit_code == 1 and begins(words, JUDGING)), said
    if result.exit_code == 2:
        refused(result, progress=True)
    if result.exit_code == 1:
        assert result.stderr.strip(), said
    stands = tree(folder)
    replaced = "out" if "--overwrite" in words else None
    lost = [name for name in kept if stands.get(name) != kept[name] and not (replaced and name.startswith(replaced))]
    assert not lost, (said, lost)
    new = sorted(path.relative_to(folder) for path in folder.rglob("*") if path not in names)
    if result.exit_code and not begins(words, KEEPING):
        assert not new, (said, new)
    assert not [name for name in new if TEMPORARY.fullmatch(name.name) and name.name not in words], (said, new)
    if result.exit_code == 0:
        for name in new:
            read_again(folder / name)
    return result.exit_code


def begins(words: Sequence[str], commands: Sequence[str]) -> bool:
    return f"{' '.join(words)} ".startswith(tuple(f"{command} " for command in commands))


@contextlib.contextmanager
def bounds(room: int = ROOM, file: int | None = None) -> Iterator[None]:
    """Bound memory, time and files' size while a command runs in this process; Linux alone knows what is mapped."""
    (soft, hard), sizes = resource.getrlimit(resource.RLIMIT_AS), resource.getrlimit(resource.RLIMIT_FSIZE)
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before = signal.signal(signal.SIGPROF, _stop)
    resource.setrlimit(resource.RLIMIT_AS, (mapped + room, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (sizes[0] if file is None else file, sizes[1]))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        resource.setrlimit(resource.RLIMIT_FSIZE, sizes)
        signal.signal(signal.SIGPROF, before)


def _stop(*_: object) -> None:
    raise AssertionError(f"the command took more than {SECONDS} s")


def read_again(path: Path) -> None:
    """Read a file as its name says, and assert that its numbers are finite; names without a reader are passed over."""
    name = path.name.lower()
    if name.endswith((".nii", ".nii.gz", ".tif", ".npy", ".mrc")) or (path / "0" / "zarr.json").exists():
        assert np.isfinite(load(path).values).all(), path
    elif name.endswith(".npz"):
        with np.load(path, allow_pickle=False) as file:
            assert [file[key] for key in file.files]
    elif name.endswith(".json"):
        json.loads(path.read_text(encoding="utf-8"), parse_constant=lambda word: 1 / 0)
    elif name.endswith(".png"):
        assert path.read_bytes().endswith(b"IEND\xaeB`\x82"), path
    elif name.endswith(".html"):
        assert path.read_text(encoding="utf-8").rstrip().endswith("</html>"), path


EXAMPLES = int(os.environ.get("CURVAFIT_HOSTILE", "0"))
#: Of each command, and of all together.
DRAWN = settings(deadline=None, phases=[Phase.generate], print_blob=True, suppress_health_check=list(HealthCheck))
FEW, MANY = (settings(DRAWN, max_examples=EXAMPLES or n, derandomize=not EXAMPLES) for n in (4, 60))
#: Commands that fetch a file.
FETCHING = {"demo", "samples get"}
#: What is typed to draw, which is no table.
REFUSED = ("atlas map none -o out",)

NUMBERS = "0 -0 1 -1 2 7 0.5 -0.5 1e-300 1e30 -1e30 1e300 nan inf -inf 18446744073709551616 1,2 0,0,1 1,2,3 -1,-1,-1"
WORDS = (
    *("", " ", "word", "50%", "1/3", "[red]8[/red]", "%s{0}", "~", "a\nb", "\x1b[2J", "١٢", "🦴", "über", "x" * 300),
    *("9" * 400, "\udcff", "--", ",,,", "0:8,:,:", ":,:,9:2", "0:1", "otsu", "all", "mask", "folder", "none.nii.gz"),
    *("tubes", "mask.nii.gz", "mm", "z", "1e9,1,1"),
)
VALUES = st.sampled_from(NUMBERS.split()) | st.sampled_from(WORDS) | st.text(max_size=8)


def commands(group: Any = None, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every command that help shows, by the words that are typed."""
    for name, inner in (group or typer.main.get_command(app)).commands.items():
        words = f"{path} {name}".strip()
        if not inner.hidden and (hasattr(inner, "commands") and words != "samples"):
            yield from commands(inner, words)
        elif not inner.hidden:
            yield words, inner


def command_of(line: str) -> tuple[str, Any]:
    return max((pair for pair in commands() if begins(line.split(), [pair[0]])), key=lambda pair: len(pair[0]))


#: Of each command one line of the corpus, or all.
LINES = [*COMMANDS.values(), *REFUSED]
if not EXAMPLES:
    LINES = list({command_of(line)[0]: line for line in reversed(LINES)}.values())


def test_every_command_is_tried() -> None:
    assert {command_of(line)[0] for line in LINES} == {name for name, _ in commands()} - FETCHING


@st.composite
def typed(draw: st.DrawFn, line: str) -> list[str]:
    """Options of the line's command, read off the command itself, with odd values."""
    options = [each for each in command_of(line)[1].params if each.opts[0].startswith("-")]
    words = line.split()
    for option in draw(st.lists(st.sampled_from(options), min_size=1, max_size=3)) if options else []:
        if option.is_flag:
            words.append(draw(st.sampled_from([*option.opts, *option.secondary_opts])))
            continue
        value = draw(VALUES)
        if "workers" in option.opts[-1] and value in ["1", "2", "7"]:  # starting processes takes long
            value = "0"
        words.append(f"{option.opts[-1]}={value}")
    return words


@pytest.mark.parametrize("line", LINES)
def test_whatever_is_typed_the_law_holds(line: str) -> None:
    @FEW
    @given(typed(line), st.sampled_from([None, None, None, "file", "folder", "link"]))
    def holds(words: list[str], there: str | None) -> None:
        with inputs(line) as folder:
            for out in (word for word in words if word.startswith("out")):
                plant(folder, out, there)
            assert obey(folder, words) in (0, 1, 2)

    holds()


@contextlib.contextmanager
def inputs(line: str) -> Iterator[Path]:
    """A new folder with the files that a line names, and one that it does not."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "folder").mkdir()
        (folder / "folder" / "thesis.txt").write_text("the only copy")
        copy_inputs(line, folder)
        yield folder


def copy_inputs(line: str, folder: Path) -> None:
    for word in line.split():
        if (FOLDER / word).is_dir():
            shutil.copytree(FOLDER / word, folder / word, dirs_exist_ok=True)
        elif (FOLDER / word).exists():
            (folder / word).parent.mkdir(exist_ok=True)
            shutil.copyfile(FOLDER / word, folder / word)


def plant(folder: Path, out: str, what: str | None) -> None:
    """Put something of the user's where a command writes."""
    if what == "folder":
        shutil.copytree(folder / "folder", folder / out)
    elif what == "link":
        (folder / out).symlink_to("folder")
    elif what == "file":
        (folder / out).write_text("the only copy")


# ---- what files hold -------------------------------------------------------------------------------------------------

#: What may stand in a file instead, besides damage to its bytes.
FOREIGN = (b"", b"<html>404</html>", b"[" * 100_000, b"\x89HDF\r\n\x1a\n" + bytes(600))
#: What takes the place of a value in JSON.
ODD = st.sampled_from(["null", "true", '"text"', "[]", "{}", "-1", "1e400", "NaN", "9" * 400, '"\\ud800"', "[[1], 2]"])


@st.composite
def harmed(draw: st.DrawFn, content: bytes) -> bytes:
    """The bytes of a file, damaged; of JSON, with another value in one place, half of the time."""
    parts = list(places(whole := json.loads(content))) if content[:1] in (b"{", b"[") else []
    if parts and draw(st.booleans()):
        node, key = draw(st.sampled_from(parts))
        node[key] = "@"
        return json.dumps(whole).replace('"@"', draw(ODD)).encode("utf-8", "surrogatepass")
    if draw(st.integers(0, 2)) == 0:
        return draw(st.sampled_from(FOREIGN))
    head = draw(st.sampled_from((len(content), 600)))  # half of the damage is near the beginning
    return damaged(content[:head] or b"\0", random.Random(draw(st.integers(0, 10**6)))) + content[head:]


def places(node: Any) -> Iterator[tuple[Any, Any]]:
    for key, inner in list(node.items() if isinstance(node, dict) else enumerate(node)):
        yield node, key
        if isinstance(inner, dict | list):
            yield from places(inner)


@pytest.mark.parametrize("line", [line for line in LINES if any((FOLDER / word).exists() for word in line.split())])
def test_whatever_a_file_holds_the_law_holds(line: str) -> None:
    @FEW
    @given(st.data())
    def holds(data: st.DataObject) -> None:
        with inputs(line) as folder:
            files = [file for file in files_of(folder) if "folder" not in file.parts]
            file = data.draw(st.sampled_from(sorted(str(file.relative_to(folder)) for file in files)))
            (folder / file).write_bytes(data.draw(harmed((folder / file).read_bytes())))
            assert obey(folder, line.split()) in (0, 1, 2)

    holds()


KINDS = st.sampled_from(["f8", "f4", "f2", "i8", "u8", "i1", "u2", "?", "c16", "U3", ">f4", "M8[s]"])


@MANY
@given(st.data(), KINDS, array_shapes(min_dims=0, max_dims=5, min_side=0, max_side=9))
def test_any_array_is_measured_or_refused(data: st.DataObject, kind: str, shape: tuple[int, ...]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder, "scan.npy"), data.draw(arrays(kind, shape)))
        assert obey(Path(folder), ["measure", "scan.npy", "-o", "out.csv"]) in (0, 2)


#: Bytes that a command may map beyond what its libraries do, and zeros that a bomb swells to.
MEMORY, SWOLLEN = 1 << 30, 2 << 30
LAW = "generate --coefficients 1,2,6,-40,-40,400 --mass=-0.6 --shape 16"
QUICK = f"{LAW} --steps 30"
LONG = f"{LAW} --steps 120 --checkpoint run.pt --checkpoint-every 0 -o out.npy"
SYNTH = "synth -o out --atlas store --modality confocal --shape 6 --count 3 --workers 0"
BUILD = "atlas build out --shape 16 --design near.yaml --count 2 --workers 0"
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


CLAIMS: dict[str, bytes | Callable[[Path], object]] = {
    "a.npy": npy("(10000, 10000, 10000)") + bytes(100), "b.npy": npy(f"({10**30}, 2, 2)") + bytes(100),
    "a.nii": nifti(32767, 32767, 32767) + bytes(99), "a.nii.gz": gzip.compress(nifti(32767, 32767, 32767) + bytes(99)),
    "a.mrc": struct.pack("<4i", 30000, 30000, 30000, 2) + bytes(192) + b"MAP \x44\x44\0\0" + bytes(808),
    "a.nrrd": nrrd("30000 30000 30000", "raw") + bytes(100),
    "packed.nrrd": nrrd("30000 30000 30000", "gzip") + gzip.compress(bytes(100)),
    "loop.tif": b"II*\0\x08\0\0\0\0\0\x08\0\0\0",
    "a.h5": lambda path: hdf5(path, (2**40, 2**20, 8), chunks=(64, 64, 8)),
    "filled.h5": lambda path: hdf5(path, (3000,) * 3, chunks=(64,) * 3, fillvalue=2),
    "chunk.zarr": lambda path: zarr.create_array(path, shape=(10000,) * 3, chunks=(10000,) * 3, dtype="f4"),
    "sparse.tif": lambda path: path.touch() or os.truncate(path, 10**12),
    "sparse.npy": lambda path: path.touch() or os.truncate(path, 10**12),
    "whole.nii.gz": lambda path: path.write_bytes(swollen(nifti(1200, 1200, 1200))),
    "tail.nii.gz": lambda path: path.write_bytes(swollen(nifti(8, 8, 8))),
    "bomb.nrrd": lambda path: path.write_bytes(nrrd("8 8 8", "gzip") + swollen(b"")),
    "bomb.npz": lambda path: np.savez_compressed(path, big=np.broadcast_to(np.float32(0), (SWOLLEN >> 22, 1024, 1024))),
}  # fmt: skip


def test_what_no_memory_holds_is_refused(tmp_path: Path) -> None:
    """A header that claims it, and a file that swells to it."""
    for name, write in CLAIMS.items():
        (tmp_path / name).write_bytes(write) if isinstance(write, bytes) else write(tmp_path / name)
    before = {path: path.stat().st_mtime for path in tmp_path.rglob("*")}
    with contextlib.chdir(tmp_path):
        for name in CLAIMS:
            with bounds(MEMORY):
                result = call(*f"segment {name} --prior tubes --steps 1 -o out.nii.gz".split())
            refused(result, progress=True)
    assert {path: path.stat().st_mtime for path in tmp_path.rglob("*")} == before


@pytest.mark.parametrize("name", ["out.npy", "out.nii.gz", "out.ome.tif", "out.mrc", "out.zarr", "out.stl"])
def test_a_disk_that_is_full_is_said_and_leaves_nothing(tmp_path: Path, name: str) -> None:
    for size in (1, 4000):
        with contextlib.chdir(tmp_path), bounds(file=size):
            result = call(*f"{QUICK} --spacing 1 --unit um --no-picture -o {name}".split())
        refused(result, progress=True)
        assert not list(tmp_path.iterdir()), size


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


def test_a_run_that_is_ended_leaves_whole_files_and_goes_on(tmp_path: Path) -> None:
    """By a signal at a change of a file: afterwards the same command ends as an unbroken one does."""
    code, said = run(tmp_path / "whole", BUILD)
    changes = int(said.rpartition("changes ")[2])
    assert code == 0 and changes > 9, said
    folder = tmp_path / "ended"
    code, said = run(folder, BUILD, 1 + changes // 2, signal.SIGKILL)
    assert code in (0, -signal.SIGKILL) and "Traceback" not in said, said
    values(folder)
    assert (again := run(folder, BUILD))[0] == 0, (said, again)
    assert values(folder) == values(tmp_path / "whole")


def values(folder: Path) -> dict[str, bytes]:
    """The volumes that a command made, by name; all can be read, but for those that bear a temporary name."""
    names = [str(path.relative_to(folder)) for path in files_of(folder) if path.name.endswith((".npy", ".nii.gz"))]
    found = {name: load(folder / name).values.tobytes() for name in names if "/." not in f"/{name}"}
    for path in folder.glob("out/[0-9]*.npz"):
        with np.load(path) as draw:
            found[path.name] = draw["field"].tobytes() if "field" in draw else b""
    return found
