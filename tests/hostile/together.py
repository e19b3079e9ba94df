"""Two at once: the same command twice, on one file, one checkpoint, one store, one set.

Both succeed, or one says in a sentence why it does not; what they leave is whole.
"""

from __future__ import annotations

import os
import random
import re
import time
from collections.abc import Iterator

from .case import Case, Fault, Place, Setup, nothing, taking
from .judge import left, spoken, standing
from .larder import BUILD, LONG, QUICK, SYNTH
from .moments import watch
from .sandbox import Outcome, Running, commanding, finish, run, start

_SET = tuple(part.replace("{store}", "{larder}/store.zarr") for part in SYNTH)

#: Command, what it keeps, set-up, and the command that checks the result.
SCENES: dict[str, tuple[tuple[str, ...], tuple[str, ...], Setup, tuple[str, ...]]] = {
    "npy": (("generate", *QUICK, "-o", "out.npy"), (), nothing, ()),
    "nii": (("generate", *QUICK, "-o", "out.nii.gz"), (), nothing, ()),
    "zarr": (("generate", *QUICK, "-o", "out.zarr"), (), nothing, ()),
    "stl": (("generate", *QUICK, "-o", "out.stl"), (), nothing, ()),
    "over": (("generate", *QUICK, "-o", "shape.nii.gz"), ("shape.*",), taking("shape.nii.gz", "shape.png",
        "shape.json"), ()),
    "snapshots": (("generate", *QUICK, "--snapshots", "10", "-o", "out.zarr"), (), nothing, ()),
    "checkpoint": (("generate", *LONG, "-o", "long.npy"), ("run.pt",), nothing, ()),
    "resumed": (("generate", *LONG, "-o", "long.npy"), ("run.pt",), taking("run.pt"), ()),
    "segment": (("segment", "{larder}/scan.nii.gz", "--prior", "tubes", "--steps", "2", "-o", "out.zarr"), (),
        nothing, ()),
    "build": ((*BUILD, "--count", "3"), ("store.zarr",), nothing, ("atlas", "verify", "store.zarr")),
    "extend": (
        ("atlas", "extend", "store.zarr", "--count", "2", "--workers", "0"), ("store.zarr",), taking("store.zarr"),
        ("atlas", "verify", "store.zarr"),
    ),
    "extract": (("atlas", "extract", "{larder}/store.zarr", "-o", "out.npz"), (), nothing, ()),
    "synth": ((*_SET, "--count", "4"), ("set",), nothing, ()),
    "synth-more": ((*_SET, "--count", "5"), ("set",), taking("set"), ()),
}  # fmt: skip
#: Seconds that the second starts after the first, and that a change of a file lasts at most, as on a slow disk.
DELAYS = ((0.0, 0.0), (0.0, 0.04), (0.1, 0.1))


def cases(seed: int) -> Iterator[Case]:
    """Each scene with both at the same time, and one a little later."""
    for name, (command, keeps, setup, check) in SCENES.items():
        for delay, lag in DELAYS:
            more, kept = (check, delay, lag), (*keeps, *(f"{each}/*" for each in keeps))
            yield Case(f"together/{name}/{delay}-{lag}", setup, command, kept, kept, _play, more)


def _play(case: Case, place: Place) -> list[Fault]:
    check, delay, lag = case.more
    before, job = standing(place.here), commanding(case.arguments(place))
    gate, opener = os.pipe()

    def started(number: int) -> Running:
        rng = random.Random(place.rng.random())

        def wait() -> None:
            os.close(opener)
            os.read(gate, 1)
            time.sleep(number * delay)
            if lag:
                watch(place.here, lambda _: time.sleep(lag * rng.random()))

        return start(job, place.here, place.root / f"said-{number}", (wait,))

    pair = [started(number) for number in (0, 1)]
    os.close(gate)
    os.close(opener)  # opens the gate for both
    outcomes = [finish(each) for each in pair]
    found = [fault for outcome in outcomes for fault in (*spoken(outcome, (0, 2)), *_inner(outcome))]
    code = min(outcome.code for outcome in outcomes) if not found else 0
    found += [fault for fault in left(case, place, before, max(0, code)) if fault not in found]
    if not found and code == 2:
        found.append(Fault("wrong", "neither of the two came to its end"))
    if check and not found:
        said = run(commanding(check), place.here, place.root / "said-check")
        found += [] if said.code == 0 else [Fault("torn", f"checked: {(said.stderr or said.stdout).strip()[-200:]}")]
    return found


def _inner(outcome: Outcome) -> list[Fault]:
    """A sentence about a file that is none of the user's tells the user nothing."""
    found = re.search(r"\S*(\.part\b|\.partial\.|\.[0-9a-f]{8}\.)\S*", outcome.stderr)
    return [Fault("wrong", f"exit code {outcome.code}, about a temporary name: {found[0]}")] if found else []
