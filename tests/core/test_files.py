"""What is written is whole or not there, and takes nobody else's place; a record comes back as it was written."""

import io
import os
import random
import shutil
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from damage import damaged
from disk import tree

from curvafit.core import files
from curvafit.core.files import (
    check_folder,
    is_empty,
    move_together,
    remove,
    temporary_folder,
    write_atomically,
    write_content,
)
from curvafit.core.records import Format, can_write, has_mark, parse_json, sibling
from curvafit.volumes import Volume, load, save


def test_a_file_is_the_new_one_or_the_old_one(tmp_path: Path) -> None:
    target = write_content(tmp_path / "new" / "a.txt", "one ", b"two")
    assert target.read_text() == "one two"

    def half(path: Path) -> None:
        path.write_text("half")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        write_atomically(target, half)
    assert tree(tmp_path) == {"new/a.txt": b"one two"}


def test_a_staged_folder_goes_with_what_was_not_moved(tmp_path: Path) -> None:
    with temporary_folder(tmp_path / "deep" / "out") as work:
        for name in "abc":
            (work / name).write_text(name)
        assert move_together([work / "a", work / "b"], tmp_path) == (tmp_path / "a", tmp_path / "b")
    with pytest.raises(KeyboardInterrupt), temporary_folder(tmp_path / "out") as work:
        (work / "half").write_text("")
        raise KeyboardInterrupt
    assert tree(tmp_path) == {"a": b"a", "b": b"b"}
    assert list((tmp_path / "deep").iterdir()) == []


def test_a_link_is_replaced_and_not_what_it_leads_to(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis").write_text("mine")
    for name in ("link", "other"):
        (tmp_path / name).symlink_to(tmp_path / "folder")
    write_content(tmp_path / "link", "new")
    files.remove(tmp_path / "other")
    assert tree(tmp_path) == {"folder/thesis": b"mine", "link": b"new"}


def test_what_a_killed_process_left_is_swept(tmp_path: Path) -> None:
    for name in (".0123abcd.run.pt", ".0123abcd.other.pt", ".0123abc.run.pt", "run.pt", ".run.pt"):
        (tmp_path / name).write_text("")
    files.remove_leftovers(tmp_path / "run.pt")
    assert sorted(tree(tmp_path)) == [".0123abc.run.pt", ".0123abcd.other.pt", ".run.pt", "run.pt"]


# ---- whose a place is ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["file", "folder", "hidden", "link to a file", "link to a folder"])
def test_a_place_that_is_taken_is_refused(what: str, tmp_path: Path) -> None:
    new, place, mine = (tmp_path / name for name in ("new", "out", "elsewhere"))
    mine.mkdir()
    (mine / "thesis").write_text("mine")
    if what == "file":
        place.write_text("mine")
    elif what.startswith("link"):
        place.symlink_to(mine / "thesis" if what.endswith("file") else mine)
    else:
        place.mkdir()
        (place / (".thesis" if what == "hidden" else "thesis")).write_text("mine")
    before = tree(tmp_path)
    with pytest.raises(ValueError, match="overwrite"):
        can_write(new, lambda path: False, more=[place])
    can_write(new, lambda path: path == place, more=[place])
    can_write(new, lambda path: False, more=[place], overwrite=True)
    assert tree(tmp_path) == before


def test_nothing_is_free_and_an_empty_folder_where_a_folder_goes(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    can_write(tmp_path / "none", is_empty, more=[tmp_path / "empty"])
    with pytest.raises(ValueError, match="folder"):
        can_write(tmp_path / "none", is_empty, more=[tmp_path / "link"])


def test_devices_and_pipes_are_never_written_over_nor_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    for place in (tmp_path / "pipe.json", Path(os.devnull)):
        with pytest.raises(ValueError, match="device"):
            can_write(place, lambda path: True, overwrite=True)
    assert not Format("ours").owns(tmp_path / "pipe.json") and not has_mark(tmp_path / "pipe.json", "x")


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    ("read", "written"),
    [
        ("scan", "scan"), ("scan/0.tif", "scan"), ("scan", "scan/out.tif"), ("scan/0.tif", "same.tif"),
        ("scan/0.tif::key", "scan/0.tif"), ("link", "scan"),
    ],
)  # fmt: skip
def test_an_input_is_never_written_over(read: str, written: str, overwrite: bool, tmp_path: Path) -> None:
    source, new = tmp_path / "scan", tmp_path / "new"
    source.mkdir()
    (source / "0.tif").write_text("")
    os.link(source / "0.tif", tmp_path / "same.tif")
    (tmp_path / "link").symlink_to(source)
    with pytest.raises(ValueError, match="input"):
        can_write(new, lambda path: True, more=[tmp_path / written], inputs=[tmp_path / read], overwrite=overwrite)
    can_write(new, lambda path: True, inputs=[source, "none.tif"], overwrite=overwrite)


def test_a_folder_that_cannot_take_files_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is a file"):
        check_folder(tmp_path / "file" / "deep")
    assert check_folder(tmp_path / "new" / "deep") == tmp_path / "new" / "deep"
    assert sorted(tree(tmp_path)) == ["file"]

    monkeypatch.setattr("tempfile.TemporaryFile", Mock(side_effect=OSError(30, "Read-only file system")))
    with pytest.raises(ValueError, match="written"):
        check_folder(tmp_path / "new")


FIELD = Volume(np.arange(70 * 6 * 5, dtype=np.float32).reshape(70, 6, 5), (0.1, 0.2, 0.3), "mm")


def test_save_replaces_its_own_stores_alone(tmp_path: Path) -> None:
    """Of the same kind, and with nothing of a user's put in since."""
    place = tmp_path / "a.zarr"
    for _ in range(2):
        save(FIELD, place, kind="volume")
    assert np.array_equal(load(place).values, FIELD.values)
    with pytest.raises(ValueError, match="overwrite"):
        save(FIELD, place, kind="mask")
    (place / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="overwrite"):
        save(FIELD, place)
    assert (place / "notes.txt").read_text() == "mine"
    save(FIELD, place, overwrite=True)
    assert not (place / "notes.txt").exists()


@pytest.mark.parametrize("damage", [None, '{"attributes": {"curvafit": 3}}', '{"attri', "[" * 100_000])
def test_what_bears_no_mark_is_nobodys_to_replace(damage: str | None, tmp_path: Path) -> None:
    """A mark that is not there, another's, torn, or nested too deeply."""
    place = tmp_path / "a.zarr"
    save(FIELD, place)
    (place / "zarr.json").unlink()
    if damage is not None:
        (place / "zarr.json").write_text(damage)
    before = tree(tmp_path)
    with pytest.raises(ValueError, match="overwrite"):
        save(FIELD, place)
    assert tree(tmp_path) == before


# ---- records ---------------------------------------------------------------------------------------------------------


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
    """Any damage ends in the same values or in a refusal."""
    path, chance, refused = ATLAS.write(tmp_path / "a.npz", {}, ARRAYS), random.Random(0), 0
    content = path.read_bytes()
    for _ in range(200):
        path.write_bytes(damaged(content, chance))
        try:
            arrays = ATLAS.read(path).arrays
        except ValueError:
            refused += 1
            continue
        assert all(np.array_equal(value, ARRAYS[name]) for name, value in arrays.items() if name in ARRAYS)
    assert refused > 100


TWICE = b'{"format": "ours", "format": 1}'


@pytest.mark.parametrize("content", [b"", b"PK", b"{", b"[]", b'{"format": "other"}', b"[" * 100_000, TWICE, None])
def test_other_files_are_refused(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    os.mkfifo(path) if content is None else path.write_bytes(content)  # a pipe may never end
    with pytest.raises(ValueError, match="not an atlas file"):
        ATLAS.read(path)
    assert not ATLAS.owns(path)


def test_records_of_another_version_or_content_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with pytest.raises(FileNotFoundError, match="an atlas file"):
        ATLAS.read(path)
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


def test_a_program_replaces_only_what_it_wrote(tmp_path: Path) -> None:
    """A file of the format, and those that the record beside it lists with it, but none that somebody changed since."""
    atlas, shape = ATLAS.write(tmp_path / "a.npz", {}, ARRAYS), tmp_path / "a.nii.gz"
    note, picture = sibling(shape, ".json"), sibling(shape, ".png")
    assert can_write(atlas, ATLAS) == atlas and can_write(shape, NOTE, more=[note, picture]) == shape
    for path in (shape, picture):
        path.write_text("mine")
        with pytest.raises(ValueError, match="overwrite"):
            can_write(shape, NOTE, more=[note, picture])
    can_write(shape, NOTE, more=[note, picture], overwrite=True)
    NOTE.write(note, {"files": ["a.nii.gz", "a.json", "a.png"]})
    can_write(shape, NOTE, more=[note, picture])
    later = note.stat().st_mtime + 60
    os.utime(shape, (later, later))
    for path, more, word, options in (
        (atlas, [], "overwrite", {}), (shape, [note, picture], "overwrite", {}),
        (sibling(shape, ".tif"), [note], "overwrite", {}), (tmp_path, [], "folder", {"overwrite": True}),
        (shape, [], "input", {"inputs": [f"{shape}::key"], "overwrite": True}),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=word):
            can_write(path, NOTE, more=more, **options)


def test_names_beside_a_file() -> None:
    cases = {"a/b.c.nii.gz": "a/b.c.json", "b.STL": "b.json", "b.OME.zarr": "b.json", "b": "b.json", ".b": ".b.json"}
    assert {name: str(sibling(name, ".json")) for name in cases} == cases


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("{\n,", "line 2"), (b"\xff", "UTF-8"), ("[" * 100_000, "deeply"), ("NaN", "finite"), ("1e999", "finite"),
        ("1" * 41, "41 digits"), ('{"a": 1, "a": 2}', "twice"),
    ],
)  # fmt: skip
def test_json_that_is_read_is_sound(text: str | bytes, word: str) -> None:
    assert parse_json(b'\xef\xbb\xbf{"a": [1, 2.5, null]}', "JSON", "here") == {"a": [1, 2.5, None]}
    with pytest.raises(ValueError, match=word):
        parse_json(text, "a header", "here")


def test_a_folder_that_goes_is_never_there_in_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that is killed while it deletes leaves nothing under the folder's name."""
    folder = tmp_path / "tiles"
    folder.mkdir()
    (folder / "run.json").write_text("{}")
    monkeypatch.setattr(shutil, "rmtree", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        remove(folder)
    assert not folder.exists() and all(path.name.startswith(".") for path in tmp_path.iterdir())
