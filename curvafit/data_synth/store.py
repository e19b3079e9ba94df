"""A store of generated shapes: Zarr groups, one a draw, each visible whole or not at all.

Layout, version 2 (every attribute is JSON in a group's `zarr.json`)::

    STORE/                 format, version, settings (shape, spacing, epsilon, blur, design, seed, schedule), and how
                           many viable shapes are wanted
    STORE/draws/000012/    the record of draw 12: parameters, mass, seed, steps, viability, energy, software versions;
                           and the SHA-256 of all that and the field
    STORE/draws/000012/field   the phase field, float32 (Z, Y, X), one checksummed chunk; absent where not viable

A draw is written beside its place, flushed to disk and renamed into it, so that a killed process loses no more than the
draw it was at. Draws that were not viable keep their record: a resumed build does not make them again.

Fields are float32, not float16: the stationarity fit reads Hess u where |u| is near 1 and ∇u near 0, and there
float16's half step of 2.4e-4 is a second difference of up to 1e-3 / Δx² = 10 in working units.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import shutil
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from curvafit.core.checks import SEEDS, check_float, check_int, quoted
from curvafit.core.files import temporary_folder, write_content
from curvafit.core.records import parse_json
from curvafit.core.runtime import hold_signals
from curvafit.generation.result import Viability, is_well_formed
from curvafit.generation.schedule import Schedule
from curvafit.priors.coefficients import NAMES, Coefficients
from curvafit.priors.grid import Grid

FORMAT = "curvafit shapes"
VERSION = 2
#: Name, behind a dot, of an unfinished draw's folder.
PARTIAL = "partial"


@dataclass(frozen=True)
class Settings:
    """What all draws of a store share; ε and blur are in spacing's unit, design and schedule as their `as_dict`."""

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    epsilon: float
    blur: float
    design: dict[str, Any]
    seed: int
    schedule: dict[str, Any]


@dataclass(frozen=True)
class Record:
    """The record of one draw: index, parameters, noise seed, steps made (fewer where rejected early), viability, final
    F_ε, the flow's status sentence, software versions and the seconds it took."""

    index: int
    coefficients: Coefficients
    mass: float
    seed: int
    steps: int
    viability: Viability
    energy: float
    status: str
    versions: dict[str, str]
    seconds: float


class Store:
    """The draws in a folder; any number of processes may write draws and read them. Open with `open_store`."""

    def __init__(self, path: Path, settings: Settings) -> None:
        self.path, self.settings = path, settings

    @property
    def name(self) -> str:
        """Return the name of the store's folder without the suffix, which names the store in atlases and tables."""
        return self.path.resolve().name.removesuffix(".zarr")

    @property
    def wanted(self) -> int:
        """Return how many viable shapes the store is to have."""
        return int((_read_attributes(self.path) or {"wanted": 0})["wanted"])

    def want(self, count: int) -> None:
        """Raise the number of viable shapes that are wanted to `count`; for one process at a time."""
        if count > self.wanted:
            file = self.path / "zarr.json"
            text = parse_json(file.read_bytes(), "a Zarr group", self.path)
            text["attributes"]["wanted"] = count
            write_content(file, json.dumps(text, indent=2))

    def indices(self) -> list[int]:
        """Return the draws with a complete record, in increasing order."""
        names = (entry.name for entry in (self.path / "draws").iterdir())
        return sorted(int(name) for name in names if name.isdigit() and self.has(int(name)))

    def has(self, index: int) -> bool:
        """Return whether the store has a draw, complete."""
        return bool(self._attributes(index))

    def record(self, index: int) -> Record:
        """Return the record of a draw; KeyError where the draw is missing, ValueError where it is damaged."""
        attributes = self._require(index)
        try:
            return _decode(attributes)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise self._describe_damage("record", index, error) from error

    def viable(self, index: int) -> bool:
        """Return whether a draw is recorded as a shape; KeyError where the draw is missing."""
        return self._require(index)["viability"]["viable"]

    def field(self, index: int) -> np.ndarray:
        """Return the phase field of a viable draw, float32 (Z, Y, X); KeyError and ValueError as for `record`."""
        folder = self._folder(index) / "field"
        if not self.has(index) or not folder.is_dir():
            raise KeyError(f"{self.path} has no viable draw {index}")
        try:
            array = zarr.open_array(store=str(folder), mode="r")
            if array.shape != self.settings.shape or array.dtype != np.float32:
                raise ValueError(f"{array.dtype} of shape {array.shape}")
            return np.asarray(array[...])
        except Exception as error:  # zarr and its codecs have many ways to say that a field is damaged
            raise self._describe_damage("field", index, error) from error

    def intact(self, index: int) -> bool:
        """Return whether a draw's record and field match their checksum; KeyError where the draw is missing."""
        attributes = self._require(index)
        try:
            field = self.field(index) if attributes["viability"]["viable"] else None
        except ValueError:  # a chunk that is truncated, or whose own checksum is wrong
            return False
        return _digest(attributes, field) == attributes["sha256"]

    def write(self, record: Record, field: np.ndarray | None) -> bool:
        """Add a draw, whole or not at all; return False, and change nothing, where the store has it already.

        The phase field is float32 of the store's shape, or None where the draw is not viable.
        """
        folder = self._folder(record.index)
        if self.has(record.index):
            return False
        for leftover in (self.path / "draws").glob(f".{PARTIAL}*"):
            if time.time() - leftover.stat().st_mtime > 600:  # a killed process left it
                shutil.rmtree(leftover, ignore_errors=True)
        with temporary_folder(self.path / "draws" / PARTIAL) as partial:
            _write_draw(partial / folder.name, record, field)
            if _publish(partial / folder.name, folder):
                return True
            if self.has(record.index):
                return False
            shutil.rmtree(folder)  # an incomplete draw is in its place
            return _publish(partial / folder.name, folder)

    def _describe_damage(self, part: str, index: int, error: Exception) -> ValueError:
        damage = f"the {part} of draw {index} in {self.path} is damaged ({quoted(str(error))})"
        return ValueError(f"{damage}: `curvafit atlas verify` lists such draws")

    def _require(self, index: int) -> dict[str, Any]:
        """Return a draw's attributes, or raise KeyError."""
        if attributes := self._attributes(index):
            return attributes
        raise KeyError(f"{self.path} has no complete draw {index}")

    def _folder(self, index: int) -> Path:
        return self.path / "draws" / f"{index:06d}"

    def _attributes(self, index: int) -> dict[str, Any]:
        """Return a draw's attributes, none where a part of it is missing; the field is not read."""
        folder = self._folder(index)
        attributes = _read_attributes(folder) or {}
        viability = attributes.get("viability")
        viable = viability.get("viable") if isinstance(viability, dict) else None
        complete = viable is False or (viable is True and (folder / "field/c/0/0/0").is_file())
        return attributes if complete and attributes.get("index") == index and "sha256" in attributes else {}


def open_store(path: str | Path, settings: Settings | None = None) -> Store:
    """Open a store; with `settings`, create it where there is none.

    Raises FileNotFoundError where there is none and no settings were given; ValueError where `path` holds something
    else, or a store of another version or of other settings.
    """
    path = Path(path)
    if not path.exists() or (settings is not None and path.is_dir() and not any(path.iterdir())):
        if settings is None:
            raise FileNotFoundError(f"found no store of shapes at {path}")
        _create(path, settings)
    attributes = _read_attributes(path)
    if attributes is None or attributes.get("format") != FORMAT:
        raise ValueError(f"{path} is not a store of shapes")
    if (version := attributes.get("version")) != VERSION:
        raise ValueError(f"{path} is a store of version {quoted(version)}; this curvafit reads version {VERSION}")
    try:
        stored = _decode_settings(attributes)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ValueError(f"the header of the store {path} is damaged ({quoted(str(error))})") from error
    if settings is not None:
        # Draws do not depend on the schedule's name.
        old, new = (dataclasses.asdict(one) | {"schedule": one.schedule | {"name": ""}} for one in (stored, settings))
        check_same(old, new, path)
    return Store(path, stored)


@lru_cache(maxsize=16)
def find_well_formed(paths: tuple[Path, ...]) -> list[tuple[Store, int]]:
    """Return the well-formed draws of stores, each as its store and index; a process looks for them once."""
    draws = []
    for store in map(open_store, paths):
        well_formed = [(store, index) for index in store.indices() if is_well_formed(store.record(index).viability)]
        if not well_formed:
            raise ValueError(f"the store {store.path} has no well-formed shapes")
        draws += well_formed
    return draws


def check_same(stored: Any, wanted: Any, path: Path, name: str = "") -> None:
    """Raise ValueError where settings, stored and wanted, differ, with the name of the first nested value that does."""
    if isinstance(stored, dict) and isinstance(wanted, dict) and stored.keys() == wanted.keys():
        for key in stored:
            check_same(stored[key], wanted[key], path, f"{name}.{key}" if name else key)
    elif stored != wanted:
        raise ValueError(f"{path} was begun with {name} {stored} and not {wanted}: choose another folder, or delete it")


def _decode_settings(attributes: dict[str, Any]) -> Settings:
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in attributes["settings"].items()}
    settings = Settings(**values)
    Grid(settings.shape, settings.spacing)
    sound = len(settings.shape) == len(settings.spacing) == 3 and bool(Schedule(**settings.schedule).steps)
    least = min(settings.blur, settings.seed, int(attributes["wanted"]))
    if not (sound and settings.epsilon > 0 and least >= 0):
        raise ValueError("a setting is missing or negative")
    return settings


def _create(path: Path, settings: Settings) -> None:
    """Write an empty store, whole or not at all."""
    exists = path.is_dir()  # an empty folder, which may be another disk's
    with temporary_folder(path / "store" if exists else path) as partial:
        header = {"format": FORMAT, "version": VERSION, "settings": dataclasses.asdict(settings), "wanted": 0}
        with hold_signals():
            zarr.create_group(store=str(partial / "store"), attributes=header)
            zarr.create_group(store=str(partial / "store" / "draws"))
        if exists:
            for part in ("draws", "zarr.json"):
                os.replace(partial / "store" / part, path / part)
        else:
            _publish(partial / "store", path)


@hold_signals()  # Zarr writes in threads of its own, which would go on beside what cleans up
def _write_draw(folder: Path, record: Record, field: np.ndarray | None) -> None:
    content = dataclasses.asdict(record) | {"coefficients": record.coefficients.as_dict()}
    # NumPy's numbers become Python's, and NaN and infinity null.
    attributes = json.loads(json.dumps(content, default=np.generic.item), parse_constant=lambda _: None)
    zarr.create_group(store=str(folder), attributes=attributes | {"sha256": _digest(attributes, field)})
    if field is not None:
        codecs = [BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"), Crc32cCodec()]
        options = {"chunks": field.shape, "compressors": codecs, "dimension_names": ("z", "y", "x")}
        zarr.create_array(store=str(folder / "field"), data=field, **options)


def _publish(partial: Path, target: Path) -> bool:
    """Flush a folder's files and rename it to `target`; return False where another process was first."""
    for file in partial.rglob("*"):
        if file.is_file():
            with file.open("rb+") as handle:
                os.fsync(handle.fileno())
    try:
        os.replace(partial, target)
    except OSError:
        if not target.is_dir():
            raise
        return False
    return True


def _read_attributes(folder: Path) -> dict[str, Any] | None:
    """Return the attributes of the Zarr group in a folder, None where there is no readable one."""
    try:
        text = parse_json((folder / "zarr.json").read_bytes(), "a Zarr group", folder)
    except (OSError, ValueError):
        return None
    attributes = text.get("attributes") if isinstance(text, dict) and text.get("node_type") == "group" else None
    return attributes if isinstance(attributes, dict) else None


def _digest(attributes: dict[str, Any], field: np.ndarray | None) -> str:
    """Return the SHA-256 of a record as canonical JSON, and of the field's bytes."""
    content = {name: value for name, value in attributes.items() if name != "sha256"}
    checksum = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    checksum.update(b"" if field is None else np.ascontiguousarray(field).tobytes())
    return checksum.hexdigest()


def _decode(attributes: dict[str, Any]) -> Record:
    viability = {field.name: attributes["viability"][field.name] for field in dataclasses.fields(Viability)}
    numbers = {name: _number(value) for name, value in viability.items() if name not in ("viable", "reason")}
    return Record(
        **{name: check_int(attributes[name], name, 0, SEEDS - 1) for name in ("index", "seed", "steps")},
        **{name: _number(attributes[name]) for name in ("mass", "energy", "seconds")},
        coefficients=Coefficients(*(_number(attributes["coefficients"][name]) for name in NAMES)),
        viability=Viability(**viability | numbers),
        status=str(attributes["status"]),
        versions=dict(attributes["versions"]),
    )


def _number(value: Any) -> Any:
    """Return a number of a record; null is NaN."""
    return math.nan if value is None else check_float(value, "a number")
