"""What an inference leaves behind: one self-contained page, `fit.json`, the regenerated volume."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from curvafit.files import bears, check_folder, check_free, move_together, own_record, staged, write_content
from curvafit.interrupts import undisturbed
from curvafit.priors.coefficients import NAMES
from curvafit.priors.fit_file import FORMAT
from curvafit.report.pictures import TWINS, diagram_figures, slice_figures, surface_figures, window_framed
from curvafit.report.wording import describe, glossary_link
from curvafit.units import density, length, number, per_unit, percent, unit_name
from curvafit.volumes.scan import Field, save

if TYPE_CHECKING:
    from curvafit.inference.infer import Inference

#: The mark by which a page is known as this program's.
_MARK = '<meta name="generator" content="curvafit'
#: What an inference writes into its folder.
FILES = ("fit.json", "report.html", "regenerated.nii.gz")
#: Each coefficient as it is written, what it multiplies, and the power of 1/length that it carries in physical units.
_TERMS = {
    "a20": ("a₂₀", "κ₁²", 0),
    "a11": ("a₁₁", "κ₁κ₂", 0),
    "a02": ("a₀₂", "κ₂²", 0),
    "a10": ("a₁₀", "κ₁", 1),
    "a01": ("a₀₁", "κ₂", 1),
    "a00": ("a₀₀", "1", 2),
}


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


def parameter_table(inference: Inference) -> list[tuple[str, str, str, str]]:
    """Return rows of name, working value, deviation and physical value for the better supported parameters."""
    fit = inference.fit
    physical = fit.coefficients_physical.as_dict()
    rows = []
    for name, value in fit.coefficients.as_dict().items():
        _, _, power = _TERMS[name]
        unit = f" {per_unit(fit.length_unit, power)}" if power else ""
        deviation = _deviation(fit.uncertainty.get(name), 1.0) if fit.chosen == "fit" else ""
        rows.append((name, number(value), deviation.removeprefix("± "), number(physical[name]) + unit))
    return [*rows, ("mass", number(fit.mass), "", "")]


def write_report(inference: Inference, path: str | Path) -> Path:
    """Write the report of an inference as one HTML page without outside parts, and return its path."""
    page = report_html(inference)
    return write_content(Path(path), page)


def report_html(inference: Inference) -> str:
    """Return the page itself."""
    template = Template(files("curvafit.report").joinpath("templates", "report.html").read_text(encoding="utf-8"))
    fit = inference.fit
    sentence = escape(describe(inference))
    return template.substitute(
        version=escape(str(fit.provenance.get("curvafit", ""))),
        title=f"{sentence} · curvafit",
        sentence=sentence + ".",
        scan=_scan_line(inference),
        verdict=escape(fit.status),
        slices=slice_figures(inference),
        frame=" The dashed frame is the main window." if window_framed(inference) else "",
        notes=_list(fit.notes),
        surfaces=surface_figures(inference),
        diagrams=diagram_figures(inference),
        distance_unit=_distance_unit(inference),
        distances_say=_distances_say(inference),
        bars=_bars(inference),
        law=glossary_link("law"),
        scale_say=_scale_say(inference),
        physical_head=f"{TWINS[fit.chosen].split()[0]}, physical",
        parameters=_parameter_rows(inference),
        parameters_say=_parameters_say(inference),
        numbers=_number_rows(inference),
        euler=f"Euler number {fit.morphometry.euler} in the box",
        matches=_match_rows(inference),
        command=escape("curvafit generate --prior fit.json --shape 100 --seed 1 -o more.nii.gz"),
        python=_PYTHON,
        provenance=_provenance(inference),
    )


_PYTHON = escape(
    """import curvafit
from curvafit.priors import read_fit

fit = read_fit("fit.json")
flow = curvafit.generate(fit.coefficients, fit.mass, 100, seed=1)"""
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
    noise = inference.fit.distances.get("seed_noise")
    if noise is None:
        return "The same parameters could not be grown twice, so it is not known how far apart two seeds lie."
    return f"Two seeds of the same parameters lie {number(noise, 2)} apart: smaller differences mean nothing."


def _bars(inference: Inference) -> str:
    fit = inference.fit
    rows = (("nearest match", "match"), ("refined", "fit"), ("two seeds", "seed_noise"))
    longest = max([value for value in fit.distances.values() if value is not None], default=1.0) or 1.0
    parts = []
    for name, key in rows:
        value = fit.distances.get(key)
        style = "noise" if key == "seed_noise" else "best" if key == fit.chosen else ""
        bar = (
            f'<span class="bar {style}" style="width:{100 * value / longest:.1f}%"></span>' if value is not None else ""
        )
        bold = ' class="chosen"' if key == fit.chosen else ""
        text = number(value, 2) if value is not None else "could not be made" if key != "seed_noise" else "not known"
        parts.append(f"<span{bold}>{name}</span><span>{bar}</span><span{bold}>{text}</span>")
    return "\n".join(parts)


def _scale_say(inference: Inference) -> str:
    fixed = [name for name in ("a20", "a02") if abs(inference.fit.coefficients.as_dict()[name] - 1) < 1e-9]
    return f"here {_TERMS[fixed[0]][0]} = 1" if fixed else "all six may be multiplied by one factor"


def _parameter_rows(inference: Inference) -> str:
    fit = inference.fit
    match, refined = fit.matches[0].coefficients.as_dict(), fit.refined["coefficients"]
    physical = fit.coefficients_physical.as_dict()
    rows = [_coefficient_row(inference, name, match[name], refined[name], physical[name]) for name in NAMES]
    marks = {name: " chosen" if name == fit.chosen else "" for name in TWINS}
    rows.append(
        '<tr><th scope="row">m₀</th><td>mass</td>'
        f'<td class="n{marks["match"]}">{number(fit.matches[0].mass)}</td>'
        f'<td class="n{marks["fit"]}">{number(fit.refined["mass"])}</td><td></td>'
        f'<td class="n chosen">{number(fit.mass)}</td><td></td><td></td></tr>'
    )
    ε = f"{number(fit.epsilon_physical)}</td><td></td><td>{unit_name(fit.length_unit, 2)}"
    rows.append(
        '<tr><th scope="row">ε</th><td>interface</td>'
        f'<td class="n">0.02</td><td class="n">0.02</td><td></td><td class="n">{ε}</td></tr>'
    )
    return "\n".join(rows)


def _coefficient_row(inference: Inference, name: str, match: float, refined: float, physical: float) -> str:
    fit = inference.fit
    symbol, factor, power = _TERMS[name]
    deviation = fit.uncertainty.get(name)
    working_sd = _deviation(deviation, 1.0)
    physical_sd = _deviation(deviation, fit.length**-power) if fit.chosen == "fit" else ""
    best = {key: " chosen" if key == fit.chosen else "" for key in TWINS}
    unit = per_unit(fit.length_unit, power) if power else ""
    return (
        f'<tr><th scope="row">{symbol}</th><td>{factor}</td><td class="n{best["match"]}">{number(match)}</td>'
        f'<td class="n{best["fit"]}">{number(refined)}</td><td class="sd">{working_sd}</td>'
        f'<td class="n chosen">{number(physical)}</td><td class="sd">{physical_sd}</td><td>{unit}</td></tr>'
    )


def _deviation(value: float | None, factor: float) -> str:
    if value is None:
        return ""
    return f"± {number(value * factor, 2)}" if value > 0 else "fixed"


def _parameters_say(inference: Inference) -> str:
    fit = inference.fit
    voxel = length(fit.working_voxel, fit.length_unit, 3)
    method = escape(str(fit.refined.get("method", "refinement")))
    return (
        f"The nearest match and the refined parameters are in {glossary_link('working unit', 's')} (voxel 0.01, ε "
        f"0.02); a working voxel is {escape(voxel)}. Bold: the {TWINS[fit.chosen]}, the better supported, which "
        f"fit.json holds. ± is one standard deviation of the refinement ({method}), without what the model leaves out."
    )


def _number_rows(inference: Inference) -> str:
    numbers = inference.fit.morphometry
    unit = numbers.unit
    thickness = f"{length(numbers.thickness_mean, unit)} ± {length(numbers.thickness_std, unit)}"
    rows = (
        ("Volume fraction", "BV/TV", percent(numbers.volume_fraction)),
        ("Mean thickness", "Tb.Th", thickness),
        ("Mean spacing", "Tb.Sp", length(numbers.spacing_mean, unit)),
        ("Connectivity density", "Conn.D", density(numbers.connectivity_density, unit, 3)),
        ("Surface to volume", "BS/BV", density(numbers.surface_to_volume, unit, 1)),
    )
    return "\n".join(
        f'<tr><th scope="row">{name}</th><td class="small">{short}</td><td class="n">{escape(value)}</td></tr>'
        for name, short, value in rows
    )


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
