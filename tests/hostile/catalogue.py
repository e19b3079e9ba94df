"""All cases, and the quick part of them."""

from __future__ import annotations

from itertools import zip_longest

from . import belongings, bombs, damage, designs, disks, documents, names, options, signals, together
from .case import Case, dice, unique

#: Modules of a class each, or of some.
_CLASSES = (damage, options, documents, designs, bombs, names, belongings, signals, disks, together)
#: Cases of the quick part, by class.
SHARES = {
    "damage": 24, "damage-command": 4, "options": 16, "documents": 14, "designs": 8, "bombs": 8, "names": 12,
    "belongings": 10, "signals": 4, "disks": 5, "together": 3,
}  # fmt: skip


def all_cases(seed: int) -> list[Case]:
    """Every case of a seed."""
    return unique(case for each in _CLASSES for case in each.cases(seed))


def quick_part(cases: list[Case], seed: int) -> list[Case]:
    """Some short cases of every class, by turns from its groups, which the seed shuffles."""
    groups: dict[str, dict[str, list[Case]]] = {}
    for case in cases:
        if case.quick:
            kind, group, *_ = case.id.split("/")
            groups.setdefault(kind, {}).setdefault(group, []).append(case)
    chosen: set[str] = set()
    for kind, inner in groups.items():
        rng = dice(seed, f"quick {kind}")
        rows = [rng.sample(group, len(group)) for group in inner.values()]
        rng.shuffle(rows)
        turns = [case.id for turn in zip_longest(*rows) for case in turn if case is not None]
        chosen.update(turns[: SHARES[kind]])
    return [case for case in cases if case.id in chosen]
