"""What an inference leaves behind: one self-contained page, `fit.json`, the regenerated volume."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, NamedTuple

from curvafit.core.files import bears, check_folder, check_free, move_together, own_record, staged, write_content
from curvafit.core.runtime import undisturbed
from curvafit.core.units import density, length, number, per_unit, percent, unit_name
from curvafit.inference.candidates import TITLES, Candidate, seed_noise_of
from curvafit.priors.coefficients import NAMES
from curvafit.priors.fit_file import FORMAT
from curvafit.report.pictures import (
    bands,
    corner,
    diagram_figures,
    shown,
    slice_figures,
    surface_figures,
    title_of,
    window_framed,
)
from curvafit.report.wording import describe, glossary_link
from curvafit.volumes.field import Field
from curvafit.volumes.write import save

if TYPE_CHECKING:
    from curvafit.geometry.morphometry import Morphometry
    from curvafit.inference.infer import Inference

#: The mark by which a page is known as this program's.
_MARK = '<meta name="generator" content="curvafit'
#: What an inference writes into its folder.
FILES = ("fit.json", "report.html", "regenerated.nii.gz")


class _Term(NamedTuple):
    """A parameter as it is written, what it multiplies, and the power of 1/length that it carries."""

    symbol: str
    factor: str
    power: int


#: Each coefficient as it is written, what it multiplies, and the power of 1/length that it carries in physical units.
_TERMS = {
    "a20": _Term("a₂₀", "κ₁²", 0),
    "a11": _Term("a₁₁", "κ₁κ₂", 0),
    "a02": _Term("a₀₂", "κ₂²", 0),
    "a10": _Term("a₁₀", "κ₁", 1),
    "a01": _Term("a₀₁", "κ₂", 1),
    "a00": _Term("a₀₀", "1", 2),
    "mass": _Term("m₀", "mass", 0),
}
_NUMERIC = ' class="n"'


def check_report(directory: str | Path, inputs: Iterable[str | Path] = (), overwrite: bool = False) -> Path:
    """Return the folder if `write_inference` can write there; ask before the work is done.

    `inputs` are the files, or folders, that are read: none may be written over. `overwrite` tells whether files of the
    same names that no inference wrote may be.

    Raises
    ------
    ValueError
        If it is no folder that can be written to, or an input or another file stands where one of the three goes.
    """
    folder = check_folder(directory)
    ours = bool(own_record(folder / "fit.json", FORMAT)) and bears(folder / "report.html", _MARK)
    check_free([folder / name for name in FILES], lambda _: ours, inputs, overwrite)
    return folder


def write_inference(inference: Inference, directory: str | Path, *, overwrite: bool = False) -> Path:
    """Write `fit.json`, `report.html` and `regenerated.nii.gz` into a folder and return the report's path.

    All three are written into a temporary folder beside it and moved once they are whole. Without a regenerated shape
    there is no `regenerated.nii.gz`. The files of an earlier inference are replaced.

    Raises
    ------
    ValueError
        As `check_report`.
    """
    target = check_report(directory, overwrite=overwrite)
    with staged(target / FILES[0] if target.is_dir() else target) as work:
        (work / "fit.json").write_text(inference.fit.to_json(), encoding="utf-8")
        write_report(inference, work / "report.html")
        if inference.best is not None:
            edge = inference.fit.working_voxel
            save(Field(inference.best, (edge, edge, edge), inference.fit.length_unit), work / "regenerated.nii.gz")
        with undisturbed():
            target.mkdir(exist_ok=True)
            (target / "regenerated.nii.gz").unlink(missing_ok=True)
            move_together(sorted(work.iterdir()), target)
    return target / "report.html"


def with_command(inference: Inference, command: str) -> Inference:
    """Return the inference with the command line that made it in its provenance."""
    provenance = {**inference.fit.provenance, "command": command}
    return dataclasses.replace(inference, fit=dataclasses.replace(inference.fit, provenance=provenance))


def parameter_table(inference: Inference) -> list[tuple[str, str, str, str, str]]:
    """Return rows of name, chosen value, its own deviation, the posterior's 90 % interval, and the physical value; no
    rows where there is no law."""
    fit, best, physical = inference.fit, inference.fit.best, inference.fit.coefficients_physical
    if best is None or physical is None:
        return []
    intervals = {} if fit.draws is None else fit.draws.intervals()
    values = {**best.coefficients.as_dict(), "mass": best.mass}
    rows = []
    for name, value in values.items():
        power = _TERMS[name].power
        unit = f" {per_unit(fit.length_unit, power)}" if power else ""
        scaled = "" if name == "mass" else number(physical.as_dict()[name]) + unit
        rows.append((name, number(value), _deviation(best, name), _interval(intervals.get(name), "90"), scaled))
    return rows


def write_report(inference: Inference, path: str | Path) -> Path:
    """Write the report of an inference as one HTML page without outside parts, and return its path."""
    page = report_html(inference)
    return write_content(Path(path), page)


def report_html(inference: Inference) -> str:
    """Return the page itself."""
    template = Template(files("curvafit.report").joinpath("templates", "report.html").read_text(encoding="utf-8"))
    sections = (_shapes, _diagrams, _numbers, _law, _unusual, _matches, _more)
    sentence = escape(describe(inference))
    return template.substitute(
        version=escape(str(inference.fit.provenance.get("curvafit", ""))),
        title=f"{sentence} · curvafit",
        sentence=sentence + ".",
        scan=_scan_line(inference),
        verdict=escape(inference.fit.status),
        slices=slice_figures(inference),
        frame=" The dashed frame is the main window." if window_framed(inference) else "",
        notes=_list(inference.fit.notes),
        sections="\n".join(part for part in (section(inference) for section in sections) if part),
        provenance=_provenance(inference),
    )


def _section(title: str, *parts: str) -> str:
    body = "\n".join(part for part in parts if part)
    return f"<section>\n<h2>{escape(title)}</h2>\n{body}\n</section>\n"


def _shapes(inference: Inference) -> str:
    """Return the section of the scan and what grew from each candidate."""
    if not inference.twins:
        return ""
    say = (
        "All but the first were grown from random noise, with nothing but six coefficients and a mass. They should "
        "have the scan's texture; they are not copies of it."
    )
    return _section("Scanned and regrown", f"<p>{say}</p>", f'<div class="row">{surface_figures(inference)}</div>')


def _diagrams(inference: Inference) -> str:
    """Return the section of curvature diagrams and their distances."""
    if inference.diagram is None:
        return ""
    say = (
        "How the surface's area is spread over its two principal curvatures κ₁ ≥ κ₂: the darker, the more area "
        "(logarithmic, over three decades). All have the same axes; nothing can lie above the red line κ₁ = κ₂."
    )
    parts = [f"<p>{say}</p>", f'<div class="row">{diagram_figures(inference)}</div>']
    if inference.twins:
        parts.append(
            "<p>The Wasserstein distance from the scan's diagram to that of each regrown shape, in "
            f"{_distance_unit(inference)}. {_distances_say(inference)}</p>"
        )
        parts.append(f'<div class="bars">{_bars(inference)}</div>')
    return _section("Curvature diagrams", *parts)


def _numbers(inference: Inference) -> str:
    """Return the section of familiar numbers: the scan's beside its twins'."""
    fit, best = inference.fit, inference.fit.best
    twins = () if best is None else best.twins
    head = ""
    if twins:
        among = f"{len(twins)} twins" if len(twins) > 1 else "a twin"
        head = (
            '<thead><tr><th></th><th></th><th class="n">the scan</th>'
            f'<th class="n">{among}</th><th class="n">twins over scan</th></tr></thead>'
        )
    euler = f"Euler number {fit.morphometry.euler} in the box"
    note = f"Thickness and spacing are the mean diameters of the largest balls that fit; {euler}."
    if twins and fit.kind != "field":
        note += " The twins were grown at the scan's volume fraction."
    table = f'<div class="wide"><table>{head}<tbody>{_number_rows(fit.morphometry, twins)}</tbody></table></div>'
    return _section("Familiar numbers", table, f'<p class="small">{note}</p>')


def _law(inference: Inference) -> str:
    """Return the section of the parameters and how well they are known; empty where there is no law."""
    fit, best = inference.fit, inference.fit.best
    if best is None:
        return ""
    heads = ("coefficient", "of", "chosen", "±", "median", "50 % interval", "90 % interval", "chosen, physical", "unit")
    head = "".join(f'<th scope="col"{_NUMERIC if k > 1 and k != 8 else ""}>{name}</th>' for k, name in enumerate(heads))
    parts = [
        f"<p>Six coefficients and a mass are the scan's {glossary_link('law')}: its shapes have little energy "
        "∫ p(κ₁, κ₂) dA for their volume, where p = a₂₀ κ₁² + a₁₁ κ₁κ₂ + a₀₂ κ₂² + a₁₀ κ₁ + a₀₁ κ₂ + a₀₀. Only the "
        f"ratios of the six matter: {_scale_say(best)}.</p>",
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>',
        f"<tbody>{_parameter_rows(inference)}</tbody></table></div>",
        f'<p class="small">{_parameters_say(inference)}</p>',
    ]
    if fit.drift is not None:
        parts.append(
            "<p>Started at the scan, a short flow of the chosen law moves its surface by "
            f"{number(fit.drift, 2)} voxels: the less, the more the scan is a shape of this law.</p>"
        )
    if fit.weak_directions:
        parts.append("<p>What the scan leaves open:</p>" + _list(fit.weak_directions))
    if fit.draws is not None:
        parts.append(
            f'<div class="corner">{corner(inference)}</div><p class="small">{len(fit.draws.values)} draws of the '
            "posterior, two parameters at a time, in working units. A long thin cloud is a direction that the scan "
            "does not tell apart.</p>"
        )
    return _section("The law, and how well it is known", *parts)


def _unusual(inference: Inference) -> str:
    """Return the section of how usual the scan's descriptors are for the model."""
    misfit = inference.fit.misfit
    if misfit is None:
        return ""
    say = (
        f"p is the part of shapes of this model ({escape(misfit.method)}) that lie as far out as the scan does. All "
        f"descriptors together: p = {number(misfit.probability, 2)}."
    )
    return _section("Could this model have made the scan?", f"<p>{say}</p>", bands(inference))


def _matches(inference: Inference) -> str:
    """Return the section of the nearest shapes of the atlas."""
    if not inference.fit.matches:
        return ""
    heads = ("shape", "distance", *(_TERMS[name].symbol for name in (*NAMES, "mass")), "seed")
    head = "".join(f'<th scope="col"{_NUMERIC if k else ""}>{name}</th>' for k, name in enumerate(heads))
    return _section(
        "Nearest shapes of the atlas",
        f'<div class="wide"><table class="ids"><thead><tr>{head}</tr></thead>'
        f"<tbody>{_match_rows(inference)}</tbody></table></div>",
        '<p class="small">The nearest is the baseline: its parameters are what the nearest curvature diagram says, '
        "without any uncertainty. These distances are to the diagrams that the atlas holds; those above are to shapes "
        "regrown in a box of the scan's size.</p>",
    )


def _more(inference: Inference) -> str:
    """Return the section of how to grow more of a scan's texture."""
    if inference.fit.best is None:
        return ""
    command = escape("curvafit generate --prior fit.json --shape 100 --seed 1 -o more.nii.gz")
    say = (
        "Either of these grows a volume of the same texture: of any size, and another one for each seed. "
        "<code>fit.json</code> lies beside this page."
    )
    return _section("Make more of it", f"<p>{say}</p>", f"<pre>{command}</pre>", f"<pre>{_PYTHON}</pre>")


_PYTHON = escape(
    """import curvafit
from curvafit.priors import read_fit

fit = read_fit("fit.json")
flow = curvafit.generate(fit.coefficients, fit.mass, 100, schedule="deep", seed=1)"""
)


def _scan_line(inference: Inference) -> str:
    scan, fit = inference.scan, inference.fit
    shape = " × ".join(str(n) for n in scan.values.shape)
    kind = {"field": "phase field", "mask": "mask", "image": "image"}.get(fit.kind, fit.kind)
    same = len({round(h / scan.spacing[0], 6) for h in scan.spacing}) == 1
    spacing = (scan.spacing[0],) if same else scan.spacing
    voxel = " × ".join(f"{h:.4g}" for h in spacing) + f" {unit_name(scan.unit, spacing[0])}"
    name = Path(scan.source).name or "a volume"
    line = f"{name}: {kind} of {shape} voxels (z, y, x), voxel edge {voxel}."
    return escape(line) + f" Measured on voxels of {escape(length(fit.working_voxel, fit.length_unit, 3))}."


def _list(notes: tuple[str, ...]) -> str:
    return '<ul class="small">' + "".join(f"<li>{escape(note)}</li>" for note in notes) + "</ul>" if notes else ""


def _distance_unit(inference: Inference) -> str:
    voxel = length(inference.fit.length, inference.fit.length_unit, 3)
    return f"1/{glossary_link('working unit')} (100 working voxels, {escape(voxel)})"


def _distances_say(inference: Inference) -> str:
    noise = seed_noise_of(inference.fit.candidates)
    if noise is None:
        return "The same parameters could not be grown twice, so it is not known how far apart two seeds lie."
    return f"Two seeds of the same parameters lie {number(noise, 2)} apart: smaller differences mean nothing."


def _bars(inference: Inference) -> str:
    fit = inference.fit
    rows = [(title_of(each), each.distance, each.name == fit.chosen) for each in shown(inference)]
    noise = seed_noise_of(fit.candidates)
    longest = max([value for _, value, _ in rows if value is not None] + [noise or 0.0]) or 1.0
    parts = []
    for name, value, best in (*rows, ("Two seeds", noise, None)):
        style = "noise" if best is None else "best" if best else ""
        bar = "" if value is None else f'<span class="bar {style}" style="width:{100 * value / longest:.1f}%"></span>'
        bold = ' class="chosen"' if best else ""
        text = number(value, 2) if value is not None else "not known" if best is None else "nothing grew"
        parts.append(f"<span{bold}>{escape(name)}</span><span>{bar}</span><span{bold}>{text}</span>")
    return "\n".join(parts)


def _scale_say(candidate: Candidate) -> str:
    fixed = [name for name in ("a20", "a02") if abs(candidate.coefficients.as_dict()[name] - 1) < 1e-9]
    return f"here {_TERMS[fixed[0]].symbol} = 1" if fixed else "all six may be multiplied by one factor"


def _parameter_rows(inference: Inference) -> str:
    fit, best, physical = inference.fit, inference.fit.best, inference.fit.coefficients_physical
    assert best is not None and physical is not None
    intervals = {} if fit.draws is None else fit.draws.intervals()
    rows = []
    for name, value in {**best.coefficients.as_dict(), "mass": best.mass}.items():
        term, known = _TERMS[name], intervals.get(name)
        median = number(known["median"]) if known else ""
        scaled = "" if name == "mass" else number(physical.as_dict()[name])
        unit = per_unit(fit.length_unit, term.power) if term.power else ""
        cells = (
            number(value), _deviation(best, name), median, _interval(known, "50"), _interval(known, "90"), scaled
        )  # fmt: skip
        columns = "".join(
            f'<td class="n{" chosen" if k in (0, 5) else ""}">{cell}</td>' for k, cell in enumerate(cells)
        )
        rows.append(f'<tr><th scope="row">{term.symbol}</th><td>{term.factor}</td>{columns}<td>{unit}</td></tr>')
    epsilon = f'<td class="n">0.02</td>{"<td></td>" * 4}<td class="n">{number(fit.epsilon_physical)}</td>'
    rows.append(f'<tr><th scope="row">ε</th><td>interface</td>{epsilon}<td>{unit_name(fit.length_unit, 2)}</td></tr>')
    return "\n".join(rows)


def _deviation(candidate: Candidate, name: str) -> str:
    """Return a candidate's own deviation of a parameter; nothing where it has none."""
    value = candidate.uncertainty.get(name)
    return "" if value is None else "fixed" if value == 0 else number(value, 2)


def _interval(known: Mapping[str, Any] | None, level: str) -> str:
    return "" if known is None else " to ".join(number(end) for end in known[level])


def _parameters_say(inference: Inference) -> str:
    fit, best = inference.fit, inference.fit.best
    assert best is not None
    voxel = length(fit.working_voxel, fit.length_unit, 3)
    own = (
        f"± is its own standard deviation ({TITLES.get(best.name, best.name)})."
        if best.uncertainty
        else "It has no uncertainty of its own."
    )
    rest = f" Median and intervals are the posterior's ({escape(fit.draws.method)})." if fit.draws else ""
    return (
        f"In {glossary_link('working unit', 's')} (voxel 0.01, ε 0.02); a working voxel is {escape(voxel)}. Bold: the "
        f"chosen law ({TITLES.get(best.name, best.name)}), which fit.json holds. {own}{rest}"
    )


def _number_rows(scan: Morphometry, twins: tuple[Morphometry, ...]) -> str:
    """Return rows of the scan's familiar numbers, the twins' mean and extremes, and the ratio of the two."""
    unit = scan.unit
    rows: tuple[tuple[str, str, str, Callable[[float], str]], ...] = (
        ("Volume fraction", "BV/TV", "volume_fraction", percent),
        ("Mean thickness", "Tb.Th", "thickness_mean", lambda x: length(x, unit)),
        ("Mean spacing", "Tb.Sp", "spacing_mean", lambda x: length(x, unit)),
        ("Connectivity density", "Conn.D", "connectivity_density", lambda x: density(x, unit, 3)),
        ("Surface to volume", "BS/BV", "surface_to_volume", lambda x: density(x, unit, 1)),
    )
    parts = []
    for name, short, key, text in rows:
        own = float(getattr(scan, key))
        cells = [text(own)]
        if twins:
            values = [float(getattr(each, key)) for each in twins]
            mean = sum(values) / len(values)
            band = f" ({text(min(values))} to {text(max(values))})" if len(values) > 1 else ""
            cells += [text(mean) + band, number(mean / own, 2) if own else "–"]
        columns = "".join(f'<td class="n">{escape(cell)}</td>' for cell in cells)
        parts.append(f'<tr><th scope="row">{name}</th><td class="small">{short}</td>{columns}</tr>')
    return "\n".join(parts)


def _match_rows(inference: Inference) -> str:
    rows = []
    for match in inference.fit.matches:
        cells = [number(match.distance, 2), *map(number, match.coefficients.as_dict().values()), number(match.mass)]
        columns = "".join(f'<td class="n">{cell}</td>' for cell in (*cells, str(match.seed)))
        rows.append(f'<tr><th scope="row">{escape(str(match.id))}</th>{columns}</tr>')
    return "\n".join(rows)


def _provenance(inference: Inference) -> str:
    return "\n".join(
        f"<dt>{escape(str(name).replace('_', ' '))}</dt><dd>{escape(_plain(value))}</dd>"
        for name, value in inference.fit.provenance.items()
    )


def _plain(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_plain(part)}" for name, part in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_plain(part) for part in value)
    return str(value)
