"""Segmentation without a network on real bone: a volume from sparse slices, and a mask from noisy grey levels.

    python -m benchmarks.bone [--blocks 8] [--only sparse|noise] [-o bone]

CURVAFIT_DATA names the folder with `scans/lhdl_trabecular_200.tif` and its `_otsu_mask.tif` (the truth). Blocks of 96³
are the volume's corners; the coefficients for those of one half are inferred from the mask of the other half, once.
Sparse: every 4th, 8th, 12th slice is kept, and what lies between the first and the last is compared with the truth.
Noise: Gaussian, of deviations that bring Otsu's Dice to about 0.9, 0.7, 0.55; TV's weight and the random walker's β
are the best in hindsight.
Distances are means over both surfaces' voxels, in voxels; the Betti error sums |Δb0|, |Δb1| and |Δb2|. Means over the
blocks, ± the standard error. Finished cases stay in the folder: a second run goes on, and draws.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import warnings
from collections.abc import Callable, Iterable
from itertools import product
from pathlib import Path

import numpy as np
import tifffile
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy import ndimage
from skimage.filters import threshold_otsu
from skimage.restoration import denoise_tv_chambolle
from skimage.segmentation import random_walker

from curvafit.core.files import write_atomically, write_content
from curvafit.geometry.topology import betti_numbers
from curvafit.inference.infer import infer
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.completion import reconstruct
from curvafit.segmentation.segment import segment
from curvafit.segmentation.slices import Slices
from curvafit.volumes.scan import Field

EDGE, SPACING = 96, 0.0195
KEPT = (4, 8, 12)
NOISE = (20, 40, 60)
#: TV's weights, as shares of the grey levels' contrast; the random walker's β.
WEIGHTS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0, 1.5)
BETAS = (1, 130)
FIGURES = ("dice", "distance", "betti")
Corner = tuple[int, int, int]


def scores(mask: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Dice, mean distance between the surfaces, sum of the Betti numbers' errors."""
    shells = [each & ~ndimage.binary_erosion(each, border_value=1) for each in (mask, truth)]
    apart = [ndimage.distance_transform_edt(~a)[b] for a, b in (shells, shells[::-1])]
    found, right = betti_numbers(mask), betti_numbers(truth)
    return {
        "dice": 2 * float((mask & truth).sum()) / float(mask.sum() + truth.sum()),
        "distance": float(np.concatenate(apart).mean()),
        "betti": float(sum(abs(a - b) for a, b in zip(found, right, strict=True))),
        **{f"b{k}": float(n) for k, n in enumerate(found)},
    }


def sparse(truth: np.ndarray, every: int, priors: dict[str, Coefficients | Path]) -> dict[str, np.ndarray]:
    """Each way's mask from every so many slices, up to the last of them."""
    places = list(range(0, EDGE, every))
    length = places[-1] + 1
    slices = Slices(truth[places], tuple(places), length, (1.0, 1.0, 1.0))
    masks = {
        "truth": truth[:length],
        "nearest slice": slices.level("nearest") > 0,
        "linear": slices.level("linear") > 0,
        "cubic spline": slices.level("spline") > 0,
    }
    scan = Field(truth.astype(np.uint8), (SPACING,) * 3, "mm")
    for name, prior in priors.items():
        masks[name] = reconstruct(scan, prior, every=every).mask.values[:length]
    return masks


def noisy(truth: np.ndarray, grey: np.ndarray, noise: int, priors: dict[str, Coefficients | Path]) -> dict:
    """Each way's mask of the grey levels with noise of that deviation."""
    values = grey + noise * np.random.default_rng(noise).standard_normal(grey.shape).astype(np.float32)
    masks = {"truth": truth, "grey": values, "Otsu": values > threshold_otsu(values)}
    contrast = float(grey[truth].mean() - grey[~truth].mean())
    smooth = [denoise_tv_chambolle(values / contrast, weight=weight) for weight in WEIGHTS]
    masks["TV + Otsu"] = _best((u > threshold_otsu(u) for u in smooth), truth)
    masks["random walker"] = _best((walked(values, beta) for beta in BETAS), truth)
    scan = Field(values, (SPACING,) * 3, "mm")
    for name, prior in priors.items():
        masks[name] = segment(scan, prior).mask.values
    return masks


def walked(values: np.ndarray, beta: float) -> np.ndarray:
    """skimage's random walker, from seeds where the smoothed levels are within a quarter of the classes' means."""
    smooth = ndimage.gaussian_filter(values, 1.0)
    bright = smooth > threshold_otsu(smooth)
    low, high = float(smooth[~bright].mean()), float(smooth[bright].mean())
    edge = (high - low) / 4
    seeds = np.where(smooth > high - edge, 1, np.where(smooth < low + edge, 2, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of probabilities a little beyond [0, 1]
        return random_walker(values, seeds, beta=beta, mode="cg_j", tol=1e-3) == 1


def _best(masks: Iterable[np.ndarray], truth: np.ndarray) -> np.ndarray:
    """The one with the largest Dice."""
    return max(masks, key=lambda mask: float((mask & truth).sum()) / float(mask.sum() + truth.sum()))


def inferred(half: str, truth: np.ndarray, folder: Path) -> Path:
    """The fit.json of the mask's lower or upper half."""
    path = folder / f"fit-{half}.json"
    if not path.exists():
        part = truth[:EDGE] if half == "lower" else truth[-EDGE:]
        fit = infer(Field(part.astype(np.uint8), (SPACING,) * 3, "mm"), kind="mask").fit
        write_content(path, fit.to_json())
    return path


def case(path: Path, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, dict[str, float]]:
    """The scores of every way, made or read; a middle section of each is kept for the figure."""
    if not path.exists():
        begun, masks = time.perf_counter(), make()
        truth = masks["truth"]
        found = {name: scores(mask, truth) for name, mask in masks.items() if mask.dtype == bool}
        sections = {name: mask[:, mask.shape[1] // 2] for name, mask in masks.items()}
        write_atomically(path.with_suffix(".npz"), lambda temporary: np.savez_compressed(temporary, **sections))
        found["truth"]["seconds"] = time.perf_counter() - begun
        write_content(path, json.dumps(found))
    return json.loads(path.read_text())


def table(title: str, cases: dict[int, list[dict]]) -> None:
    """A line a way, three figures a level."""
    print(f"\n{title}")
    levels = sorted(cases)
    print(f"{'':16}" + "".join(f"{f'{level}, {len(cases[level])} blocks':^45}" for level in levels))
    print(f"{'':16}" + "".join(f"{figure:^15}" for figure in FIGURES) * len(levels))
    names = [name for name in cases[levels[0]][0] if name != "truth"]
    for name in names:
        cells = [_mean([found[name][figure] for found in cases[level]]) for level in levels for figure in FIGURES]
        row = "".join(
            f"{m:8.{digits}f} ±{e:5.{digits}f}" for (m, e), digits in zip(cells, (3, 2, 1) * len(levels), strict=True)
        )
        print(f"{name:16}{row}", flush=True)


def _mean(values: list[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


def draw(cases: dict[int, list[dict]], sections: Path, path: Path, label: str) -> None:
    """A section of every way, and Dice and Betti error over the levels."""
    with np.load(sections) as kept:
        pictures = {name: kept[name] for name in kept.files}
    names = [name for name in pictures if name not in ("truth", "grey")]
    figure = Figure(figsize=(2.3 * (len(names) + 1), 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, len(names) + 1, height_ratios=(1, 1.25))
    for k, name in enumerate(("truth", *names)):
        axes = figure.add_subplot(grid[0, k])
        axes.imshow(pictures.get("grey", pictures[name]), cmap="gray", interpolation="nearest", origin="lower")
        axes.contour(pictures["truth"], [0.5], colors="tab:cyan", linewidths=0.7)
        if name != "truth":
            axes.contour(pictures[name], [0.5], colors="tab:orange", linewidths=0.9)
        axes.set(title=name, xticks=[], yticks=[])
    for side, key in enumerate(("dice", "betti")):
        half = (len(names) + 1) // 2
        axes = figure.add_subplot(grid[1, :half] if side == 0 else grid[1, half:])
        for name in names:
            rows = [_mean([found[name][key] for found in cases[level]]) for level in sorted(cases)]
            axes.errorbar(sorted(cases), *zip(*rows, strict=True), label=name, marker="o", capsize=3)
        axes.set(xlabel=label, ylabel="Dice" if key == "dice" else "Betti error", xticks=sorted(cases))
    figure.axes[-2].set_ylim(bottom=0.8)
    figure.axes[-1].set_yscale("symlog", linthresh=10)
    figure.axes[-1].set_ylim(bottom=0)
    figure.axes[-1].legend(fontsize=8)
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=130))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=8, help="1 to 8 corners")
    parser.add_argument("--only", choices=("sparse", "noise"))
    parser.add_argument("-o", "--output", type=Path, default=Path("bone"))
    options = parser.parse_args()
    scans, folder = Path(os.environ["CURVAFIT_DATA"]) / "scans", options.output
    truth = tifffile.imread(scans / "lhdl_trabecular_200_otsu_mask.tif") > 0
    grey = tifffile.imread(scans / "lhdl_trabecular_200.tif").astype(np.float32)
    folder.mkdir(parents=True, exist_ok=True)
    far = truth.shape[0] - EDGE
    # Opposite corners first, so that a few blocks already span the volume.
    corners = sorted(product((0, far), repeat=3), key=lambda c: (sum(map(bool, c)) % 2, c))[: options.blocks]
    jobs = {
        "sparse": (KEPT, "every so many slices", lambda t, g, level, p: sparse(t, level, p)),
        "noise": (NOISE, "noise's deviation, in grey levels", noisy),
    }
    for job, (levels, label, make) in jobs.items():
        if options.only not in (None, job):
            continue
        cases: dict[int, list[dict]] = {level: [] for level in levels}
        for corner in corners:
            box = tuple(slice(start, start + EDGE) for start in corner)
            other = inferred("lower" if corner[0] else "upper", truth, folder)
            priors = {"Willmore": Coefficients.willmore(), "inferred": other}
            for level in levels:
                path = folder / f"{job}-{level}-{'-'.join(map(str, corner))}.json"
                found = case(path, lambda: make(truth[box], grey[box], level, priors))  # noqa: B023
                cases[level].append(found)
                print(f"{path.stem}: {found['inferred']['dice']:.4f}", flush=True)
        table(f"{job}: {label}", cases)
        first = "-".join(map(str, corners[0]))
        draw(cases, folder / f"{job}-{levels[-2]}-{first}.npz", folder / f"{job}.png", label)


if __name__ == "__main__":
    main()
