"""Networks on real vessels, three annotated slices: Dice + CE, and the same with clDice, skeleton recall or F_ε.

    CURVAFIT_DATA=… python -m benchmarks.vessels -o FOLDER [--budget full] [--seeds 3]

A small 3D U-Net is fitted on one half of one stack and tested on the other half of the other, both ways round. All
losses share network, patches, steps and the number of settings tried: Dice + CE chooses its learning rate, which all
take; the others the weight of what they add. Settings are chosen on the validation block by `merit`, the mean of both
ways, with a seed of their own. F_ε takes its coefficients from `infer` on the mask that the tuned Dice + CE network
predicts on its own fitting part: no label beyond the three slices enters. Every loss begins with the same third of
steps of Dice + CE. A killed run goes on; a finished one only prints `vessels.txt` and draws `vessels.png`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from benchmarks.vessel_data import SPACING, STACKS, part
from benchmarks.vessel_report import picture, table
from benchmarks.vessel_scores import block_counts, scores
from benchmarks.vessel_training import LOSSES, Plan, Setting, Training, dice_ce, predict
from curvafit.core.files import write_content
from curvafit.inference.infer import infer
from curvafit.volumes.scan import Field

#: The seed of the tuning runs; those reported count from 0.
TUNING = 100


class Budget(NamedTuple):
    """Steps; settings tried: learning rates, weights of clDice and of skeleton recall, (share, ε in µm) of F_ε; whether
    coefficients are inferred."""

    steps: int
    rates: tuple[float, ...]
    weights: tuple[float, ...]
    curvature: tuple[tuple[float, float], ...]
    inferred: bool


BUDGETS = {
    "small": Budget(12, (4e-3,), (1.0,), ((0.3, 2.0),), False),
    "full": Budget(
        400,
        (2e-3, 4e-3, 8e-3, 1.6e-2),
        (0.1, 0.3, 1.0, 3.0),
        ((0.1, 2.0), (0.3, 2.0), (1.0, 2.0), (0.3, 1.0)),
        True,
    ),
}


class Study:
    """The runs of a budget, kept in a folder."""

    def __init__(self, folder: Path, budget: Budget) -> None:
        self.folder, self.budget = folder, budget
        folder.mkdir(parents=True, exist_ok=True)

    def run(self, setting: Setting, rate: float, seed: int, stack: str) -> dict:
        """Train on a stack, validate there, test on the other; or read what an earlier run kept."""
        name = f"{setting.loss}-{setting.weight:g}-{setting.epsilon:g}-{rate:g}-{seed}-{stack}"
        path = self.folder / f"{name}.json"
        if not path.exists():
            begun = time.process_time()
            training = self._begun(rate, seed, stack)
            weight = training.finish(setting)
            kept = {"weight": weight, "seconds": time.process_time() - begun, "steps": self.budget.steps}
            for end, where in (("validation", stack), ("test", other(stack))):
                image, label = part(where, end)
                mask = predict(training.model, image) > 0.5
                kept[end] = block_counts(mask, label)
                np.savez_compressed(path.with_name(f"{name}-{end}.npz"), mask=mask)
            if setting.loss == "dice+ce":
                mask = predict(training.model, part(stack, "fit").image) > 0.5
                np.savez_compressed(path.with_name(f"{name}-fit.npz"), mask=mask)
            kept |= {
                "name": name,
                "setting": setting._asdict(),
                "rate": rate,
                "seed": seed,
                "stack": stack,
            } | provenance()
            write_content(path, json.dumps(kept))
            found = " ".join(f"{value:.4f}" for value in scores(kept["validation"]))
            print(f"{time.strftime('%H:%M')} {name}: validation {found}, {kept['seconds']:.0f} s", flush=True)
        return json.loads(path.read_text())

    def _begun(self, rate: float, seed: int, stack: str) -> Training:
        """The training that all losses share, up to where they part."""
        plan = Plan(self.budget.steps, self.budget.steps // 3, rate)
        training, path = Training(part(stack, "fit"), plan, seed), self.folder / f"begun-{rate:g}-{seed}-{stack}.pt"
        if path.exists():
            training.load(path)
        else:
            training.run(dice_ce, plan.alone)
            training.save(path)
        return training

    def rate(self) -> float:
        """The learning rate with the best merit under Dice + CE."""
        merits = {rate: self.merit("dice+ce", 0, 0, rate) for rate in self.budget.rates}
        return max(merits, key=merits.__getitem__)

    def settings(self, loss: str) -> list[tuple[float, float]]:
        """Weights and ε that are tried."""
        if loss == "dice+ce":
            return [(0, 0)]
        return list(self.budget.curvature) if loss == "curvature" else [(weight, 0) for weight in self.budget.weights]

    def chosen(self, loss: str, rate: float) -> tuple[float, float]:
        """The weight and ε with the best merit."""
        tried = self.settings(loss)
        merits = [self.merit(loss, *setting, rate) for setting in tried]
        return tried[int(np.argmax(merits))]

    def merit(self, loss: str, weight: float, epsilon: float, rate: float) -> float:
        """Dice + clDice - Betti-0 error as a share of the true components, on the validation blocks of both stacks."""
        total = 0.0
        for run in self.pair(loss, weight, epsilon, rate, TUNING):
            counts = run["validation"]
            dice, cldice, error, _ = scores(counts)
            total += dice + cldice - error / np.mean(counts["true_components"])
        return float(total) / len(STACKS)

    def pair(self, loss: str, weight: float, epsilon: float, rate: float, seed: int) -> list[dict]:
        """The runs of a setting, fitted on either stack."""
        fits = [self.fit(rate, stack) if loss == "curvature" else "" for stack in STACKS]
        return [
            self.run(Setting(loss, weight, epsilon, fit), rate, seed, stack)
            for fit, stack in zip(fits, STACKS, strict=True)
        ]

    def fit(self, rate: float, stack: str) -> str:
        """The coefficients inferred from what the tuned Dice + CE network predicts on its fitting part: a file."""
        if not self.budget.inferred:
            return "tubes"
        path = self.folder / f"fit-{stack}.json"
        if not path.exists():
            with np.load(self.folder / f"dice+ce-0-0-{rate:g}-{TUNING}-{stack}-fit.npz") as kept:
                example = Field(kept["mask"].astype(np.uint8), SPACING, "um")
            found = infer(example, kind="mask").fit
            write_content(path, found.to_json())
            print(f"{time.strftime('%H:%M')} {path.name}: {found.chosen}, {found.coefficients}", flush=True)
        return str(path)


def tuning(study: Study, rate: float) -> list[tuple[float, list[dict]]]:
    """All tuning runs: merit, and the runs of both stacks."""
    settings = [("dice+ce", 0.0, 0.0, each) for each in study.budget.rates]
    settings += [(loss, *setting, rate) for loss in LOSSES[1:] for setting in study.settings(loss)]
    return [(study.merit(*setting), study.pair(*setting, TUNING)) for setting in settings]


def other(stack: str) -> str:
    return STACKS[1 - STACKS.index(stack)]


def provenance() -> dict[str, str]:
    asked = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=False)
    packages = {name: version(name) for name in ("curvafit", "torch", "monai", "numpy", "scikit-image")}
    return {"commit": asked.stdout.strip() or "unknown"} | packages


def begun(doc: str | None, folder: str, budgets: Iterable[str]) -> argparse.Namespace:
    """The options of a study, and torch as it needs it: one thread, the same bits every time."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path(folder))
    parser.add_argument("--budget", choices=list(budgets), default="full")
    parser.add_argument("--seeds", type=int, default=3)
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    return parser.parse_args()


def main() -> None:
    options = begun(__doc__, "vessels", BUDGETS)
    study = Study(options.output / options.budget, BUDGETS[options.budget])
    rate = study.rate()
    chosen = {loss: study.chosen(loss, rate) for loss in LOSSES}
    runs: dict[str, list[list[dict]]] = {loss: [] for loss in LOSSES}
    for seed in range(options.seeds):
        for loss, setting in chosen.items():
            runs[loss].append(study.pair(loss, *setting, rate, seed))
        text = table(runs, tuning(study, rate))
        write_content(study.folder / "vessels.txt", text)
    print(text)
    picture(study.folder, runs)


if __name__ == "__main__":
    main()
