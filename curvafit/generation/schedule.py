"""Step schedules of flows, as data, and the formula of step lengths."""

from __future__ import annotations

import dataclasses
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Literal

from curvafit.core.checks import as_tuple, check_choice, check_float, check_int, check_open_interval, check_type
from curvafit.priors.law import Law

#: The most steps that a flow may have, and the longest one.
MOST_STEPS, LONGEST_STEP = 10**7, 1e6


@dataclass(frozen=True)
class Phase:
    """A phase at the beginning of a schedule: its share in (0, 1) of all steps, and fields as those of `Schedule`."""

    share: float
    start: float
    stop: float
    shape: Literal["constant", "cosine"]
    momentum: float = 0.9
    memory: float = 0.999

    def __post_init__(self) -> None:
        share = check_open_interval(self.share, "a phase's share of the steps in (0, 1)", 0, 1)
        object.__setattr__(self, "share", share)
        _normalise_steps(self)


@dataclass(frozen=True)
class Schedule:
    """The number of a flow's steps, their lengths, and Adam's decay rates.

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
    opening
        Phases that come first, in order; the fields above describe the remaining steps. Where a phase shortens memory
        within the first 300 steps or so, the next steps are longer than stated, since Adam corrects its bias by the
        new rate.
    """

    name: str
    steps: int
    start: float
    stop: float
    shape: Literal["constant", "cosine"]
    momentum: float = 0.9
    memory: float = 0.999
    opening: tuple[Phase, ...] = ()

    def __post_init__(self) -> None:
        check_type(self.name, str, "a schedule's name as text")
        steps = check_int(self.steps, "a whole number of steps, at least 1", 1, MOST_STEPS)
        object.__setattr__(self, "steps", steps)
        _normalise_steps(self)
        opening = as_tuple(self.opening, "phases")
        phases = tuple(Phase(**phase) if isinstance(phase, dict) else phase for phase in opening)
        for phase in phases:
            check_type(phase, Phase, "an opening of phases as Phase")
        total = sum(phase.share for phase in phases)  # 0 where there is no opening
        check_open_interval(total, "phases with shares below 1 in all", -1, 1)
        object.__setattr__(self, "opening", phases)

    def rate(self, step: int) -> float:
        """Return the length of a step, numbered from 0 to steps - 1."""
        phase, first, count = self._find_phase(step)
        if phase.shape == "constant" or count == 1:
            return phase.start
        angle = math.pi * (step - first) / (count - 1)
        return phase.stop + (phase.start - phase.stop) * (1 + math.cos(angle)) / 2

    def betas_at(self, step: int) -> tuple[float, float]:
        """Return Adam's decay rates at a step: momentum and memory."""
        phase, _, _ = self._find_phase(step)
        return phase.momentum, phase.memory

    @property
    def bounds(self) -> tuple[int, ...]:
        """The numbers of steps after which a phase of the opening ends."""
        return tuple(round(self.steps * share) for share in accumulate(phase.share for phase in self.opening))

    def _find_phase(self, step: int) -> tuple[Phase | Schedule, int, int]:
        """Return the phase of a step, the first step of that phase, and its number of steps."""
        k = bisect_right(self.bounds, step)
        starts, ends = (0, *self.bounds), (*self.bounds, self.steps)
        return (*self.opening, self)[k], starts[k], ends[k] - starts[k]

    def as_dict(self) -> dict[str, Any]:
        """Return the fields in JSON's types, for records: `Schedule(**fields)` is the schedule again."""
        fields = dataclasses.asdict(self)
        opening = fields.pop("opening")
        return fields | {"opening": list(opening)} if opening else fields

    @property
    def checks(self) -> tuple[int, ...]:
        """Numbers of steps before the end after which viability is checked."""
        # The paper checked its runs, whose steps are all as long, after these steps (Experiment 4).
        marks = (500, 1000, 5000) if self.shape == "constant" else (self.steps // 2,)
        return tuple(mark for mark in marks if 0 < mark < self.steps)


def _normalise_steps(phase: Phase | Schedule) -> None:
    """Convert a phase's step lengths and decay rates to floats, in place; raise ValueError if one is out of range."""
    for name in ("start", "stop"):
        length = check_float(getattr(phase, name), "positive step lengths", 1e-30, LONGEST_STEP)
        object.__setattr__(phase, name, length)
    check_choice(phase.shape, ("constant", "cosine"), "a schedule's shape 'constant' or 'cosine'")
    for name in ("momentum", "memory"):
        # The check is of an open interval: with the greatest float below 0 as its end, 0 is in it.
        object.__setattr__(phase, name, check_open_interval(getattr(phase, name), f"{name} in [0, 1)", -math.ulp(0), 1))


def _make_phased(name: str, longest: float) -> Schedule:
    """Return a schedule of 1500 steps: as published while the topology forms, then longer, up to `longest`.

    With more momentum and less memory the longer steps follow the same descent.
    """
    late = {"shape": "cosine", "momentum": 0.97, "memory": 0.99}
    opening = Phase(0.2, 1e-3, 1e-3, "constant"), Phase(0.2, 1e-3, longest, **late)
    return Schedule(name, 1500, longest, 1e-3, **late, opening=opening)


#: `paper` is the published schedule. `fast` ends in a shape near that of `paper`, in a fifth of the steps. `deep`,
#: with steps twice as long, descends further where the energy still falls: the preset `weird` ends in another shape.
#: `cosine` begins with long steps: it is done sooner, often in other shapes of less energy. See `benchmarks.texture`.
SCHEDULES: dict[str, Schedule] = {
    "paper": Schedule("paper", 8000, 1e-3, 1e-3, "constant"),
    "fast": _make_phased("fast", 7.5e-3),
    "deep": _make_phased("deep", 1.5e-2),
    "cosine": Schedule("cosine", 1000, 2e-2, 1e-4, "cosine", momentum=0.97, memory=0.97),
}
#: The schedule of the packaged atlas and of most shapes that the packaged posterior learned from. What `infer` grows
#: from a law grows by it too, since the law was read off shapes that ended so.
LEARNED = "deep"


def schedule(name: str | Schedule, steps: int | None = None) -> Schedule:
    """Return the schedule of that name (else ValueError), or a `Schedule` itself, with `steps` steps if stated."""
    if not isinstance(name, Schedule):
        check_choice(name, SCHEDULES, f"a schedule among {', '.join(SCHEDULES)}")
        name = SCHEDULES[name]
    return name if steps is None else dataclasses.replace(name, steps=steps)


def choose_schedule(laws: Sequence[Law], stated: str | Schedule | None = None) -> Schedule:
    """Return the stated schedule; where none is, that of the laws, and `fast` where these differ."""
    names = {law.schedule for law in laws}
    return schedule((names.pop() if len(names) == 1 else "fast") if stated is None else stated)
