"""The laws of many scans: a report of each, one page of them all, and a tidy table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.metadata import version
from operator import itemgetter
from pathlib import Path
from typing import Any

from curvafit.core.records import Format
from curvafit.core.runtime import Progress, silent
from curvafit.core.workers import cluster, collect_all
from curvafit.inference.fit import Fit
from curvafit.inference.infer import infer
from curvafit.report.page import (
    check_report,
    check_result_folder,
    list_strips,
    render_template,
    start_record,
    with_command,
    write_inference,
    write_study,
)
from curvafit.studies.scans import name_errors
from curvafit.studies.tables import format_csv

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
    check_result_folder(FORMAT, FILES, target, scans, overwrite, command)
    for folder in folders:
        check_report(target / folder, scans, overwrite, command)
    left = [k for k, folder in enumerate(folders) if not _is_done(target / folder, command)]
    target.mkdir(parents=True, exist_ok=True)

    def watch(k: int, text: str, share: float) -> None:
        progress(f"{folders[k]}: {text}", (k + share) / len(folders))

    make = partial(
        _infer_one, list(zip(scans, folders, strict=True)), command, overwrite, options, None if workers else watch
    )
    with cluster(workers) as crew:
        for k in collect_all(crew, ((make, target, [k]) for k in left)):
            watch(k, "inferred", 1.0)
    fits = {folder: Fit.load(target / folder / "fit.json") for folder in folders}
    return write_laws(fits, target, command=command, overwrite=overwrite)


def name_folders(scans: Sequence[str]) -> list[str]:
    """Return a folder's name for each scan: its file's, without suffixes unless two would be alike."""
    names = [Path(scan.partition("::")[0]).name for scan in scans]
    stems = [name.partition(".")[0] or name for name in names]
    found = [stem if stems.count(stem) == 1 else name for stem, name in zip(stems, names, strict=True)]
    if twice := sorted({name for name in found if found.count(name) > 1}):
        raise ValueError(f"expected scans with names of their own, got several named {twice[0]}")
    return found


def write_laws(fits: dict[str, Fit], directory: str | Path, *, command: str = "", overwrite: bool = False) -> Path:
    """Write page, table and record of fits, by the names of their folders, and return the page's path."""
    target = check_result_folder(FORMAT, FILES, directory, (), overwrite, command)
    record = start_record(command, scans={name: fit.provenance.get("scan", "") for name, fit in fits.items()})
    rows = [row for name, fit in fits.items() for row in _rows(name, fit)]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for name, fit in fits.items():
        for strip in filter(itemgetter("low"), list_strips(fit)):
            groups.setdefault((strip["low"], strip["high"]), []).append(strip | {"scan": name})
    page = render_template(
        "laws.html", version=record["curvafit"], title=f"The laws of {len(fits)} scans", fits=fits, groups=groups,
        provenance=[(name, record[name]) for name in ("command", "date") if record[name]],
    )  # fmt: skip
    return write_study(target, FORMAT, FILES, record, {"laws.html": page, "laws.csv": format_csv(rows)}, {})


def _infer_one(
    jobs: Sequence[tuple[str, str]], command: str, overwrite: bool, options: dict[str, Any],
    watch: Callable[[int, str, float], None] | None, target: Path, indices: Sequence[int],
) -> list[int]:  # fmt: skip
    """Infer some of the scans, and write their reports into their folders."""
    for k in indices:
        scan, folder = jobs[k]
        with name_errors(scan):
            found = infer(scan, progress=silent if watch is None else partial(watch, k), **options)
        write_inference(with_command(found, command), target / folder, overwrite=overwrite)
    return list(indices)


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
