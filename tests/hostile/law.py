"""What holds of every command, whatever is typed and whatever its files hold.

The exit code is 0, 1 or 2. With 2 there is one sentence on the error stream, nothing on the other one, and the folder
is as it was; with 0 what is new can be read. What stood in the folder before stays, and no temporary name is left.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from calling import call, refused
from disk import tree

from curvafit.volumes.read import load

#: Bytes that a command may map, and seconds of processor that it may take.
ROOM, SECONDS = 3 << 30, 60
#: Commands that keep finished parts where they fail, and those that go on with a store that is there.
KEEPING, GROWING = ("atlas build", "atlas extend", "atlas describe", "synth"), ("atlas extend",)
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
    replaced = "out" if "--overwrite" in words else "store.zarr" if begins(words, GROWING) else None
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
def bounds() -> Iterator[None]:
    """Bound memory and time while a command runs in this process; Linux alone knows what is mapped."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before = signal.signal(signal.SIGPROF, _stop)
    resource.setrlimit(resource.RLIMIT_AS, (mapped + ROOM, hard))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
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
