"""Teach a repairer from generated shapes: damage them as networks do, and let it find the shape again."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from curvafit.core.checks import check_int, check_seed
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.scan.grids import centre_distance, resample
from curvafit.segmentation.damage import Damage, damage
from curvafit.segmentation.repair import FAR, SUREST, Repairer, RepairNet, choose_pixel
from curvafit.segmentation.teach import (
    RATE,
    TUNING_RATE,
    Batches,
    Mix,
    Texture,
    draw_window,
    hold_out,
    learn,
    near_error,
)
from curvafit.segmentation.trials import BEYOND, dice_of, gain_of, tally
from curvafit.segmentation.uncertainty import fit_temperature

#: Steps of teaching, and batches of shapes held out.
STEPS, JUDGED = 2600, 40
#: Steps of tuning on an example, and the shortest side of an example, in voxels.
TUNING, SHORTEST = 120, 12
#: Thickness of structures, in voxels: on thin ones the network sees furthest.
MIX = Mix(thickness=(2.5, 14.0), pairs=0.15, stretch=0.25)

#: Log-odds, signed distances and truth of a batch, each (B, Z, Y, X).
MapLesson = tuple[np.ndarray, np.ndarray, np.ndarray]


class MapBatches(Batches):
    """Batches of maps to repair."""

    def loss(self, network: nn.Module, lesson: MapLesson) -> Tensor:
        odds, distances, truth = lesson
        return F.binary_cross_entropy_with_logits(network(odds, distances), truth)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class MapLessons(MapBatches):
    """Batches of damaged maps, the same for ever for a seed: batch k depends on (seed, k) alone.

    Attributes
    ----------
    sources
        Shapes by where they come from: each source teaches as often as the others.
    edge
        Voxels of a window's side, a multiple of 4.
    size
        Windows of a batch.
    """

    sources: Sequence[Sequence[Texture]]
    mix: Mix
    how: Damage
    seed: int
    length: int
    size: int = 3
    edge: int = 56

    def __getitem__(self, number: int) -> MapLesson:
        rng, places = np.random.default_rng([self.seed, number]), np.arange(self.edge, dtype=np.float64)
        found: list[MapLesson] = []
        while len(found) < self.size:
            mask = draw_window(self.sources, self.mix, rng, (places,) * 3)
            if 0.01 < mask.mean() < 0.9:
                found.append(pose(mask, damage(mask, rng, self.how)))
        return stack(found)


def pose(mask: np.ndarray, odds: np.ndarray) -> MapLesson:
    """Return log-odds, the signed distances of their mask, and the truth, float32."""
    return odds, centre_distance(odds > 0, (1.0, 1.0, 1.0), FAR), mask.astype(np.float32)


def stack(windows: Sequence[MapLesson]) -> MapLesson:
    """Return windows, each (Z, Y, X), as a batch."""
    odds, distances, truths = (np.stack(each) for each in zip(*windows, strict=True))
    return odds, distances, truths


def teach_repair(
    sources: Sequence[Sequence[Texture]],
    card: dict[str, Any],
    *,
    steps: int = STEPS,
    seed: int = 0,
    checkpoint: Path | None = None,
    workers: int = 1,
    progress: Progress = silent,
) -> Repairer:
    """Teach a repairer by shapes, every tenth of which is held out to judge it.

    The parameters and errors are those of `teach`.
    """
    steps, seed = check_int(steps, "a number of steps from 1", 1, 10**7), check_seed(seed)
    taught, held = hold_out(sources)
    how = Damage()
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = RepairNet()
    lessons = MapLessons(taught, MIX, how, seed, steps)
    losses = learn(
        network, lessons, RATE, checkpoint=checkpoint, workers=workers, progress=sub_progress(progress, 0, 0.97)
    )
    temperature, error, figures = judge_repair(network, MapLessons([held], MIX, how, seed + 1, JUDGED))
    progress("judging on shapes held out", 1.0)
    told = {"shapes": sum(map(len, taught)), "held_out": len(held), "steps": steps, "seed": seed}
    told |= {"mix": asdict(MIX), "damage": asdict(how), "losses": losses}
    return Repairer(network, temperature, {**card, **told, **figures}, error)


@torch.inference_mode()
def judge_repair(network: RepairNet, lessons: MapLessons) -> tuple[float, float, dict[str, float]]:
    """Return the temperature; the calibration error near surfaces, where it is that of the other half of the lessons;
    and the cross entropy of shapes held out, and that of the damaged maps at their own best temperature."""
    found, plain, truths = [], [], []
    for number in range(len(lessons)):
        odds, distances, truth = (torch.from_numpy(each) for each in lessons[number])
        found.append(network(odds, distances).flatten())
        plain.append(odds.flatten())
        truths.append(truth.flatten())
    parts = [(torch.cat(found[k::2]), torch.cat(truths[k::2])) for k in (0, 1)]
    cooled = [fit_temperature(z.numpy(), y.numpy()) for z, y in parts]
    error = float(np.mean([near_error(z / t, y) for (z, y), t in zip(parts, cooled[::-1], strict=True)]))
    temperature, answer = float(np.sqrt(np.prod(cooled))), torch.cat(truths)
    before, after = torch.cat(plain), torch.cat(found) / temperature
    before = before / fit_temperature(before.numpy(), answer.numpy())
    losses = {
        f"held_out_{name}": float(F.binary_cross_entropy_with_logits(odds, answer))
        for name, odds in (("loss", after), ("damaged", before))
    }
    return temperature, error, losses


# ---- an example ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ExampleLessons(MapBatches):
    """Batches of windows of one map whose truth is known, mirrored at random; batch k depends on (seed, k) alone.

    `odds` and `truth` (Z, Y, X) are on cubes.
    """

    odds: np.ndarray
    truth: np.ndarray
    length: int
    seed: int = 0
    size: int = 2
    edge: int = 48

    def __getitem__(self, number: int) -> MapLesson:
        rng = np.random.default_rng([self.seed, number])
        edges, found = [min(self.edge, n // 4 * 4) for n in self.odds.shape], []
        for _ in range(self.size):
            corner = [int(rng.integers(n - edge + 1)) for n, edge in zip(self.odds.shape, edges, strict=True)]
            window = tuple(slice(a, a + edge) for a, edge in zip(corner, edges, strict=True))
            axes = tuple(axis for axis in range(3) if rng.random() < 0.5)
            odds, mask = (np.ascontiguousarray(np.flip(each[window], axes)) for each in (self.odds, self.truth))
            found.append(pose(mask, odds))
        return stack(found)


def tune_repair(
    repairer: Repairer, odds: np.ndarray, truth: np.ndarray, spacing: Sequence[float], progress: Progress = silent
) -> Repairer:
    """Tune a repairer on the log-odds (Z, Y, X) that a network gives for a volume whose true mask is known.

    Two thirds of it teach. On the rest p > 1/2, the repairer and the tuned one are compared: a later one is taken where
    it is better by more than the noise. Raises ValueError if a part has no surface or is too short.
    """
    side = int(np.argmax(odds.shape))
    cut = 2 * odds.shape[side] // 3
    (lesson, known), (rest, answer) = (
        [each[(slice(None),) * side + (part,)] for each in (odds, truth)] for part in (slice(cut), slice(cut, None))
    )
    if min(lesson.shape + rest.shape) < 1 or any(each.all() or not each.any() for each in (known, answer)):
        raise ValueError("expected an example with voxels inside and outside in both its parts")
    pixel = choose_pixel(odds > 0, spacing)
    scale = [pixel / h for h in spacing]
    shape = [round(n / s) for n, s in zip(lesson.shape, scale, strict=True)]
    if min(shape) < SHORTEST:
        raise ValueError(f"expected an example of {SHORTEST} or more voxels a side, got {min(shape)}")
    cubes = [resample(each.astype(np.float32), scale, (0, 0, 0), shape) for each in (lesson, known)]
    lessons = ExampleLessons(cubes[0].clip(-SUREST, SUREST), cubes[1] > 0.5, TUNING)
    network = copy.deepcopy(repairer.network)
    learn(network, lessons, TUNING_RATE, workers=0, progress=lambda _, share: progress("tuning on the example", share))
    tuned = replace(repairer, network=network, temperature=1.0)
    plain, learnt = "p > 1/2 is as good", "repaired by the network, tuned on the example"
    found: dict[str, tuple[Repairer, np.ndarray, np.ndarray]] = {
        plain: (replace(repairer, helps=False), rest, rest > 0)
    }
    for name, each in (("repaired by the network", repairer), (learnt, tuned)):
        each = replace(each, helps=True)
        repaired = each.repair(rest, spacing)
        cooled = fit_temperature(repaired.ravel(), answer.ravel())
        each = replace(each, temperature=cooled * each.temperature)
        found[name] = each, repaired / cooled, repaired / cooled > each.threshold(repaired / cooled)
    counts = {name: tally(mask, answer, range(len(answer))) for name, (_, _, mask) in found.items()}
    chosen = plain
    for name in list(found)[1:]:
        gain, noise = gain_of(counts[name], counts[chosen])
        chosen = name if gain > BEYOND * noise else chosen
    best, likely, _ = found[chosen]
    before, after = (dice_of(counts[name].sum(0)) for name in (plain, chosen))
    truths = torch.from_numpy(np.ascontiguousarray(answer, np.float32)).flatten()
    return replace(
        best,
        error=near_error(torch.from_numpy(np.ascontiguousarray(likely, np.float32)).flatten(), truths),
        status=f"{chosen} (Dice {before:.3f} on a part of the example, {after:.3f} repaired)",
    )
