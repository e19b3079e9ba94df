"""The page of two groups that are compared, its figures and tables, and a paragraph on the methods."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.records import Format
from curvafit.core.units import format_number, format_percent, per_unit, plain_unit, power_name
from curvafit.drawing.groups import comparison_figure, numbers_figure
from curvafit.geometry.distances import DIRECTIONS, QUANTILES
from curvafit.report.page import (
    Picture,
    check_result_folder,
    picture_of,
    record_study,
    render_template,
    write_study,
)
from curvafit.scan.measure import Measures
from curvafit.studies.compare import BINS, LEVEL, SMOOTH, Comparison, Number
from curvafit.studies.scans import count_notes
from curvafit.studies.tables import format_csv
from curvafit.studies.trajectory import Trajectory

#: `format` of a comparison's record.
FORMAT = Format("curvafit comparison", 1, title="the record of a comparison")
#: What a comparison writes into its folder.
FILES = ("compare.json", "compare.html", "measures.csv", "numbers.csv")
FILES += ("difference.svg", "difference.png", "numbers.svg", "numbers.png")
#: Returns the folder if `write_comparison` can write there, else raises ValueError; call it before the work.
check_comparison = partial(check_result_folder, FORMAT, FILES)


def write_comparison(
    comparison: Comparison, directory: str | Path, *, command: str = "", overwrite: bool = False
) -> Path:
    """Write the page, figures, tables and record of a comparison into a folder, and return the page's path.

    The files (`FILES`) are moved into the folder once all are whole. Those of the same command are replaced;
    others are a ValueError without `overwrite`. `command` is what the record calls the command line.
    """
    target = check_comparison(directory, overwrite=overwrite, command=command)
    difference, numbers = comparison_figure(comparison), numbers_figure(comparison)
    drawn = {
        "difference": (difference, picture_of(difference, "Mean curvature diagrams and their difference")),
        "numbers": (numbers, picture_of(numbers, "Each number by group")),
    }
    record = _record(comparison, command)
    texts = {
        "measures.csv": format_csv(list(_measure_rows(comparison))),
        "numbers.csv": format_csv(list(_test_rows(comparison))),
        "compare.html": _page(comparison, record, {name: picture for name, (_, picture) in drawn.items()}),
    }
    return write_study(target, FORMAT, FILES, record, texts, drawn)


def _page(comparison: Comparison, record: dict[str, Any], pictures: dict[str, Picture]) -> str:
    """Return the page of a comparison, with its record and its pictures, as text."""
    a, b = comparison.groups
    bins = int(comparison.significant.sum())
    region = f"The outline holds the bins that differ at a family-wise level of {LEVEL:.2g}."
    return render_template(
        "compare.html",
        version=version("curvafit"),
        title=comparison.verdict,
        a=a,
        b=b,
        scans="; ".join(_count_scans(comparison)) + ".",
        status=comparison.status,
        region=region if bins else f"No bin differs at a family-wise level of {LEVEL:.2g}.",
        rows=[_format_row(number, comparison.unit) for number in comparison.numbers],
        level=f"{LEVEL:.2g}",
        **pictures,
        methods=record["methods"],
        notes=comparison.notes,
        provenance=[(name, record[name]) for name in ("command", "date", "seed", "permutations") if record[name] != ""],
    )


def describe_methods(comparison: Comparison) -> str:
    """Return a paragraph, for a paper, on what was done and what came of it."""
    c, unit = comparison, per_unit(comparison.unit, 1)
    tried = f"{c.permutations} permutations"
    tried = f"all {tried}" if c.exact else f"{tried} (random, seed {c.options['seed']})"
    differ = [each for each in c.numbers if each.family <= LEVEL]
    found = ", ".join(f"{each.symbol} (g = {format_number(each.effect, 2)})" for each in differ)
    found = f"{len(differ)} of them differ{f': {found}' if differ else ''}."
    tested = int(np.isfinite(c.bins_p).sum())
    named = (
        [f"Named beforehand and tested alone was {c.primary.symbol}: p = {format_number(c.primary.p, 2)}."]
        if c.primary
        else []
    )
    return " ".join(
        [
            f"Scans of two groups, {' and '.join(_count_scans(c))}, were measured with curvafit {version('curvafit')}; "
            f"{say_kinds(c.measures)}.",
            *describe_measures(c.measures),
            "Scans of a subject were averaged; subjects are what all tests count.",
            "Diagrams were compared by the energy distance (Székely & Rizzo 2004) of the groups, over the sliced "
            f"Wasserstein distance of subjects' diagrams ({DIRECTIONS} directions, {QUANTILES} quantiles): "
            f"E = {format_number(c.energy, 3)} {unit}, p = {format_number(c.p, 2)}, the share of {tried} of subjects "
            "with at least that distance.",
            f"Each of {len(c.numbers)} numbers was tested by the difference of means over the same permutations, and "
            "corrected for all of them by the greatest correlation with the group in each permutation (Westfall & "
            "Young 1993), besides the corrections of Holm and of Benjamini and Hochberg.",
            f"At a family-wise level of {LEVEL:.2g}, {found}",
            *named,
            "Effect sizes are Hedges' g, with 95 % intervals of the noncentral t distribution (normal subjects).",
            f"The difference of the mean diagrams, over {BINS} × {BINS} bins and smoothed by a Gaussian of {SMOOTH:g} "
            f"bins, was tested in the {tested} with area, corrected likewise; {int(c.significant.sum())} differ.",
        ]
    )


def say_kinds(measures: Sequence[Measures]) -> str:
    """Return what scans were taken for."""
    return " and ".join(f"{n} were taken for {kind}s" for kind, n in Counter(each.kind for each in measures).items())


def describe_measures(measures: Sequence[Measures]) -> list[str]:
    """Return sentences, for a paper, on what was done to scans, how their numbers are made, and what to cite."""
    return [
        *count_notes(measures),
        "Thickness (Tb.Th) and spacing (Tb.Sp) are mean diameters of the largest balls that fit (Hildebrand & "
        "Rüegsegger 1997); the number per length (Tb.N) is (BV/TV) / Tb.Th; connectivity is that of the Euler number "
        "(Odgaard & Gundersen 1993); the surface (BS) is that of marching cubes of the mask after a Gaussian of "
        "0.7 voxels; anisotropy (DA) is 1 less the ratio of the smallest eigenvalue to the largest of the "
        "mean of n⊗n over the surface's normals n.",
        "Curvatures are those of the level set of a smooth profile of the mask; the curvature diagram of a scan is the "
        "share of its surface's area over the principal curvatures κ₁ ≥ κ₂, and its families part "
        "that area by the direction of (κ₁, κ₂), but for layers, where both are small.",
        f"The program: the curvafit authors, curvafit, version {version('curvafit')} (software); with Song (2022), "
        "Generation of Tubular and Membranous Shape Textures with Curvature Functionals, Journal of Mathematical "
        "Imaging and Vision 64, 17, doi:10.1007/s10851-021-01049-9.",
    ]


def _count_scans(comparison: Comparison) -> list[str]:
    """Return each group's name with the numbers of its scans and subjects."""
    groups = Counter(case.group for case in comparison.cases)
    return [
        f"{name} ({groups[name]} scans of {count} subjects)"
        for name, count in zip(comparison.groups, comparison.counts, strict=True)
    ]


def _format_row(number: Number, unit: str) -> dict[str, Any]:
    """Return a row of the page's table."""
    means = (
        f"{format_number(mean)} ± {format_number(sd, 2)}"
        for mean, sd in zip(number.means, number.deviations, strict=True)
    )
    ps = (format_number(each, 2) for each in (number.p, number.family, number.holm, number.discovery))
    interval = f"{format_number(number.low, 2)} to {format_number(number.high, 2)}"
    known = "–" if math.isnan(number.known) else "all" if number.known >= 1 else format_percent(number.known)
    cells = (*means, format_number(number.difference), format_number(number.effect, 2), interval, *ps, known)
    named = name_quantity(number.name, number.symbol, number.power, unit)
    return {**named, "cells": cells, "chosen": number.family <= LEVEL}


def name_quantity(name: str, symbol: str, power: int, unit: str) -> dict[str, str]:
    """Return the name of a quantity, and its symbol and unit, as a table has them."""
    parts = ("" if symbol in name else symbol, power_name(unit, power))
    return {"name": name[0].upper() + name[1:], "symbol": ", ".join(part for part in parts if part)}


# ---- tables and record -----------------------------------------------------------------------------------------------


def _measure_rows(comparison: Comparison) -> Iterator[dict[str, Any]]:
    """Yield the rows of `curvafit measure`'s table, with subject and group."""
    for measures, case in zip(comparison.measures, comparison.cases, strict=True):
        yield from measures.rows(subject=case.subject, group=case.group)


def _test_rows(comparison: Comparison) -> Iterator[dict[str, Any]]:
    """Yield a row for each test: the diagrams', then each number's; None where there is no value."""
    columns = ("quantity", "symbol", "unit", "mean_a", "mean_b", "sd_a", "sd_b", "difference", "g", "g_low", "g_high")
    columns += ("p", "p_family", "p_holm", "p_bh", "known_error")
    empty = dict.fromkeys(columns)
    whole = {"quantity": "curvature diagram", "symbol": "E", "unit": plain_unit(comparison.unit, -1)}
    yield empty | whole | {"difference": comparison.energy, "p": comparison.p}
    for each in comparison.numbers:
        cells = (each.name, each.symbol, plain_unit(comparison.unit, each.power), *each.means, *each.deviations)
        cells += (each.difference, each.effect, each.low, each.high)
        cells += (each.p, each.family, each.holm, each.discovery, each.known)
        yield {name: known(cell) for name, cell in zip(columns, cells, strict=True)}


def _record(comparison: Comparison, command: str) -> dict[str, Any]:
    """Return the content of `compare.json`."""
    return {
        **record_study(comparison, command, FILES),
        **record_test(comparison),
        "groups": list(comparison.groups),
        "scans": [
            {"scan": each.source, "subject": case.subject, "group": case.group, "kind": each.kind, "notes": each.notes}
            for each, case in zip(comparison.measures, comparison.cases, strict=True)
        ],
        "energy": comparison.energy,
        "apart": comparison.apart,
        "within": comparison.within,
        "tests": list(_test_rows(comparison)),
        "methods": describe_methods(comparison),
    }


def record_test(study: Comparison | Trajectory) -> dict[str, Any]:
    """Return what the records of studies with a test by permutation hold of it."""
    more = {"permutations": study.permutations, "exact": study.exact, "p": known(study.p)}
    return {"seed": study.options["seed"], **more}


def known(cell: Any) -> Any:
    """Return a cell, None where it is a number that is not finite."""
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell
