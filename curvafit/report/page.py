"""Pages: how one is made of a template, its pictures and its values, and how a study's folder is written.

All pages are `templates/page.html` with sections of their own, of the parts in `templates/parts.html`. Each stands
alone: pictures are inside it, and all text is escaped.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib.figure import Figure

from curvafit.core.files import move_together, remove, temporary_folder
from curvafit.core.records import Format, can_write, has_mark
from curvafit.core.runtime import hold_signals
from curvafit.core.units import GLOSSARY, format_number
from curvafit.drawing import plot
from curvafit.drawing.plot import png, svg
from curvafit.scan.measures import Measures, Outline
from curvafit.studies.scans import format_csv
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import save

#: Pixels per inch of files; letters of a scan's name in a panel, and beside its outlines; the most scans with outlines.
PRINTED, WORD, LINE, MOST_OUTLINES = 300, 22, 36, 25
#: The mark by which a page is known as this program's.
MARK = '<meta name="generator" content="curvafit'


class Picture(NamedTuple):
    """A picture in the page: its PNG in base64, None where no shape was grown, and the words below it."""

    data: str | None
    alt: str
    title: str = ""
    text: str = ""
    badge: str = ""


class Chosen(str):
    """The text of a table's cell that stands out."""

    chosen = True


def picture_of(figure: Figure | None, alt: str, **words: str) -> Picture:
    """Return a figure as a picture for the page; `alt` describes it, `words` are further fields of `Picture`."""
    return Picture(None if figure is None else base64.b64encode(png(figure)).decode("ascii"), alt, **words)


def render(name: str, **values: Any) -> str:
    """Return the template of a name, filled with values, which are escaped in a page.

    All pages take `title`, and `made`, which says how the page was made; and, if there are any, `status` for below the
    title, `methods` and `notes` for below the sections.
    """
    environment = Environment(
        loader=PackageLoader("curvafit.report"), autoescape=select_autoescape(), undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    environment.globals |= {"version": version("curvafit"), "number": format_number, "glossary": GLOSSARY}
    return environment.get_template(name).render(values)


# ---- files -----------------------------------------------------------------------------------------------------------


def check_result_folder(
    kind: Format,
    files: Sequence[str],
    directory: str | Path,
    inputs: Iterable[str | Path] = (),
    overwrite: bool = False,
    command: str = "",
) -> Path:
    """Return the folder if a result can be written into it; else raise ValueError.

    `files` are the names of the record, the page and the result's other files, in this order. `inputs` are files or
    folders that are read, and so never written over. An earlier result of the same `command` may be replaced; other
    results, and files that are no result, only with `overwrite`.
    """
    folder = Path(directory)
    record, page, *others = (folder / name for name in files)
    ours = kind.owns(record) and has_mark(page, MARK) and _command_of(record) == command
    can_write(record, lambda _: ours, more=(page, *others), inputs=inputs, overwrite=overwrite)
    return folder


def _command_of(record: Path) -> str:
    """Return the command line in a result's record; an empty text where the result was made from Python."""
    content = json.loads(record.read_text(encoding="utf-8"))
    return str(content.get("command") or content.get("provenance", {}).get("command") or "")


@contextmanager
def fill_folder(target: Path, files: Sequence[str]) -> Iterator[Path]:
    """Yield a temporary folder to write into, and move its files into `target` together at the end of the block.

    Those of `files` that an earlier result had and this one lacks are deleted.
    """
    with temporary_folder(target / files[0] if target.is_dir() else target) as work:
        yield work
        with hold_signals():
            target.mkdir(exist_ok=True)
            for name in files:
                if not (work / name).exists():
                    remove(target / name)
            move_together(sorted(work.iterdir()), target)


def start_record(command: str, **more: Any) -> dict[str, Any]:
    """Return a record of version, date, command line and `more`, whose values become JSON types or else text."""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    origin = {"curvafit": version("curvafit"), "date": date, "command": command}
    return origin | json.loads(json.dumps(more, default=str))


def write_study(
    target: Path,
    form: Format,
    files: Sequence[str],
    record: dict[str, Any],
    values: Mapping[str, Any],
    tables: Mapping[str, Iterable[dict[str, Any]]],
    *,
    figures: Mapping[str, tuple[Figure | None, str]] | None = None,
    maps: Mapping[str, Volume] | None = None,
    more: Mapping[str, Callable[[Path], object]] | None = None,
) -> Path:
    """Write a study's record, page, tables, maps, figures as PNG and SVG, and what `more` writes, into a folder.

    `files` are their names, the record's and the page's first. The page is the template of its name, filled with the
    record, `values` and the figures, each of which comes with a description. Return the page's path.
    """
    drawn = {name: (figure, alt) for name, (figure, alt) in (figures or {}).items() if figure is not None}
    pictures = {name: picture_of(*drawn[name]) if name in drawn else None for name in figures or ()}
    made = {name: record[name] for name in ("command", "date") if record[name]}
    texts = {files[1]: render(files[1], made=made, **record | pictures | dict(values))}
    texts |= {name: format_csv(list(rows)) for name, rows in tables.items()}
    with fill_folder(target, files) as work:
        for name, volume in (maps or {}).items():
            save(volume, work / name, kind=form.name)
        for name, write in (more or {}).items():
            write(work / name)
        for name, text in texts.items():
            (work / name).write_text(text, encoding="utf-8", newline="")
        for name, (figure, _) in drawn.items():
            (work / f"{name}.png").write_bytes(png(figure, PRINTED))
            (work / f"{name}.svg").write_bytes(svg(figure))
        written = [name for name in files if name == files[0] or (work / name).exists()]
        form.write(work / files[0], record | {"files": written})
    return target / files[1]


# ---- scans -----------------------------------------------------------------------------------------------------------


def name_parts(parts: Sequence[Measures]) -> list[str]:
    """Return a name for each scan or part of one: its file, or the path where two files have one name, and its part."""
    sources: dict[str, set[str]] = {}
    for part in parts:
        sources.setdefault(Path(part.source).name, set()).add(part.source)
    names = []
    for k, part in enumerate(parts, 1):
        file = Path(part.source).name
        name = file if file and len(sources[file]) == 1 else part.source or f"array {k}"
        names.append(f"{name}, {' '.join(map(str, part.part))}" if part.part else name)
    return names


def shorten(names: Sequence[str], most: int = WORD) -> list[str]:
    """Return names that a panel has room for: both ends of a long name, with a number where two would be the same."""
    short = [name if len(name) <= most else f"{name[:8]}…{name[9 - most :]}" for name in names]
    return [name if short.count(name) == 1 else f"{k} {name}" for k, name in enumerate(short, 1)]


def outlines_figure(names: Sequence[str], outlines: Sequence[Outline | None], unit: str) -> Figure | None:
    """Return a figure of what was taken for the structure in the first `MOST_OUTLINES` scans of one unit, or None."""
    known = [(name, each) for name, each in zip(shorten(names, LINE), outlines, strict=True) if each][:MOST_OUTLINES]
    if not known:
        return None
    figure = plot.make_figure(7.6, 2.6 * len(known), layout="constrained")
    for row, (name, outline) in zip(figure.subplots(len(known), 3, squeeze=False), known, strict=True):
        limits = plot.grey_limits(np.concatenate([plane.ravel() for plane in outline.levels]))
        plot.sections_on(row, plot.Sections(outline.levels, outline.inside, limits), outline.spacing)
        for axes, axis, place in zip(row, "zyx", outline.places, strict=True):
            axes.set_title(f"{axis} = {place}", fontsize=8)
        plot.scale_on(row[0], outline.spacing[2], unit)
        row[0].set_ylabel(plot.plain(name), fontsize=9)
    return figure
