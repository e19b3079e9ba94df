"""A record comes back as it was written or is refused, and a program replaces only what it wrote."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
import pytest
from disk import tree

from curvafit.core.records import Format, can_write, parse_json, read_archive, sibling

ATLAS = Format("ours", 2, "an atlas file", remedy="extract it again", fixed={"bins": [1, 2]})
NOTE = Format("note-1")
ARRAYS = {"points": np.arange(12.0).reshape(3, 4), "names": np.array(["a", "b"]), "f": np.asfortranarray(np.eye(3))}


def test_a_record_comes_back(tmp_path: Path) -> None:
    path = ATLAS.write(tmp_path / "a.npz", {"unit": "mm"}, ARRAYS)
    for source in (path, str(path), io.BytesIO(path.read_bytes())):
        header, arrays = ATLAS.read(source)
        assert header == {"format": "ours", "version": 2, "bins": [1, 2], "unit": "mm"}
        assert arrays.keys() == ARRAYS.keys() and all(np.array_equal(arrays[k], v) for k, v in ARRAYS.items())
    assert ATLAS.read(path, lambda header, arrays: header["unit"]) == "mm"
    assert NOTE.read(NOTE.write(tmp_path / "a.json", {"files": ["x"]})).header == {"format": "note-1", "files": ["x"]}
    assert sorted(tree(tmp_path)) == ["a.json", "a.npz"]


def test_every_bit_of_an_archive_counts_or_changes_nothing(tmp_path: Path) -> None:
    """A flipped bit or a cut ends in the same values or in a refusal."""
    path = ATLAS.write(tmp_path / "a.npz", {}, ARRAYS)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    damaged = [content[:n] for n in range(0, len(content), 97)]
    for place in rng.integers(0, len(content), 200):
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(rng.integers(8))
        damaged.append(bytes(flipped))
    refused = 0
    for each in damaged:
        path.write_bytes(each)
        try:
            arrays = ATLAS.read(path).arrays
        except ValueError:
            refused += 1
            continue
        assert all(np.array_equal(value, ARRAYS[name]) for name, value in arrays.items() if name in ARRAYS)
    assert refused > len(damaged) / 2


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with pytest.raises(FileNotFoundError, match="an atlas file"):
        ATLAS.read(path)
    os.mkfifo(tmp_path / "pipe")
    for content in (
        b"",
        b"PK",
        b"{",
        b"[]",
        b'{"format": "other"}',
        b"[" * 100_000,
        b'{"format": "ours", "format": 1}',
    ):
        path.write_bytes(content)
        for place in (path, tmp_path / "pipe"):
            with pytest.raises(ValueError, match="not an atlas file"):
                ATLAS.read(place)
        assert not ATLAS.owns(path) and not ATLAS.owns(tmp_path / "pipe")
    for other, word in [(Format("ours", 1, fixed=ATLAS.fixed), "version"), (Format("ours", 2), "bins")]:
        other.write(path, {}, ARRAYS)
        assert ATLAS.owns(path)
        with pytest.raises(ValueError, match=f"{word}.* instead of .*extract it again"):
            ATLAS.read(path)
    ATLAS.write(path, {}, ARRAYS)
    with pytest.raises(ValueError, match="lacks 'unit'"):
        ATLAS.read(path, lambda header, arrays: header["unit"])
    np.savez(path, header=np.array([object()]))
    with pytest.raises(ValueError, match="not an atlas file"):
        ATLAS.read(path)
    with pytest.raises(ValueError, match="NPZ"):
        read_archive(tmp_path / "pipe")


def test_a_program_replaces_only_what_it_wrote(tmp_path: Path) -> None:
    """A file of the format, and those that the record beside it lists together with it."""
    atlas, shape = tmp_path / "a.npz", tmp_path / "a.nii.gz"
    note, picture = sibling(shape, ".json"), sibling(shape, ".png")
    assert can_write(atlas, ATLAS) == atlas
    assert can_write(shape, NOTE, more=[note, picture]) == shape
    ATLAS.write(atlas, {}, ARRAYS)
    can_write(atlas, ATLAS)
    with pytest.raises(ValueError, match="overwrite"):
        can_write(atlas, NOTE)
    for path in (shape, picture):
        path.write_text("mine")
        with pytest.raises(ValueError, match="overwrite"):
            can_write(shape, NOTE, more=[note, picture])
    can_write(shape, NOTE, more=[note, picture], overwrite=True)
    NOTE.write(note, {"files": ["a.nii.gz", "a.json", "a.png"]})
    can_write(shape, NOTE, more=[note, picture])
    with pytest.raises(ValueError, match="overwrite"):
        can_write(sibling(shape, ".tif"), NOTE, more=[note])
    with pytest.raises(ValueError, match="input"):
        can_write(shape, NOTE, inputs=[f"{shape}::key"], overwrite=True)
    with pytest.raises(ValueError, match="folder"):
        can_write(tmp_path, NOTE, overwrite=True)


def test_a_file_that_somebody_changed_is_not_replaced(tmp_path: Path) -> None:
    form, target = Format("mask-test", title="a record"), tmp_path / "mask.npy"
    target.write_bytes(b"ours")
    form.write(tmp_path / "mask.json", {"files": ["mask.npy", "mask.json"]})
    assert can_write(target, form) == target
    later = (tmp_path / "mask.json").stat().st_mtime + 60
    os.utime(target, (later, later))
    with pytest.raises(ValueError, match="free"):
        can_write(target, form)
    assert can_write(target, form, overwrite=True) == target


def test_names_beside_a_file() -> None:
    cases = {"a/b.c.nii.gz": "a/b.c.json", "b.STL": "b.json", "b.OME.zarr": "b.json", "b": "b.json", ".b": ".b.json"}
    assert {name: str(sibling(name, ".json")) for name in cases} == cases


def test_json_that_is_read_is_sound() -> None:
    assert parse_json(b'\xef\xbb\xbf{"a": [1, 2.5, null]}', "JSON", "here") == {"a": [1, 2.5, None]}
    for text, word in [
        ("{\n,", "line 2"),
        (b"\xff", "UTF-8"),
        ("[" * 100_000, "deeply"),
        ("NaN", "finite"),
        ("1e999", "finite"),
        ("1" * 41, "41 digits"),
        ('{"a": 1, "a": 2}', "twice"),
    ]:
        with pytest.raises(ValueError, match=word):
            parse_json(text, "a header", "here")
