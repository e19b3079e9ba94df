"""Designs: sequences of parameters for an atlas (from a box, a list, or around a point), and their YAML files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import yaml
from scipy.stats import qmc

from curvafit.core.checks import SEEDS, as_tuple, check_choice, check_float, check_int, check_open_interval, quoted
from curvafit.priors.coefficients import NAMES, Coefficients, check_strengths
from curvafit.priors.grid import WORKING_EPSILON
from curvafit.priors.law import Law

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
#: Width of a box around a point as a multiple of Experiment 4's.
SPREAD = 0.1
#: The kinds of file by their main key, with the optional keys of each.
KEYS: dict[str, tuple[str, ...]] = {"box": ("law", "log"), "around": ("law", "spread"), "list": ()}

#: How the points of a design are chosen.
Sampling = Literal["random", "sobol", "list"]


class Draw(NamedTuple):
    """Parameters in working units, and the seed of the white noise, a number below 2³²."""

    coefficients: Coefficients
    mass: float
    seed: int


@dataclass(frozen=True)
class Design:
    """A sequence of parameters that a seed reproduces: draw i depends on (seed, i) alone.

    Sampling is `"random"`, uniform and independent in a box; `"sobol"`, the same box, filled evenly by a scrambled
    Sobol sequence; or `"list"`, the points of seven numbers in turn, again and again with other noise. The box holds
    intervals of (a20, a11, a02, a10, a01, a00, m₀) in working units; a fixed one has equal ends. Parameters named in
    `log` are uniform in the logarithm; their intervals are above 0. A parameter out of range is a ValueError.
    """

    sampling: Sampling
    box: tuple[tuple[float, float], ...] = ()
    points: tuple[tuple[float, ...], ...] = ()
    log: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_choice(self.sampling, get_args(Sampling), f"a sampling among {', '.join(get_args(Sampling))}")
        for name in ("box", "points"):
            rows = (as_tuple(row, f"numbers in each row of {name}") for row in as_tuple(getattr(self, name), name))
            object.__setattr__(self, name, tuple(rows))
        if any(len(interval) != 2 for interval in self.box):
            raise ValueError("an interval in a box must be two numbers")
        # Points to check: those of a list, or the lowest and the highest corner of the box.
        rows = self.points if self.sampling == "list" else tuple(zip(*self.box, strict=True))
        if not rows or any(len(row) != len(PARAMETERS) for row in rows):
            raise ValueError(f"a {self.sampling} design needs {len(PARAMETERS)} parameters ({', '.join(PARAMETERS)})")
        for name, value in (item for row in rows for item in zip(PARAMETERS, row, strict=True)):
            check_float(value, f"{name} as finite numbers")
        for name, interval in zip(PARAMETERS, self.box, strict=False):
            if interval[0] > interval[1]:
                raise ValueError(f"the interval of {name} must go from low to high, got {list(interval)}")
        object.__setattr__(self, "log", as_tuple(self.log, "names of parameters in log"))
        positive = [name for name, (low, _) in zip(PARAMETERS, self.box, strict=False) if low > 0]
        if others := [name for name in self.log if name not in positive]:
            raise ValueError(f"log must name parameters whose interval is above 0, got {quoted(others[0])}")
        for row in rows:
            check_open_interval(row[-1], "masses in (-1, 1)", -1, 1)
            check_strengths(row[:-1], WORKING_EPSILON)

    def draw(self, seed: int, index: int) -> Draw:
        """Return the parameters of draw `index` of a seed, both whole numbers from 0."""
        seed = check_int(seed, "a seed that is a whole number from 0", 0, SEEDS - 1)
        index = check_int(index, "an index that is a whole number from 0", 0, SEEDS - 1)
        noise_seed = np.random.SeedSequence(seed, spawn_key=(index, 1)).generate_state(1)[0]
        values = self.points[index % len(self.points)] if self.sampling == "list" else self._draw_from_box(seed, index)
        return Draw(Coefficients(*map(float, values[:-1])), float(values[-1]), int(noise_seed))

    def __str__(self) -> str:
        domain = f"of {len(self.points)} points" if self.points else f"in {list(map(list, self.box))}"
        return f"{self.sampling} {domain}"

    def as_dict(self) -> dict[str, Any]:
        """Return the design in JSON's types, for a store's record."""
        name, rows = ("points", self.points) if self.sampling == "list" else ("box", self.box)
        return {"law": self.sampling, name: list(map(list, rows))} | ({"log": list(self.log)} if self.log else {})

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Design:
        """Return the design that `as_dict` wrote, or raise ValueError."""
        if not isinstance(content, Mapping) or "law" not in content:
            raise ValueError(f"a design has a law and a box or points, got {quoted(content)}")
        return Design(content["law"], *(content.get(name, ()) for name in ("box", "points", "log")))

    def _draw_from_box(self, seed: int, index: int) -> list[float]:
        """Return the parameters of a draw; one that is fixed takes no random number."""
        dimension = sum(low < high for low, high in self.box)
        stream = index if self.sampling == "random" else 0  # one scrambling for all points of a Sobol sequence
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream, 0)))
        if self.sampling == "random":
            point = rng.random(dimension)
        else:
            engine = qmc.Sobol(dimension, scramble=True, rng=rng)
            point = (engine.fast_forward(index) if index else engine).random(1)[0]
        coordinates, values = iter(point.tolist()), []
        for name, (low, high) in zip(PARAMETERS, self.box, strict=True):
            fraction = next(coordinates) if low < high else 0.0
            values.append(low * (high / low) ** fraction if name in self.log else low + (high - low) * fraction)
        return values


def design_box(
    sampling: Sampling = "random", log: Sequence[str] = (), /, **intervals: float | Sequence[float]
) -> Design:
    """Return a design in Experiment 4's box, with given intervals or fixed values by name; see `Design` for `log`."""
    unknown = set(intervals) - set(PARAMETERS)
    if unknown:
        raise ValueError(f"parameters are {', '.join(PARAMETERS)}, got {', '.join(sorted(unknown))}")
    box: dict[str, Any] = {"a20": (1.0, 1.0), **INTERVALS}
    box |= {name: (value, value) if isinstance(value, Real) else value for name, value in intervals.items()}
    return Design(sampling, tuple(box[name] for name in PARAMETERS), log=log)  # type: ignore[arg-type]


def design_around(point: Sequence[float], spread: float, sampling: Sampling = "random") -> Design:
    """Return a box around a point of seven numbers, `spread` times as wide as Experiment 4's.

    The point is scaled to a20 = 1, and the box is cut to a02 ≥ 1/15 and m₀ in [-0.99, 0.99].
    """
    spread = check_float(spread, "a positive spread", 1e-9, 100.0)
    point = as_tuple(point, "seven numbers as a point")
    if len(point) != len(PARAMETERS):
        raise ValueError(f"a point is {len(PARAMETERS)} numbers ({', '.join(PARAMETERS)}), got {len(point)}")
    check_float(point[0], "a point with a20 > 0", 1e-6, 1e6)
    centre = dict(zip(PARAMETERS, (*(value / point[0] for value in point[:-1]), point[-1]), strict=True))
    half = {name: spread * (high - low) / 2 for name, (low, high) in INTERVALS.items()}
    box = {name: (centre[name] - half[name], centre[name] + half[name]) for name in INTERVALS}
    least = INTERVALS["a02"][0]
    box["a02"] = (max(box["a02"][0], least), max(box["a02"][1], least))
    box["mass"] = (max(box["mass"][0], -0.99), min(box["mass"][1], 0.99))
    return design_box(sampling, **box)


def read_design(path: str | PathLike[str]) -> Design:
    """Read a design from a YAML file; docs/howto/atlas.md has its keys. Raises FileNotFoundError or ValueError."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"found no file {path}")
    try:
        content = yaml.safe_load(path.read_bytes().decode().removeprefix("\ufeff"))
    except (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        # deep nesting and values with a wrong YAML tag raise the last six
        raise ValueError(f"{path} is not YAML: {' '.join(str(error).split())[:200]}") from error
    try:
        return _decode_design(content, path.parent)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_point(source: Any, folder: Path = Path()) -> tuple[float, ...]:
    """Return the seven numbers of a law: a preset's name, a `fit.json` in `folder`, or the numbers by name."""
    if isinstance(source, str):
        return Law.of(folder / source if source.endswith(".json") else source).point
    if not isinstance(source, Mapping) or set(source) != set(PARAMETERS):
        raise ValueError(f"a point is a preset, a fit.json or {', '.join(PARAMETERS)}, got {quoted(source)}")
    return tuple(check_float(_parse_number(source[name]), f"a number for {name}") for name in PARAMETERS)


def _decode_design(content: Any, folder: Path) -> Design:
    main_keys = [key for key in KEYS if key in content] if isinstance(content, Mapping) else []
    if len(main_keys) != 1:
        raise ValueError(f"a design has one of the keys {', '.join(KEYS)}, got {quoted(content)}")
    (main_key,) = main_keys
    if unknown := [key for key in content if key not in (main_key, *KEYS[main_key])]:
        raise ValueError(f"a design with the key {main_key} has no key {quoted(unknown[0])}")
    if main_key == "list":
        points = as_tuple(content["list"], "points in list")
        return Design("list", points=tuple(read_point(point, folder) for point in points))
    sampling = content.get("law", "random")
    if main_key == "around":
        spread = _parse_number(content.get("spread", SPREAD))
        return design_around(read_point(content["around"], folder), spread, sampling)
    if not isinstance(content["box"], Mapping):
        raise ValueError(f"box must hold names and intervals, got {quoted(content['box'])}")
    intervals = {str(name): _parse_number(value) for name, value in content["box"].items()}
    return design_box(sampling, content.get("log", ()), **intervals)


def _parse_number(value: Any) -> Any:
    """Return a value or a list of YAML, with texts that are numbers, such as 1e3 (text to YAML), as numbers."""
    if isinstance(value, list):
        return [_parse_number(end) if isinstance(end, str) else end for end in value]
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value
