"""The table and the picture of the vessel benchmark."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from benchmarks.vessel_data import STACKS, part
from benchmarks.vessel_scores import SCORES, block_counts, bootstrap, scores

#: How much worse Dice may become.
MARGIN = 0.005
#: Slices and pixels of the picture.
WINDOW = np.s_[8:16, 256:416, 40:200]


def table(runs: dict[str, list[list[dict]]], tuning: list[tuple[float, list[dict]]]) -> str:
    """Test scores and differences to Dice + CE with 95 % intervals, the verdict, and all settings tried.

    Parameters
    ----------
    runs
        Of each loss, by seed and stack.
    tuning
        Merit on the validation blocks, and the runs, of every setting.
    """
    found = bootstrap({loss: stacked(those) for loss, those in runs.items()}, "dice+ce")
    one = runs["dice+ce"][0][0]
    seeds = len(runs["dice+ce"])
    lines = [
        f"Test halves, {seeds} seeds, both stacks, {one['steps']} steps; commit {one['commit']}, torch {one['torch']}, "
        f"monai {one['monai']}.",
        "95 % intervals: bootstrap over places (blocks of the plane, the same in both stacks) and seeds.",
        "",
        f"{'':24}" + "".join(f"{name:>27}" for name in SCORES),
    ]
    lines += [f"{label(those[0][0]):24}" + cells(found[loss][0], "") for loss, those in runs.items()]
    best = scores(best_thresholds()).mean((0, 1))
    lines += [f"{'best threshold':24}" + "".join(f"{value:>27.4f}" for value in best)]
    lines += ["", "Differences to Dice + CE"]
    others = [loss for loss in runs if loss != "dice+ce"]
    lines += [f"{loss:24}" + cells(found[loss][1], "+") for loss in others]
    lines += ["", *(verdict(loss, found[loss][1]) for loss in others), "", *_sweep(tuning)]
    return "\n".join(lines) + "\n"


def stacked(those: list[list[dict]], end: str = "test") -> dict[str, np.ndarray]:
    """Counts `(seeds, stacks, blocks)`."""
    return {name: np.array([[run[end][name] for run in pair] for pair in those]) for name in those[0][0][end]}


def label(run: dict) -> str:
    setting = run["setting"]
    if setting["loss"] == "dice+ce":
        return f"dice+ce, rate {run['rate']:g}"
    epsilon = f", ε {setting['epsilon']:g} µm" if setting["epsilon"] else ""
    return f"{setting['loss']} {setting['weight']:g}{epsilon}"


def verdict(loss: str, difference: np.ndarray) -> str:
    """Whether the bar is met: clDice and Betti-0 error better beyond the interval, Dice worse by 0.005 at most."""
    (dice, *_), low, high = difference
    parts = (
        f"Dice {'kept' if dice >= -MARGIN else 'lost'}",
        f"clDice {'better' if low[1] > 0 else 'worse' if high[1] < 0 else 'undecided'}",
        f"Betti-0 error {'better' if high[2] < 0 else 'worse' if low[2] > 0 else 'undecided'}",
    )
    met = dice >= -MARGIN and low[1] > 0 and high[2] < 0
    return f"{loss} against Dice + CE: {', '.join(parts)}: the bar is {'met' if met else 'not met'}."


def picture(folder: Path, runs: dict[str, list[list[dict]]]) -> None:
    """A window of the first test part, and the differences to Dice + CE."""
    figure, axes = plt.subplots(2, 4, figsize=(15, 7.8), layout="constrained")
    stack = STACKS[1]
    image, true = part(stack, "test")
    pictures = {"image": image[WINDOW].max(0), "annotation": true[WINDOW].sum(0)}
    for those in runs.values():
        with np.load(folder / f"{those[0][0]['name']}-test.npz") as kept:
            pictures[label(those[0][0])] = kept["mask"][WINDOW].sum(0)
    for axis, (name, values) in zip(axes.flat, pictures.items(), strict=False):
        axis.imshow(values, cmap="gray")
        axis.set(title=name, xticks=[], yticks=[])
    found = bootstrap({loss: stacked(those) for loss, those in runs.items()}, "dice+ce")
    for axis, columns in zip(axes.flat[6:], ((0, 1), (2, 3)), strict=True):
        _bars(axis, found, columns)
    figure.savefig(folder / "vessels.png", dpi=110)
    plt.close(figure)


def _bars(axis: Axes, found: dict[str, np.ndarray], columns: tuple[int, ...]) -> None:
    losses = [loss for loss in found if loss != "dice+ce"]
    for shift, column in enumerate(columns):
        middle, low, high = np.array([found[loss][1][:, column] for loss in losses]).T
        places = np.arange(len(losses)) + 0.2 * (shift - 0.5)
        axis.errorbar(places, middle, (middle - low, high - middle), fmt="o", capsize=3, label=SCORES[column])
    axis.axhline(0, color="grey", linewidth=0.8)
    axis.set(title="less Dice + CE, 95 %", xticks=range(len(losses)), xticklabels=losses)
    axis.legend()


def cells(values: np.ndarray, sign: str) -> str:
    return "".join(f"{f'{middle:{sign}.4f} [{low:{sign}.4f}, {high:{sign}.4f}]':>27}" for middle, low, high in values.T)


def best_thresholds() -> dict[str, np.ndarray]:
    """Counts `(1, stacks, blocks)` of the one threshold that is best in hindsight on each stack's test part."""
    found = []
    for stack in STACKS:
        image, true = part(stack, "test")
        levels = np.quantile(image, np.linspace(0.85, 0.995, 59))
        overlaps = [2 * ((image > level) & true).sum() / ((image > level).sum() + true.sum()) for level in levels]
        found.append(block_counts(image > levels[int(np.argmax(overlaps))], true))
    return {name: np.array([[counts[name] for counts in found]]) for name in found[0]}


def _sweep(tuning: list[tuple[float, list[dict]]]) -> list[str]:
    """Validation and test scores of all settings tried, one seed."""
    heads = "".join(f"{name:>15}" for name in SCORES)
    lines = [
        "All settings tried (one seed): validation, by which one is chosen; and test.",
        f"{'':28}merit{heads}{heads}",
    ]
    for merit, pair in tuning:
        cells = [scores(stacked([pair], end)).mean((0, 1)) for end in ("validation", "test")]
        lines.append(f"{label(pair[0]):24}{merit:9.4f}" + "".join(f"{value:15.4f}" for value in np.concatenate(cells)))
    return lines
