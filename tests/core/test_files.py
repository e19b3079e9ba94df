"""What is written is whole or not there, and takes nobody else's place."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from disk import tree

from curvafit.core.files import (
    check_folder,
    is_empty,
    move_together,
    remove,
    remove_leftovers,
    temporary_folder,
    write_atomically,
    write_content,
)
from curvafit.core.records import Format, can_write, has_mark
from curvafit.volumes.field import Field
from curvafit.volumes.read import load
from curvafit.volumes.write import save


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
    assert [path.name for path in (tmp_path / "deep").iterdir()] == []


def test_a_link_is_replaced_and_not_what_it_leads_to(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "folder")
    write_content(tmp_path / "link", "new")
    assert tree(tmp_path) == {"folder/thesis": b"mine", "link": b"new"}
    (tmp_path / "other").symlink_to(tmp_path / "folder")
    remove(tmp_path / "other")
    assert tree(tmp_path) == {"folder/thesis": b"mine", "link": b"new"}


def test_what_a_killed_process_left_is_swept(tmp_path: Path) -> None:
    for name in (".0123abcd.run.pt", ".0123abcd.other.pt", ".0123abc.run.pt", "run.pt", ".run.pt"):
        (tmp_path / name).write_text("")
    remove_leftovers(tmp_path / "run.pt")
    assert sorted(tree(tmp_path)) == [".0123abc.run.pt", ".0123abcd.other.pt", ".run.pt", "run.pt"]


# ---- whose a place is ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["file", "folder", "hidden", "link to a file", "link to a folder"])
def test_a_place_that_is_taken_is_refused(what: str, tmp_path: Path) -> None:
    place, mine = tmp_path / "out", tmp_path / "elsewhere"
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
        can_write(tmp_path / "new", lambda path: False, more=[place])
    can_write(tmp_path / "new", lambda path: path == place, more=[place])
    can_write(tmp_path / "new", lambda path: False, more=[place], overwrite=True)
    assert tree(tmp_path) == before


def test_nothing_is_free_and_an_empty_folder_where_a_folder_goes(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    can_write(tmp_path / "none", is_empty, more=[tmp_path / "empty"])
    with pytest.raises(ValueError, match="folder"):
        can_write(tmp_path / "none", is_empty, more=[tmp_path / "link"])


def test_devices_and_pipes_are_never_written_over(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path / "pipe", Path(os.devnull)):
        with pytest.raises(ValueError, match="device"):
            can_write(place, lambda path: True, overwrite=True)


def test_a_pipe_is_no_record_and_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "out.json")
    assert not Format("ours").owns(tmp_path / "out.json") and not has_mark(tmp_path / "out.json", "x")


@pytest.mark.parametrize("overwrite", [False, True])
def test_an_input_is_never_written_over(overwrite: bool, tmp_path: Path) -> None:
    source = tmp_path / "scan"
    source.mkdir()
    (source / "0.tif").write_text("")
    os.link(source / "0.tif", tmp_path / "same.tif")
    (tmp_path / "link").symlink_to(source)
    cases = [
        ("scan", "scan"),
        ("scan/0.tif", "scan"),
        ("scan", "scan/out.tif"),
        ("scan/0.tif", "same.tif"),
        ("link", "scan"),
    ]
    for read, written in cases:
        with pytest.raises(ValueError, match="input"):
            inputs = [tmp_path / read]
            can_write(
                tmp_path / "new", lambda path: True, more=[tmp_path / written], inputs=inputs, overwrite=overwrite
            )
    with pytest.raises(ValueError, match="input"):
        can_write(source / "0.tif", lambda path: True, inputs=[f"{source / '0.tif'}::key"], overwrite=overwrite)
    can_write(tmp_path / "out.tif", lambda path: True, inputs=[source, "none.tif"], overwrite=overwrite)


def test_a_folder_that_cannot_take_files_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is a file"):
        check_folder(tmp_path / "file" / "deep")
    assert check_folder(tmp_path / "new" / "deep") == tmp_path / "new" / "deep"
    assert sorted(tree(tmp_path)) == ["file"]

    def read_only(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("tempfile.TemporaryFile", read_only)
    with pytest.raises(ValueError, match="written"):
        check_folder(tmp_path / "new")


# ---- Zarr stores -----------------------------------------------------------------------------------------------------

FIELD = Field(np.arange(70 * 6 * 5, dtype=np.float32).reshape(70, 6, 5), (0.1, 0.2, 0.3), "mm")


def test_save_replaces_its_own_stores_alone(tmp_path: Path) -> None:
    """Of the same kind, and with nothing of a user's put in since."""
    place = tmp_path / "a.zarr"
    for kind in ("volume", "volume"):
        save(FIELD, place, kind=kind)
    assert np.array_equal(load(place).values, FIELD.values)
    with pytest.raises(ValueError, match="overwrite"):
        save(FIELD, place, kind="mask")
    (place / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="overwrite"):
        save(FIELD, place)
    assert (place / "notes.txt").read_text() == "mine"
    save(FIELD, place, overwrite=True)
    assert not (place / "notes.txt").exists()


@pytest.mark.parametrize("damage", ["no zarr.json", "another's", "torn", "nested"])
def test_what_bears_no_mark_is_nobodys_to_replace(damage: str, tmp_path: Path) -> None:
    place = tmp_path / "a.zarr"
    save(FIELD, place)
    if damage == "no zarr.json":
        (place / "zarr.json").unlink()
    else:
        text = {"another's": '{"attributes": {"curvafit": 3}}', "torn": '{"attri', "nested": "[" * 100_000}[damage]
        (place / "zarr.json").write_text(text)
    before = tree(tmp_path)
    with pytest.raises(ValueError, match="overwrite"):
        save(FIELD, place)
    assert tree(tmp_path) == before
    shutil.rmtree(place)
    save(FIELD, place)
