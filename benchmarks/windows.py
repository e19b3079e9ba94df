"""What maps of windows say of volumes whose local size is known.

White noise, blurred by a Gaussian whose width is another in each slice, is cut at its 70 % quantile. The width is
the only length there: thickness goes with it, surface per volume and curvedness with its inverse. In `graded` volumes
the width goes from 2.5 to 4.5 voxels along z; in `halves` it is one or the other, and the clusters of windows that do
not straddle are held against it. A window holds few periods: what R² lacks is mostly chance.

`--on maps`: volumes of 256 × 64 × 64 voxels, grown by a law that goes from `sponge` to `tubes` and back along z. Each
number of a window is held against that of whole shapes of 64³, grown by the law at its place; each sum of the law's
parameters (L1 to L6) against that of the law itself: squared correlations, of which nine windows that overlap by half
give .2 by chance.
"""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from benchmarks.harness import Cases, Figure, Values, bootstrap, show
from curvafit.generation.flow import generate
from curvafit.inference.posterior import load_posterior
from curvafit.inference.table import parameters_of
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import preset
from curvafit.scan.measure import measure
from curvafit.studies.windows import windows

#: Voxels along z, y, x; the widths at both ends; windows; and seeds.
SHAPE, ENDS, SIZE, STRIDE, SEEDS = (128, 80, 80), (2.5, 4.5), 32, 16, 4
POWERS = {"thickness": 1, "spacing": 1, "surface density": -1, "curvedness": -1}


def textured(widths: np.ndarray, seed: int) -> np.ndarray:
    """Return a level set, uint8, whose Gaussian field has a width of its own in each slice."""
    noise, field = np.random.default_rng(seed).standard_normal(SHAPE), np.empty(SHAPE)
    for width in np.unique(widths):
        blurred = gaussian_filter(noise, width, mode="wrap")
        field[widths == width] = (blurred / blurred.std())[widths == width]
    return (field > np.quantile(field, 0.7)).astype(np.uint8)


def case(kind: str, seed: int) -> Values:
    steps = np.linspace(*ENDS, 17 if kind == "graded" else 2)
    widths = steps[np.arange(SHAPE[0]) * len(steps) // SHAPE[0]]
    maps = windows(textured(widths, seed), SIZE, STRIDE, kind="mask")
    known = maps.known
    local = np.lib.stride_tricks.sliding_window_view(widths, SIZE)[::STRIDE]
    truth = np.broadcast_to(local.mean(1)[:, None, None], known.shape)
    if kind == "halves":
        whole = known & (np.ptp(local, axis=1) == 0)[:, None, None]
        right = (maps.clusters.values == 2) == (truth > np.mean(ENDS))
        return {"clusters": float(right[whole].mean()), "windows": int(whole.sum())}
    return {
        name: float(np.corrcoef(truth[known] ** power, maps[name].values[known])[0, 1] ** 2)
        for name, power in POWERS.items()
    }


# ---- laws that vary --------------------------------------------------------------------------------------------------

#: Voxels of a volume whose law varies along z, windows, their stride, and the law's two ends.
LONG, PART, STEP, ENDS_OF_LAW = (256, 64, 64), (48, 64, 64), (24, 64, 64), ("sponge", "tubes")
#: Numbers that are held against those of whole shapes, whole shapes of a law, and laws along the path.
NUMBERS = ("thickness", "spacing", "mean curvature", "curvedness", "share of tubes", "share of sponge")
SHAPES, LAWS = 2, 5


def law_at(place: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the six coefficients and the mass at places from 0 to 1 between the two laws."""
    ends = [np.array([*law.coefficients, law.mass], dtype=float) for law in map(preset, ENDS_OF_LAW)]
    return tuple(a + (b - a) * place for a, b in zip(*ends, strict=True))


def grown(place: np.ndarray, shape: tuple[int, int, int], seed: int, cases: Cases, name: str) -> np.ndarray:
    """Return a mask that was grown by the law at places from 0 to 1, one number or one for each slice."""

    def grow() -> np.ndarray:
        *numbers, mass = (torch.tensor(each, dtype=torch.float32).reshape(-1, 1, 1) for each in law_at(place))
        flow = generate(Coefficients(*numbers), mass, grid=shape, schedule="paper", seed=seed)
        return np.packbits(flow.field.numpy() > 0)

    return np.unpackbits(cases.array(name, grow)).reshape(shape)


def whole(place: float, seed: int, cases: Cases) -> Values:
    """Return the numbers of a shape of 64³ of one law."""
    found = measure(grown(np.array([place]), (64, 64, 64), seed, cases, f"whole-{place:g}-{seed}"), periodic=True)
    return {name: found[name].value for name in NUMBERS}


def varied(seed: int, cases: Cases) -> Values:
    """Return where windows lie between the two laws, their numbers, and what they tell of sums of parameters."""
    place = 1 - np.abs(1 - 2 * (np.arange(LONG[0]) + 0.5) / LONG[0])
    found = windows(grown(place, LONG, seed, cases, f"varied-{seed}"), PART, STEP, kind="mask", laws=True)
    local = np.lib.stride_tricks.sliding_window_view(place, PART[0])[:: STEP[0]].mean(1)
    sums = {symbol: found[symbol].values[:, 0, 0].tolist() for symbol in (f"L{k}" for k in range(1, 7))}
    return {"place": local.tolist(), **{name: found[name].values[:, 0, 0].tolist() for name in NUMBERS}, **sums}


def on_maps(quick: bool, cases: Cases) -> dict[str, Figure]:
    places = np.linspace(0, 1, LAWS)
    wholes = cases.all({f"whole-{place:g}-{seed}": partial(whole, float(place), seed, cases)
                        for place in places for seed in range(SHAPES)})  # fmt: skip
    found = cases.all({f"varied-{seed}": partial(varied, seed, cases) for seed in range(1 if quick else SEEDS)})
    if len(wholes) < SHAPES * LAWS:
        return {}
    sums = load_posterior().combinations
    figures, rows = {}, []
    for name in (*NUMBERS, *(f"L{k}" for k in range(1, 7))):
        fits = []
        for row in found.values():
            local = np.array(row["place"])
            if name in NUMBERS:
                means = [
                    np.mean([wholes[f"whole-{place:g}-{seed}"][name] for seed in range(SHAPES)]) for place in places
                ]
                truth = np.interp(local, places, means)
            else:
                *numbers, mass = law_at(local)
                laws = [parameters_of(Coefficients(*each), m) for *each, m in zip(*numbers, mass, strict=True)]
                truth = sums(np.array(laws))[:, int(name[1]) - 1]
            seen = np.array(row[name], dtype=float)
            known = np.isfinite(seen)
            fits.append(np.corrcoef(truth[known], seen[known])[0, 1] ** 2 if known.sum() > 3 else np.nan)
        if np.isfinite(fits).all():
            figures[f"windows_maps.{name.replace(' ', '_')}"] = bootstrap(fits, np.mean)
        rows.append([name, np.mean(fits)])
    show(["squared correlation of a number's map with its law's", "mean"], rows)
    return figures


# ---- runs ------------------------------------------------------------------------------------------------------------


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--on", default="sizes", help="sizes: level sets of known size; maps: laws that vary")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    return on_maps(options.quick, cases) if options.on == "maps" else on_sizes(options.quick, cases)


def on_sizes(quick: bool, cases: Cases) -> dict[str, Figure]:
    seeds = range(1 if quick else SEEDS)
    jobs = {f"{kind}-{seed}": partial(case, kind, seed) for kind in ("graded", "halves") for seed in seeds}
    found = cases.all(jobs)
    figures = {
        f"windows.{name.replace(' ', '_')}": bootstrap(
            [values[name] for values in found.values() if name in values], np.mean
        )
        for name in (*POWERS, "clusters")
    }
    show(["R² of the map with the truth; share of windows in their half's cluster", "mean"], list(figures.items()))
    return figures
