"""Any option of any command with any value, any damage of any file that a command reads: the law of `law.py` holds.

`CURVAFIT_HOSTILE=300 python -m pytest tests/hostile` draws so many examples for each command, new ones every time.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

pytest.importorskip("resource", reason="needs limits of memory and time")

from damage import FORMATS, files_of

from curvafit.cli.app import app
from tests.golden.inputs import FOLDER
from tests.golden.rows import COMMANDS
from tests.hostile.law import begins, obey

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs limits of memory and time"),
    pytest.mark.filterwarnings("default"),
]

EXAMPLES = int(os.environ.get("CURVAFIT_HOSTILE", "0"))
#: Of each command, and of all together.
FEW, MANY = (
    settings(
        max_examples=EXAMPLES or count,
        derandomize=not EXAMPLES,
        deadline=None,
        phases=[Phase.generate],
        print_blob=True,
        suppress_health_check=list(HealthCheck),
    )
    for count in (4, 60)
)
#: Commands that fetch a file.
FETCHING = {"demo", "samples get"}
#: What is typed to draw, which is no table, and to teach, which takes hours.
REFUSED = ("atlas map none.zarr -o out", "atlas train none.npz -o out.npz", "atlas teach none.zarr -o out.npz")

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


# ---- what is typed ---------------------------------------------------------------------------------------------------


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
            obey(folder, words)

    holds()


@contextlib.contextmanager
def inputs(line: str) -> Iterator[Path]:
    """A new folder with the files that a line names, and one that it does not."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "folder").mkdir()
        (folder / "folder" / "thesis.txt").write_text("the only copy")
        for word in line.split():
            if (FOLDER / word).is_dir():
                shutil.copytree(FOLDER / word, folder / word, dirs_exist_ok=True)
            elif (FOLDER / word).exists():
                (folder / word).parent.mkdir(exist_ok=True)
                shutil.copyfile(FOLDER / word, folder / word)
        yield folder


def plant(folder: Path, out: str, what: str | None) -> None:
    """Put something of the user's where a command writes."""
    if what == "folder":
        shutil.copytree(folder / "folder", folder / out)
    elif what == "link":
        (folder / out).symlink_to("folder")
    elif what == "file":
        (folder / out).write_text("the only copy")


# ---- what files hold -------------------------------------------------------------------------------------------------

#: What is done to the bytes of a file, at a place in it.
HARMS: dict[str, Callable[[bytes, int], bytes]] = {
    "flip": lambda content, place: content[:place] + bytes([content[place] ^ (1 << place % 8)]) + content[place + 1 :],
    "cut": lambda content, place: content[:place],
    "grow": lambda content, place: content + content[:place] + b"garbage",
    "zeros": lambda content, place: content[:place] + bytes(16) + content[place + 16 :],
    "ones": lambda content, place: content[:place] + b"\xff" * 16 + content[place + 16 :],
    "empty": lambda content, place: b"",
    "head": lambda content, place: b"\x89HDF\r\n\x1a\n" + content[8:],
    "text": lambda content, place: b"<html>404</html>",
    "nest": lambda content, place: b"[" * 100_000,
}
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
    place = draw(st.integers(0, max(0, len(content) - 1)) | st.integers(0, min(600, max(0, len(content) - 1))))
    return HARMS[draw(st.sampled_from(sorted(HARMS)))](content or b"\0", place)


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
            obey(folder, line.split())

    holds()


@MANY
@given(st.data(), st.sampled_from(sorted(FORMATS)))
def test_a_damaged_volume_of_any_format_is_measured_or_refused(data: st.DataObject, name: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, name)
        FORMATS[name](path)
        file = data.draw(st.sampled_from(sorted(files_of(path))))
        file.write_bytes(data.draw(harmed(file.read_bytes())))
        obey(Path(folder), ["measure", name, "-o", "out.csv"])


@MANY
@given(
    st.data(),
    st.sampled_from(["f8", "f4", "f2", "i8", "u8", "i1", "u2", "?", "c16", "U3", ">f4", "M8[s]"]),
    array_shapes(min_dims=0, max_dims=5, min_side=0, max_side=9),
)
def test_any_array_is_measured_or_refused(data: st.DataObject, kind: str, shape: tuple[int, ...]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder, "scan.npy"), data.draw(arrays(kind, shape)))
        obey(Path(folder), ["measure", "scan.npy", "-o", "out.json"])
