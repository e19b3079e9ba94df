"""YAML read safely: what a design goes through."""

from __future__ import annotations

import math
from typing import Any

import yaml

from curvafit.core.checks import quoted
from curvafit.core.records import DIGITS, repeated

#: Values of a text at most, each counted wherever an alias repeats it.
_MOST = 1_000_000


class _Loader(yaml.SafeLoader):
    """Plain values; a key that stands twice and a number of no end are errors."""


def parse_yaml(content: bytes, expected: str, place: object) -> Any:
    """Return the value of a YAML text in UTF-8.

    Parameters
    ----------
    expected, place
        What the text should be and where it stands, for the sentence of an error.

    Raises
    ------
    ValueError
        If it is no YAML, nested too deeply, names a key twice, repeats itself beyond a million values, or holds a whole
        number of more than 40 digits.
    """
    try:
        loader = _Loader(content.decode().removeprefix("\ufeff"))
        node = loader.get_single_node()
        if node is None:
            return None
        _size(node, {})
        return loader.construct_document(node)
    except UnicodeDecodeError:
        reason = "no text in UTF-8"
    except RecursionError:
        reason = "what is nested too deeply"
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = str(getattr(error, "problem", None) or error)
        reason = f"{problem[:160]} in line {mark.line + 1}" if mark else problem[:160]
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:  # a tag that its value is not
        reason = str(error)[:160]
    raise ValueError(f"expected {expected}, got {place}: {' '.join(reason.split())}")


def _size(node: yaml.Node, known: dict[int, float]) -> float:
    """Return how many values a node holds when its aliases are written out; one within itself has no end."""
    if id(node) in known:
        if known[id(node)] > _MOST:
            raise ValueError(f"more than {_MOST:,} values, with what its aliases repeat")
        return known[id(node)]
    known[id(node)] = math.inf
    pairs = node.value if isinstance(node, yaml.CollectionNode) else ()
    parts = [each for pair in pairs for each in (pair if isinstance(pair, tuple) else (pair,))]
    known[id(node)] = 1 + sum(_size(part, known) for part in parts)
    return _size(node, known)


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    names = [(key.tag, key.value) for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
    if (name := repeated(names)) is not None:
        raise ValueError(f"the key {quoted(name[1])} twice in line {node.start_mark.line + 1}")
    loader.flatten_mapping(node)
    return loader.construct_mapping(node, deep=True)


def _whole(loader: _Loader, node: yaml.ScalarNode) -> int:
    if len(node.value) > DIGITS:
        raise ValueError(f"a number of {len(node.value)} digits in line {node.start_mark.line + 1}")
    return loader.construct_yaml_int(node)


def _truth(loader: _Loader, node: yaml.ScalarNode) -> bool:
    if str(node.value).lower() not in loader.bool_values:
        raise ValueError(f"{quoted(node.value)}, which is neither true nor false")
    return loader.construct_yaml_bool(node)


_Loader.add_constructor("tag:yaml.org,2002:map", _mapping)
_Loader.add_constructor("tag:yaml.org,2002:int", _whole)
_Loader.add_constructor("tag:yaml.org,2002:bool", _truth)
