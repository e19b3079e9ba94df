"""What a store holds, and whether it is whole."""

from __future__ import annotations

import os
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from curvafit.core.runtime import Progress, silent
from curvafit.data_synth.design import Design
from curvafit.data_synth.draws import flows, versions
from curvafit.data_synth.record import Record
from curvafit.data_synth.store import Store, open_store
from curvafit.generation.schedule import present_name


@dataclass(frozen=True)
class Verdict:
    """What is wrong with a store, a sentence each; what is only remarkable; and a sentence in all."""

    problems: tuple[str, ...]
    notes: tuple[str, ...]
    status: str


def census(store: Store) -> dict[str, str]:
    """Return the facts about a store, by name."""
    records = [store.record(index) for index in store.indices()]
    Design.from_dict(store.settings.design)
    settings, viable = store.settings, sum(record.viability.viable for record in records)
    return {
        "shapes": str(viable),
        "wanted": str(store.wanted),
        "draws": str(len(records)),
        "voxels": " x ".join(map(str, settings.shape)),
        "epsilon": f"{settings.epsilon:g} (voxel edges {', '.join(f'{edge:g}' for edge in settings.spacing)})",
        "design": _named(settings.design),
        "seed": str(settings.seed),
        "schedule": _schedule(settings.schedule),
        "made with": "; ".join(f"{text} ({count})" for text, count in Counter(map(_made_with, records)).items()),
        "seconds a draw": f"{np.mean([record.seconds for record in records]):.2f}" if records else "none",
        "size": f"{_size(store.path) / 1e6:.1f} MB",
    }


def verify(
    path: str | Path,
    regenerate: int = 3,
    seed: int = 0,
    progress: Progress = silent,
) -> Verdict:
    """Check every draw: that it is there, whole, itself and single; and that some come out again as they are.

    Parameters
    ----------
    regenerate, seed
        How many draws are made again, by this process, and the seed of their choice. Where Python, libraries and
        processor are those of the record, a field must come out bit for bit; elsewhere a difference is a note.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no store, it is of another version, or a number is negative.
    """
    for name, value in (("number of draws to make again", regenerate), ("seed", seed)):
        if value < 0:
            raise ValueError(f"expected a {name} from 0, got {value}")
    store = open_store(path)
    indices, problems, notes, sound = store.indices(), [], [], []
    design, viable = Design.from_dict(store.settings.design), 0
    for k, index in enumerate(indices):
        progress(f"{k} of {len(indices)} draws checked", k / (len(indices) + regenerate))
        viable += store.viable(index)
        if store.intact(index):
            sound.append(index)
            problems += _wrong(store, store.record(index), design)
        else:
            problems.append(
                f"draw {index} is not what was written: its checksum differs (delete draws/{index:06d}, and a build "
                "makes it again)"
            )
    missing = sorted(set(range(max(indices, default=-1) + 1)) - set(indices))
    lost = f"{len(missing)} draws are not there: {', '.join(map(str, missing[:9]))}"
    if missing or viable < store.wanted:
        (problems if missing and viable >= store.wanted else notes).append(
            f"{viable} of {store.wanted} shapes are made" + f"; {lost}" * bool(missing)
        )
    problems += _strangers(store, indices)
    sample = np.random.default_rng(seed).permutation(sound)[:regenerate].tolist()
    for k, index in enumerate(sample):
        progress(f"making draw {index} again", (len(indices) + k) / (len(indices) + regenerate))
        _compare(store, index, problems, notes)
    repeats = f"{len(sample)} made again"
    finding = "nothing is wrong" if not problems else f"{len(problems)} things are wrong"
    return Verdict(
        tuple(problems), tuple(notes), f"{len(indices)} draws, {viable} shapes checked, {repeats}: {finding}"
    )


def _wrong(store: Store, record: Record, design: Design) -> list[str]:
    """Return the faults of one intact draw, its flow aside."""
    if (record.coefficients, record.mass, record.seed) != design.draw(store.settings.seed, record.index):
        return [f"draw {record.index} has other parameters than the design's"]
    if record.viability.viable:
        field = store.field(record.index)
        if not np.isfinite(field).all() or not field.min() < 0 < field.max():
            return [f"draw {record.index} is recorded as a shape, but has no surface"]
    return []


def _strangers(store: Store, indices: list[int]) -> list[str]:
    """Return the entries of the folder that are neither draws, those that a build adds meanwhile among them, nor what a
    killed worker leaves."""
    expected = {f"{index:06d}" for index in indices} | {"zarr.json"}
    entries = (each.name for each in (store.path / "draws").iterdir())
    others = sorted(name for name in entries if name not in expected and not name.startswith("."))
    strangers = [name for name in others if not (len(name) == 6 and name.isdigit() and store.has(int(name)))]
    return [f"draws/{name} is torn, or no draw" for name in strangers]


def _compare(store: Store, index: int, problems: list[str], notes: list[str]) -> None:
    """Make a draw again, and say where it differs."""
    record = store.record(index)
    ((_, flow),) = flows(store.settings, [index])
    same = flow.viability.viable == record.viability.viable
    if same and record.viability.viable:
        same = np.array_equal(flow.field.cpu().numpy().astype(np.float32), store.field(index))
    if same:
        return
    if record.versions == versions():
        problems.append(f"draw {index} came out otherwise when it was made again")
    else:
        notes.append(f"draw {index} came out otherwise, made with {_made_with(record)}")


def _size(folder: Path) -> int:
    """Return the bytes of a folder's files; those that a build takes away meanwhile do not count."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):
                total += os.stat(os.path.join(place, name)).st_size
    return total


def _named(design: dict) -> str:
    points = len(design.get("points", ()))
    return f"{design['law']} of {points} points" if points else f"{design['law']} in {design['box']}"


def _schedule(fields: dict) -> str:
    """Return a schedule's name today, that in the record where it is another, and the number of steps."""
    name, recorded = present_name(fields), fields["name"]
    return f"{name}{f' (named {recorded} then)' * (name != recorded)}, {fields['steps']} steps"


def _made_with(record: Record) -> str:
    return ", ".join(f"{name} {version}" for name, version in record.versions.items())
