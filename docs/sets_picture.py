"""Draw docs/sets.png from the ledger: Dice against labelled slices, after each set that teaches.

python docs/sets_picture.py
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from curvafit.drawing.plot import QUIET, make_figure, write_picture

ROOT = Path(__file__).resolve().parents[1]
SLICES = (0, 1, 3, 10)
SETS = {
    "scratch": ("no set", "#6B7280"),
    "law": ("the law's shapes", "#D55E00"),
    "wrong": ("layers", "#CC79A7"),
    "cut": ("level cuts", "#0072B2"),
    "tubes": ("straight tubes", "#009E73"),
    "real": ("real masks", "#111827"),
}
TITLES = {"bone": "bone", "pores": "pores of sandstone"}


def main() -> None:
    lines = map(json.loads, (ROOT / "benchmarks/results/sets.jsonl").read_text(encoding="utf-8").splitlines())
    figures = {line["figure"]: line for line in lines if "figure" in line}
    scans = [scan for scan in TITLES if f"sets_{scan}.law.dice_0" in figures]
    figure = make_figure(5.2 * len(scans), 4.0, layout="constrained")
    for axes, scan in zip(np.atleast_1d(figure.subplots(1, len(scans))), scans, strict=True):
        for name, (label, colour) in SETS.items():
            found = {n: figures[f"sets_{scan}.{name}.dice_{n}"]["value"] for n in SLICES if (name, n) != ("scratch", 0)}
            style = {"color": colour, "markersize": 5, "linewidth": 1.4, "label": label}
            axes.plot(np.log1p(list(found)), list(found.values()), "--s" if name == "scratch" else "-o", **style)
        axes.set_xticks(np.log1p(SLICES), [str(n) for n in SLICES])
        axes.set(xlabel="labelled slices", title=TITLES[scan])
        axes.spines[:].set_color(QUIET)
        axes.grid(axis="y", color="#E5E7EB", linewidth=0.6)
    figure.axes[0].set_ylabel("Dice of the other slices")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    write_picture(figure, ROOT / "docs/sets.png")


if __name__ == "__main__":
    main()
