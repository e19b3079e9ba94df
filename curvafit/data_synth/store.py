"""A store of generated shapes: Zarr groups, one a draw, each visible whole or not at all.

Layout, version 2 (every attribute is JSON in a group's `zarr.json`)::

    STORE/                 format, version, settings (shape, spacing, epsilon, blur, design, seed, schedule), and how
                           many viable shapes are wanted
    STORE/draws/000012/    the record of draw 12: parameters, mass, seed, steps, viability, energy, software versions;
                           and the SHA-256 of all that and the field
    STORE/draws/000012/field   the phase field, float32 (Z, Y, X), one checksummed chunk; absent where not viable

A draw is written beside its place, flushed to disk and renamed into it, so a killed process loses the draw it was
at and nothing else. Draws that were not viable keep their record: a resumed build does not make them again.

Fields are float32, not float16: the stationarity fit reads Hess u where |u| is near 1 and ∇u near 0, and there
float16's half step of 2.4e-4 is a second difference of up to 1e-3 / Δx² = 10 in working units.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from curvafit.core.checks import quoted
from curvafit.core.files import staged, write_content
from curvafit.core.records import parse_json
from curvafit.core.runtime import undisturbed
from curvafit.data_synth.record import Record, Settings, attributes_of, digest, record_of
from curvafit.generation.schedule import Schedule, present_name
from curvafit.priors.grid import Grid

FORMAT = "curvafit shapes"
VERSION = 2
#: What a draw's folder is called, behind a dot, until it is whole.
PARTIAL = "partial"
#: A draw's folder is written in less than this; an older one was left by a killed process.
_STALE_SECONDS = 600.0


class Store:
    """The draws in a folder; any number of processes may write draws and read them. Open with `open_store`."""

    def __init__(self, path: Path, settings: Settings) -> None:
        self.path, self.settings = path, settings

    @property
    def name(self) -> str:
        """Return the store's name in atlases and tables: its folder's, without the suffix."""
        return self.path.resolve().name.removesuffix(".zarr")

    @property
    def wanted(self) -> int:
        """Return how many viable shapes the store is to have."""
        attributes = _group_attributes(self.path)
        return 0 if attributes is None else int(attributes["wanted"])

    def want(self, count: int) -> None:
        """Set how many are wanted, where it is more than before; one process at a time."""
        if count > self.wanted:
            _rewrite(self.path, {"wanted": count})

    def indices(self) -> list[int]:
        """Draws with a complete record, in increasing order."""
        names = (entry.name for entry in (self.path / "draws").iterdir())
        return sorted(int(name) for name in names if name.isdigit() and self.has(int(name)))

    def has(self, index: int) -> bool:
        """Return whether a draw is there, complete."""
        return self._attributes(index) is not None

    def record(self, index: int) -> Record:
        """Return the record of a draw.

        Raises
        ------
        KeyError, ValueError
            If the draw is missing or incomplete, or its record damaged.
        """
        attributes = self._complete(index)
        try:
            return record_of(attributes)
        except ValueError as error:
            raise self._damaged("record", index, error) from error

    def viable(self, index: int) -> bool:
        """Return whether a draw is recorded as a shape.

        Raises
        ------
        KeyError
            If the draw is missing or incomplete.
        """
        return self._complete(index)["viability"]["viable"]

    def field(self, index: int) -> np.ndarray:
        """Return the phase field of a viable draw, float32 (Z, Y, X).

        Raises
        ------
        KeyError, ValueError
            If the draw is missing, incomplete or was not viable, or its field damaged.
        """
        folder = self._place(index) / "field"
        if not self.has(index) or not folder.is_dir():
            raise KeyError(f"expected a viable draw {index} in {self.path}, got none")
        try:
            array = zarr.open_array(store=str(folder), mode="r")
            if array.shape != self.settings.shape or array.dtype != np.float32:
                raise ValueError(f"{array.dtype} of shape {array.shape}")
            return np.asarray(array[...])
        except Exception as error:  # zarr and its codecs have many ways to say that a field is damaged
            raise self._damaged("field", index, error) from error

    def intact(self, index: int) -> bool:
        """Return whether a draw's record and field are, bit for bit, what was written.

        Raises
        ------
        KeyError
            If the draw is missing or incomplete.
        """
        attributes = self._complete(index)
        try:
            field = self.field(index) if attributes["viability"]["viable"] else None
        except ValueError:  # a chunk that is truncated, or whose own checksum is wrong
            return False
        return digest(attributes, field) == attributes["sha256"]

    def write(self, record: Record, field: np.ndarray | None) -> bool:
        """Add a draw, whole or not at all; False where it was there already (nothing is then changed).

        Raises
        ------
        ValueError
            If the field is missing for a viable record, present for another, or not float32 of the store's shape.
        """
        if record.viability.viable != (field is not None):
            raise ValueError(f"expected a field exactly for viable draws, got viable = {record.viability.viable}")
        if field is not None and (field.dtype != np.float32 or field.shape != self.settings.shape):
            raise ValueError(f"expected a float32 field {self.settings.shape}, got {field.dtype} {field.shape}")
        place = self._place(record.index)
        if self.has(record.index):
            return False
        self._clear_stale()
        with staged(self.path / "draws" / PARTIAL) as partial:
            _write_draw(partial / place.name, record, field)
            if _publish(partial / place.name, place):
                return True
            if self.has(record.index):
                return False
            shutil.rmtree(place)  # what is there is torn
            return _publish(partial / place.name, place)

    def _damaged(self, what: str, index: int, error: Exception) -> ValueError:
        state = f"got a damaged one ({quoted(str(error))}): `curvafit atlas verify` lists such draws"
        return ValueError(f"expected a whole {what} of draw {index} in {self.path}, {state}")

    def _complete(self, index: int) -> dict:
        attributes = self._attributes(index)
        if attributes is None:
            raise KeyError(f"expected a complete draw {index} in {self.path}, got none")
        return attributes

    def _place(self, index: int) -> Path:
        return self.path / "draws" / f"{index:06d}"

    def _attributes(self, index: int) -> dict | None:
        """Return a draw's attributes, None where anything of it is missing; a field's bytes are checked when it is
        read."""
        place = self._place(index)
        attributes = _group_attributes(place)
        if attributes is None or attributes.get("index") != index or "sha256" not in attributes:
            return None
        viability = attributes.get("viability")
        if not isinstance(viability, dict) or not isinstance(viability.get("viable"), bool):
            return None
        complete = not attributes["viability"]["viable"] or (place / "field" / "c" / "0" / "0" / "0").is_file()
        return attributes if complete else None

    def _clear_stale(self) -> None:
        for left in (self.path / "draws").glob(f".{PARTIAL}*"):
            if time.time() - left.stat().st_mtime > _STALE_SECONDS:
                shutil.rmtree(left, ignore_errors=True)


def open_store(path: str | Path, settings: Settings | None = None) -> Store:
    """Open a store; with `settings`, create it where there is none.

    Raises
    ------
    FileNotFoundError
        If there is nothing at `path` and no settings were given.
    ValueError
        If `path` holds something else, a store of another format version, or a store made with other settings.
    """
    path = Path(path)
    if not path.exists() or (settings is not None and path.is_dir() and not any(path.iterdir())):
        if settings is None:
            raise FileNotFoundError(f"expected a store of shapes at {path}, got nothing there")
        _create(path, settings)
    attributes = _group_attributes(path)
    if attributes is None or attributes.get("format") != FORMAT:
        raise ValueError(f"expected a store of shapes at {path}, got something else")
    if (version := attributes.get("version")) != VERSION:
        raise ValueError(f"expected a store of version {VERSION} at {path}, got version {quoted(version)}")
    stored = _settings(path, attributes)
    if settings is not None and _today(settings) != _today(stored):
        raise ValueError(f"expected the settings of {path}, got another {_difference(stored, settings)}")
    return Store(path, stored)


def _settings(path: Path, attributes: dict[str, Any]) -> Settings:
    """Return the settings in a store's header; its other entry is how many shapes are wanted."""
    try:
        values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in attributes["settings"].items()}
        settings = Settings(**values)
        Grid(settings.shape, settings.spacing)
        sound = len(settings.shape) == len(settings.spacing) == 3 and bool(Schedule(**settings.schedule).steps)
        if not (
            sound
            and settings.epsilon > 0
            and settings.blur >= 0
            and settings.seed >= 0
            and int(attributes["wanted"]) >= 0
        ):
            raise ValueError("a setting is missing or negative")
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        state = f"got one with a damaged header ({quoted(str(error))})"
        raise ValueError(f"expected a whole store of shapes at {path}, {state}") from error
    return settings


def _today(settings: Settings) -> Settings:
    """Return the settings with the schedule's name of today."""
    plan = settings.schedule
    return dataclasses.replace(settings, schedule=plan | {"name": present_name(plan)})


def _create(path: Path, settings: Settings) -> None:
    there = path.is_dir()  # an empty folder, which may be another disk's
    with staged(path / "store" if there else path) as partial:
        header = {"format": FORMAT, "version": VERSION, "settings": dataclasses.asdict(settings), "wanted": 0}
        with undisturbed():
            zarr.create_group(store=str(partial / "store"), attributes=header)
            zarr.create_group(store=str(partial / "store" / "draws"))
        if there:
            for part in ("draws", "zarr.json"):
                os.replace(partial / "store" / part, path / part)
        else:
            _publish(partial / "store", path)


@undisturbed()  # Zarr writes in threads of its own, which would go on beside what cleans up
def _write_draw(folder: Path, record: Record, field: np.ndarray | None) -> None:
    attributes = attributes_of(record)
    zarr.create_group(store=str(folder), attributes=attributes | {"sha256": digest(attributes, field)})
    if field is None:
        return
    array = zarr.create_array(
        store=str(folder / "field"),
        shape=field.shape,
        dtype=field.dtype,
        chunks=field.shape,
        compressors=[BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"), Crc32cCodec()],
        dimension_names=("z", "y", "x"),
    )
    array[...] = field


def _rewrite(folder: Path, attributes: dict[str, Any]) -> None:
    """Change attributes of the Zarr group in a folder, all at once."""
    text = parse_json((folder / "zarr.json").read_bytes(), "a Zarr group", folder)
    text["attributes"] |= attributes
    write_content(folder / "zarr.json", json.dumps(text, indent=2))


def _publish(partial: Path, place: Path) -> bool:
    """Flush a folder's files and rename it into its place; False where another process was first."""
    for file in partial.rglob("*"):
        if file.is_file():
            with file.open("rb+") as handle:
                os.fsync(handle.fileno())
    try:
        os.replace(partial, place)
    except OSError:
        if not place.is_dir():
            raise
        return False
    return True


def _group_attributes(folder: Path) -> dict | None:
    """Return the attributes of the Zarr group in a folder, None where there is no readable one."""
    try:
        text = parse_json((folder / "zarr.json").read_bytes(), "a Zarr group", folder)
    except (OSError, ValueError):
        return None
    known = isinstance(text, dict) and text.get("node_type") == "group"
    return attributes if known and isinstance(attributes := text.get("attributes"), dict) else None


def _difference(stored: Settings, wanted: Settings) -> str:
    """Return the first setting that differs, with both values."""
    for name, value in dataclasses.asdict(stored).items():
        other = getattr(wanted, name)
        if other != value:
            return f"{name}: {other} for {value}"
    return "one"
