"""JSON that is not what it was: wrong types, missing keys, numbers beyond all numbers, other encodings, deep nests."""

from __future__ import annotations

import copy
import io
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .case import INFER, Case, Place, Setup, dice, every, nothing, taking
from .larder import SYNTH

#: What takes the place of a value somewhere in a document, as JSON's text.
VALUES: dict[str, str] = {
    "null": "null", "true": "true", "text": '"text"', "empty": '""', "list": "[]", "table": "{}", "zero": "0",
    "minus": "-1", "huge": "1e308", "minus-huge": "-1e308", "tiny": "1e-320", "beyond": "1e400", "nan": "NaN",
    "infinity": "Infinity", "minus-infinity": "-Infinity", "400-digits": "9" * 400, "5000-digits": "7" * 5000,
    "number-text": '"1.5"', "nan-text": '"nan"', "digits-text": '"' + "9" * 400 + '"', "numbers": "[1, 2, 3]",
    "nested": '{"a": {"b": [null]}}', "nest": "[" * 900 + "]" * 900, "half": "0.5", "path": '"../../other"',
    "newline": '"a\\nb"', "nul": '"a\\u0000b"', "surrogate": '"\\ud800"', "long": '"' + "x" * 100_000 + '"',
    "many": "[" + ", ".join(["1"] * 5000) + "]", "three": "3", "fraction": "2.7", "minus-zero": "-0.0",
}  # fmt: skip

#: What is done to the whole text.
WHOLE: dict[str, Callable[[bytes, Any], bytes]] = {
    "empty": lambda text, rng: b"",
    "spaces": lambda text, rng: b" \n\t " * 100,
    "null": lambda text, rng: b"null",
    "list": lambda text, rng: b"[" + text + b"]",
    "string": lambda text, rng: json.dumps(text.decode()).encode(),
    "number": lambda text, rng: b"42",
    "digits": lambda text, rng: b"9" * 6000,
    "cut": lambda text, rng: text[: rng.randrange(1, len(text) - 1)],
    "bom": lambda text, rng: b"\xef\xbb\xbf" + text,
    "utf-16": lambda text, rng: text.decode().encode("utf-16"),
    "latin-1": lambda text, rng: text.replace(b"{", b'{"na\xefve": "\xfcber",', 1),
    "nul": lambda text, rng: text.replace(b",", b"\0,", 1),
    "nuls": lambda text, rng: bytes(len(text)),
    "nest": lambda text, rng: b"[" * 100_000 + b"]" * 100_000,
    "nest-open": lambda text, rng: b"[" * 100_000,
    "nest-tables": lambda text, rng: b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
    "nest-inside": lambda text, rng: text.replace(b"{", b'{"deep": ' + b"[" * 100_000 + b"]" * 100_000 + b",", 1),
    "twice": lambda text, rng: text + text,
    "tail": lambda text, rng: text + b"garbage",
    "quotes": lambda text, rng: text.replace(b'"', b"'"),
    "comment": lambda text, rng: b"// note\n" + text,
    "flip": lambda text, rng: _flipped(text, rng),
    "flips": lambda text, rng: _flipped(_flipped(_flipped(text, rng), rng), rng),
    "noise": lambda text, rng: rng.randbytes(500),
    "pickle": lambda text, rng: b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00.",
    "carriage": lambda text, rng: text.replace(b"\n", b"\r"),
    "doubled-keys": lambda text, rng: text.replace(b"{", b"{" + text.strip()[1:-1] + b",", 1),
}


class Document(NamedTuple):
    """A document, the command that reads it, and how many cases of values to make of it."""

    path: str
    command: tuple[str, ...]
    setup: Setup
    count: int
    changes: tuple[str, ...] = ()
    stays: tuple[str, ...] = ()
    whole: bool = True
    quick: bool = True


_SET = tuple(part.replace("{store}", "{larder}/store.zarr") for part in SYNTH)
_GENERATE = ("generate", "--prior", "fit.json", "--shape", "10", "--steps", "4", "-o", "out.npy")
_BEGUN = ("set", "set/*")
_GROWN = ("store.zarr", "store.zarr/*")
_FIT = taking("fit.json")

DOCUMENTS: dict[str, Document] = {
    "fit-generate": Document("fit.json", _GENERATE, _FIT, 36),
    "fit-nnunet": Document("fit.json", ("nnunet", "--prior", "fit.json"), _FIT, 24),
    "fit-segment": Document(
        "fit.json",
        ("segment", "scan.nii.gz", "--prior", "fit.json", "--steps", "2", "-o", "out.nii.gz"),
        taking("fit.json", "scan.nii.gz"),
        24,
        whole=False,
    ),
    "fit-synth": Document(
        "fit.json",
        ("synth", "-o", "set", "--prior", "fit.json", "--modality", "confocal", "--shape", "6", "--count", "1",
         "--workers", "0"),
        _FIT, 6, stays=_BEGUN, whole=False, quick=False,
    ),
    "fit-around": Document(
        "fit.json",
        ("atlas", "build", "out.zarr", "--around", "fit.json", "--count", "1", "--shape", "16", "--workers", "0"),
        _FIT, 6, stays=("out.zarr", "out.zarr/*"), whole=False, quick=False,
    ),
    "store-info": Document("store.zarr/zarr.json", ("atlas", "info", "store.zarr"), taking("store.zarr"), 26),
    "store-verify": Document(
        "store.zarr/zarr.json", ("atlas", "verify", "store.zarr"), taking("store.zarr"), 10,
        whole=False,
    ),
    "store-extend": Document(
        "store.zarr/zarr.json", ("atlas", "extend", "store.zarr", "--count", "0", "--workers", "0"),
        taking("store.zarr"), 12, changes=_GROWN, whole=False,
    ),
    "draw-info": Document("store.zarr/draws/000000/zarr.json", ("atlas", "info", "store.zarr"), taking("store.zarr"),
        34),
    "draw-verify": Document(
        "store.zarr/draws/000000/zarr.json", ("atlas", "verify", "store.zarr"),
        taking("store.zarr"), 16, whole=False,
    ),
    "draw-extract": Document(
        "store.zarr/draws/000000/zarr.json", ("atlas", "extract", "store.zarr", "-o", "out.npz"),
        taking("store.zarr"), 16, whole=False,
    ),
    "field-extract": Document(
        "store.zarr/draws/000000/field/zarr.json", ("atlas", "extract", "store.zarr", "-o", "out.npz"),
        taking("store.zarr"), 14, whole=False,
    ),
    "draw-synth": Document(
        "store.zarr/draws/000000/zarr.json",
        ("synth", "-o", "set", "--atlas", "store.zarr", "--modality", "confocal", "--shape", "6", "--count", "1",
         "--workers", "0"),
        taking("store.zarr"), 8, stays=_BEGUN, whole=False,
    ),
    "set": Document("set/curvafit.json", (*_SET, "--count", "4"), taking("set"), 26, changes=_BEGUN),
    "set-case": Document("set/cases/case_00001.json", (*_SET, "--count", "4"), taking("set"), 8, changes=_BEGUN),
    "record": Document(
        "shape.json", ("generate", *_GENERATE[1:-1], "shape.nii.gz"),
        every(_FIT, taking("shape.nii.gz", "shape.png", "shape.json")), 10, changes=("shape.*",),
    ),
    "scan-zarr": Document(
        "v3_group.zarr/volume/zarr.json",
        ("segment", "v3_group.zarr", "--prior", "tubes", "--steps", "1", "-o", "out.nii.gz"),
        taking("v3_group.zarr"), 20,
    ),
    "scan-zarray": Document(
        "v2_zlib.zarr/.zarray", ("segment", "v2_zlib.zarr", "--prior", "tubes", "--steps", "1", "-o", "out.nii.gz"),
        taking("v2_zlib.zarr"), 16, whole=False,
    ),
}  # fmt: skip


def cases(seed: int) -> Iterator[Case]:
    """Values and whole texts of every document, and the header of an atlas."""
    for name, each in DOCUMENTS.items():
        for k in range(each.count):
            value = dice(seed, f"{name} {k}").choice(sorted(VALUES) + ["missing"] * 5)
            yield _case(f"documents/{name}/{k:02d}-{value}", each, _altering(value, each.path))
        for what in WHOLE if each.whole else ():
            yield _case(f"documents/{name}/whole-{what}", each, _rewriting(WHOLE[what], each.path))
    for k in range(16):
        value = dice(seed, f"atlas {k}").choice([*sorted(VALUES), "missing"])
        command = (*INFER, "atlas.npz", "-o", "found")
        setup = every(taking("atlas.npz"), _altering_header(value))
        yield Case(f"documents/atlas/{k:02d}-{value}", setup, command, quick=False)


def _case(name: str, document: Document, alter: Setup) -> Case:
    setup = every(document.setup or nothing, alter)
    return Case(name, setup, document.command, document.changes, document.stays, quick=document.quick)


def _altering(value: str, path: str) -> Setup:
    def setup(place: Place) -> None:
        file = place.here / path
        file.write_bytes(altered(file.read_text(), value, place.rng).encode("utf-8", "surrogatepass"))

    return setup


def _rewriting(change: Callable[[bytes, Any], bytes], path: str) -> Setup:
    def setup(place: Place) -> None:
        file = place.here / path
        file.write_bytes(change(file.read_bytes(), place.rng))

    return setup


def _altering_header(value: str) -> Setup:
    """The same in the JSON that an atlas bears within."""

    def setup(place: Place) -> None:
        path = place.here / "atlas.npz"
        with np.load(path) as file:
            arrays = dict(file)
        text = altered(arrays["header"].tobytes().decode(), value, place.rng)
        arrays["header"] = np.frombuffer(text.encode("utf-8", "surrogatepass"), np.uint8)
        np.savez(path, **arrays)

    return setup


def altered(text: str, value: str, rng: Any) -> str:
    """The document with another value, or none, at a random place; places near the top are likelier."""
    content = copy.deepcopy(json.loads(text))
    places = [(node, key) for node, key, depth in _places(content, 0) for _ in range(max(1, 4 - depth))]
    node, key = rng.choice(places)
    if value == "missing":
        del node[key]
        return json.dumps(content, indent=2)
    node[key] = "@@here@@"
    return json.dumps(content, indent=2).replace('"@@here@@"', VALUES[value])


def _places(node: Any, depth: int) -> Iterator[tuple[Any, Any, int]]:
    pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, inner in list(pairs):
        yield node, key, depth
        yield from _places(inner, depth + 1)


def _flipped(text: bytes, rng: Any) -> bytes:
    content = bytearray(text)
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    return bytes(content)


def rezipped(path: Path, change: Callable[[str, bytes], bytes]) -> None:
    """A zip file with its members' contents changed."""
    with zipfile.ZipFile(path) as file:
        members = {name: change(name, file.read(name)) for name in file.namelist()}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for name, content in members.items():
            file.writestr(name, content)
    path.write_bytes(buffer.getvalue())
