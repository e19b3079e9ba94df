"""The data card of a training set: what its images show, how they were made, and what they are not."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.files import write_content
from curvafit.core.records import parse_json
from curvafit.core.units import format_number, unit_name
from curvafit.data_synth.case import Recipe
from curvafit.data_synth.design import PARAMETERS
from curvafit.data_synth.sets import RECORDS, SetSpec, case_name, list_cases, read_spec
from curvafit.data_synth.sources import Generated

#: The card's file, and its first line: a card without it is somebody's own, and is left alone.
CARD, MARK = "card.md", "<!-- written by curvafit synth, which replaces it; without this line it stays as it is -->"
#: The most laws that the card lists.
MOST_LAWS = 40


def write_card(folder: str | Path, command: str = "") -> Path:
    """Write `card.md` into a set's folder, unless somebody else's is there, and return its path.

    Raises ValueError where the folder is no set, or a case's record is damaged.
    """
    place = Path(folder) / CARD
    if place.exists() and not place.read_text(encoding="utf-8", errors="replace").startswith(MARK):
        return place
    return write_content(place, "\n".join(_card(Path(folder), read_spec(folder), command)) + "\n")


def _card(folder: Path, spec: SetSpec, command: str) -> Iterator[str]:
    """Yield the lines of a set's card."""
    recipe, records = spec.recipe, list(_read_records(folder))
    imaging = recipe.modality.base
    edges, unit = " x ".join(format_number(each) for each in imaging.spacing), unit_name(imaging.unit, 2)
    made = records[0]["versions"] if records else {}
    yield MARK
    yield f"# {_quote(folder.resolve().name)}\n"
    yield "Synthetic 3D images of generated shapes, with labels that are exact because the shapes are known.\n"
    yield "![Some of the cases](preview.png)\n"
    rows = {
        "cases": len(records),
        "voxels of an image": " x ".join(map(str, recipe.shape)),
        "edges of a voxel": f"{edges} {unit}",
        "labels": ", ".join(f"{number} {name}" for number, name in enumerate(("background", *recipe.classes))),
        "further labels": ", ".join(spec.parts) or "none",
        "layout": spec.layout,
    }
    for number, name in enumerate(recipe.classes):
        shares = [record["class_fractions"][number] for record in records]
        rows[f"part of the voxels that is {name}"] = _percent_range(shares)
    yield from _table(("what", ""), rows.items())
    yield "\n## Shapes\n"
    yield from _describe_source(recipe.source)
    low, high = recipe.calibres
    if (low, high) != (1.0, 1.0):
        yield f"\nStructures are {format_number(low)} to {format_number(high)} times as thick, case by case."
    yield from _describe_composition(recipe)
    yield f"\n## Images\n\n{recipe.modality.name}: {recipe.modality.about}\n"
    drawn = [(name, *(_numbers(end) for end in ends)) for name, ends in recipe.modality.ranges.items()]
    if drawn:
        yield "Each case draws its own values from these ranges:\n"
        yield from _table(("parameter", "from", "to"), drawn)
    yield "\n## What they are not\n"
    yield "Images are simulated: a network that has seen these alone has seen no scan. A mask is where the structure"
    yield "is, not what an annotator would draw on the image. No person, animal or sample is shown."
    yield "\n## How they were made\n"
    how = {"command": _quote(command) if command else "", "seed": recipe.seed}
    how |= {name: made[name] for name in ("curvafit", "torch", "numpy") if name in made}
    yield from _table(("what", ""), ((name, value) for name, value in how.items() if value != ""))
    first = f"{RECORDS}/{case_name(0)}.json"
    yield f"\nCase i depends on `curvafit.json` and on i alone; `{first}` and the like are the cases' records."


def _describe_source(source: Any) -> Iterator[str]:
    """Yield the lines on where shapes come from."""
    if not isinstance(source, Generated):
        stores = ", ".join(_quote(path.name) for path in source.paths)
        how = "by any angle" if source.rotate else "by the symmetries of the cube"
        yield f"Random crops of the {source.draws} shapes of {stores}, turned {how}."
        return
    filled = (
        f", to a volume fraction of {format_number(source.fraction)} in place of the mass" if source.fraction else ""
    )
    yield f"Grown by these laws in turn, in working units{filled}:\n"
    rows = [(name, *map(format_number, point)) for name, point in zip(source.names, source.points, strict=True)]
    yield from _table(("law", *PARAMETERS), rows[:MOST_LAWS])
    if len(rows) > MOST_LAWS:
        yield f"\nand {len(rows) - MOST_LAWS} more, in `curvafit.json`."


def _describe_composition(recipe: Recipe) -> Iterator[str]:
    """Yield the lines on what a case shows of its shapes."""
    shown, names = recipe.composition, recipe.classes
    unit = unit_name(recipe.modality.base.unit, 2)
    if shown.classes:
        yield "\nEvery case shows a shape of each law, one class each; an earlier law's is in front."
    if shown.wall is not None:
        yield f"\nThe shape is a wall of {format_number(shown.wall)} {unit} inside its surface, around a lumen."
    if len(names) > 1 or shown.levels:
        levels = zip(names, shown.choose_levels(len(names)), strict=True)
        told = ", ".join(f"{name} {format_number(level)}" for name, level in levels)
        yield f"\nLight of a class, 0 as the background's and 1 as the structure's: {told}."
    if len(names) > 1:
        yield "Further labels are of all classes together."


def _read_records(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the records of a set's cases."""
    for index in list_cases(folder):
        place = folder / RECORDS / f"{case_name(index)}.json"
        record = parse_json(place.read_bytes(), "a case's record", place)
        if not isinstance(record, dict) or not {"class_fractions", "versions"} <= record.keys():
            raise ValueError(f"{place} is not the record of a case")
        yield record


def _quote(text: str) -> str:
    """Return a text as code in Markdown, whatever signs it has."""
    fence = "`" * (1 + max((len(run) for run in re.findall("`+", text)), default=0))
    return f"{fence} {text} {fence}" if "`" in text else f"`{text}`"


def _percent_range(shares: Sequence[float]) -> str:
    """Return the least and the greatest of some shares, and their median, in percent."""
    if not shares:
        return "none"
    low, middle, high = (format_number(100 * float(each), 2) for each in np.percentile(shares, (0, 50, 100)))
    return f"{low} to {high} %, median {middle} %"


def _numbers(value: Any) -> str:
    """Return one number, or several between commas."""
    return ", ".join(format_number(each) for each in value) if isinstance(value, tuple | list) else format_number(value)


def _table(head: Sequence[str], rows: Any) -> Iterator[str]:
    """Yield the lines of a table in Markdown."""
    yield f"| {' | '.join(head)} |"
    yield f"|{'---|' * len(head)}"
    for row in rows:
        yield f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in row)} |"
