"""Probabilities of a volume between slices, and the slices that they suggest, on generated shapes.

    python -m benchmarks.uncertainty [--laws tubes,sponge,…] [--target 2] [--ways grown,example] [-o uncertainty]
    python -m benchmarks.uncertainty --suggest [--laws …] [--target 2] [--starts even,irregular,straight]

Shapes and fits are those of `benchmarks.completion`: crops of 64³, the law inferred from another seed's mask. Chosen on
target 2, reported on target 4.

Calibration, every 8, 8 runs, on the unknown slices between the first and the last known one. `grown` and `example` say
on what the probabilities were fitted: a shape grown from the inferred law, or the other seed's mask.

- `ece`: expected calibration error within 3 voxels of the surface of probability 1/2; `all`: everywhere; `true`: within
  3 voxels of the true surface, which no map can know; `said`: what `reconstruct` says of itself.
- `mask`, `half`: Dice of the mask, and of where the probability is above 1/2.

Suggestions, of 64 x 40 x 40 voxels of the shapes: three slices are added one after another, each suggested by 8 runs
(`suggested`), or each in the middle of the largest gap (`middle`). Dice of the whole volume before, and after each.

- `even`: slices 0, 21, 42 and 63 are known, where the middles are even spacing; `irregular`: 0, 5, 10, 40 and 63.
- `straight`: as `even`, but from slice 32 on the shape goes on straight, so that half of the volume needs no slice.

Finished cases stay in the folder: a second run goes on. `--seconds` ends a run early.
"""

from __future__ import annotations

import argparse
import json
import time
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.completion import EDGE, fitted, shape
from curvafit.core.files import write_content
from curvafit.segmentation.completion import reconstruct
from curvafit.segmentation.ensemble import RUNS, near
from curvafit.segmentation.probability import calibration_error

EVERY = 8
STARTS = {"even": (0, 21, 42, 63), "irregular": (0, 5, 10, 40, 63), "straight": (0, 21, 42, 63)}
ADDED = 3
PLANE = 40


def dice(mask: np.ndarray, truth: np.ndarray) -> float:
    return 2 * float((mask & truth).sum()) / float(mask.sum() + truth.sum())


def calibration(law: str, seed: int, way: str, folder: Path) -> dict:
    """Calibration errors and Dice of a shape, computed once."""
    path = folder / f"calibration-{law}-{seed}-{way}.json"
    if not path.exists():
        begun, truth = time.process_time(), shape(law, seed, folder)
        other = {"example": shape(law, seed + 1, folder).astype(np.uint8)} if way == "example" else {}
        found = reconstruct(truth.astype(np.uint8), fitted(law, seed + 1, folder), every=EVERY, runs=RUNS, **other)
        p, between = found.probability.values, [n for n in range((EDGE - 1) // EVERY * EVERY) if n % EVERY]
        bands = {"ece": near(p > 0.5), "true": near(truth), "all": np.ones_like(truth)}
        errors = {
            name: calibration_error(p[between][band[between]], truth[between][band[between]])
            for name, band in bands.items()
        }
        scores = {
            name: dice(each[between], truth[between]) for name, each in (("mask", found.mask.values), ("half", p > 0.5))
        }
        more = {"said": found.uncertainty.calibration_error, "status": found.status}
        write_content(path, json.dumps({**errors, **scores, **more, "seconds": time.process_time() - begun}))
    return json.loads(path.read_text())


def addition(way: str, law: str, seed: int, start: str, folder: Path) -> dict:
    """Slices added in a way, and Dice before and after each, computed once."""
    path = folder / f"addition-{way}-{law}-{seed}-{start}.json"
    if not path.exists():
        begun, fit = time.process_time(), fitted(law, seed + 1, folder)
        truth = shape(law, seed, folder)[:, :PLANE, :PLANE]
        if start == "straight":
            truth = np.concatenate(
                [truth[: EDGE // 2], np.repeat(truth[EDGE // 2 - 1][None], EDGE - EDGE // 2, axis=0)]
            )
        known, scores, said = list(STARTS[start]), [], []
        for left in range(ADDED, -1, -1):
            suggest = min(left, 1) if way == "suggested" else 0
            found = reconstruct(truth.astype(np.uint8), fit, known=known, suggest=suggest)
            scores.append(dice(found.mask.values, truth))
            said.append(found.status)
            if left:
                known.append(found.uncertainty.suggestions[0] if suggest else middle(known))
        more = {"added": known[-ADDED:], "status": said, "seconds": time.process_time() - begun}
        write_content(path, json.dumps({"dice": scores, **more}))
    return json.loads(path.read_text())


def middle(known: list[int]) -> int:
    """The middle of the largest gap, the first of those as large."""
    places = sorted(known)
    gaps = np.diff(places)
    return int(places[gaps.argmax()] + gaps.max() // 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laws", default="tubes,sponge,trabec,pearls")
    parser.add_argument("--target", type=int, default=2, help="seed of the target; the law's is the next")
    parser.add_argument("--ways", default="grown,example")
    parser.add_argument("--suggest", action="store_true", help="suggestions in place of calibration")
    parser.add_argument("--starts", default=",".join(STARTS))
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("-o", "--output", type=Path, default=Path("uncertainty"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    laws, begun = options.laws.split(","), time.monotonic()
    cases = product(laws, (options.starts if options.suggest else options.ways).split(","))
    for law, how in cases:
        if time.monotonic() - begun > options.seconds:
            break
        if options.suggest:
            for way in ("middle", "suggested"):
                found = addition(way, law, options.target, how, options.output)
                scores = " ".join(f"{each:.4f}" for each in found["dice"])
                print(f"{law:9}{how:10}{way:10}{scores}  added {found['added']}", flush=True)
        else:
            found = calibration(law, options.target, how, options.output)
            scores = " ".join(f"{name} {found[name]:.4f}" for name in ("ece", "all", "true", "said", "mask", "half"))
            print(f"{law:9}{how:9}{scores}  {found['status']}", flush=True)


if __name__ == "__main__":
    main()
