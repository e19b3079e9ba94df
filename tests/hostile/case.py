"""What a case is: a set-up, a command, and what may change; and the folder that it is played in."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

#: Columns of the table, in order.
COLUMNS = ("tracebacks", "lost", "torn", "misread", "hung", "wrong")


class Fault(NamedTuple):
    """What went wrong: a name of `COLUMNS`, and a sentence."""

    column: str
    said: str


@dataclass
class Place:
    """Where a case is played: `here` is the working folder, `larder` holds good inputs that no case may touch."""

    root: Path
    larder: Path
    rng: random.Random
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def here(self) -> Path:
        return self.root / "here"

    def take(self, name: str, target: str | None = None) -> Path:
        """A copy of something in the larder, under its own or another name."""
        source, place = self.larder / name, self.here / (target or name)
        place.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, place, dirs_exist_ok=True)
        else:
            shutil.copyfile(source, place)
        return place

    def plant(self, name: str, content: bytes | str = b"my thesis, the only copy\n") -> Path:
        """A file of the user's."""
        place = self.here / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content.encode() if isinstance(content, str) else content)
        return place


Setup = Callable[[Place], Any]
#: An inference that grows nothing, for a whole one takes longer than any case may; an atlas and an output follow.
INFER = ("infer", "{larder}/long.npy", "--fast", "--kind", "field", "--periodic", "--atlas")


@dataclass(frozen=True)
class Case:
    """One case.

    Parameters
    ----------
    id
        `class/name`, unique.
    setup
        Puts the inputs and the user's files into the place.
    command
        Arguments of curvafit; `{larder}` and `{here}` stand for the two folders.
    changes
        Patterns of what is there that the command may change: only its own earlier outputs, or what it resumes.
    stays
        Patterns of what a run that fails may leave, as the program documents.
    play
        How the case is played, where that is another way than once by a command.
    more
        What `play` needs.
    quick
        Whether the case is short enough for the quick part.
    """

    id: str
    setup: Setup
    command: tuple[str, ...] = ()
    changes: tuple[str, ...] = ()
    stays: tuple[str, ...] = ()
    play: Callable[[Case, Place], list[Fault]] | None = None
    more: Any = None
    quick: bool = True

    @property
    def kind(self) -> str:
        return self.id.partition("/")[0]

    def arguments(self, place: Place) -> list[str]:
        """The command with its folders put in."""
        known = {"{larder}": str(place.larder), "{here}": str(place.here)}
        told = list(self.command)
        for name, folder in known.items():
            told = [part.replace(name, folder) for part in told]
        return told


def nothing(_: Place) -> None:
    """A set-up that puts nothing there."""


def taking(*names: str) -> Setup:
    """A set-up that copies these from the larder."""

    def setup(place: Place) -> None:
        for name in names:
            place.take(name)

    return setup


def every(*setups: Setup) -> Setup:
    """Several set-ups in turn."""

    def setup(place: Place) -> None:
        for each in setups:
            each(place)

    return setup


def dice(seed: int, name: str) -> random.Random:
    """Random numbers of a seed and a name, the same everywhere."""
    return random.Random(f"{seed}:{name}")


def unique(cases: Iterable[Case]) -> list[Case]:
    """The cases, whose names must differ."""
    found = list(cases)
    names = [case.id for case in found]
    doubled = {name for name in names if names.count(name) > 1} if len(set(names)) < len(names) else set()
    if doubled:
        raise ValueError(f"expected cases with names of their own, got two named {', '.join(sorted(doubled)[:5])}")
    return found
