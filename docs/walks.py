"""Walks through the code: which types, modules and functions of the package a scan, slices, logits and a preset meet.

`python docs/walks.py` runs one small job of each kind and prints, for each, the functions that ran (stays), the folders
they lie in (rooms), the types of which something was made, and where a function called one of a folder above its own
(climbs): these are functions that were handed down as arguments.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

import curvafit
from curvafit.priors import CurvaturePrior

#: The folders of the package, the lowest floor first; those of one floor stand together.
FLOORS = (
    ("core",), ("priors",), ("generation", "volumes", "geometry"), ("scan",), ("inference",), ("data_synth",),
    ("segmentation",), ("studies",), ("drawing", "report"), ("cli",),
)  # fmt: skip


def walk(job: Callable[[], object]) -> tuple[set[str], set[str], set[str], set[str]]:
    """Return the functions that a job runs, their folders, the types that it makes, and its climbs."""
    stays, rooms, types, climbs = set[str](), set[str](), set[str](), set[str]()

    def look(frame: Any, event: str, _: object) -> None:
        if event != "call":
            return
        made = frame.f_locals.get("self" if frame.f_code.co_name == "__init__" else "_cls")
        if frame.f_code.co_name in ("__init__", "__new__") and made is not None:
            kind = made if isinstance(made, type) else type(made)
            if kind.__module__.startswith("curvafit."):
                types.add(kind.__name__)
        module = frame.f_globals.get("__name__", "")
        if not module.startswith("curvafit.") or frame.f_code.co_name.startswith("<"):
            return
        room = module.split(".")[1]
        stays.add(f"{module}.{frame.f_code.co_qualname}")
        rooms.add(room)
        caller = frame.f_back.f_globals.get("__name__", "") if frame.f_back else ""
        if caller.startswith("curvafit.") and floor_of(room) > floor_of(caller.split(".")[1]):
            climbs.add(f"{caller} -> {module}.{frame.f_code.co_qualname}")

    sys.setprofile(look)
    try:
        job()
    finally:
        sys.setprofile(None)
    return stays, rooms, types, climbs


def floor_of(room: str) -> int:
    """Return the number of a folder's floor, the lowest 0."""
    return next((number for number, floor in enumerate(FLOORS) if room in floor), len(FLOORS))


def main() -> None:
    """Walk, and print what was met."""
    z, y, x = np.mgrid[:40, :40, :40] / 5
    mask = np.sin(z) * np.cos(y) + np.sin(y) * np.cos(x) + np.sin(x) * np.cos(z) > 0
    noise = 20 * np.random.default_rng(0).standard_normal(mask.shape)
    logits = torch.randn(1, 1, 24, 24, 24, requires_grad=True)
    jobs: dict[str, Callable[[], object]] = {
        "a scan, measured": lambda: curvafit.measure((100 * mask + noise).astype(np.float32), spacing=0.5, unit="um"),
        "slices, filled": lambda: curvafit.reconstruct(mask.astype(np.uint8), every=8),
        "logits, in a loss": lambda: CurvaturePrior("tubes")(logits.sigmoid()).backward(),
        "a preset, grown": lambda: curvafit.generate("tubes", grid=24, schedule="fast"),
    }
    for name, job in jobs.items():
        job()  # what is imported and compiled once is no part of the way
        stays, rooms, types, climbs = walk(job)
        print(f"{name}: {len(stays)} stays, {len(rooms)} rooms, {len(types)} types, {len(climbs)} climbs")
        print(f"  rooms: {', '.join(sorted(rooms, key=floor_of))}\n  types: {', '.join(sorted(types))}")
        for climb in sorted(climbs):
            print(f"  climb: {climb}")


if __name__ == "__main__":
    main()
