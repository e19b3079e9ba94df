"""Scanco's files, written here by their layout: values and place come back."""

import random
import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from damage import damaged
from disk import unreadable

from curvafit.volumes import ScanError, load

VALUES = np.random.default_rng(0).integers(-3000, 30000, (4, 5, 6)).astype("<i2")
MASK = np.where(np.random.default_rng(1).random((4, 5, 6)) < 0.5, 127, 0).astype("i1")
#: Edges (x, y, z) in µm, and the voxel of the scan in which an AIM begins.
EDGES, START = (10, 20, 30), (7, 8, 9)
LOG = b"! Processing Log \nMu_Scaling                                    8192\n" + b"!\n" * 250


def isq(values: np.ndarray = VALUES, blocks: int = 3) -> bytes:
    """Return an ISQ file whose values begin after some more blocks, with a block that is not full at its end."""
    shape = values.shape[::-1]
    numbers = [3, 0, 0, 1, 1, 0, 0, *shape, *(n * h for n, h in zip(shape, EDGES, strict=True)), 30, 30, 0, 0, 0, 8192]
    head = b"CTDATA-HEADER_V1" + struct.pack(f"<{len(numbers)}i", *numbers)
    return head.ljust(508, b"\0") + struct.pack("<i", blocks) + bytes(512 * blocks) + values.tobytes() + bytes(100)


def vax(number: float) -> bytes:
    first, second = struct.unpack("<2H", struct.pack("<f", 4 * number))
    return struct.pack("<2H", second, first)


def aim(version: int, kind: int, content: bytes, shape: tuple[int, ...] = VALUES.shape) -> bytes:
    """Return an AIM file; lengths are floats of VAX in mm in version 020, whole numbers of nm in 030."""
    code, magic, size = ("i", b"", 140) if version == 20 else ("q", b"AIMDATA_V030   \0", 224)
    head = struct.pack(f"<5{code}", 20 if version == 20 else 40, size, len(LOG), len(content), 0)
    places = struct.pack(f"<21{code}", *START, *shape[::-1], *([0] * 15))
    edges = b"".join(vax(h / 1000) if version == 20 else struct.pack("<q", 1000 * h) for h in EDGES)
    image = bytes(20 if version == 20 else 12) + struct.pack("<i", kind) + places + edges
    return magic + head + image.ljust(size, b"\0") + LOG + content


def runs(version: int, kind: int) -> bytes:
    """Return the mask as runs, the longest of which are 254."""
    flat = MASK.ravel()
    starts = np.flatnonzero(np.diff(flat, prepend=flat[0] + 1))
    lengths, values = np.diff(starts, append=flat.size), flat[starts].astype("u1")
    if kind == 0x00080002:
        content = np.column_stack([lengths, values]).astype("u1").tobytes()
    else:
        content = bytes([values[0], values[1], *lengths])
    return len(content + bytes(4 if version == 20 else 8)).to_bytes(4 if version == 20 else 8, "little") + content


FILES = {
    "SCAN.ISQ;1": (isq(), VALUES),
    **{f"{version}.aim": (aim(version, 0x00020002, VALUES.tobytes()), VALUES) for version in (20, 30)},
    "FLOATS.AIM;12": (aim(30, 0x001A0004, VALUES.astype("<f4").tobytes()), VALUES.astype("<f4")),
    **{
        f"{version}-{kind:x}.aim": (aim(version, kind, runs(version, kind)), MASK)
        for version in (20, 30)
        for kind in (0x00150001, 0x00080002)
    },
}


@pytest.mark.parametrize("name", FILES)
def test_values_and_place_are_those_of_the_file(tmp_path: Path, name: str) -> None:
    content, values = FILES[name]
    path = tmp_path / name
    path.write_bytes(content)
    field = load(path)
    assert field.values.dtype == values.dtype and np.array_equal(field.values, values)
    assert field.unit == "mm" and field.spacing == pytest.approx((0.03, 0.02, 0.01), rel=1e-6)
    start = (0, 0, 0) if "ISQ" in name else START
    flips = np.array([-0.01, -0.02, 0.03])
    assert (field.affine @ [1, 2, 3, 1])[:3] == pytest.approx(flips * np.add(start, (1, 2, 3)), rel=1e-6)
    assert any("8192" in note for note in field.notes) == (values is not MASK)
    part = load(path, crop="1:4,0:5,2:5")
    assert np.array_equal(part.values, values[1:4, :, 2:5])
    assert (part.affine @ [0, 0, 0, 1])[:3] == pytest.approx((field.affine @ [2, 0, 1, 1])[:3])


def test_a_run_longer_than_254_goes_on(tmp_path: Path) -> None:
    runs = bytes([0, 127, 255, 46, 100])  # 254 + 46 voxels of 0, then 100 of 127
    path = tmp_path / "mask.aim"
    path.write_bytes(aim(20, 0x00150001, struct.pack("<i", 9) + runs, (4, 10, 10)))
    assert np.array_equal(load(path).values.ravel(), np.repeat([0, 127], [300, 100]))


@pytest.mark.parametrize("name", FILES)
def test_damage_is_one_sentence(tmp_path: Path, name: str) -> None:
    content, _ = FILES[name]
    path = tmp_path / name
    whole = len(content) - 100 if "ISQ" in name else len(content)
    cut = [content[: min(size, whole - 1)] for size in (0, 15, 100, 500, 512, 1000, whole // 2, whole - 1)]
    for broken in (*cut, b"<!DOCTYPE html>" * 100):
        path.write_bytes(broken)
        unreadable(path)
    chance = random.Random(2)
    for _ in range(60):  # a broken header is a ScanError or read, never another fault
        path.write_bytes(damaged(content[:512], chance) + content[512:])
        with suppress(ScanError):
            load(path)
