"""What `--suggest` gains: a volume filled with three more slices that it names, or that others choose.

Every 16th slice of 36 blocks of real structures (`completion`) is known, and every 8th of four grown shapes; with
`--irregular` each but the first and the last is off by up to a quarter of that. The rivals:

- `even`: as many slices in all, equally far apart, as if none were annotated yet;
- `spread`: the middles of three gaps that are spread over the volume;
- `middle`: the middle of the largest gap, the first of equals, three times;
- `random`: chance.

Dice counts the slices that no way knows, between the first and the last known one. Nothing was chosen on these volumes
but the network's mix and the mask's threshold, on `completion.CHOSEN_ON`.
"""

from __future__ import annotations

import argparse
from functools import partial
from itertools import product

import numpy as np

from benchmarks.completion import CHOSEN_ON, FEW, LAWS, STRUCTURES, blocks, shape
from benchmarks.harness import Cases, Figure, Values, bootstrap, show
from curvafit.segmentation.reconstruct import reconstruct
from curvafit.segmentation.trials import dice
from curvafit.volumes.field import Field

#: Slices that are added, and the shapes' seed.
MORE, SEED = 3, 2
RIVALS = ("even", "spread", "middle", "random")


def rival_places(way: str, known: list[int], random: np.random.Generator) -> list[int]:
    """Return the known slices and those that a rival adds; or `even` ones, which are all new but the outermost."""
    if way == "even":
        return np.linspace(known[0], known[-1], len(known) + MORE).round().astype(int).tolist()
    if way == "random":
        return sorted(
            [*known, *random.choice(sorted(set(range(known[-1])) - set(known)), MORE, replace=False).tolist()]
        )
    places, gaps = list(known), np.linspace(0, len(known) - 2, MORE + 2).round().astype(int)[1:-1]
    for gap in gaps:
        k = places.index(known[gap]) if way == "spread" else int(np.argmax(np.diff(places)))
        places.insert(k + 1, (places[k] + places[k + 1]) // 2)
    return places


def case(number: int, kind: str, name: str, block: int, irregular: bool, cases: Cases) -> Values:
    if kind == "shapes":
        truth, axis, every = Field(shape(name, SEED, cases)), 0, 8
    else:
        truth, every = blocks(name, int(kind))[block], 16
        axis = int(truth.shape[0] < FEW)
    length, random = (truth.shape[axis] - 1) // every * every + 1, np.random.default_rng(number)
    known = list(range(0, length, every))
    if irregular:
        known[1:-1] = (np.array(known[1:-1]) + random.integers(-every // 4, every // 4 + 1, len(known) - 2)).tolist()
    truth = truth.crop(tuple(slice(0, length if k == axis else n) for k, n in enumerate(truth.shape)))
    before = reconstruct(truth, known=known, axis=axis, suggest=MORE)
    assert before.uncertainty is not None
    places = {way: rival_places(way, known, random) for way in RIVALS}
    places |= {"before": known, "suggest": sorted([*known, *before.uncertainty.suggestions])}
    judged = [k for k in range(length) if not any(k in each for each in places.values())]
    masks = {way: reconstruct(truth, known=each, axis=axis).mask for way, each in places.items() if way != "before"}
    inside, *filled = (np.moveaxis(each.values > 0, axis, 0)[judged] for each in (truth, *masks.values(), before.mask))
    scores = {way: dice(mask, inside) for way, mask in zip((*masks, "before"), filled, strict=True)}
    return {**scores, "places": {way: sorted(set(each) - set(known)) for way, each in places.items()}}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--irregular", action="store_true", help="known slices are not equally far apart")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    volumes = [(str(side), *each) for name in STRUCTURES for side in (0, 1)
               for each in product([name], range(STRUCTURES[name].targets))]  # fmt: skip
    volumes = [*volumes, *(("shapes", law, 0) for law in LAWS[:4])]
    group = "irregular" if options.irregular else "regular"
    jobs = {
        f"{group}-{name}-{kind}-{block}": partial(case, number, kind, name, block, options.irregular, cases)
        for number, (kind, name, block) in enumerate(volumes[: 1 if options.quick else None])
    }
    found = list(cases.all(jobs).values())
    seen = [kind == "shapes" or int(kind) in CHOSEN_ON.get(name, ()) for kind, name, _ in volumes]
    figures: dict[str, Figure] = {}
    unseen = [row for row, known in zip(found, seen, strict=False) if not known]
    for which, rows in (("all", found), ("report", unseen))[: 2 if unseen else 1]:
        for rival in (*RIVALS, "before"):
            gain = 100 * np.array([row["suggest"] - row[rival] for row in rows])
            figures[f"suggest.{group}_{which}.{rival}"] = bootstrap(gain, np.mean)
        figures[f"suggest.{group}_{which}.dice"] = bootstrap([row["suggest"] for row in rows], np.mean)
    show(["Dice, and gain of --suggest in points", "mean"], list(figures.items()), f"{len(found)} volumes, {group}")
    return figures
