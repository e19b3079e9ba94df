"""Damaged volumes: flipped bits, files cut short, rubbish behind them, chunks that are missing.

Each is read by `curvafit.load` and compared with the truth; some go through a command as well.
"""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .case import Case, Fault, Place, dice
from .judge import spoken
from .sandbox import Job, run
from .volumes import FORMATS, STORES

#: How often each kind of damage is done to each format.
FLIPS, BLIND, CUTS, TAILS, HOLES = 14, 6, 5, 2, 2
#: What a reader may raise: the command line makes one sentence of these.
_REFUSALS = (ValueError, OSError, ImportError, MemoryError)


def cases(seed: int) -> Iterator[Case]:
    """Flips where something vouches for the bytes and where nothing does, cuts, tails, holes."""
    for name in [*FORMATS, "bare.raw"]:
        vouched = 0 if name == "bare.raw" else FLIPS
        yield from _loads(name, "flip", vouched, _flip_vouched)
        yield from _loads(name, "blind", BLIND, _flip_anywhere)
        yield from _loads(name, "cut", CUTS, _cut)
        yield from _loads(name, "tail", TAILS, _lengthen)
        yield from _loads(name, "hole", HOLES, _blank)
    for name, (_, _, vouched) in STORES.items():
        yield from _loads(name, "flip", FLIPS // 2 if vouched else 0, _in_chunk(_flip_bit))
        yield from _loads(name, "cut", CUTS, _in_chunk(_cut_file))
        yield from _loads(name, "missing", 4, _in_chunk(lambda path, rng: path.unlink()))
        yield from _loads(name, "empty", 1, _in_chunk(lambda path, rng: path.write_bytes(b"")))
        yield from _loads(name, "blind", BLIND, _in_metadata(_flip_bit))
        yield from _loads(name, "meta", 3, _in_metadata(_cut_file))
    yield from _loads("series", "cut", CUTS, _in_slice(_cut_file))
    yield from _loads("series", "blind", BLIND, _in_slice(_flip_bit))
    yield from _loads("series", "missing", 4, _inner_slice)
    yield from _commands(seed)


def _loads(name: str, what: str, count: int, harm: Callable[[Path, Any], object]) -> Iterator[Case]:
    for k in range(count):

        def setup(place: Place) -> None:
            harm(place.take(name), place.rng)

        yield Case(f"damage/{name}/{what}-{k:02d}", setup, play=_load, more=(name, what == "blind"))


def _commands(seed: int) -> Iterator[Case]:
    """The same damage seen from the command line."""
    for name, each in FORMATS.items():
        for k in range(3):
            rng = dice(seed, f"{name}{k}")
            harm = rng.choice((_flip_anywhere, _cut, _flip_vouched if each.vouched else _cut))
            source, out = f"{name}::volume" if name.endswith(".h5") else name, rng.choice(("m.nii.gz", "m.tif"))

            def setup(place: Place, name: str = name, harm: Any = harm) -> None:
                harm(place.take(name), place.rng)

            command = ("segment", source, "--prior", "tubes", "--steps", "1", "-o", out)
            yield Case(f"damage-command/{name}/{k}", setup, command)
    for name in STORES:

        def groups(place: Place, name: str = name) -> None:
            for part in ("first/a", "first/b", "second/c", "second/d"):
                store = place.take(name, f"{part}.zarr")
            _in_chunk(lambda path, rng: path.unlink())(store, place.rng)

        yield Case(f"damage-command/{name}/0", groups, ("compare", "first", "second", "--strict", "-o", "out"))


def _load(case: Case, place: Place) -> list[Fault]:
    """Read the damaged volume and compare it with the sound one."""
    name, blind = case.more
    outcome = run(_loading(name, place.root / "loaded"), place.here, place.root / "said")
    if outcome.hung or outcome.code != 0:
        return spoken(outcome, (0,))
    with (place.root / "loaded").open("rb") as stream:
        found = pickle.load(stream)
    if "refused" in found or blind:
        return []
    with (place.larder / f"{name}.truth").open("rb") as stream:
        sound = pickle.load(stream)
    told = set(found["notes"]) - set(sound["notes"])
    other = [part for part in ("values", "spacing", "unit", "affine") if not _same(found[part], sound[part])]
    return [Fault("misread", f"read without a word with other {', '.join(other)}")] if other and not told else []


def _same(one: Any, other: Any) -> bool:
    if one is None or other is None or isinstance(one, str):
        return one is other or one == other
    return np.shape(one) == np.shape(other) and bool(np.array_equal(one, other))


def _loading(name: str, out: Path) -> Job:
    """The job of reading a volume and leaving what was read, or that it was refused."""

    def job() -> None:
        import curvafit

        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            try:
                field = curvafit.load(name, **({"raw_shape": (9, 10, 12), "dtype": "u2"} if ".raw" in name else {}))
            except _REFUSALS as error:
                found: dict[str, Any] = {"refused": str(error)}
            else:
                notes = [*field.notes, *(str(each.message) for each in said if each.category is UserWarning)]
                found = {"values": field.values, "spacing": field.spacing, "unit": field.unit}
                found |= {"affine": field.affine, "notes": notes}
        with out.open("wb") as stream:
            pickle.dump(found, stream)

    return job


def write_truths(larder: Path) -> None:
    """What every sound volume is read as.

    Raises
    ------
    RuntimeError
        If one cannot be read: there is nothing to compare with then.
    """
    for name in (*FORMATS, *STORES, "bare.raw", "series"):
        outcome = run(_loading(name, larder / f"{name}.truth"), larder, larder.parent / "said")
        with (larder / f"{name}.truth").open("rb") as stream:
            found = pickle.load(stream) if outcome.code == 0 else {"refused": outcome.stderr}
        if "refused" in found:
            raise RuntimeError(f"expected {name} to be readable, got: {found['refused']}")


# ---- harm ------------------------------------------------------------------------------------------------------------


def _flip_bit(path: Path, rng: Any, first: int = 0, last: int | None = None) -> None:
    content = bytearray(path.read_bytes())
    place = rng.randrange(first, len(content) if last is None else last)
    content[place] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


def _flip_vouched(path: Path, rng: Any) -> None:
    """A bit that a checksum or a size vouches for; a cut where there is none."""
    parts = FORMATS[path.name].vouched(path)
    if not parts:
        return _cut(path, rng)
    first, last = rng.choice(parts)
    return _flip_bit(path, rng, first, last)


def _flip_anywhere(path: Path, rng: Any) -> None:
    """A bit of the first 600 bytes, where headers are, or of all."""
    size = path.stat().st_size
    _flip_bit(path, rng, 0, min(size, 600) if rng.random() < 0.7 else size)


def _cut_file(path: Path, rng: Any) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: rng.randrange(len(content))])


def _cut(path: Path, rng: Any) -> None:
    """Cut anywhere, often near the end."""
    content = path.read_bytes()
    short = rng.randrange(1, 60) if rng.random() < 0.5 else rng.randrange(1, len(content))
    path.write_bytes(content[: max(0, len(content) - short)])


def _lengthen(path: Path, rng: Any) -> None:
    with path.open("ab") as stream:
        stream.write(rng.randbytes(rng.randrange(1, 5000)))


def _blank(path: Path, rng: Any) -> None:
    """Sixty-four zeros where something vouches for the bytes; a cut where nothing does."""
    parts = [] if path.name == "bare.raw" else [p for p in FORMATS[path.name].vouched(path) if p[1] - p[0] > 64]
    if not parts:
        return _cut(path, rng)
    content = bytearray(path.read_bytes())
    first, last = rng.choice(parts)
    start = rng.randrange(first, last - 64)
    content[start : start + 64] = bytes(64)
    path.write_bytes(content)
    return None


def _in_chunk(harm: Callable[[Path, Any], object]) -> Callable[[Path, Any], None]:
    """To one of a store's chunks."""

    def done(store: Path, rng: Any) -> None:
        chunks = sorted(p for p in store.rglob("*") if p.is_file() and not p.name.startswith((".", "zarr.json")))
        harm(rng.choice(chunks), rng)

    return done


def _in_metadata(harm: Callable[[Path, Any], object]) -> Callable[[Path, Any], None]:
    def done(store: Path, rng: Any) -> None:
        files = sorted(p for p in store.rglob("*") if p.name in ("zarr.json", ".zarray", ".zattrs", ".zgroup"))
        harm(rng.choice(files), rng)

    return done


def _in_slice(harm: Callable[[Path, Any], object]) -> Callable[[Path, Any], None]:
    def done(folder: Path, rng: Any) -> None:
        harm(rng.choice(sorted(folder.iterdir())), rng)

    return done


def _inner_slice(folder: Path, rng: Any) -> None:
    """Without a slice that is neither the first nor the last."""
    rng.choice(sorted(folder.iterdir())[1:-1]).unlink()
