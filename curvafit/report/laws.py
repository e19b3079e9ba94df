"""The laws of many scans: a report of each, one page of them all, and a tidy table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from importlib.metadata import version
from operator import itemgetter
from pathlib import Path
from typing import Any

from curvafit.core.records import Format
from curvafit.core.runtime import Progress, silent
from curvafit.inference.fit import Fit
from curvafit.inference.inference import infer
from curvafit.report import page
from curvafit.studies.scans import Task, name_errors, share_out

#: `format` of the record.
FORMAT = Format("curvafit laws", 1, title="the record of many inferences")
#: What is written beside the scans' folders.
FILES = ("laws.json", "laws.html", "laws.csv")


def infer_scans(
    scans: Sequence[str],
    directory: str | Path,
    *,
    workers: int = 0,
    command: str = "",
    overwrite: bool = False,
    progress: Progress = silent,
    **options: Any,
) -> Path:
    """Infer the parameters of many scans into a folder: for each its own, and a page and a table; return the page.

    A scan whose folder has a fit of the same command and version is not inferred again. `options` are those of `infer`.
    Raises ValueError as `infer`, with the scan's name, and where a folder has others' files.
    """
    target, folders = Path(directory), name_folders(scans)
    page.check_result_folder(FORMAT, FILES, target, scans, overwrite, command)
    for folder in folders:
        page.check_report(target / folder, scans, overwrite, command)
    left: dict[int, Task] = {
        k: partial(_infer_one, scans[k], target / folder, command, overwrite, options)
        for k, folder in enumerate(folders)
        if not _is_done(target / folder, command)
    }
    target.mkdir(parents=True, exist_ok=True)
    share_out(left, folders, workers, progress)
    fits = {folder: Fit.load(target / folder / "fit.json") for folder in folders}
    record = page.start_record(command, scans={name: fit.provenance.get("scan", "") for name, fit in fits.items()})
    rows = [row for name, fit in fits.items() for row in _rows(name, fit)]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for name, fit in fits.items():
        for strip in filter(itemgetter("low"), page.list_strips(fit)):
            groups.setdefault((strip["low"], strip["high"]), []).append(strip | {"scan": name})
    shown = {"title": f"The laws of {len(fits)} scans", "fits": fits, "groups": groups}
    return page.write_study(target, FORMAT, FILES, record, shown, {"laws.csv": rows})


def name_folders(scans: Sequence[str]) -> list[str]:
    """Return a folder's name for each scan: its file's, without suffixes unless two would be alike."""
    names = [Path(scan.partition("::")[0]).name for scan in scans]
    stems = [name.partition(".")[0] or name for name in names]
    found = [stem if stems.count(stem) == 1 else name for stem, name in zip(stems, names, strict=True)]
    if twice := sorted({name for name in found if found.count(name) > 1}):
        raise ValueError(f"expected scans with names of their own, got several named {twice[0]}")
    return found


def _infer_one(
    scan: str, folder: Path, command: str, overwrite: bool, options: dict[str, Any], progress: Progress
) -> None:
    with name_errors(scan):
        found = infer(scan, progress=progress, **options)
    page.write_inference(page.with_command(found, command), folder, overwrite=overwrite)


def _is_done(folder: Path, command: str) -> bool:
    """Return whether a folder has the fit of a command, by this version."""
    if not (folder / "report.html").exists():
        return False
    made = Fit.load(folder / "fit.json").provenance
    return (made.get("command"), made.get("curvafit")) == (command, version("curvafit"))


def _rows(name: str, fit: Fit) -> Iterator[dict[str, Any]]:
    """Yield a row for each number of a fit; None where it is not known."""
    columns = ("scan", "quantity", "value", "low", "high", "known", "version")
    told = [(f"from {each.low} to {each.high}", each.median, *each.interval, each.known)
            for each in fit.combinations if each.low]  # fmt: skip
    told += [(key, each["median"], *each["90"], None) for key, each in (fit.intervals() or {}).items()]
    told.append(("p of the law", None if fit.misfit is None else fit.misfit.probability, None, None, None))
    for row in told:
        yield dict(zip(columns, (name, *row, version("curvafit")), strict=True))
