"""A small U-Net trained on synthetic pairs only, tested on real capillaries.

    python -m benchmarks.synthetic [-o synthetic] [--budget full] [--seeds 3]

From the unlabelled x < 240 of one stack come the coefficients, the volume fraction and all degradations (`infer` and
`like` on the mask that `like` itself guesses; of the matches that `infer` finds, the one that is nearest when it is as
dense as the scan); the test is x > 272 of the other; then the two swap. Four kinds of shapes are imaged alike:
straight tubes, Gaussian level cuts, the packaged atlas, inferred textures. Each is enlarged or reduced at random,
since a texture has one calibre and the scan's structures have many. A network sees synthetic pairs only, and its
threshold is 0.5. Masks hold what the images show (`Imaging.visible`), as an annotator's do. Beside them stand the one
threshold that is best in hindsight on the test part itself; and three annotated slices, from scratch and after
training on the inferred textures. Shapes, fits and runs are kept: what was stopped goes on.
"""

from __future__ import annotations

import itertools
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.synthetic_shapes import EPSILON, KINDS, fields, law, nearest_at_its_density
from benchmarks.vessel_data import PATCH, SPACING, STACKS, part, raw
from benchmarks.vessel_report import WINDOW, best_thresholds, cells, stacked
from benchmarks.vessel_scores import SCORES, block_counts, interval, resampled, scores
from benchmarks.vessel_training import BATCH, Plan, Training, dice_ce, predict
from benchmarks.vessels import begun, other, provenance
from curvafit.core.files import write_content
from curvafit.data_synth.imaging.estimate import bright, like
from curvafit.data_synth.imaging.imaging import field_shape, visible_share
from curvafit.data_synth.imaging.modality import Modality
from curvafit.data_synth.sets.case import drawn_voxel, imaged
from curvafit.data_synth.sets.moves import SYMMETRIES, cropped, turned
from curvafit.geometry.morphometry import local_thickness
from curvafit.inference.infer import infer
from curvafit.volumes.scan import Field

SLICES = "three slices"
#: The least part of its own size that a shape is shown at: less would not fill a patch.
LEAST = 0.95
TUNED = "inferred, then three slices"
THRESHOLD = "best threshold in hindsight"


class Budget(NamedTuple):
    """Steps of a training, and of the tuning on slices after it; the rates of both; fields of a kind."""

    steps: int
    tuning: int
    rate: float
    tuning_rate: float
    count: int


BUDGETS = {"small": Budget(6, 4, 8e-3, 4e-3, 2), "full": Budget(200, 400, 8e-3, 4e-3, 12)}


class Synthetic(Training):
    """A network in training on pairs that are made as it goes."""

    def __init__(
        self,
        shapes: np.ndarray,
        edge: float,
        calibres: tuple[float, float],
        modality: Modality,
        scan: np.ndarray,
        plan: Plan,
        seed: int,
    ) -> None:
        super().__init__(None, plan, seed)
        values = np.log1p(scan.astype(np.float32))
        self.shapes, self.edge, self.calibres, self.modality = shapes, edge, calibres, modality
        self.mean, self.spread = values.mean(), values.std()

    def batch(self, step: int) -> tuple[Tensor, Tensor]:
        x, y = (torch.stack(each) for each in zip(*(self._pair(step, k) for k in range(BATCH)), strict=True))
        return x, y

    def _pair(self, step: int, k: int) -> tuple[Tensor, Tensor]:
        """An image, standardised like the scan, with its grey values changed as a real patch's are; and its label."""
        words = np.random.SeedSequence((self.seed, step % 2**32, k))
        rng, (draw, noise) = np.random.default_rng(words), map(int, words.generate_state(2))
        imaging = self.modality.draw(draw)
        whole = turned(self.shapes[int(rng.integers(len(self.shapes)))], int(rng.integers(SYMMETRIES)))
        edge = drawn_voxel(self.edge, self.calibres, rng)
        size = field_shape(PATCH, edge, imaging)
        corner = [int(rng.integers(n - m + 1)) for n, m in zip(whole.shape, size, strict=True)]
        crop = torch.from_numpy(np.ascontiguousarray(cropped(whole, corner, size)))
        grey, _, mask = imaged(crop, EPSILON, edge, imaging, noise, PATCH)
        x = (torch.log1p(grey.clamp_min(0)) - self.mean) / self.spread
        x = float(rng.uniform(0.9, 1.1)) * x + float(rng.uniform(-0.1, 0.1))
        return x[None].float(), mask[None].float()


class Study:
    """The runs of a budget, kept in a folder."""

    def __init__(self, folder: Path, budget: Budget) -> None:
        self.folder, self.budget = folder, budget
        folder.mkdir(parents=True, exist_ok=True)
        kept = folder / "budget.json"
        if not kept.exists():
            write_content(kept, json.dumps(budget))
        if (found := json.loads(kept.read_text())) != list(budget):
            raise SystemExit(f"expected runs of {budget} in {folder}, got some of {found}: choose another folder")

    def scan(self, stack: str) -> Field:
        """The unlabelled part that all is taken from."""
        return Field(raw(stack, "side"), SPACING, "um")

    def mask(self, stack: str) -> Field:
        """Where that part is bright: a guess without labels."""
        guess = bright(self.scan(stack).values.astype(np.float32), SPACING)
        return Field(guess.astype(np.uint8), SPACING, "um")

    def modality(self, stack: str) -> Modality:
        """Images like that part, with masks of what can be seen."""
        found = like(self.scan(stack))
        return replace(found, base=replace(found.base, visible=visible_share(found.base)))

    def calibres(self, stack: str) -> tuple[float, float]:
        """How much thinner and thicker the scan's structure is than its median: the first and the last decile."""
        mask = self.mask(stack).values > 0
        thickness = local_thickness(mask, SPACING)[mask]
        low, middle, high = np.quantile(thickness, (0.1, 0.5, 0.9))
        return float(max(low / middle, LEAST)), float(high / middle)

    def fit(self, stack: str) -> Path:
        path = self.folder / f"fit-{stack}.json"
        if not path.exists():
            found = nearest_at_its_density(infer(self.mask(stack), kind="mask", seed=0).fit)
            write_content(path, found.to_json())
            print(f"{path.name}: {found.coefficients}", flush=True)
        return path

    def run(self, name: str, stack: str, seed: int) -> dict:
        """Train as `name` says on a stack's side, test on the other; or read what an earlier run kept."""
        path = self.path(name, stack, seed)
        if not path.exists():
            begun = time.process_time()
            training = self._trained(name, stack, seed)
            image, label = part(other(stack), "test")
            mask = mirrored(training.model, image) > 0.5
            kept = {"name": name, "seed": seed, "stack": stack, "seconds": time.process_time() - begun}
            kept |= {"test": block_counts(mask, label), "steps": training.plan.steps} | provenance()
            np.savez_compressed(path.with_suffix(".npz"), mask=mask)
            write_content(path, json.dumps(kept))
            print(f"{time.strftime('%H:%M')} {path.stem}: {kept['seconds']:.0f} s", flush=True)
        return json.loads(path.read_text())

    def path(self, name: str, stack: str, seed: int) -> Path:
        return self.folder / f"{name.replace(' ', '-').replace(',', '')}-{seed}-{stack}.json"

    def _trained(self, name: str, stack: str, seed: int) -> Training:
        if name in KINDS:
            training = self.synthetic(name, stack, seed)
            training.run(dice_ce, self.budget.steps)
            training.save(self.path(name, stack, seed).with_suffix(".pt"))
            return training
        budget, tuned = self.budget, name == TUNED
        steps, rate = (budget.tuning, budget.tuning_rate) if tuned else (budget.steps + budget.tuning, budget.rate)
        training = Training(part(stack, "fit"), Plan(steps, 0, rate), seed)
        if tuned:
            self.run("inferred", stack, seed)
            before = torch.load(self.path("inferred", stack, seed).with_suffix(".pt"))
            training.model.load_state_dict(before["model"])
        training.run(dice_ce, steps)
        return training

    def synthetic(self, kind: str, stack: str, seed: int) -> Synthetic:
        fit, plan = self.fit(stack), Plan(self.budget.steps, 0, self.budget.rate)
        shapes = fields(kind, fit, self.folder, self.budget.count)
        edge, scan = law(fit).working_voxel, self.scan(stack).values
        return Synthetic(shapes, edge, self.calibres(stack), self.modality(stack), scan, plan, seed)


def mirrored(model: nn.Module, image: np.ndarray) -> np.ndarray:
    """Mean prediction of a part and its mirror images in the plane."""
    turns = [axes for n in range(3) for axes in itertools.combinations((1, 2), n)]
    found = [np.flip(predict(model, np.ascontiguousarray(np.flip(image, axes))), axes) for axes in turns]
    return np.mean(found, axis=0)


def table(runs: dict[str, list[list[dict]]]) -> str:
    counts = {name: stacked(those) for name, those in runs.items()}
    seeds = len(runs["inferred"])
    counts[THRESHOLD] = {name: np.repeat(of[:, ::-1], seeds, 0) for name, of in best_thresholds().items()}
    drawn = resampled(counts)
    every = [run for those in runs.values() for pair in those for run in pair]
    commits, torches = ({run[key] for run in every} for key in ("commit", "torch"))
    steps = {name: those[0][0]["steps"] for name, those in runs.items()}
    lines = [
        f"Test halves, {seeds} seeds, both stacks; commit {', '.join(sorted(commits))}, "
        f"torch {', '.join(sorted(torches))}. 95 % intervals: bootstrap over places and seeds.",
        f"Steps: {steps}, the last after those of the inferred textures.",
        f"{'':28}" + "".join(f"{name:>27}" for name in SCORES),
    ]
    lines += [f"{name:28}" + cells(interval(drawn[name]), "") for name in counts]
    for base in ("inferred", THRESHOLD, SLICES):
        lines += ["", f"Differences to {base}"]
        lines += [f"{name:28}" + cells(interval(drawn[name] - drawn[base]), "+") for name in runs if name != base]
    return "\n".join([*lines, "", *by_stack(counts)]) + "\n"


def by_stack(counts: dict[str, dict[str, np.ndarray]]) -> list[str]:
    """Dice on each stack's test half, trained on the other."""
    lines = ["Dice on each stack's test half: mean, least and most of the seeds"]
    lines += [f"{'':28}" + "".join(f"{other(stack):>28}" for stack in STACKS)]
    for name, those in counts.items():
        dice = scores(those)[..., 0].T
        lines += [f"{name:28}" + "".join(f"{d.mean():>14.4f} {d.min():.4f} {d.max():.4f}" for d in dice)]
    return lines


def pictures(study: Study, names: list[str]) -> None:
    """A window of the real image, what each network found there, and a synthetic image of every kind."""
    stack = STACKS[1]
    image, true = part(stack, "test")
    shown: dict[str, np.ndarray] = {"image": image[WINDOW].max(0), "annotation": true[WINDOW].sum(0)}
    for kind in KINDS:
        x, _ = study.synthetic(kind, stack, 0).batch(0)
        shown[f"a pair's image, {kind} (half as wide)"] = x[0, 0].amax(0).numpy()
    for name in names:
        with np.load(study.path(name, other(stack), 0).with_suffix(".npz")) as kept:
            shown[name] = kept["mask"][WINDOW].sum(0)
    figure, axes = plt.subplots(3, 4, figsize=(15, 11.5), layout="constrained")
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (name, values) in zip(axes.flat, shown.items(), strict=False):
        axis.imshow(values, cmap="gray")
        axis.set_title(name)
    figure.savefig(study.folder / "synthetic.png", dpi=100)
    plt.close(figure)


def main() -> None:
    options = begun(__doc__, "synthetic", BUDGETS)
    study, names = Study(options.output / options.budget, BUDGETS[options.budget]), [*KINDS, SLICES, TUNED]
    runs: dict[str, list[list[dict]]] = {name: [] for name in names}
    for seed in range(options.seeds):
        for name in names:
            runs[name].append([study.run(name, stack, seed) for stack in STACKS])
        text = table(runs)
        write_content(study.folder / "synthetic.txt", text)
    print(text)
    pictures(study, names)


if __name__ == "__main__":
    main()
