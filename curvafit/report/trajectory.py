"""The page of a series of scans, its figures and its table, and a paragraph on the methods."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from curvafit.atlas_map.picture import FAMILY_COLOURS, map_on
from curvafit.core.records import Format
from curvafit.core.units import format_number, per_unit, plain_unit
from curvafit.drawing.groups import FIRST, SIGNED, keep_sign, number_panels, plain
from curvafit.drawing.plot import INK, QUIET, make_figure
from curvafit.geometry.diagram import FAMILIES
from curvafit.geometry.distances import DIRECTIONS, QUANTILES
from curvafit.inference.atlas import load_atlas
from curvafit.priors.grid import WORKING_SPACING
from curvafit.report.comparison import describe_measures, known, name_quantity, record_test, say_kinds
from curvafit.report.page import check_result_folder, picture_of, record_study, render_template, write_study
from curvafit.scan.prepare import WORKING_THICKNESS
from curvafit.studies.compare import LEVEL
from curvafit.studies.tables import format_csv
from curvafit.studies.trajectory import Change, Trajectory, say_change

#: `format` of a series' record.
FORMAT = Format("curvafit trajectory", 1, title="the record of a series of scans")
#: What a series writes into its folder.
FILES = ("trajectory.json", "trajectory.html", "trajectory.csv", "path.svg", "path.png", "numbers.svg", "numbers.png")
#: Returns the folder if `write_trajectory` can write there, else raises ValueError; call it before the work.
check_trajectory = partial(check_result_folder, FORMAT, FILES)
#: Colours of scans from the first to the last.
LATER = LinearSegmentedColormap.from_list("later", ["#C4C9D1", INK])
#: Shapes of the map that a path is shown among at the least; least step between names of families, of the panel.
AROUND, APART = 25, 0.055
#: Least reach of a number's axis below and above its mean, as a share of it.
LEAST_REACH = 0.1


def write_trajectory(
    trajectory: Trajectory, directory: str | Path, *, command: str = "", overwrite: bool = False
) -> Path:
    """Write the page, figures, table and record of a series into a folder, and return the page's path.

    The files (`FILES`) are moved into the folder once all are whole. Those of the same command are replaced; others
    are a ValueError without `overwrite`. `command` is what the record calls the command line.
    """
    target = check_trajectory(directory, overwrite=overwrite, command=command)
    path, numbers = trajectory_figure(trajectory), numbers_figure(trajectory)
    drawn = {
        "path": (path, picture_of(path, "The curvature diagram over time")),
        "numbers": (numbers, picture_of(numbers, "Each number over time")),
    }
    record = _record(trajectory, command)
    page = render_template(
        "trajectory.html",
        version=version("curvafit"),
        title=f"{len(trajectory.times)} scans, {' to '.join(trajectory.ends)}",
        status=trajectory.status,
        **{name: picture for name, (_, picture) in drawn.items()},
        ends=trajectory.ends,
        rows=[_format_row(trajectory, change) for change in trajectory.changes],
        level=f"{LEVEL:.2g}",
        methods=record["methods"],
        notes=trajectory.notes,
        provenance=[(name, record[name]) for name in ("command", "date", "seed", "permutations") if record[name] != ""],
    )
    rows = [
        row
        for measures, time in zip(trajectory.measures, trajectory.times, strict=True)
        for row in measures.rows(time=time, unit_of_time=trajectory.unit_of_time)
    ]
    texts = {"trajectory.html": page, "trajectory.csv": format_csv(rows)}
    return write_study(target, FORMAT, FILES, record, texts, drawn)


# ---- figures ---------------------------------------------------------------------------------------------------------


def trajectory_figure(trajectory: Trajectory) -> Figure:
    """Return a figure of the diagram's distance from the first, the families' shares, and the path on the atlas's map.

    The map's unit is that in which the first scan's structure is as thick as scans are resampled to.
    """
    figure = make_figure(13.2, 4.4)
    away, shares, place = (
        figure.add_axes((left, 0.13, width, 0.78)) for left, width in ((0.045, 0.2), (0.285, 0.2), (0.59, 0.4))
    )
    away.plot(trajectory.times, trajectory.distances, "o-", color=FIRST, markersize=5, clip_on=False)
    away.set(ylim=(0, None), title=f"distance from the first ({per_unit(trajectory.unit, 1)})")
    _shares_on(shares, trajectory)
    for axes in (away, shares):
        axes.set_xlabel(_name_time(trajectory))
        axes.set_xlim(trajectory.times[0], trajectory.times[-1])
        axes.title.set_fontsize(11)
        axes.tick_params(length=3, labelsize=9)
        axes.spines[:].set_color(QUIET)
    length = trajectory.measures[0]["thickness"].value / (WORKING_THICKNESS * WORKING_SPACING)
    seen_as = "field" if all(each.kind == "field" for each in trajectory.measures) else "mask"
    own = map_on(place, load_atlas(), seen_as, trajectory.embeddings * length)
    _zoom_on(place, own)
    for k, shade in enumerate(LATER(np.linspace(0, 1, len(own)))):
        place.plot(
            *own[max(k - 1, 0) : k + 1].T,
            color=shade,
            linewidth=2.2,
            zorder=5,
            path_effects=[withStroke(linewidth=4, foreground="white")],
        )
        place.scatter(*own[k], s=60, color=shade, edgecolors="white", linewidths=1.0, zorder=6)
    words = {"textcoords": "offset points", "fontsize": 10, "fontweight": "bold", "zorder": 7}
    words["path_effects"] = [withStroke(linewidth=3, foreground="white")]
    ahead = place.transData.transform(own[[0, -1]])
    ahead = (ahead[1] - ahead[0]) / max(float(np.linalg.norm(ahead[1] - ahead[0])), 1e-9)
    for name, at, side in zip(trajectory.ends, (own[0], own[-1]), (-ahead, ahead), strict=True):
        place.annotate(plain(name), at, 22 * side, ha="center", va="center", **words)
    return figure


def _name_time(trajectory: Trajectory) -> str:
    """Return what an axis of time says."""
    return plain(f"time ({trajectory.unit_of_time})" if trajectory.unit_of_time else "time")


def _zoom_on(axes: Axes, path: np.ndarray) -> None:
    """Narrow a map to a path (n, 2) and at least the `AROUND` shapes that are nearest to its middle."""
    limits = np.array([axes.get_xlim(), axes.get_ylim()])
    spans, middle = np.ptp(limits, axis=1), (path.min(0) + path.max(0)) / 2
    shapes = np.concatenate([np.asarray(each.get_offsets()) for each in axes.collections])
    away = np.sort(np.abs((shapes - middle) / spans).max(1))
    reach = max(0.8 * float((np.ptp(path, axis=0) / spans).max()), float(away[min(AROUND, len(away)) - 1]))
    if reach < 0.5:
        (left, right), (bottom, top) = middle[:, None] + reach * spans[:, None] * [-1, 1]
        axes.set(xlim=(left, right), ylim=(bottom, top))


def _shares_on(axes: Axes, trajectory: Trajectory) -> None:
    """Draw the share of each family over time, one above the other, with their names at the last scan."""
    shares = np.stack([trajectory.table(f"share of {name}")[0] for name in FAMILIES])
    axes.stackplot(trajectory.times, shares, colors=[FAMILY_COLOURS[name] for name in FAMILIES], alpha=0.8, linewidth=0)
    heights = (shares.cumsum(0) - shares / 2)[:, -1]
    for k in range(1, len(heights)):
        heights[k] = max(heights[k], heights[k - 1] + APART)
    heights -= np.maximum(heights - 1 + APART * np.arange(len(heights))[::-1], 0)
    for name, height, share in zip(FAMILIES, heights, shares[:, -1], strict=True):
        label = axes.annotate(
            f"{name} {share:.0%}", (1, height), (5, 0), "axes fraction", "offset points", fontsize=8.5
        )
        label.set(va="center", color=FAMILY_COLOURS[name])
    axes.set(ylim=(0, 1), title="shares of the surface")


def numbers_figure(trajectory: Trajectory) -> Figure:
    """Return a figure of each quantity over time, with the band of its 95 % intervals.

    The names of quantities that move with time, among all, are bold.
    """
    figure, panels = number_panels(
        trajectory.changes,
        trajectory.unit,
        LEVEL,
        lambda change: (
            say_change(change)
            if math.isnan(change.p)
            else f"r = {format_number(change.correlation, 2)}, p = {format_number(change.p, 2)}"
        ),
    )
    for axes, change in zip(panels, trajectory.changes, strict=True):
        values, halves = trajectory.table(change.symbol)
        lows = values - halves if change.symbol in SIGNED else np.maximum(values - halves, 0)
        axes.fill_between(trajectory.times, lows, values + halves, color=FIRST, alpha=0.2, linewidth=0)
        axes.plot(trajectory.times, values, "o-", color=FIRST, markersize=4, markeredgewidth=0, linewidth=1.2)
        if np.isfinite(mean := values.mean()):
            (low, high), reach = axes.get_ylim(), LEAST_REACH * abs(mean)
            axes.set_ylim(min(low, mean - reach), max(high, mean + reach))
        keep_sign(axes, change.symbol)
        axes.set_xlabel(_name_time(trajectory), fontsize=8)
    return figure


# ---- words, table and record -----------------------------------------------------------------------------------------


def describe_series(trajectory: Trajectory) -> str:
    """Return a paragraph, for a paper, on what was done and what came of it."""
    t, unit = trajectory, per_unit(trajectory.unit, 1)
    changed = ", ".join(f"{each.symbol} ({say_change(each, t.unit)})" for each in t.changes if each.significant)
    lines = [
        f"{len(t.times)} scans of one object, from {' to '.join(t.ends)}, were measured with curvafit "
        f"{version('curvafit')}; {say_kinds(t.measures)}.",
        *describe_measures(t.measures),
        "Intervals of each scan's numbers are 95 %, by a jackknife over blocks; that of the change from the first scan "
        "to the last is the root of the sum of the squares of both.",
        f"Of {len(t.changes)} numbers, these intervals are without 0 of {changed or 'none'}.",
        f"The sliced Wasserstein distance ({DIRECTIONS} directions, {QUANTILES} quantiles) of the last diagram from "
        f"the first is {format_number(t.distances[-1], 3)} {unit}.",
    ]
    if not math.isnan(t.p):
        tried = (
            f"all {t.permutations} orders" if t.exact else f"{t.permutations} orders (random, seed {t.options['seed']})"
        )
        moving = [f"{each.symbol} (r = {format_number(each.correlation, 2)})" for each in t.changes if each.moves]
        found = f"These numbers move with time: {', '.join(moving)}" if moving else "No number moves with time"
        lines += [
            f"Each number's correlation with the scan's place in the series was tested over {tried} of the scans, and "
            "corrected for all numbers by the greatest correlation in each order (Westfall & Young 1993).",
            t.limit or f"{found} (family-wise level {LEVEL:.2g}).",
            "Whether the distance of two diagrams goes with theirs in the series was tested over the same orders "
            f"(Mantel 1967): p = {format_number(t.p, 2)}.",
        ]
    return " ".join(lines)


def _format_row(trajectory: Trajectory, change: Change) -> dict[str, Any]:
    """Return a row of the page's table."""
    values, halves = trajectory.table(change.symbol)
    texts = [f"{format_number(values[k])} ± {format_number(halves[k], 2)}" for k in (0, -1)]
    tests = (format_number(each, 2) for each in (change.correlation, change.p, change.family))
    return {
        **name_quantity(change.name, change.symbol, change.power, trajectory.unit),
        "cells": (*texts, say_change(change), *tests),
        "chosen": (2,) * change.significant + (5,) * change.moves,
    }


def _record(trajectory: Trajectory, command: str) -> dict[str, Any]:
    """Return the content of `trajectory.json`."""
    changes = [
        {name: known(value) for name, value in asdict(each).items()} | {"unit": plain_unit(trajectory.unit, each.power)}
        for each in trajectory.changes
    ]
    return {
        **record_study(trajectory, command, FILES),
        **record_test(trajectory),
        "unit_of_time": trajectory.unit_of_time,
        "scans": [
            {
                "scan": each.source,
                "time": time,
                "kind": each.kind,
                "distance": float(distance),
                "notes": each.notes,
            }
            for each, time, distance in zip(trajectory.measures, trajectory.times, trajectory.distances, strict=True)
        ],
        "changes": changes,
        "methods": describe_series(trajectory),
    }
