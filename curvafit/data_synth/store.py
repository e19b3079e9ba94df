"""A store of generated shapes: a folder of plain files, one for each draw, whole or not there.

Layout, version 3::

    STORE/curvafit.json    format, version and settings (shape, spacing, epsilon, blur, design, seed, schedule)
    STORE/000012.npz       draw 12: its record as JSON in `header` (parameters, mass, seed, steps, viability, energy,
                           software versions); and `field`, float32 (Z, Y, X), absent where not viable

A draw is written beside its place, flushed to disk and linked into it, so that a killed process loses no more than the
draw it was at; the checksums of NPZ files notice changed bytes. Draws that were not viable keep their record: a resumed
build does not make them again.

Fields are float32, not float16: the stationarity fit reads Hess u where |u| is near 1 and ∇u near 0, and there
float16's half step of 2.4e-4 is a second difference of up to 1e-3 / Δx² = 10 in working units.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import time
import zipfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from curvafit.core.checks import quoted
from curvafit.core.files import temporary_folder
from curvafit.core.records import Format, parse_json, read_member
from curvafit.core.schema import Rule, decode, encode
from curvafit.generation.result import Viability, is_well_formed
from curvafit.generation.schedule import Schedule
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid

STORE = Format("curvafit shapes", 3, "a store of shapes", remedy="build it anew in another folder")
DRAW = Format("curvafit shape", title="a draw of a store")
#: The record of the store.
HEADER = "curvafit.json"
#: What a process that was killed may leave.
_TEMPORARY = re.compile(r"\.(\d+\.npz|curvafit\.json)\.[0-9a-f]{8}|\.[0-9a-f]{8}\.curvafit\.json")


@dataclass(frozen=True)
class Settings:
    """What all draws of a store share; ε and blur are in spacing's unit, design and schedule as their `as_dict`."""

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    epsilon: Annotated[float, Rule(above=0)]
    blur: Annotated[float, Rule(least=0)]
    design: dict[str, Any]
    seed: Annotated[int, Rule(least=0)]
    schedule: dict[str, Any]


@dataclass(frozen=True)
class Record:
    """The record of one draw: index, parameters, noise seed, steps made (fewer where rejected early), viability, final
    F_ε, the flow's status sentence, software versions and the seconds it took."""

    index: Annotated[int, Rule(least=0)]
    coefficients: Coefficients
    mass: float
    seed: Annotated[int, Rule(least=0)]
    steps: Annotated[int, Rule(least=0)]
    viability: Viability
    energy: Annotated[float, Rule(unknown=True)]
    status: str
    versions: dict[str, str]
    seconds: float


class Store:
    """The draws in a folder; any number of processes may write draws and read them. Open with `open_store`."""

    def __init__(self, path: Path, settings: Settings) -> None:
        self.path, self.settings = path, settings

    @property
    def name(self) -> str:
        """Return the name of the store's folder, which names the store in atlases and tables."""
        return self.path.resolve().name

    def indices(self) -> list[int]:
        """Return the draws, in increasing order."""
        return sorted(int(path.stem) for path in self.path.glob("*.npz") if path.stem.isdigit())

    def has(self, index: int) -> bool:
        """Return whether the store has a draw."""
        return self._file(index).is_file()

    def record(self, index: int) -> Record:
        """Return the record of a draw; KeyError where the draw is missing, ValueError where it is damaged."""
        try:
            header = parse_json(self._member(index, "header").tobytes(), "a record", self._file(index))
            record = decode(Record, header)
            if record.index != index:
                raise ValueError(f"it is draw {record.index}")
        except ValueError as error:
            raise self._describe_damage("record", index, error) from error
        return record

    def viable(self, index: int) -> bool:
        """Return whether a draw is recorded as a shape; errors as for `record`."""
        return self.record(index).viability.viable

    def field(self, index: int) -> np.ndarray:
        """Return the phase field of a viable draw, float32 (Z, Y, X); KeyError and ValueError as for `record`."""
        try:
            field = self._member(index, "field")
            if field.shape != self.settings.shape or field.dtype != np.float32:
                raise ValueError(f"{field.dtype} of shape {field.shape}")
        except ValueError as error:
            raise self._describe_damage("field", index, error) from error
        return field

    def intact(self, index: int) -> bool:
        """Return whether a draw's record, and its field if it is viable, are there and match their checksums."""
        try:
            if self.viable(index):
                self.field(index)
        except (KeyError, ValueError):
            return False
        return True

    def write(self, record: Record, field: np.ndarray | None) -> bool:
        """Add a draw, whole or not at all; return False, and change nothing, where the store has it already.

        The phase field is float32 of the store's shape, or None where the draw is not viable.
        """
        if self.has(record.index):
            return False
        for entry in self.path.iterdir():
            if _TEMPORARY.fullmatch(entry.name) and time.time() - entry.stat().st_mtime > 600:  # of a killed process
                shutil.rmtree(entry, ignore_errors=True)
        # NumPy's numbers become Python's, and NaN and infinity null.
        text = json.dumps(dataclasses.asdict(record), default=np.generic.item)
        header, target = json.loads(text, parse_constant=lambda _: None), self._file(record.index)
        with temporary_folder(target) as work:
            DRAW.write(work / target.name, header, {} if field is None else {"field": field})
            return _publish(work / target.name, target)

    def _file(self, index: int) -> Path:
        return self.path / f"{index:06d}.npz"

    def _member(self, index: int, name: str) -> np.ndarray:
        """Return the record (`header`) or the field of a draw; errors as for `record`."""
        file = self._file(index)
        if not file.is_file():
            raise KeyError(f"{self.path} has no draw {index}")
        try:
            with zipfile.ZipFile(file) as archive:
                present = f"{name}.npy" in archive.namelist()
                member = read_member(archive, f"{name}.npy") if present else None
        except Exception as error:  # zipfile, zlib and numpy raise a dozen types of error
            raise ValueError(str(error)) from error
        if member is None and name == "header":
            raise ValueError("it has no record")
        if member is None:
            raise KeyError(f"{self.path} has no viable draw {index}")
        return member

    def _describe_damage(self, part: str, index: int, error: Exception) -> ValueError:
        damage = f"the {part} of draw {index} in {self.path} is damaged ({quoted(str(error))})"
        return ValueError(f"{damage}: `curvafit atlas verify` lists such draws")


def open_store(path: str | Path, settings: Settings | None = None) -> Store:
    """Open a store; with `settings`, create it where there is none, or an empty folder.

    Raises FileNotFoundError where there is none and no settings were given; ValueError where `path` holds something
    else, or a store of another version or of other settings.
    """
    path = Path(path)
    header = path / HEADER
    if not header.exists():
        if path.exists() and (settings is None or not _is_free(path)):
            raise ValueError(f"{path} is not a store of shapes: it has no {HEADER}")
        if settings is None:
            raise FileNotFoundError(f"found no store of shapes at {path}")
        STORE.write(header, {"settings": encode(settings)})
    stored = STORE.read(header, lambda content, _: _decode_settings(content["settings"]))
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


def check_same(old: Any, new: Any, path: Path, name: str = "") -> None:
    """Raise ValueError where old settings differ from new ones, with the name of the first nested value that does."""
    if isinstance(old, dict) and isinstance(new, dict) and old.keys() == new.keys():
        for key in old:
            check_same(old[key], new[key], path, f"{name}.{key}" if name else key)
    elif old != new:
        raise ValueError(f"{path} was begun with {name} {old} and not {new}: choose another folder, or delete it")


def _decode_settings(content: Any) -> Settings:
    settings = decode(Settings, content, "settings")
    Grid(settings.shape, settings.spacing)
    Schedule(**settings.schedule)
    return settings


def _is_free(path: Path) -> bool:
    """Return whether a folder is empty, but for files that a process is writing."""
    return path.is_dir() and all(_TEMPORARY.fullmatch(entry.name) for entry in path.iterdir())


def _publish(file: Path, target: Path) -> bool:
    """Give a finished file its name on the same disk; return False where another process was first."""
    try:
        os.link(file, target)
    except FileExistsError:
        return False
    except OSError:  # a disk that knows no links
        os.replace(file, target)
    return True
