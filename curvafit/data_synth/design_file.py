"""A design written down: a YAML file with a box, the surroundings of a point, or a list of points."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from curvafit.core.checks import check_float, quoted
from curvafit.data_synth.design import PARAMETERS, Design, around, boxed
from curvafit.data_synth.yaml_text import parse_yaml
from curvafit.priors.law import texture_of

#: The kinds of design, and the keys that may stand beside each.
KEYS = {"box": {"law", "log"}, "around": {"law", "spread"}, "list": set()}
#: Share of Experiment 4's intervals that the surroundings of a point span.
SPREAD = 0.1


def read_design(path: str | PathLike[str]) -> Design:
    """Read a design; see docs/howto/atlas.md for its keys.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no such file, or it is not YAML, has unknown keys, or is no design (`Design`).
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"expected a design in YAML, found no file {path}")
    content = parse_yaml(Path(path).read_bytes(), "a design in YAML", path)
    try:
        return _design(content, Path(path).parent)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def point_of(source: Any, folder: Path = Path()) -> tuple[float, ...]:
    """Return the seven numbers of a law: of a preset's name, of a `fit.json` (beside `folder` where its path is
    relative), or by name.

    Raises
    ------
    FileNotFoundError, ValueError
        If it is none of these, or a number is missing.
    """
    if isinstance(source, str):
        return texture_of(folder / source if source.endswith(".json") else source).point
    if not isinstance(source, Mapping) or set(source) != set(PARAMETERS):
        raise ValueError(f"expected a preset, a fit.json or {', '.join(PARAMETERS)}, got {quoted(source)}")
    try:
        return tuple(float(source[name]) for name in PARAMETERS)
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected numbers for {', '.join(PARAMETERS)}, got {quoted(source)}") from error


def _design(content: Any, folder: Path) -> Design:
    kind = _kind(content)
    if kind == "list":
        if not isinstance(content["list"], list):
            raise ValueError(f"expected a list of points, got {quoted(content['list'])}")
        return Design("list", points=tuple(point_of(each, folder) for each in content["list"]))
    law = content.get("law", "random")
    if law not in ("random", "sobol"):
        raise ValueError(f"expected a law random or sobol, got {quoted(law)}")
    if kind == "around":
        return around(point_of(content["around"], folder), _spread(content.get("spread", SPREAD)), law)
    if not isinstance(content["box"], Mapping):
        raise ValueError(f"expected a box of names and intervals, got {quoted(content['box'])}")
    log = content.get("log", [])
    if not isinstance(log, list):
        raise ValueError(f"expected a list of parameters in log, got {quoted(log)}")
    return boxed(law, log, **{str(name): _number(value) for name, value in content["box"].items()})


def _kind(content: Any) -> str:
    """Return which of the three a file is; every key must be known."""
    if not isinstance(content, Mapping):
        raise ValueError(f"expected the keys of a design ({', '.join(KEYS)}), got {quoted(content)}")
    kinds = [key for key in KEYS if key in content]
    known = set(KEYS) | set().union(*KEYS.values())
    for key in content:
        if key not in known:
            raise ValueError(f"expected keys among {', '.join(sorted(known))}, got {quoted(key)}")
    if len(kinds) != 1:
        raise ValueError(f"expected one of the keys {', '.join(KEYS)}, got {' and '.join(kinds) or 'none'}")
    for key in set(content) - KEYS[kinds[0]] - {kinds[0]}:
        raise ValueError(f"expected no key {quoted(key)} beside {kinds[0]!r}")
    return kinds[0]


def _number(value: Any) -> Any:
    """Return the value, but for numbers that YAML takes for text, such as 1e3."""
    if isinstance(value, list):
        return [_number(each) for each in value]
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _spread(value: Any) -> float:
    value = _number(value)
    return check_float(value, "a spread that is a number")
