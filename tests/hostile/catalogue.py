"""All cases, and the quick part of them."""

from __future__ import annotations

from . import belongings, bombs, damage, designs, disks, documents, names, options, signals, together
from .case import Case, dice, unique

#: Modules of a class each, or of some.
_CLASSES = (damage, options, documents, designs, bombs, names, belongings, signals, disks, together)
#: Cases of the quick part.
QUICK = 150


def all_cases(seed: int) -> list[Case]:
    """Every case of a seed."""
    return unique(case for each in _CLASSES for case in each.cases(seed))


def quick_part(cases: list[Case], seed: int) -> list[Case]:
    """About `QUICK` cases, of every class some, of every group of a class at least one, where it has short ones."""
    groups: dict[str, list[Case]] = {}
    for case in cases:
        if case.quick:
            groups.setdefault("/".join(case.id.split("/")[:2]), []).append(case)
    rng, chosen = dice(seed, "quick"), set()
    for group in groups.values():
        rng.shuffle(group)
        chosen.add(group.pop().id)
    while len(chosen) < QUICK and any(groups.values()):
        for group in groups.values():
            if group and len(chosen) < QUICK:
                chosen.add(group.pop().id)
    return [case for case in cases if case.id in chosen]
