"""Which parameters to draw: Experiment 4's random law, other boxes, Sobol's sequence, lists; one stream a draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from scipy.stats import qmc

from curvafit.core.checks import SEEDS, as_tuple, check_choice, check_float, check_int, quoted, seed_of
from curvafit.priors.coefficients import NAMES, POWERS, Coefficients, check_strength
from curvafit.priors.grid import WORKING_EPSILON

#: Open intervals of the uniform law, in working units; a20 = 1 is the gauge (paper, "Experiment 4").
INTERVALS: dict[str, tuple[float, float]] = {
    "a11": (-4.0, 4.0),
    "a02": (1 / 15, 15.0),
    "a10": (-200.0, 200.0),
    "a01": (-200.0, 200.0),
    "a00": (-3000.0, 3000.0),
    "mass": (-0.75, -0.15),
}
#: Parameters of a draw, in the order of a point.
PARAMETERS: tuple[str, ...] = (*NAMES, "mass")
#: Least and greatest spread of a box around a point.
SPREADS = (1e-9, 100.0)
Law = Literal["random", "sobol", "list"]


class Draw(NamedTuple):
    """Parameters in working units, and the seed of the white noise, a number below 2³²."""

    coefficients: Coefficients
    mass: float
    seed: int


@dataclass(frozen=True)
class Design:
    """A sequence of parameters, the same for ever for a seed: draw i depends on (seed, i) alone.

    Parameters
    ----------
    law
        `"random"`: uniform and independent in a box. `"sobol"`: the same box, filled evenly by a scrambled Sobol
        sequence. `"list"`: the points in turn, again and again with other noise.
    box
        Intervals of (a20, a11, a02, a10, a01, a00, m₀) in working units; of no width where a parameter is fixed.
    points
        Points of seven numbers, for `"list"`.
    log
        Names of the parameters whose logarithm the box holds uniformly; their intervals are above 0.

    Raises
    ------
    ValueError
        If the law has another name, there is no box or no point, an interval is not one, m₀ leaves (-1, 1), or no flow
        takes a coefficient that large (`generation.cost`).
    """

    law: Law
    box: tuple[tuple[float, float], ...] = ()
    points: tuple[tuple[float, ...], ...] = ()
    log: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_choice(self.law, get_args(Law), f"a law among {', '.join(get_args(Law))}")
        for name in ("box", "points"):
            rows = (as_tuple(row, f"numbers in each row of {name}") for row in as_tuple(getattr(self, name), name))
            object.__setattr__(self, name, tuple(rows))
        if any(len(interval) != 2 for interval in self.box):
            raise ValueError("expected intervals of two numbers in a box, got one of another length")
        rows = self.points if self.law == "list" else tuple(zip(*self.box, strict=True))
        if not rows or any(len(row) != len(PARAMETERS) for row in rows):
            raise ValueError(f"expected {len(PARAMETERS)} parameters ({', '.join(PARAMETERS)}) for a {self.law} design")
        for value in (value for row in rows for value in row):
            check_float(value, "finite parameters in a design")
        for name, interval in zip(PARAMETERS, self.box, strict=False):
            if interval[0] > interval[1]:
                raise ValueError(f"expected an interval of {name} from low to high, got {list(interval)}")
        object.__setattr__(self, "log", _logarithmic(self.log, self.box))
        for row in rows:
            if not -1 < row[-1] < 1:
                raise ValueError(f"expected masses in (-1, 1), got {row[-1]}")
            for name, value in zip(NAMES, row, strict=False):
                check_strength(name, value, POWERS[name], WORKING_EPSILON)

    def draw(self, seed: int, index: int) -> Draw:
        """Draw `index` of a seed, both whole numbers from 0.

        Raises
        ------
        ValueError
            If the seed or the index is not a whole number from 0.
        """
        start = int(_stream(seed, index, "start").generate_state(1)[0])
        if self.law == "list":
            values = self.points[index % len(self.points)]
        else:
            values = list(map(self._value, PARAMETERS, self.box, self._shares(seed, index)))
        return Draw(Coefficients(*map(float, values[:-1])), float(values[-1]), start)

    def as_dict(self) -> dict[str, Any]:
        """Return the design in JSON's types, for a store's record."""
        rows = {"points": self.points} if self.law == "list" else {"box": self.box}
        log = {"log": list(self.log)} if self.log else {}
        return {"law": self.law} | {name: [list(row) for row in value] for name, value in rows.items()} | log

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Design:
        """Return what `as_dict` wrote.

        Raises
        ------
        ValueError
            If it is none.
        """
        try:
            box, points = (tuple(map(tuple, content.get(name, ()))) for name in ("box", "points"))
            sound = all(len(row) == 2 for row in box) and all(
                map(_is_number, [each for row in box + points for each in row])
            )
        except (TypeError, AttributeError):
            box, points, sound = (), (), False
        if not sound or "law" not in content:
            raise ValueError(f"expected a design's law and box or points, got {quoted(content)}")
        return Design(content["law"], box, points, content.get("log", ()))

    def _value(self, name: str, interval: tuple[float, float], share: float) -> float:
        """Return the value of a parameter that lies a share into an interval."""
        low, high = interval
        return low * (high / low) ** share if name in self.log else low + (high - low) * share

    def _shares(self, seed: int, index: int) -> list[float]:
        """Return how far into each interval the draw lies, 0 to 1. A fixed parameter takes no random number."""
        free = [low < high for low, high in self.box]
        if self.law == "random":
            values = np.random.default_rng(_stream(seed, index, "parameters")).random(sum(free))
        else:
            engine = qmc.Sobol(sum(free), scramble=True, rng=np.random.default_rng(_stream(seed, 0, "parameters")))
            values = (engine.fast_forward(index) if index else engine).random(1)[0]
        shares = iter(values.tolist())
        return [next(shares) if moves else 0.0 for moves in free]


def boxed(law: Law = "random", log: Sequence[str] = (), /, **intervals: float | Sequence[float]) -> Design:
    """Return a box: Experiment 4's, but for the intervals or fixed values that are given by name; uniform in the
    logarithm of the parameters in `log`.

    Raises
    ------
    ValueError
        If a name is not a parameter's, or a value is neither a number nor two of them.
    """
    unknown = set(intervals) - set(PARAMETERS)
    if unknown:
        raise ValueError(f"expected parameters among {', '.join(PARAMETERS)}, got {', '.join(sorted(unknown))}")
    asked = {name: _interval(name, value) for name, value in intervals.items()}
    whole: dict[str, tuple[float, float]] = {"a20": (1.0, 1.0), **INTERVALS, **asked}
    return Design(law, tuple(whole[name] for name in PARAMETERS), log=log)  # type: ignore[arg-type]


def around(point: Sequence[float], spread: float, law: Law = "random") -> Design:
    """Return a box around seven numbers, brought to a20 = 1: `spread` times as wide as Experiment 4's; a02 and m₀ in
    range.

    Raises
    ------
    ValueError
        If the spread is not positive or over 100, or the point is not seven numbers with a20 > 0.
    """
    spread = check_float(spread, "a positive spread", *SPREADS)
    point = as_tuple(point, "seven numbers as a point")
    if len(point) != len(PARAMETERS):
        raise ValueError(f"expected a point of {len(PARAMETERS)} numbers ({', '.join(PARAMETERS)}), got {len(point)}")
    check_float(point[0], "a point with a20 > 0", 1e-6, 1e6)
    centre = dict(zip(PARAMETERS, (*(value / point[0] for value in point[:-1]), point[-1]), strict=True))
    box = {name: _near(centre[name], spread * (high - low) / 2) for name, (low, high) in INTERVALS.items()}
    least = INTERVALS["a02"][0]
    box["a02"] = (max(box["a02"][0], least), max(box["a02"][1], least))
    box["mass"] = (max(box["mass"][0], -0.99), min(box["mass"][1], 0.99))
    return boxed(law, **box)


def _logarithmic(names: Sequence[str], box: Sequence[tuple[float, float]]) -> tuple[str, ...]:
    """Check the names of the parameters that a box holds in logarithms."""
    names = as_tuple(names, "names of parameters in log")
    positive = [name for name, (low, _) in zip(PARAMETERS, box, strict=False) if low > 0]
    for name in names:
        if name not in positive:
            raise ValueError(f"expected in log parameters whose interval is above 0, got {quoted(name)}")
    return tuple(names)


def _near(centre: float, half: float) -> tuple[float, float]:
    return centre - half, centre + half


def _interval(name: str, value: Any) -> tuple[float, float]:
    pair = [value, value] if isinstance(value, Real) else value
    if not isinstance(pair, (list, tuple)) or len(pair) != 2 or not all(_is_number(end) for end in pair):
        raise ValueError(f"expected {name} as a number or two of them, got {quoted(value)}")
    return float(pair[0]), float(pair[1])


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _stream(seed: int, index: int, purpose: str) -> np.random.SeedSequence:
    index = check_int(index, "an index that is a whole number from 0", 0, SEEDS - 1)
    return np.random.SeedSequence(seed_of(seed), spawn_key=(index, ("parameters", "start").index(purpose)))
