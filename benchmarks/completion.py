"""The volume between known slices: plain interpolations and F_ε, on generated shapes.

    python -m benchmarks.completion [--laws tubes,trabec,…] [--every 4,8,12,16] [--target 0] [--ways …] [-o completion]

A shape of 64³ is known at every so many slices, as a box that repeats and as a crop (the same box, not told to repeat).
The law is inferred from the mask of another seed, without growing anything. Dice and the sum of the Betti numbers'
errors count between the first and the last known slice only.

- `spline`, `linear`, `nearest`, `ITK` (its morphological contour interpolation, where its package is installed): plain
  interpolations; the best of them *in hindsight* is what the others are held to.
- `calibrated`: `reconstruct` with the inferred fit, tried out on slices left out; `example`: on the other seed's mask.
- `optimum`, `posterior`, `match`, `true`, `Willmore`: a law, not calibrated; `short`: the setting before (150 steps, no
  blur, and springs that squeeze the profile).

Finished cases stay in the folder: a second run goes on. `--seconds` ends a run early. The table has medians over laws.
`--picture LAW` draws three slices of a crop's truth, spline and completed volume in place of the table.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.completion_ways import ITK, baselines, draw, interpolated, scores, stored
from curvafit.core.files import write_atomically, write_content
from curvafit.generation import data
from curvafit.generation.flow import descend, generate
from curvafit.inference.fit import Fit
from curvafit.inference.infer import infer
from curvafit.priors.coefficients import Coefficients, preset
from curvafit.priors.profile import optimal_profile
from curvafit.segmentation.completion import STIFFNESS, reconstruct
from curvafit.segmentation.engine import stiff
from curvafit.segmentation.slices import WAYS, Slices
from curvafit.segmentation.working import WorkingGrid

LAWS = ("tubes", "trabec", "sponge", "metatubes", "pearls", "sieve", "flow", "bilayers")
EDGE = 64
PRIORS = ("calibrated", "example", "optimum", "posterior", "match", "true", "Willmore", "short")


def shape(law: str, seed: int, folder: Path) -> np.ndarray:
    """A mask of a law, made once."""
    path = folder / f"{law}-{seed}.npy"
    if not path.exists():
        mask = generate(law, grid=EDGE, schedule="deep", seed=seed).field.numpy() > 0
        write_atomically(path, lambda temporary: np.save(temporary, np.packbits(mask)))
    return np.unpackbits(np.load(path)).reshape(EDGE, EDGE, EDGE) > 0


def fitted(law: str, seed: int, folder: Path) -> Fit:
    """The fit of a mask, made once."""
    path = folder / f"fit-{law}-{seed}.json"
    if not path.exists():
        mask = shape(law, seed, folder).astype(np.uint8)
        write_content(path, infer(mask, kind="mask", fast=True, periodic=True).fit.to_json())
    return Fit.load(path)


def completed(way: str, law: str, seed: int, every: int, periodic: bool, folder: Path) -> tuple[np.ndarray, str]:
    """A way's mask, and what it says of itself."""
    truth, places = shape(law, seed, folder), range(0, EDGE, every)
    slices = Slices(truth[places], tuple(places), EDGE, (1.0, 1.0, 1.0), periodic=periodic)
    if way in (*WAYS, ITK):
        return interpolated(slices, way), ""
    fit = fitted(law, seed + 1, folder)
    known = {"every": every, "periodic": periodic}
    if way in ("calibrated", "example"):
        other = {"example": shape(law, seed + 1, folder).astype(np.uint8)} if way == "example" else {}
        found = reconstruct(truth.astype(np.uint8), fit, **known, **other)
    else:
        prior = {"true": preset(law), "Willmore": Coefficients.willmore(), "short": fit}.get(way)
        prior = replace(fit, chosen=way) if prior is None else prior
        if way == "short":
            return _short(slices, fit), ""
        found = reconstruct(truth.astype(np.uint8), prior, stiffness=STIFFNESS, **known)
    return found.mask.values, found.status


def _short(slices: Slices, fit: Fit) -> np.ndarray:
    """The mask of the setting before: 150 steps without a blur, known voxels held at ±1 or beyond."""
    place = WorkingGrid.of(slices.frame, None)
    pull = np.zeros(slices.frame.shape, dtype=np.float32)
    pull[list(slices.places)] = np.where(slices.inside, 1e6, -1e6)
    start = optimal_profile(place.finer(slices.level("spline")), place.epsilon)
    law, spring = stiff(fit.to_prior().coefficients), data.Hinge(place.spread(pull, centre=0))
    options = {"optimiser": "adam", "steps": 150, "blur": 0.0, "data": spring}
    mask = place.back(descend(start, law, place.grid, **options).field) > 0
    mask[list(slices.places)] = slices.inside
    return mask


def case(way: str, law: str, seed: int, every: int, periodic: bool, folder: Path) -> dict:
    """A way's scores between the first and the last known slice, made once."""

    def make() -> dict:
        begun = time.process_time()
        mask, status = completed(way, law, seed, every, periodic, folder)
        between = slice(0, (EDGE - 1) // every * every + 1)
        found = scores(mask[between], shape(law, seed, folder)[between])
        return {**found, "status": status, "seconds": time.process_time() - begun}

    return stored(folder / f"case-{way}-{law}-{seed}-{every}-{'box' if periodic else 'crop'}.json", make)


def table(cases: dict[tuple, dict], laws: list[str], levels: list[int], ways: list[str]) -> None:
    """Medians over laws of Dice, of what it gains on the best interpolation, and of the Betti errors."""
    for periodic, every in product((True, False), levels):
        rows = {way: [cases.get((way, law, every, periodic)) for law in laws] for way in ways}
        whole = [k for k in range(len(laws)) if all(row[k] for row in rows.values())]
        if not whole:
            continue
        best = [max(row[k]["dice"] for way, row in rows.items() if way not in PRIORS) for k in whole]
        print(f"\n{'boxes' if periodic else 'crops'}, every {every}: {', '.join(laws[k] for k in whole)}")
        for way, row in rows.items():
            dice = np.array([row[k]["dice"] for k in whole])
            gains, betti = 100 * (dice - best), np.median([row[k]["betti"] for k in whole])
            each = " ".join(f"{gain:+6.1f}" for gain in gains)
            print(f"{way:11}{np.median(dice):7.3f}{np.median(gains):+7.1f}{betti:7.1f}   {each}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laws", default=",".join(LAWS))
    parser.add_argument("--every", default="4,8,12,16")
    parser.add_argument("--target", type=int, default=0, help="seed of the target; the law's is the next")
    parser.add_argument("--ways", default=",".join(PRIORS), help="besides the interpolations")
    parser.add_argument("--boxes", default="box,crop")
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--picture", metavar="LAW", help="at the first distance of --every")
    parser.add_argument("-o", "--output", type=Path, default=Path("completion"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    laws, levels = options.laws.split(","), [int(n) for n in options.every.split(",")]
    if options.picture:
        crop = options.picture, options.target, levels[0], False, options.output
        masks = {title: completed(way, *crop)[0] for title, way in (("spline",) * 2, ("reconstruct", "calibrated"))}
        path = options.output / f"{options.picture}.png"
        draw(shape(options.picture, options.target, options.output), masks, levels[0], path)
        return
    ways, boxes = (
        [*baselines(), *filter(None, options.ways.split(","))],
        [box == "box" for box in options.boxes.split(",")],
    )
    cases, begun = {}, time.monotonic()
    for every, law, periodic, way in product(levels, laws, boxes, ways):
        if time.monotonic() - begun > options.seconds:
            break
        found = cases[way, law, every, periodic] = case(way, law, options.target, every, periodic, options.output)
        print(f"{way} {law} {every} {periodic}: {found['dice']:.4f} {found['betti']:.0f} {found['status']}", flush=True)
    table(cases, laws, levels, ways)


if __name__ == "__main__":
    main()
