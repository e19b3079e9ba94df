"""The page of scans that are compared, its figures and tables, and a paragraph on the methods."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np

from curvafit.core.records import Format
from curvafit.core.units import format_number, format_percent, per_unit, plain_unit, power_name
from curvafit.drawing.groups import comparison_figure, numbers_figure
from curvafit.geometry.distances import DIRECTIONS, QUANTILES
from curvafit.report.page import check_result_folder, start_record, write_study
from curvafit.scan.measures import Measures
from curvafit.studies.comparison import BINS, LEVEL, SMOOTH, Comparison, Number, join_names
from curvafit.studies.scans import count_notes

#: `format` of a comparison's record.
FORMAT = Format("curvafit comparison", 1, title="the record of a comparison")
#: The tests of each quantity as the page's table heads them.
TESTS = ("p", "family-wise", "Holm", "BH")
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
    c, label, tests = comparison, "group" if comparison.groups else "number", list(_test_rows(comparison))
    tried = {"seed": c.options["seed"], "permutations": c.permutations}
    record = start_record(command, unit=c.unit, options=c.options, status=c.status, notes=c.notes, **tried)
    record |= {"exact": c.exact, "p": c.p, "least_p": c.least, "by": c.by, "groups": list(c.groups)}
    record["scans"] = [
        {"scan": each.source, "subject": case.subject, label: case.label, "kind": each.kind, "notes": list(each.notes)}
        for each, case in zip(c.measures, c.cases, strict=True)
    ]
    record |= {"energy" if c.groups else "distance_correlation": c.statistic, "apart": c.apart, "within": c.within}
    record |= {"tests": tests, "methods": describe_methods(c)}
    page = {
        "title": c.verdict, "scans": "; ".join(_count_scans(c)) + ".", "effect": c.effect,
        "head": [*c.groups, "difference" if c.groups else "slope", c.effect, "95 %", *TESTS, "known error"],
        "rows": [_format_row(number, c) for number in c.numbers], "level": f"{LEVEL:.2g}",
        "differs": bool(c.significant.any()),
    }  # fmt: skip
    drawn = {
        "difference": (comparison_figure(c), "Mean curvature diagrams and their difference"),
        "numbers": (numbers_figure(c), f"Each number by {c.by}"),
    }
    whose = [{"subject": case.subject, label: case.label} for case in c.cases]
    rows = (row for each, told in zip(c.measures, whose, strict=True) for row in each.rows(**told))
    tables = {"measures.csv": rows, "numbers.csv": tests}
    return write_study(target, FORMAT, FILES, record, page, tables, figures=drawn, told=("command", "date", *tried))


def describe_methods(comparison: Comparison) -> str:
    """Return a paragraph, for a paper, on what was done and what came of it."""
    c, unit = comparison, per_unit(comparison.unit, 1)
    tried = f"all {c.permutations}" if c.exact else f"{c.permutations} random (seed {c.options['seed']})"
    tried += f" permutations of {'groups' if c.groups else c.by}{' within subjects' * (c.blocks is not None)}"
    differ = [each for each in c.numbers if each.family <= LEVEL]
    found = ", ".join(f"{each.symbol} ({c.effect} = {format_number(each.effect, 2)})" for each in differ)
    found = f"{len(differ)} of them differ{f': {found}' if differ else ''}."
    named = "Named beforehand and tested alone was {0.symbol}: p = {1}."
    statistic = format_number(c.statistic, 3)
    over = f"the sliced Wasserstein distance of subjects' diagrams ({DIRECTIONS} directions, {QUANTILES} quantiles)"
    tests = {
        "g": (
            f"the energy distance (Székely & Rizzo 2004) of the groups, over {over}: E = {statistic} {unit}",
            "the difference of means" if c.blocks is None else "the mean difference of pairs",
            "Effect sizes are Hedges' g, with 95 % intervals of the noncentral t distribution (normal subjects).",
        ),
        "η": (
            f"the dispersion between groups (Rizzo & Székely 2010) over {over}: E = {statistic} {unit}",
            "the variance between groups",
            "Effect sizes are correlation ratios.",
        ),
        "r": (
            f"the distance correlation (Székely, Rizzo & Bakirov 2007) with the rank of {c.by}, over {over}: R = "
            f"{statistic}",
            f"the correlation with the rank of {c.by}",
            "Effect sizes are correlations, with 95 % intervals by Fisher's z (normal subjects).",
        ),
    }
    diagrams, numbers, effects = tests[c.effect]
    return " ".join(
        [
            f"Scans of {join_names(_count_scans(c))} were measured with curvafit {version('curvafit')}; "
            f"{say_kinds(c.measures)}.",
            *describe_measures(c.measures),
            "Scans of a subject were averaged; subjects are what all tests count.",
            f"Diagrams were compared by {diagrams}, p = {format_number(c.p, 2)}, the share of {tried} with at least as "
            "much.",
            f"Each of {len(c.numbers)} numbers was tested by {numbers} over the same permutations, and corrected for "
            "all of them by the greatest correlation with the label in each permutation (Westfall & Young 1993), "
            "besides the corrections of Holm and of Benjamini and Hochberg.",
            f"At a family-wise level of {LEVEL:.2g}, {found}",
            *([named.format(c.primary, format_number(c.primary.p, 2))] if c.primary else []),
            effects,
            f"The difference of the mean diagrams, over {BINS} × {BINS} bins and smoothed by a Gaussian of {SMOOTH:g} "
            f"bins, was tested in the {int(np.isfinite(c.bins_p).sum())} with area, corrected likewise; "
            f"{int(c.significant.sum())} differ.",
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
    """Return each part's name with the numbers of its scans and subjects."""
    side = dict(zip(comparison.subjects, comparison.sides.tolist(), strict=True))
    scans = Counter(side[case.label, case.subject] for case in comparison.cases)
    return [
        f"{name} ({scans[k]} scans of {count} subjects)"
        for k, (name, count) in enumerate(zip(comparison.parts, comparison.counts, strict=True))
    ]


def _format_row(number: Number, comparison: Comparison) -> dict[str, Any]:
    means = [
        f"{format_number(mean)} ± {format_number(sd, 2)}"
        for mean, sd in zip(number.means, number.deviations, strict=True)
    ]
    interval = "–" if math.isnan(number.low) else f"{format_number(number.low, 2)} to {format_number(number.high, 2)}"
    ps = (format_number(each, 2) for each in (number.p, number.family, number.holm, number.discovery))
    known = "–" if math.isnan(number.known) else "all" if number.known >= 1 else format_percent(number.known)
    named = name_quantity(number.name, number.symbol, number.power, comparison.unit)
    cells = (*means, format_number(number.difference), format_number(number.effect, 2), interval, *ps, known)
    return {**named, "cells": cells, "chosen": number.family <= LEVEL}


def name_quantity(name: str, symbol: str, power: int, unit: str) -> dict[str, str]:
    """Return the name of a quantity, and its symbol and unit, as a table has them."""
    parts = ("" if symbol in name else symbol, power_name(unit, power))
    return {"name": name[0].upper() + name[1:], "symbol": ", ".join(part for part in parts if part)}


# ---- tables and record -----------------------------------------------------------------------------------------------


def _test_rows(comparison: Comparison) -> Iterator[dict[str, Any]]:
    """Yield a row for each test: the diagrams', then each number's; None where there is no value."""
    c, letters = comparison, [*ascii_lowercase, *range(27, 1 + len(comparison.groups))][: len(comparison.groups)]
    columns = ["quantity", "symbol", "unit", *(f"mean_{each}" for each in letters), *(f"sd_{each}" for each in letters)]
    effect = {"g": "g", "η": "eta", "r": "r"}[c.effect]
    columns += ["slope" if c.effect == "r" else "difference", effect, f"{effect}_low", f"{effect}_high"]
    columns += ["p", "p_family", "p_holm", "p_bh", "known_error"]
    whole = {"quantity": "curvature diagram", "symbol": "E", "unit": plain_unit(c.unit, -1)}
    statistic = {"difference": c.statistic} if c.groups else {"symbol": "R", "unit": "", "r": c.statistic}
    yield dict.fromkeys(columns) | whole | statistic | {"p": c.p}
    for each in c.numbers:
        cells = (each.name, each.symbol, plain_unit(c.unit, each.power), *each.means, *each.deviations)
        cells += (each.difference, each.effect, each.low, each.high)
        cells += (each.p, each.family, each.holm, each.discovery, each.known)
        known = (None if isinstance(cell, float) and not math.isfinite(cell) else cell for cell in cells)
        yield dict(zip(columns, known, strict=True))
