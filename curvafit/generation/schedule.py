"""Step schedules of flows, as data, and the formula of step lengths."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

from curvafit.priors.bounds import inside, instance, named, real, whole

#: The most steps that a flow may have, and the longest one.
MOST_STEPS, LONGEST_STEP = 10**7, 1e6
#: Steps after which the paper checked its runs (Experiment 4).
_PAPER_CHECKS = (500, 1000, 5000)


@dataclass(frozen=True)
class Schedule:
    """The number of a flow's steps, and their lengths.

    Parameters
    ----------
    name
        A name for the records of shapes, as the schedule influences the shape.
    steps
        Number of steps, 1 to 10 million.
    start, stop
        First and last step length (Adam's learning rate), above 0 and at most 1e6.
    shape
        `"constant"` (all steps as long as `start`) or `"cosine"` (half a period from `start` to `stop`).
    momentum, memory
        Adam's decay rates of the gradient and of the gradient's square. Long momentum smooths long steps; short memory
        forgets the steep noise of the start.

    Raises
    ------
    ValueError
        If a number is out of range, or the shape has another name.
    """

    name: str
    steps: int
    start: float
    stop: float
    shape: Literal["constant", "cosine"]
    momentum: float = 0.9
    memory: float = 0.999

    def __post_init__(self) -> None:
        instance(self.name, str, "a schedule's name as text")
        steps = whole(self.steps, "a whole number of steps, at least 1", 1, MOST_STEPS)
        object.__setattr__(self, "steps", steps)
        for name in ("start", "stop"):
            length = real(getattr(self, name), "positive step lengths", 1e-30, LONGEST_STEP)
            object.__setattr__(self, name, length)
        named(self.shape, ("constant", "cosine"), "a schedule's shape 'constant' or 'cosine'")
        for name in ("momentum", "memory"):
            object.__setattr__(self, name, inside(getattr(self, name), f"{name} in [0, 1)", -math.ulp(0), 1))

    def among(self, step: int) -> int:
        """Return a snapshot's number of steps.

        Raises
        ------
        ValueError
            If it is not a whole number from 0 to the schedule's number of steps.
        """
        return whole(step, f"snapshots at 0 to {self.steps} steps", 0, self.steps)

    def rate(self, step: int) -> float:
        """Return the length of a step, numbered from 0 to steps - 1."""
        if self.shape == "constant" or self.steps == 1:
            return self.start
        phase = math.pi * step / (self.steps - 1)
        return self.stop + (self.start - self.stop) * (1 + math.cos(phase)) / 2

    @property
    def betas(self) -> tuple[float, float]:
        """Adam's decay rates: momentum and memory."""
        return self.momentum, self.memory

    @property
    def checks(self) -> tuple[int, ...]:
        """Numbers of steps before the end after which viability is checked."""
        marks = _PAPER_CHECKS if self.shape == "constant" else (self.steps // 2,)
        return tuple(mark for mark in marks if 0 < mark < self.steps)


#: `paper` is the published schedule; `fast` makes similar textures in an eighth of the steps: `benchmarks.texture`
#: compares the two for each preset.
SCHEDULES: dict[str, Schedule] = {
    "paper": Schedule("paper", 8000, 1e-3, 1e-3, "constant"),
    "fast": Schedule("fast", 1000, 2e-2, 1e-4, "cosine", momentum=0.97, memory=0.97),
}


def schedule(name: str | Schedule, steps: int | None = None) -> Schedule:
    """Return the schedule of a name, or a `Schedule` itself, with `steps` steps where that is not None.

    Raises
    ------
    ValueError
        If there is no schedule of that name.
    """
    if not isinstance(name, Schedule):
        named(name, SCHEDULES, f"a schedule among {', '.join(SCHEDULES)}")
        name = SCHEDULES[name]
    return name if steps is None else dataclasses.replace(name, steps=steps)
