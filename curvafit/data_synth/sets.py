"""Training sets on disk: cases that are made once, whole or not at all, by any number of workers."""

from __future__ import annotations

import errno
import hashlib
import itertools
import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.checks import as_tuple, check_choice, check_int, check_type, quoted
from curvafit.core.files import remove, write_content
from curvafit.core.records import parse_json
from curvafit.core.runtime import Progress, silent, undisturbed
from curvafit.core.workers import Here, Workers
from curvafit.data_synth.case import Case, Recipe
from curvafit.data_synth.centreline import centreline
from curvafit.data_synth.centreline_files import write_graphml, write_swc
from curvafit.data_synth.draws import versions
from curvafit.data_synth.labels import NAMES, labels_of
from curvafit.data_synth.layouts import LAYOUTS, About
from curvafit.priors.grid import Grid
from curvafit.volumes.field import Field
from curvafit.volumes.write import save

FORMAT = "curvafit set"
VERSION = 2
#: The set's own record, and the folder of the cases'.
HEADER, RECORDS = "curvafit.json", "cases"
#: What the layout's readers want.
LIST = "dataset.json"
#: Cases that a set may be asked for.
MOST = 10**7
#: Labels besides the mask that a set can have.
PARTS = (*(name for name in NAMES if name != "mask"), "centreline")
#: Seconds between two lists of the cases.
LISTED_EVERY = 1.0


@dataclass(frozen=True)
class Order:
    """What a set is to be: its recipe, layout (a name of `LAYOUTS`) and labels besides the mask (names of `PARTS`).

    Raises
    ------
    ValueError
        If a name is unknown.
    """

    recipe: Recipe
    layout: str = "nnunet"
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_type(self.recipe, Recipe, "a Recipe")
        check_choice(self.layout, LAYOUTS, f"a layout among {', '.join(LAYOUTS)}")
        object.__setattr__(self, "parts", as_tuple(self.parts, "labels"))
        for part in self.parts:
            check_choice(part, PARTS, f"labels among {', '.join(PARTS)}")
        if self.parts and min(self.recipe.shape) < 4:
            edges = " x ".join(map(str, self.recipe.shape))
            raise ValueError(f"expected images of at least 4 voxels along each axis beside --labels, got {edges}")

    def as_dict(self) -> dict[str, Any]:
        return {"recipe": self.recipe.as_dict(), "layout": self.layout, "parts": list(self.parts)}


def build_set(
    folder: str | Path, order: Order, count: int, progress: Progress = silent, *, workers: Workers | None = None
) -> Path:
    """Make cases 0 to `count` - 1 of a set, those that are not there yet, and the list that its readers want.

    Case i depends on the order and i alone, so that its voxels are the same whenever and by however many workers it is
    made. What is written is a valid set at any time, but for the list of one that was killed: the next run mends that.

    Parameters
    ----------
    folder
        Of the set; a new or an empty one, or a set of the same order to go on with.

    Raises
    ------
    ValueError
        If `count` is not positive, or the folder holds something else or a set of another order.
    OSError
        If the folder can't be written, or the workers are gone. The cases that were made are kept.
    """
    count = check_int(count, "a count of at least 1 case", 1, MOST)
    folder, workers = Path(folder), workers or Here()
    with _begun(folder, order):
        return _filled(folder, order, count, progress, workers)


def _filled(folder: Path, order: Order, count: int, progress: Progress, workers: Workers) -> Path:
    before = set(cases_of(folder))
    cases = set(before)
    todo = iter([index for index in range(count) if index not in cases])
    pending, listed = 0, -LISTED_EVERY
    try:
        while True:
            while pending < workers.places and (chunk := list(itertools.islice(todo, 1))):
                workers.submit(make_cases, folder, chunk)
                pending += 1
            if not pending:
                return folder
            cases |= set(workers.done())
            pending -= 1
            progress(f"{min(len(cases), count)} of {count} cases", min(len(cases), count) / count)
            if time.monotonic() > listed + LISTED_EVERY:
                _list(folder, order, cases)
                listed = time.monotonic()
    finally:
        _list_what_is_there(folder, order, before)


def make_cases(folder: str | Path, indices: Sequence[int]) -> list[int]:
    """Make some cases of a set that is begun; what a worker does.

    Raises
    ------
    OSError
        If they can't be written; what was written of such a case is removed.
    """
    folder = Path(folder)
    order = read_order(folder)
    try:
        for index in indices:
            _write_case(folder, order, index, order.recipe.case(index))
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), error.filename or str(folder)) from error
    return list(indices)


def read_order(folder: str | Path) -> Order:
    """Return the order that a set was begun with.

    Raises
    ------
    ValueError
        If the folder holds no set of this version.
    """
    try:
        header = parse_json((Path(folder) / HEADER).read_bytes(), "a set", folder)
        version = header["version"] if header["format"] == FORMAT else None
    except (OSError, ValueError, KeyError, TypeError):
        version = None
    if version != VERSION:
        came = "none" if version is None else f"version {quoted(version)}: begin it anew in another folder"
        raise ValueError(f"expected a set of version {VERSION} in {folder}, got {came}")
    try:
        content = header["order"]
        return Order(Recipe.from_dict(content["recipe"]), content["layout"], tuple(content["parts"]))
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        reason = quoted(str(error))
        raise ValueError(f"expected a whole set in {folder}, got one with a damaged {HEADER} ({reason})") from error


def cases_of(folder: Path) -> list[int]:
    """Return the indices of the complete cases: those with a record, which is written last."""
    names = (path.stem.removeprefix("case_") for path in (folder / RECORDS).glob("case_*.json"))
    return sorted(int(name) for name in names if name.isdigit())


def case_name(index: int) -> str:
    """Return the name of a case in files."""
    return f"case_{index:05d}"


@contextmanager
def _begun(folder: Path, order: Order) -> Iterator[None]:
    """Begin a set; where the first case can't be had, remove what was begun."""
    new = [place for place in (folder, *folder.absolute().parents) if not place.exists()]
    anew = not (folder / HEADER).exists()
    _begin(folder, order)
    try:
        yield
    except ValueError:
        if anew and not cases_of(folder):
            for place in (folder / HEADER, folder / LIST):
                place.unlink(missing_ok=True)
            within = [place for place in folder.rglob("*") if place.is_dir()]
            for place in [*sorted(within, reverse=True), *new]:
                with suppress(OSError):  # it holds something else
                    place.rmdir()
        raise


def _begin(folder: Path, order: Order) -> None:
    if not (folder / HEADER).exists():
        check_set(folder, order)
        header = {"format": FORMAT, "version": VERSION, "versions": versions(), "order": order.as_dict()}
        _write_json(folder / HEADER, header)
    check_set(folder, order)  # another process may have begun it
    (folder / RECORDS).mkdir(exist_ok=True)


def check_set(folder: Path, order: Order) -> None:
    """Raise ValueError where a folder holds other things than a set of this order: it may be new, or empty."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"expected a folder for the set, got the file {folder}")
    if not (folder / HEADER).exists():
        if folder.is_dir() and any(folder.iterdir()):
            raise ValueError(f"expected a new or empty folder, or a set to go on with, got {folder} with other things")
        return
    stored, wanted = read_order(folder).as_dict(), order.as_dict()
    if stored != wanted:
        name, was, now = _difference(stored, wanted)
        state = f"got another {name}: {now} for {was}; choose another folder, or delete this one"
        raise ValueError(f"expected what {folder} was begun with, {state}")


def _list(folder: Path, order: Order, cases: set[int]) -> None:
    """Write what the layout's readers want."""
    about, names = About(folder.resolve().name, order.recipe.modality.name), list(map(case_name, sorted(cases)))
    _write_json(folder / LIST, LAYOUTS[order.layout].listing(names, about))


def _list_what_is_there(folder: Path, order: Order, before: set[int]) -> None:
    """Write the list; where the disk is too full for it, without the last cases, which make room.

    Cases that were there before this run stay.
    """
    cases = set(cases_of(folder))
    while True:
        try:
            return _list(folder, order, cases)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT) or cases <= before:
                raise
            last = max(cases - before)
            _remove_case(folder, order, case_name(last))
            cases.remove(last)


def _remove_case(folder: Path, order: Order, name: str) -> None:
    """Remove a case, its record first: files without a record are no case."""
    layout = LAYOUTS[order.layout]
    places = [
        folder / RECORDS / f"{name}.json",
        *(folder / part.format(case=name) for part in (layout.label, layout.image)),
    ]
    for place in [*places, *(folder / "parts").glob(f"*/{name}.*")]:
        remove(place)


def _write_case(folder: Path, order: Order, index: int, case: Case) -> None:
    """Write labels, image and record of a case, in this order, all or none; with its record a case is complete."""
    layout, name = LAYOUTS[order.layout], case_name(index)
    record = folder / RECORDS / f"{name}.json"
    places = [folder / layout.label.format(case=name), folder / layout.image.format(case=name)]
    parts = folder / layout.part
    if record.exists():
        return
    try:
        known = _write_parts(order, case, lambda part: Path(str(parts).format(part=part, case=name)), places)
        mask = case.mask.astype(np.uint8)
        for values, place in zip((mask, case.image), places, strict=False):
            save(Field(values, case.spacing, case.unit), place)
        sums = {"image": _digest(case.image), "label": _digest(mask)}
        _write_json(record, case.record | known | {"sha256": sums, "versions": versions()})
    except BaseException:
        with undisturbed():
            for place in () if record.exists() else places:
                remove(place)
        raise


def _write_parts(order: Order, case: Case, place: Callable[[str], Path], places: list[Path]) -> dict[str, Any]:
    """Return the labels besides the mask; what is no volume goes into the record."""
    if not order.parts:
        return {}
    grid, known = Grid(case.image.shape, case.spacing, "replicate"), {}  # type: ignore[arg-type]
    wanted = set(order.parts) - {"centreline"} | ({"skeleton", "distance"} if "centreline" in order.parts else set())
    labels = labels_of(case.field, grid, case.epsilon, wanted) if wanted else None
    for part in order.parts:
        if part == "centreline":
            graph = centreline(labels.skeleton, labels.distance, grid)  # type: ignore[union-attr,arg-type]
            for suffix, write in ((".graphml", write_graphml), (".swc", write_swc)):
                target = place(part)
                target = target.with_name(target.name.partition(".")[0] + suffix)
                places.append(target)
                write(graph, target, case.unit)
        elif part == "betti":
            known[part] = list(labels.betti)  # type: ignore[union-attr,arg-type]
        else:
            places.append(place(part))
            save(Field(getattr(labels, part), case.spacing, case.unit), place(part))
    return known


def _digest(values: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_content(path, json.dumps(content, indent=2) + "\n")


def _difference(stored: Any, wanted: Any, name: str = "order") -> tuple[str, Any, Any]:
    """Return the name of the first value that differs, and both."""
    if isinstance(stored, dict) and isinstance(wanted, dict) and stored.keys() == wanted.keys():
        for key in stored:
            if stored[key] != wanted[key]:
                return _difference(stored[key], wanted[key], key)
    return name, stored, wanted
