"""Full disks and folders that cannot be written to: a sentence, and what was there before is there after."""

from __future__ import annotations

import contextlib
import os
import resource
import subprocess
from collections.abc import Callable, Iterator

from .case import Case, Fault, Place, Setup, dice, every, nothing, taking
from .judge import left, spoken, standing
from .larder import BUILD, LONG, QUICK, SYNTH
from .sandbox import commanding, run

_SET = tuple(part.replace("{store}", "{larder}/store.zarr") for part in SYNTH)
_SEGMENT = ("segment", "{larder}/scan.nii.gz", "--prior", "tubes", "--steps", "1", "-o")

#: Command, what it may keep of a run that fails, set-up, and what of that it may replace.
SCENES: dict[str, tuple[tuple[str, ...], tuple[str, ...], Setup, tuple[str, ...]]] = {
    "generate-npy": (("generate", *QUICK, "-o", "out.npy"), (), nothing, ()),
    "generate-nii": (("generate", *QUICK, "-o", "out.nii.gz"), (), nothing, ()),
    "generate-tif": (("generate", *QUICK, "-o", "out.ome.tif"), (), nothing, ()),
    "generate-mrc": (("generate", *QUICK, "--spacing", "1", "--unit", "um", "-o", "out.mrc"), (), nothing, ()),
    "generate-zarr": (("generate", *QUICK, "-o", "out.zarr"), (), nothing, ()),
    "generate-stl": (("generate", *QUICK, "-o", "out.stl"), (), nothing, ()),
    "generate-over": (
        ("generate", *QUICK, "-o", "shape.nii.gz"), (), taking("shape.nii.gz", "shape.png", "shape.json"), ("shape.*",),
    ),
    "generate-checkpoint": (("generate", *LONG, "-o", "out.npy"), ("run.pt",), nothing, ()),
    "generate-resumed": (("generate", *LONG, "-o", "out.npy"), (), taking("run.pt"), ("run.pt",)),
    "generate-snapshots": (("generate", *QUICK, "--snapshots", "5,10", "-o", "out.npy"), ("out*",), nothing, ()),
    "segment-nii": ((*_SEGMENT, "out.nii.gz"), (), nothing, ()),
    "segment-zarr": ((*_SEGMENT, "out.zarr"), (), nothing, ()),
    "build": ((*BUILD, "--count", "2"), ("store.zarr", "store.zarr/*"), nothing, ()),
    "extend": (
        ("atlas", "extend", "store.zarr", "--count", "1", "--workers", "0"), (), taking("store.zarr"),
        ("store.zarr/zarr.json", "store.zarr/draws/*"),
    ),
    "extract": (("atlas", "extract", "{larder}/store.zarr", "-o", "out.npz"), (), nothing, ()),
    "extract-over": (
        ("atlas", "extract", "{larder}/store.zarr", "-o", "atlas.npz"), (), taking("atlas.npz"), ("atlas.npz",),
    ),
    "synth": ((*_SET, "--count", "2"), ("set", "set/*"), nothing, ()),
    "synth-more": (
        (*_SET, "--count", "5"), ("set/*",), taking("set"), ("set/dataset.json", "set/preview.png", "set/card.md"),
    ),
    "sample": (("samples", "get", "synthetic", "-o", "out.nii.gz"), (), nothing, ()),
}  # fmt: skip


def cases(seed: int) -> Iterator[Case]:
    """Each scene on a disk with little room, with a limit on files' sizes, and in a folder for reading."""
    for name, (command, stays, setup, changes) in SCENES.items():
        for k in range(4):
            rng = dice(seed, f"{name} {k}")
            room = int(2 ** rng.uniform(8, 16.5))
            how = (_small_files, _small_disk)[k % 2]
            told = {"changes": changes, "stays": stays, "play": how, "quick": name != "sample"}
            yield Case(f"disks/{name}/{how.__name__[1:]}-{room}", setup, command, more=room, **told)
        yield Case(f"disks/{name}/read_only", every(setup, _plant), command, changes=(), play=_read_only)


def _plant(place: Place) -> None:
    place.plant("thesis.txt")


def _small_files(case: Case, place: Place) -> list[Fault]:
    """No file may grow beyond so many bytes: writing on fails as on a full disk, if under another number."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (case.more, case.more))

    return _tried(case, place, limit)


def _small_disk(case: Case, place: Place) -> list[Fault]:
    """A disk of its own for the folder, nearly full; files of limited sizes where none can be mounted."""
    keep = place.root / "kept"
    os.rename(place.here, keep)
    place.here.mkdir()
    size = 4096 * (_pages(keep) + 4 + case.more // 4096)
    told = ["mount", "-t", "tmpfs", "-o", f"size={size},mode=755", "tmpfs", str(place.here)]
    mounted = os.geteuid() == 0 and subprocess.run(told, capture_output=True, check=False).returncode == 0
    try:
        subprocess.run(["cp", "-a", f"{keep}/.", str(place.here)], check=True)
        return _tried(case, place, lambda: None) if mounted else _small_files(case, place)
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(place.here)], check=False)


def _pages(folder: os.PathLike[str]) -> int:
    """Pages that a folder's files take on a disk in memory."""
    found = 0
    for root, folders, files in os.walk(folder):
        found += len(folders) + sum(1 + os.path.getsize(os.path.join(root, name)) // 4096 for name in files)
    return found


def _read_only(case: Case, place: Place) -> list[Fault]:
    """As somebody who may not write there."""

    def drop() -> None:
        with contextlib.suppress(PermissionError):
            os.setgid(65534)
            os.setuid(65534)

    for root, _, files in os.walk(place.here):
        os.chmod(root, 0o555)
        for name in files:
            os.chmod(os.path.join(root, name), 0o444)
    try:
        return _tried(case, place, drop)
    finally:
        for root, _, _ in os.walk(place.here):
            os.chmod(root, 0o755)


def _tried(case: Case, place: Place, first: Callable[[], None]) -> list[Fault]:
    before = standing(place.here)
    outcome = run(commanding(case.arguments(place)), place.here, place.root / "said", (first,))
    found = [*spoken(outcome), *left(case, place, before, outcome.code)]
    if outcome.code != 0:  # what may be replaced is replaced by something whole, or not at all
        after = standing(place.here)
        unsound = [name for name in case.changes if name in before and name not in after]
        found += [Fault("lost", f"deleted, and the run failed: {name}") for name in unsound]
    return found
