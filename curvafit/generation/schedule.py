"""Step schedules of the flow: data beside the one formula that reads them."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

#: Steps after which the paper's runs were looked at (Experiment 4).
_PAPER_CHECKS = (500, 1000, 5000)
#: Adam's first decay rate, as published.
_MOMENTUM = 0.9


@dataclass(frozen=True)
class Schedule:
    """How many steps, and how long each is.

    Parameters
    ----------
    name
        Recorded with every shape: a schedule can change which shape comes out.
    steps
        How many; at least 1.
    start, stop
        First and last step length (Adam's learning rate).
    shape
        `"constant"` (at `start`) or `"cosine"` (half a period from `start` to `stop`).
    memory
        Adam's second decay rate. A short one (0.95) forgets the steep noise of the start.

    Raises
    ------
    ValueError
        If there is no step, a length is not positive, or the shape has another name.
    """

    name: str
    steps: int
    start: float
    stop: float
    shape: Literal["constant", "cosine"]
    memory: float = 0.999

    def __post_init__(self) -> None:
        if int(self.steps) != self.steps or self.steps < 1:
            raise ValueError(f"expected a whole number of steps, at least 1, got {self.steps}")
        if not (0 < self.start < math.inf and 0 < self.stop < math.inf):
            raise ValueError(f"expected positive step lengths, got {self.start} and {self.stop}")
        if self.shape not in ("constant", "cosine"):
            raise ValueError(f"expected a schedule's shape 'constant' or 'cosine', got {self.shape!r}")
        if not 0 <= self.memory < 1:
            raise ValueError(f"expected a decay rate in [0, 1), got {self.memory}")

    def rate(self, step: int) -> float:
        """Length of step 0 … steps - 1."""
        if self.shape == "constant" or self.steps == 1:
            return self.start
        phase = math.pi * step / (self.steps - 1)
        return self.stop + (self.start - self.stop) * (1 + math.cos(phase)) / 2

    @property
    def betas(self) -> tuple[float, float]:
        """Adam's decay rates of the gradient and of its square."""
        return _MOMENTUM, self.memory

    @property
    def checks(self) -> tuple[int, ...]:
        """Numbers of steps after which viability is asked, before the end."""
        marks = _PAPER_CHECKS if self.shape == "constant" else (self.steps // 2,)
        return tuple(mark for mark in marks if 0 < mark < self.steps)


#: `paper` is the published one; `fast` reaches its end state within seed noise in fewer steps (`benchmarks.gallery`).
SCHEDULES: dict[str, Schedule] = {
    "paper": Schedule("paper", 8000, 1e-3, 1e-3, "constant"),
    "fast": Schedule("fast", 1000, 5e-3, 1e-4, "cosine", memory=0.95),
}


def schedule(name: str | Schedule, steps: int | None = None) -> Schedule:
    """A named schedule, or the one given; with another number of steps where `steps` is.

    Raises
    ------
    ValueError
        If there is no schedule of that name.
    """
    if not isinstance(name, Schedule):
        if name not in SCHEDULES:
            raise ValueError(f"expected a schedule among {', '.join(SCHEDULES)}, got {name!r}")
        name = SCHEDULES[name]
    return name if steps is None else dataclasses.replace(name, steps=steps)
