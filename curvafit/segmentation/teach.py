"""Teach a filler: batches of gaps to fill, learning from them, and tuning on an example.

The losses are cross entropies, so that outputs are log-odds of the inside. `examples/teach.py` taught the packaged
fillers.
"""

from __future__ import annotations

import copy
from abc import ABC
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.data import DataLoader, Dataset, Subset

from curvafit.core.files import write_atomically
from curvafit.core.runtime import Progress, silent
from curvafit.segmentation.filler import Gaps, Raster, Taught, fill
from curvafit.segmentation.trials import BEYOND, Example, dice_of, gain_of, tally
from curvafit.segmentation.uncertainty import UNSURE, best_log_odds, calibration_error, fit_temperature

#: Steps of tuning, and its greatest rate.
TUNING, TUNING_RATE = 150, 5e-4
#: Largest norm of a step's gradient.
STEEPEST = 1.0
#: Whether convolutions are taught in bfloat16: where the processor multiplies matrices in it, that takes half the time.
HALF = getattr(torch.cpu, "get_capabilities", dict)().get("amx_bf16", False)
#: Steps between two checkpoints.
SAVED = 100
#: Pixels at a window's border that the network reads, but whose loss does not count.
HALO = 8

#: Distances (B, 4, Y, X), steps (B,), marks and evidence (B, n, Y, X), as in `filler.Gaps`; and the truth (B, n, Y, X).
Lesson = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None, np.ndarray]


class Batches(Dataset, ABC):
    """Batches of gaps to fill, `length` of them. The outer `halo` pixels of a window do not count for the loss."""

    length: int
    halo: int

    def __len__(self) -> int:
        return self.length

    def loss(self, network: nn.Module, lesson: Lesson) -> Tensor:
        """Return the loss of a network on a batch."""
        *inputs, truth = lesson
        with torch.autocast("cpu", torch.bfloat16, enabled=HALF):
            logits = network(Gaps(*inputs))[self.inner]  # type: ignore[arg-type]
        return F.binary_cross_entropy_with_logits(logits.float(), truth[self.inner])  # type: ignore[index]

    @property
    def inner(self) -> tuple[Any, ...]:
        """The index of the pixels that count, on the last two axes."""
        return (..., slice(self.halo, -self.halo), slice(self.halo, -self.halo))


@dataclass(frozen=True, eq=False)
class Whole:
    """A volume whose every slice is known: signed `distances` in each slice (Z, Y, X), in pixels, with slices `step`
    pixels apart. `evidence` holds an image's log-odds (Z, Y, X) where slices 0, `gap`, 2 `gap`, … are known."""

    distances: np.ndarray
    gap: int
    step: float
    evidence: np.ndarray | None = None

    @classmethod
    def of(cls, example: Example) -> Whole:
        """Return the lesson of an example, in the pixels and with the gap of its task."""
        given, raster = example.task.given, Raster.of(example.task.given)
        distances = np.stack([raster.distances(mask) for mask in example.lesson.inside])
        return cls(distances, given.gap, given.spacing[0] / raster.pixel)


@dataclass(frozen=True, eq=False)
class WholeLessons(Batches):
    """Batches of `size` gaps in one of the `volumes` each; batch k depends on (seed, k) alone. With evidence, gaps lie
    between the slices it was learnt from; without, they begin anywhere, and may be a slice shorter or longer."""

    volumes: Sequence[Whole]
    length: int
    seed: int = 0
    size: int = 3
    edge: int = 64
    halo: int = HALO

    def __getitem__(self, number: int) -> Lesson:
        """Return a batch of gaps in windows of a volume drawn at random, flipped at random."""
        rng = np.random.default_rng([self.seed, number])
        whole = self.volumes[int(rng.integers(len(self.volumes)))]
        depth, edge = len(whole.distances), self.edge + 2 * self.halo
        gap, starts = whole.gap, np.arange(0, depth - whole.gap, whole.gap)
        if whole.evidence is None:  # any slice can then be a known one; evidence was learnt from every `gap`-th
            gap = max(min(whole.gap + int(rng.integers(-1, 2)), depth - 1), 2)
            starts = np.arange(depth - gap)
        gaps: list[list[np.ndarray]] = []
        while len(gaps) < self.size:
            start = int(rng.choice(starts))
            corner = [int(rng.integers(max(n - edge, 0) + 1)) for n in whole.distances.shape[1:]]
            window = tuple(slice(a, a + edge) for a in corner)
            planes = whole.distances[:, *window]
            rows = [start - gap, start, start + gap, start + 2 * gap]
            # The nearest known slice takes the place of one beyond the volume, and now and then of any outer one.
            rows[0] = start if rows[0] < 0 or rng.random() < 0.1 else rows[0]
            rows[3] = start + gap if rows[3] >= depth or rng.random() < 0.1 else rows[3]
            between = slice(start + 1, start + gap)
            arrays = [planes[rows], planes[between] > 0]
            if whole.evidence is not None:
                arrays.append(whole.evidence[between][:, *window])
            for axis in range(3):
                if rng.random() < 0.5:
                    arrays = [np.flip(array, axis) for array in arrays]
            gaps.append(arrays)
        distances, truths, *evidence = (np.ascontiguousarray(np.stack(arrays)) for arrays in zip(*gaps, strict=True))
        steps, truths = np.full(self.size, whole.step, np.float32), truths.astype(np.float32)
        return distances, steps, np.zeros_like(truths), evidence[0] if evidence else None, truths


def learn(
    network: nn.Module,
    lessons: Batches,
    rate: float,
    *,
    checkpoint: Path | None = None,
    workers: int = 1,
    progress: Progress = silent,
) -> list[float]:
    """Lower the loss of lessons by AdamW in one cycle of rates, in place; return the mean loss of each hundred steps.
    With a checkpoint, the state is written there every `SAVED` steps, and learning goes on from it."""
    total = len(lessons)
    optimiser = torch.optim.AdamW(network.parameters(), rate, weight_decay=1e-4)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=total, pct_start=0.1)
    stateful = {"network": network, "optimiser": optimiser, "cycle": cycle}
    done, losses = 0, []
    if checkpoint is not None and checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True)
        try:
            for name, part in stateful.items():
                part.load_state_dict(state[name])
        except (KeyError, RuntimeError) as error:
            raise ValueError(f"{checkpoint} is of another teaching: delete it, or choose another output") from error
        done, losses = state["step"], state["losses"]
    network.train()
    remaining = Subset(lessons, range(done, total))
    context = "spawn" if workers else None
    loader = DataLoader(remaining, batch_size=None, num_workers=workers, multiprocessing_context=context)
    for step, lesson in enumerate(loader, done + 1):
        loss = lessons.loss(network, lesson)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), STEEPEST)
        optimiser.step()
        cycle.step()
        losses.append(float(loss.detach()))
        progress(f"step {step} of {total}, loss {np.mean(losses[-100:]):.4f}", step / total)
        if checkpoint is not None and (step % SAVED == 0 or step == total):
            state = {name: part.state_dict() for name, part in stateful.items()} | {"step": step, "losses": losses}
            write_atomically(checkpoint, partial(torch.save, state))
    network.eval()
    return [float(np.mean(losses[k : k + 100])) for k in range(0, total, 100)]


def near_error(logits: Tensor, truth: Tensor) -> float:
    """Return the calibration error of log-odds (N,) near surfaces."""
    near = logits.abs() < UNSURE
    return calibration_error(torch.sigmoid(logits[near]).numpy(), truth[near].numpy())


def tune(taught: Taught, example: Example, progress: Progress = silent) -> Taught:
    """Train a filler further on an example's lesson, for a minute, and return it if it gains more than the noise on the
    task, which is another part of the example, else the filler as it was; either is calibrated on the task."""
    task, places = example.task, list(example.task.places)
    tuned, lessons = replace(taught, filler=copy.deepcopy(taught.filler)), WholeLessons([Whole.of(example)], TUNING)
    step: Progress = lambda _, done: progress("tuning on the example", done)  # noqa: E731
    learn(tuned.filler, lessons, TUNING_RATE, workers=0, progress=step)
    predictions = [fill(task.given, candidate)[places] for candidate in (taught, tuned)]
    before, after = (tally(logits > best_log_odds(logits), task.truth, places) for logits in predictions)
    gain, noise = gain_of(after, before)
    better = gain > BEYOND * noise
    logits = torch.from_numpy(predictions[1 if better else 0]).flatten()
    truth = torch.from_numpy(task.truth).float().flatten()
    temperature = fit_temperature(logits.numpy(), truth.numpy())
    dice_before, dice_after = (float(dice_of(counts.sum(0))) for counts in (before, after))
    scores = f"Dice {dice_before:.3f} on a part of the example, {dice_after:.3f} tuned on the rest"
    return replace(
        tuned if better else taught,
        temperatures=taught.temperatures * [[1.0], [temperature]],  # rows: gaps, and the temperature of each
        error=near_error(logits / temperature, truth),
        status=f"filled by the network{', tuned on the example' if better else ''} ({scores})",
    )
