"""Ctrl-C and SIGTERM at moments drawn by the seed: at the n-th change of a file, or after a share of the time.

Afterwards nothing is torn, no temporary name is left, and the same command comes to its end; where a run can be
resumed, to the same values as an unbroken one.
"""

from __future__ import annotations

import fcntl
import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .case import INFER, Case, Fault, Place, Setup, dice, nothing, taking
from .judge import left, matching, spoken, standing
from .larder import BUILD, LONG, QUICK, SYNTH
from .moments import counting, killing
from .outputs import content
from .sandbox import Job, Outcome, commanding, finish, run, start

_SET = tuple(part.replace("{store}", "{larder}/store.zarr") for part in SYNTH)


class Scene(NamedTuple):
    """A command, what it may keep when it is stopped, and the array that shows that it was resumed."""

    command: tuple[str, ...]
    keeps: tuple[str, ...] = ()
    setup: Setup = nothing
    same: str = ""
    count: int = 8
    quick: bool = True


SCENES: dict[str, Scene] = {
    "generate": Scene(("generate", *QUICK, "-o", "out.nii.gz"), same="out.nii.gz"),
    "generate-zarr": Scene(("generate", *QUICK, "--snapshots", "10", "-o", "out.zarr"), same="out.zarr", count=6),
    "generate-stl": Scene(("generate", *QUICK, "-o", "out.stl"), count=4),
    "generate-checkpoint": Scene(("generate", *LONG, "-o", "long.npy"), ("run.pt",), same="long.npy", count=12),
    "generate-resumed": Scene(("generate", *LONG, "-o", "long.npy"), ("run.pt",), taking("run.pt"), "long.npy"),
    "build": Scene((*BUILD, "--count", "3"), ("store.zarr", "store.zarr/*"), same="store.zarr", count=12),
    "extend": Scene(
        ("atlas", "extend", "store.zarr", "--count", "1", "--workers", "0"), ("store.zarr", "store.zarr/*"),
        taking("store.zarr"), count=6,
    ),
    "extract": Scene(("atlas", "extract", "{larder}/store.zarr", "-o", "out.npz"), count=4),
    "synth": Scene((*_SET, "--count", "3"), ("set", "set/*"), same="set", count=20),
    "segment": Scene(
        ("segment", "{larder}/scan.nii.gz", "--prior", "tubes", "--steps", "4", "-o", "out.nii.gz"), same="out.nii.gz",
        count=6,
    ),
    "infer": Scene(
        (*INFER, "{larder}/atlas.npz", "-o", "found"), ("found",),
        count=5, quick=False,
    ),
}  # fmt: skip


def cases(seed: int) -> Iterator[Case]:
    """Each scene with both signals, at changes of files and at times."""
    for name, scene in SCENES.items():
        for k in range(scene.count):
            number = (signal.SIGTERM, signal.SIGINT)[k % 2]
            rng = dice(seed, f"{name} {k}")
            moment = ("change", rng.random()) if k % 4 < 3 else ("time", rng.random())
            yield Case(
                f"signals/{name}/{k:02d}-{number.name.lower()}-{moment[0]}", scene.setup, scene.command,
                changes=scene.keeps, stays=scene.keeps, play=_play, more=(scene, number, moment), quick=scene.quick,
            )  # fmt: skip


def _play(case: Case, place: Place) -> list[Fault]:
    """Measure an unbroken run elsewhere, break one here, judge, run again, compare."""
    scene, number, moment = case.more
    job = commanding(case.arguments(place))
    whole = _unbroken(case, place, job)
    if whole["code"] != 0:
        return [Fault("wrong", f"unbroken, it ends with {whole['code']}: {whole['stderr'].strip()[-200:]}")]
    before = standing(place.here)
    outcome = _broken(job, place, number, moment, whole)
    stopped = {signal.SIGINT: (130,), signal.SIGTERM: (143, -signal.SIGTERM)}[number]
    found = [*_said(outcome, (0, *stopped)), *left(case, place, before, outcome.code)]
    if found or outcome.hung:
        return found
    again = run(job, place.here, place.root / "said-again")
    if again.code != 0:
        return [Fault("torn", f"the same command again ends with {again.code}: {again.stderr.strip()[-200:]}")]
    return [*spoken(again), *left(case, place, before, 0), *_compared(place, scene, whole["here"])]


def _unbroken(case: Case, place: Place, job: Job) -> dict[str, Any]:
    """An unbroken run, made once for a scene: how long it takes, and how many changes of files it makes."""
    folder = place.root.parent / "unbroken" / case.id.split("/")[1]
    folder.mkdir(parents=True, exist_ok=True)
    told = folder / "told.json"
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not told.exists():
            other = Place(folder, place.larder, place.rng)
            other.here.mkdir(exist_ok=True)
            case.setup(other)
            outcome = run(job, other.here, folder / "said", (counting(other.here, folder / "changes"),))
            changes = int((folder / "changes").read_text()) if (folder / "changes").exists() else 1
            said = {"code": outcome.code, "seconds": outcome.seconds, "changes": changes, "stderr": outcome.stderr}
            told.write_text(json.dumps(said))
    return {"here": folder / "here", **json.loads(told.read_text())}


def _broken(job: Job, place: Place, number: int, moment: tuple[str, float], whole: dict[str, Any]) -> Outcome:
    kind, share = moment
    if kind == "change":
        count = 1 + int(share * whole["changes"])
        return run(job, place.here, place.root / "said", (killing(number, place.here, count),))
    running = start(job, place.here, place.root / "said")
    time.sleep(share * whole["seconds"])
    running.stop(number)
    return finish(running)


def _said(outcome: Outcome, codes: tuple[int, ...]) -> list[Fault]:
    """A run that a signal ends has no other code, and says at most one sentence."""
    found = spoken(outcome, codes)
    lines = [line for line in outcome.stderr.splitlines() if line.strip() and not line.startswith(("[", "note: "))]
    if not found and outcome.code not in (0, -signal.SIGTERM) and len(lines) > 1:
        found.append(Fault("wrong", f"exit code {outcome.code} with {len(lines)} lines: {' | '.join(lines)[:200]}"))
    return found


def _compared(place: Place, scene: Scene, whole: Path) -> list[Fault]:
    if not scene.same:
        return []
    one, other = (arrays(folder / scene.same) for folder in (place.here, whole))
    if one.keys() != other.keys():
        return [Fault("torn", f"run again, it holds {len(one)} arrays, unbroken {len(other)}")]
    apart = [name for name in one if not np.array_equal(one[name], other[name])]
    return [Fault("torn", f"run again, it ends in other values than unbroken: {apart[0]}")] if apart else []


def arrays(path: Path) -> dict[str, Any]:
    """The volumes that a command made, by their names below `path`."""
    if path.name == "store.zarr":
        import zarr

        fields = sorted(path.glob("draws/*/field"))
        return {
            str(field.relative_to(path)): np.asarray(zarr.open_array(str(field), mode="r")[...]) for field in fields
        }
    if path.name == "set":
        files = sorted(path.glob("*Tr/*.nii.gz"))
        return {str(file.relative_to(path)): content(file) for file in files if not matching(file.name, (".*",))}
    return {path.name: content(path)}
