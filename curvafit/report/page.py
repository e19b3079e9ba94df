"""The report of an inference: one self-contained page, `fit.json`, the regenerated volume.

The page is `templates/report.html`, filled by jinja2 with all text escaped; pictures are inside it.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from curvafit.core.files import move_together, remove, temporary_folder, write_content
from curvafit.core.records import Format, can_write, has_mark
from curvafit.core.runtime import hold_signals
from curvafit.core.units import (
    GLOSSARY,
    format_density,
    format_length,
    format_number,
    format_percent,
    per_unit,
    unit_name,
)
from curvafit.drawing.plot import (
    bands_figure,
    corner_figure,
    diagram_figure,
    gallery_figure,
    grey_limits,
    png,
    shared_limits,
    slice_figure,
    surface_figure,
    svg,
)
from curvafit.geometry.diagrams import Diagram
from curvafit.inference.candidates import TITLES, UNBELIEVED, UNDECIDED, Candidate, seed_noise_of
from curvafit.inference.fit import Fit
from curvafit.inference.inference import Inference
from curvafit.inference.posterior import KNOWN
from curvafit.inference.table import parameters_of
from curvafit.priors.law import FORMAT
from curvafit.studies.scans import format_csv
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import save

#: The mark by which a page is known as this program's.
MARK = '<meta name="generator" content="curvafit'
#: What an inference writes into its folder.
FILES = ("fit.json", "report.html", "regenerated.nii.gz")
#: Each parameter as it is written, what it multiplies, and the power of 1/length that it carries in physical units.
_TERMS = {
    "a20": ("a₂₀", "κ₁²", 0), "a11": ("a₁₁", "κ₁κ₂", 0), "a02": ("a₀₂", "κ₂²", 0), "a10": ("a₁₀", "κ₁", 1),
    "a01": ("a₀₁", "κ₂", 1), "a00": ("a₀₀", "1", 2), "mass": ("m₀", "mass", 0),
}  # fmt: skip
#: The parameters as a corner plot names them.
SYMBOLS = ("a₁₁", "log a₀₂", "a₁₀", "a₀₁", "a₀₀", "m₀")
#: Deviations among laws from the middle of a strip to its end.
STRIP = 2.5
#: tan 22.5°: how far in direction a point may lie from a family's ideal one.
_NARROW = math.tan(math.pi / 8)
#: For each round family: which points (κ1, κ2) are its own, and the curvature that its radius is one over.
_ROUND: dict[str, Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "spheres": lambda k1, k2: (k2 > _NARROW * k1, (k1 + k2) / 2),
    "tubes": lambda k1, k2: ((k1 > 0) & (np.abs(k2) < _NARROW * k1), k1),
    "tubular cavities": lambda k1, k2: ((k2 < 0) & (np.abs(k1) < -_NARROW * k2), -k2),
    "bubbles": lambda k1, k2: ((k1 < 0) & (-k1 > -_NARROW * k2), -(k1 + k2) / 2),
}


class Picture(NamedTuple):
    """A picture in the page: its PNG in base64, None where no shape was grown, and the words below it."""

    data: str | None
    alt: str
    title: str = ""
    text: str = ""
    badge: str = ""


# ---- files -----------------------------------------------------------------------------------------------------------


def check_result_folder(
    kind: Format,
    files: Sequence[str],
    directory: str | Path,
    inputs: Iterable[str | Path] = (),
    overwrite: bool = False,
    command: str = "",
) -> Path:
    """Return the folder if a result's files, the record and the page first, can be written there; else ValueError.

    `inputs` are files or folders that are read, and so never written over. A result of the same `command` is replaced;
    `overwrite` allows to replace others, and files that are no result.
    """
    folder = Path(directory)
    first, page, *more = (folder / name for name in files)
    ours = kind.owns(first) and has_mark(page, MARK) and _command_of(first) == command
    can_write(first, lambda _: ours, more=(page, *more), inputs=inputs, overwrite=overwrite)
    return folder


def _command_of(record: Path) -> str:
    """Return the command line that a result's record states; an empty one where Python made it."""
    content = json.loads(record.read_text(encoding="utf-8"))
    return str(content.get("command") or content.get("provenance", {}).get("command") or "")


@contextmanager
def fill_folder(target: Path, files: Sequence[str]) -> Iterator[Path]:
    """Give a temporary folder, and move its files into `target` together once all are whole.

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
    """Return a record: version, date and command line, and more, of which is text what JSON has not."""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    made = {"curvafit": version("curvafit"), "date": date, "command": command}
    return made | json.loads(json.dumps(more, default=str))


def write_study(
    target: Path,
    form: Format,
    files: Sequence[str],
    record: dict[str, Any],
    values: Mapping[str, Any],
    tables: Mapping[str, Iterable[dict[str, Any]]],
    *,
    figures: Mapping[str, tuple[Figure, str]] | None = None,
    maps: Mapping[str, Volume] | None = None,
    told: Sequence[str] = ("command", "date"),
) -> Path:
    """Write a study's record, page, tables, maps, and figures as PNG and SVG, into a folder together.

    Return the page's path. The record and `values` fill the template of the page's name, besides the figures, each with
    what it shows in words; entries of the record that are `told` stand at the page's end.
    """
    pictures = {name: picture_of(*each) for name, each in (figures or {}).items()}
    provenance = [(name, record[name]) for name in told if record[name] not in ("", {})]
    shown = {"version": record["curvafit"], "provenance": provenance, **record, **pictures, **values}
    page = render_template(files[1], **shown)
    with fill_folder(target, files) as work:
        for name, field in (maps or {}).items():
            save(field, work / name, kind=form.name)
        for name, text in {files[1]: page, **{name: format_csv(list(rows)) for name, rows in tables.items()}}.items():
            (work / name).write_text(text, encoding="utf-8", newline="")
        for name, (figure, _) in (figures or {}).items():
            (work / f"{name}.png").write_bytes(base64.b64decode(pictures[name].data or ""))
            (work / f"{name}.svg").write_bytes(svg(figure))
        form.write(work / files[0], record | {"files": list(files)})
    return target / files[1]


#: Returns the folder if `write_inference` can write there, else raises ValueError; call it before the work.
check_report = partial(check_result_folder, Format(FORMAT), FILES)


def write_inference(inference: Inference, directory: str | Path, *, overwrite: bool = False) -> Path:
    """Write `fit.json`, `report.html` and, if a shape was regenerated, `regenerated.nii.gz` into a folder.

    Return the report's path. The files are moved into the folder once all are whole. Those of an earlier inference by
    the same command are replaced; others are a ValueError without `overwrite`.
    """
    command = inference.fit.provenance.get("command", "")
    target = check_report(directory, overwrite=overwrite, command=command)
    with fill_folder(target, FILES) as work:
        (work / "fit.json").write_text(inference.fit.to_json(), encoding="utf-8")
        write_report(inference, work / "report.html")
        if inference.best is not None:
            edge = inference.fit.working_voxel
            save(Volume(inference.best, (edge, edge, edge), inference.fit.length_unit), work / "regenerated.nii.gz")
    return target / "report.html"


def with_command(inference: Inference, command: str) -> Inference:
    """Return the inference with the command line noted in its provenance."""
    provenance = {**inference.fit.provenance, "command": command}
    return dataclasses.replace(inference, fit=dataclasses.replace(inference.fit, provenance=provenance))


def write_report(inference: Inference, path: str | Path) -> Path:
    """Write the report of an inference as one HTML page without outside parts, and return its path."""
    return write_content(Path(path), report_html(inference))


def render_template(name: str, **values: Any) -> str:
    """Return a page of `templates`, filled with values; all text is escaped."""
    environment = Environment(
        loader=PackageLoader("curvafit.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    return environment.get_template(name).render(**values)


def report_html(inference: Inference) -> str:
    """Return the report of an inference as the text of its page."""
    fit, limits = inference.fit, grey_limits(inference.scan.values)
    return render_template(
        "report.html", version=fit.provenance.get("curvafit", ""), glossary=GLOSSARY, number=format_number, fit=fit,
        sentence=describe(inference), scan=describe_scan(inference),
        voxel=format_length(inference.prepared.working_voxel, fit.length_unit, 3),
        slices=[_slice(inference, axis, limits) for axis in range(3)],
        framed=_is_framed(inference), windows=len(inference.prepared.windows),
        shapes=_shapes(inference) if inference.twins else [],
        diagrams=[] if inference.diagram is None else _diagrams(inference),
        bars=_bars(inference) if inference.twins else [], unit=format_length(fit.length, fit.length_unit, 3),
        noise=seed_noise_of(fit.candidates), twins=0 if fit.best is None else len(fit.best.twins),
        numbers=_number_rows(inference), strips=list_strips(fit), law=_law(inference), corner=_corner(inference),
        bands=bands(inference), symbols=[symbol for symbol, _, _ in _TERMS.values()],
        provenance=[(str(name).replace("_", " "), _to_words(value)) for name, value in fit.provenance.items()],
    )  # fmt: skip


# ---- words and numbers -----------------------------------------------------------------------------------------------


def describe(inference: Inference) -> str:
    """Return the sentence that a report opens with: family, size, share of the volume."""
    fit, numbers = inference.fit, inference.fit.morphometry
    radius = None if inference.diagram is None else family_radius(inference.diagram, fit.family)
    if fit.family in _ROUND:
        physical = numbers.thickness_mean / 2 if radius is None else radius * inference.prepared.length
        size = f"radius {format_length(physical, fit.length_unit)}"
    else:
        struts = "struts " if fit.family == "sponge" else ""
        size = f"{struts}{format_length(numbers.thickness_mean, fit.length_unit)} thick"
    whose = "in a phase that is " if fit.family in ("tubular cavities", "bubbles") else ""
    return f"{fit.family.capitalize()}, {size}, {whose}{format_percent(numbers.volume_fraction)} of the volume"


def family_radius(diagram: Diagram, family: str) -> float | None:
    """Return the median radius over the area of a round family, in the diagram's unit; None for another family."""
    if family not in _ROUND:
        return None
    own, kappa = _ROUND[family](*np.asarray(diagram.points).T)
    own = own & (kappa > 0)
    if not own.any():
        return None
    weights = np.asarray(diagram.weights)[own]
    return float(1 / np.quantile(kappa[own], 0.5, weights=weights, method="inverted_cdf"))


def describe_scan(inference: Inference) -> str:
    """Return what was read: name, kind, voxels and their size."""
    scan, fit = inference.scan, inference.fit
    shape = " × ".join(str(n) for n in scan.values.shape)
    kind = "phase field" if fit.kind == "field" else fit.kind
    same = len({round(h / scan.spacing[0], 6) for h in scan.spacing}) == 1
    spacing = (scan.spacing[0],) if same else scan.spacing
    voxel = " × ".join(f"{h:.4g}" for h in spacing) + f" {unit_name(scan.unit, spacing[0])}"
    return f"{name_source(scan.source) or 'a volume'}: {kind} of {shape} voxels (z, y, x), voxel edge {voxel}."


def name_source(source: str | None) -> str:
    """Return the name of a scan's file, with the key of its array."""
    path, _, key = (source or "").partition("::")
    return "::".join(filter(None, (Path(path).name, key)))


def _bars(inference: Inference) -> list[dict[str, Any]]:
    """Return the bars of the distances: one for each candidate's shape, and one for two seeds."""
    fit, noise = inference.fit, seed_noise_of(inference.fit.candidates)
    laws = [(_title(each), each.distance, each.name == fit.chosen) for each in _chosen_first(inference)]
    rows = [(name, value, "best" if chosen else "", "nothing grew") for name, value, chosen in laws]
    rows.append(("Two seeds", noise, "noise", "not known"))
    longest = max((value for _, value, _, _ in rows if value is not None), default=0.0) or 1.0
    bars = []
    for name, value, kind, lacking in rows:
        text, width = (lacking, None) if value is None else (format_number(value, 2), f"{100 * value / longest:.1f}")
        bars.append({"name": name, "kind": kind, "text": text, "width": width})
    return bars


def _number_rows(inference: Inference) -> list[tuple[str, str, list[str]]]:
    """Return rows of the scan's familiar numbers, the twins' mean with its extremes, and the mean over the scan's."""
    scan, best = inference.fit.morphometry, inference.fit.best
    twins, unit = () if best is None else best.twins, scan.unit
    kinds: tuple[tuple[str, str, str, Callable[[float], str]], ...] = (
        ("Volume fraction", "BV/TV", "volume_fraction", format_percent),
        ("Mean thickness", "Tb.Th", "thickness_mean", lambda x: format_length(x, unit)),
        ("Mean spacing", "Tb.Sp", "spacing_mean", lambda x: format_length(x, unit)),
        ("Connectivity density", "Conn.D", "connectivity_density", lambda x: format_density(x, unit, 3)),
        ("Surface to volume", "BS/BV", "surface_to_volume", lambda x: format_density(x, unit, 1)),
    )
    rows = []
    for name, short, key, text in kinds:
        own, values = float(getattr(scan, key)), [float(getattr(each, key)) for each in twins]
        cells = [text(own)]
        if values:
            mean = sum(values) / len(values)
            extremes = f" ({text(min(values))} to {text(max(values))})" if len(values) > 1 else ""
            cells += [text(mean) + extremes, format_number(mean / own, 2) if own else "–"]
        rows.append((name, short, cells))
    return rows


def parameter_table(inference: Inference) -> list[tuple[str, str, str, str, str]]:
    """Return rows of name, chosen value, its own deviation, the posterior's 90 % interval, and the physical value.

    Without a law there are no rows.
    """
    return [
        (name, value, deviation, interval, f"{physical} {unit}".strip())
        for name, (value, deviation, _, _, interval, physical), unit in _parameters(inference)
    ]


def _parameters(inference: Inference) -> list[tuple[str, tuple[str, ...], str]]:
    """Return the name, the cells and the unit of each parameter of the chosen law."""
    fit, best, physical = inference.fit, inference.fit.best, inference.fit.coefficients_physical
    if best is None or physical is None:
        return []
    intervals = fit.intervals() or {}
    rows = []
    for name, value in {**best.coefficients.as_dict(), "mass": best.mass}.items():
        known, power = intervals.get(name), _TERMS[name][2]
        median = format_number(known["median"]) if known else ""
        scaled = "" if name == "mass" else format_number(physical.as_dict()[name])
        ranges = ("" if known is None else " to ".join(map(format_number, known[level])) for level in ("50", "90"))
        own = best.uncertainty.get(name)
        deviation = "" if own is None else "fixed" if own == 0 else format_number(own, 2)
        cells = (format_number(value), deviation, median, *ranges, scaled)
        rows.append((name, cells, per_unit(fit.length_unit, power) if power else ""))
    return rows


def list_strips(fit: Fit) -> list[dict[str, Any]]:
    """Return the bars of what a fit tells of each combination of parameters, in percent of a strip."""
    strips = []
    for each in fit.combinations:
        start, end = (100 * float(np.clip(0.5 + x / (2 * STRIP), 0, 1)) for x in each.interval)
        low, high = (format_number(x, 2) for x in each.interval)
        strips.append({"low": each.low, "high": each.high, "start": f"{start:.1f}", "width": f"{end - start:.1f}",
                       "known": each.known >= KNOWN, "text": f"{low} to {high}"})  # fmt: skip
    return strips


def _law(inference: Inference) -> dict[str, Any] | None:
    """Return what the page says of the chosen law; None without one."""
    fit, best = inference.fit, inference.fit.best
    if best is None:
        return None
    rows = [(*_TERMS[name][:2], cells, unit) for name, cells, unit in _parameters(inference)]
    width = ("0.02", "", "", "", "", format_number(fit.epsilon_physical))
    fixed = [name for name in ("a20", "a02") if abs(best.coefficients.as_dict()[name] - 1) < 1e-9]
    return {
        "rows": [*rows, ("ε", "interface", width, unit_name(fit.length_unit, 2))],
        "gauge": f"here {_TERMS[fixed[0]][0]} = 1" if fixed else "all six may be multiplied by one factor",
        "voxel": format_length(fit.working_voxel, fit.length_unit, 3),
        "title": TITLES.get(best.name, best.name),
        "own": bool(best.uncertainty),
    }


def _to_words(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_to_words(part)}" for name, part in value.items())
    return ", ".join(map(_to_words, value)) if isinstance(value, (list, tuple)) else str(value)


def _chosen_first(inference: Inference) -> list[Candidate]:
    return sorted(inference.fit.candidates, key=lambda each: each.name != inference.fit.chosen)


def _title(candidate: Candidate) -> str:
    title = TITLES.get(candidate.name, candidate.name)
    return title[0].upper() + title[1:]


# ---- pictures --------------------------------------------------------------------------------------------------------


def inference_figure(inference: Inference, **options: Any) -> Figure:
    """Return a figure of the scan's surface beside its regrown twin.

    Where no twin grew, the scan is alone. `options` are those of `gallery_figure`.
    """
    shapes = {"the scan": scan_box(inference)}
    if inference.best is not None:
        shapes[f"regrown: {TITLES[str(inference.fit.chosen)]}"] = inference.best
    return gallery_figure(shapes, **{"columns": 2, "width": 900, **options})


def picture_of(figure: Figure, alt: str, **words: str) -> Picture:
    """Return a figure as a picture for the page; `alt` describes it, `words` are further fields of `Picture`."""
    return Picture(base64.b64encode(png(figure)).decode("ascii"), alt, **words)


def _slice(inference: Inference, axis: int, limits: tuple[float, float]) -> Picture:
    """Return a picture of the slice across the main window's middle, by the edges of voxels, in the scan's unit."""
    scan, prepared = inference.scan, inference.prepared
    down, across = (k for k in range(3) if k != axis)
    index = (prepared.windows[0][axis].start + prepared.windows[0][axis].stop) // 2
    place = prepared.origin[axis] + (index + 0.5) * prepared.scale[axis]
    row = int(np.clip(place, 0, scan.values.shape[axis] - 1))
    start, step = np.array(prepared.origin) * scan.spacing, np.array(prepared.scale) * scan.spacing
    stop = start + step * prepared.phase.shape
    first = start + step * [edge.start for edge in prepared.windows[0]]
    last = start + step * [edge.stop for edge in prepared.windows[0]]
    size = np.array(scan.values.shape) * scan.spacing
    framed = (first[across], last[across], last[down], first[down]) if _is_framed(inference) else None
    figure = slice_figure(
        np.asarray(scan.values.take(row, axis), dtype=np.float32), prepared.phase.take(index, axis),
        image_extent=(0.0, size[across], size[down], 0.0),
        extent=(start[across], stop[across], stop[down], start[down]), limits=limits, unit=scan.unit,
        axes_names=("zyx"[down], "zyx"[across]), window=framed,
    )  # fmt: skip
    depth = format_length((row + 0.5) * scan.spacing[axis], scan.unit)
    part = list(scan.values.shape) != inference.fit.provenance.get("scan_shape", list(scan.values.shape))
    of = " of the part that was read" if part else ""
    title, text = f"Across {'zyx'[axis]}", f"Slice {row} of {scan.values.shape[axis]}{of}, at {depth}"
    return picture_of(figure, f"Slice across {'zyx'[axis]} with the surface's outline", title=title, text=text)


def _is_framed(inference: Inference) -> bool:
    """Return whether the main window is smaller than what the slices show."""
    shape = inference.prepared.phase.shape
    return any(edge.stop - edge.start < n for edge, n in zip(inference.prepared.windows[0], shape, strict=True))


def _shapes(inference: Inference) -> list[Picture]:
    """Return pictures of the surfaces of the scan and of each candidate's shape, in boxes of one size."""
    fit = inference.fit
    word = "the nearest" if fit.status.startswith((UNBELIEVED, UNDECIDED)) else "best supported"
    pictures = [_shape(inference, "The scan", scan_box(inference))]
    for each in _chosen_first(inference):
        distance = "" if each.distance is None else f"; distance {each.distance:.1f}"
        badge = word if each.name == fit.chosen else ""
        u = inference.shape_of(each.name)
        pictures.append(_shape(inference, f"{_title(each)}, regrown", u, distance, badge))
    return pictures


def _shape(inference: Inference, title: str, u: np.ndarray | None, more: str = "", badge: str = "") -> Picture:
    """Return a picture of one surface, without data if there is no shape; `more` follows the size of its box."""
    if u is None:
        return Picture(None, "", title, badge=badge)
    edges = [format_length(n * inference.fit.working_voxel, inference.fit.length_unit, 3) for n in u.shape]
    box = f"edge {edges[0]}" if len(set(edges)) == 1 else " × ".join(edges)
    return picture_of(surface_figure(u), f"Surface: {title}", title=title, text=box + more, badge=badge)


def scan_box(inference: Inference) -> np.ndarray:
    """Return the main window's phase field, cut to the size of the regenerated shape so that both have one scale."""
    phase = inference.prepared.phase[inference.prepared.windows[0]]
    other = inference.best
    if other is None:
        return phase
    starts = [(n - min(n, m)) // 2 for n, m in zip(phase.shape, other.shape, strict=True)]
    return phase[tuple(slice(s, s + m) for s, m in zip(starts, other.shape, strict=True))]


def _diagrams(inference: Inference) -> list[Picture]:
    """Return curvature diagrams of the scan, the chosen law and the match, with shared axes, in the scan's unit."""
    diagrams: list[tuple[str, Diagram | None]] = [("The scan", inference.diagram)]
    for each in _chosen_first(inference) if inference.twins else ():
        if each.name in (inference.fit.chosen, "match"):
            grown = (twin.diagram for twin in inference.twins.get(each.name, ()) if twin.diagram)
            diagrams.append((f"{_title(each)}, regrown", next(grown, None)))
    λ, unit = inference.prepared.length, inference.fit.length_unit
    limits = shared_limits([diagram for _, diagram in diagrams if diagram is not None], length=λ)
    pictures = []
    for title, diagram in diagrams:
        drawn = None if diagram is None else diagram_figure(diagram, limits=limits, unit=unit, length=λ)
        alt = f"Curvature diagram: {title}"
        pictures.append(Picture(None, "", title) if drawn is None else picture_of(drawn, alt, title=title))
    return pictures


def _corner(inference: Inference) -> Picture | None:
    """Return a corner plot of the posterior's draws, in working units, with marks for the chosen law and the match."""
    fit = inference.fit
    if fit.draws is None or fit.best is None:
        return None
    draws = fit.draws[:, : len(SYMBOLS)]
    shown = [each for each in fit.candidates if each.name in (fit.chosen, "match")]
    marks = {_title(each): parameters_of(each.coefficients, each.mass) for each in shown}
    rows = [np.percentile(draws, (0.5, 99.5), axis=0), *(mark[None] for mark in marks.values())]
    low, high = np.concatenate(rows).min(0), np.concatenate(rows).max(0)
    rim = 0.06 * np.maximum(high - low, 1e-6)
    limits = list(zip((low - rim).tolist(), (high + rim).tolist(), strict=True))
    return picture_of(corner_figure(draws, SYMBOLS, limits, marks), "Draws of the parameters, two by two")


def bands(inference: Inference) -> Picture | None:
    """Return a figure of the scan's descriptors on the bands of simulated ones; None where none were simulated."""
    misfit = inference.fit.misfit
    if inference.simulated is None or misfit is None:
        return None
    titles = {name: f"{name}, p = {format_number(misfit.blocks.get(name), 2)}" for name in inference.simulated}
    return picture_of(
        bands_figure({titles[name]: block for name, block in inference.simulated.items()}),
        "The scan's descriptors on the bands of simulated shapes",
        text="Orange: the scan. Bands: 50 and 90 % of shapes grown from draws of the posterior, seen as the scan is. "
        "Lengths in working units; quantiles from the least to the greatest.",
    )
