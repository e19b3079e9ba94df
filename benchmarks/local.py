"""Local simulation: does growing shapes near the answer sharpen it? A pilot of what `infer --sure` would do.

Of each law one mask of 64³ and one of 128³ are asked for. A round grows shapes of 64³ from draws that are inflated by
half: first from the packaged posterior of the mask of 64³, then from what the first round said of that of 128³. The
emulator is mended near them by a Bayesian quadratic in the parameters, of what it misses in each uncorrelated
direction; the answer is its likelihood times the packaged posterior's normal, inflated alike, by importance sampling.
Shapes are kept in `benchmarks/results/local`; a run that is stopped goes on. Errors and widths of the 90 % intervals
are in deviations of the box.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.closure import PRIOR
from benchmarks.completion import DRAWN, shape
from benchmarks.harness import RESULTS, Cases, Figure, bootstrap, show, write_whole
from benchmarks.reading import SEED, law_of
from curvafit.generation.flow import generate
from curvafit.inference.emulator import Emulator
from curvafit.inference.estimate import Described, measure_descriptors
from curvafit.inference.posterior import load_posterior
from curvafit.inference.table import law_of as coefficients_of
from curvafit.scan.measures import Reading, read_texture
from curvafit.scan.preparation import prepare
from curvafit.volumes.volume import ScanError, Volume

FOLDER, EDGE = RESULTS / "local", 64
#: Shapes of a round, by how much draws are inflated, and the most windows that count as independent.
COUNT, INFLATED, INDEPENDENT = 60, 1.5, 8
#: Deviations, in those of seeds, of the mend's constant, slopes and curvatures; of its noise's prior, in shapes.
MEND, NOISE = (1.0, 0.7, 0.3), 20
#: Draws of a step of importance sampling, steps, and draws of the answer; degrees of freedom of its t distribution.
TRIED, STEPS, DRAWS, FREEDOM = 4000, 5, 400, 5


@dataclass(frozen=True, eq=False)
class Mended:
    """An emulator that is mended near parameters: weights `(28, k)` of a quadratic, their covariance, and the noise."""

    emulator: Emulator
    view: str
    amount: float
    centre: np.ndarray
    deviation: np.ndarray
    weights: np.ndarray
    covariance: np.ndarray
    noise: np.ndarray

    @classmethod
    def fit(cls, emulator: Emulator, parameters: np.ndarray, rows: np.ndarray, view: str, amount: float) -> Mended:
        """Fit the quadratic to descriptors `(n, 351)` of shapes grown from parameters `(n, 6)`."""
        emulated = emulator(parameters, np.full(len(rows), view), np.full(len(rows), amount))
        deviation, centre = emulated.deviation.mean(0), emulator.standardise(parameters).mean(0)
        missed = (emulator.decorrelate(rows) - emulated.mean @ emulator.basis.T) / deviation
        features = quadratic(emulator.standardise(parameters) - centre)
        constant, slope, curvature = (1 / width**2 for width in MEND)
        prior = np.diag([constant, *[slope] * 6, *[curvature] * (features.shape[1] - 7)])
        noise = np.ones(missed.shape[1])
        for _ in range(3):
            covariance = np.linalg.inv(features.T @ features / noise.mean() + prior)
            weights = covariance @ features.T @ missed / noise.mean()
            left = np.square(missed - features @ weights).sum(0)
            free = len(rows) - np.trace(covariance @ features.T @ features) / noise.mean()
            noise = (NOISE + left) / (NOISE + max(free, 1.0))
        return cls(emulator, view, amount, centre, deviation, weights, covariance, noise)

    def likelihood(self, parameters: np.ndarray, windows: np.ndarray) -> np.ndarray:
        """Return the log likelihood `(m,)` of parameters `(m, 6)`, up to a constant, given windows `(k, 351)`."""
        conditions = np.full(len(parameters), self.view), np.full(len(parameters), self.amount)
        features = quadratic(self.emulator.standardise(parameters) - self.centre)
        mean = self.emulator(parameters, *conditions).mean @ self.emulator.basis.T / self.deviation
        mean = mean + features @ self.weights
        seen = self.emulator.decorrelate(windows).mean(0) / self.deviation
        uncertain = np.einsum("ni,ij,nj->n", features, self.covariance, features)[:, None]
        variance = uncertain + self.noise / min(len(windows), INDEPENDENT)
        return -0.5 * (np.square(seen - mean) / variance + np.log(variance)).sum(1)

    def sample(self, windows: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """Return draws `(DRAWS, 6)` given windows of a scan and draws `(n, 6)` of a posterior, the prior here."""
        random, low, high = np.random.default_rng(SEED), *self.emulator.box.T
        centre, covariance = draws.mean(0), INFLATED**2 * np.cov(draws.T)
        middle, precision = centre, np.linalg.inv(covariance)
        parameters, weights = draws, np.full(len(draws), 1 / len(draws))
        for _ in range(STEPS):
            normal = random.standard_normal((TRIED, 6)) * np.sqrt(FREEDOM / random.chisquare(FREEDOM, (TRIED, 1)))
            tried = centre + normal @ np.linalg.cholesky(covariance).T
            inside = ((tried >= low) & (tried <= high)).all(1)
            parameters, normal = tried[inside], normal[inside]
            away = parameters - middle
            log = self.likelihood(parameters, windows) - 0.5 * np.einsum("ni,ij,nj->n", away, precision, away)
            log += (FREEDOM + 6) / 2 * np.log1p(np.square(normal).sum(1) / FREEDOM)
            weights = np.exp(log - log.max())
            weights /= weights.sum()
            centre, apart = weights @ parameters, parameters - weights @ parameters
            few = 2.0 if 1 / np.square(weights).sum() < 50 else 1.0
            covariance = few * (weights[:, None] * apart).T @ apart + 1e-4 * np.diag(self.emulator.deviation**2)
        return parameters[random.choice(len(parameters), DRAWS, p=weights)]


def quadratic(x: np.ndarray) -> np.ndarray:
    """Return 1, the columns of x `(n, 6)`, and their products, `(n, 28)`."""
    first, second = np.triu_indices(x.shape[1])
    return np.concatenate([np.ones((len(x), 1)), x, x[:, first] * x[:, second]], 1)


def read(mask: np.ndarray) -> Described | None:
    rolled = np.roll(mask, np.random.default_rng(SEED).integers(len(mask), size=3), (0, 1, 2))
    return measure_descriptors(prepare(Volume(rolled.astype(np.uint8)), kind="mask", one_scale=True))


def grow(described: Described, parameters: np.ndarray, seed: int) -> np.ndarray | None:
    """Return the descriptors `(351,)` of a shape of 64³, read as a scan is; None where none grows."""
    flow = generate(*coefficients_of(parameters), EDGE, schedule="deep", seed=seed, reject_early=True)
    if not flow.viability.viable:
        return None
    try:
        reading = read_texture(described.prepared.scan_alike(flow.field.numpy(), seed), described.reading.view)
    except ScanError:
        return None
    return None if reading is None else reading.descriptors


def begin(name: str, described: Described) -> dict[str, Any] | None:
    """Return the two masks of a law as they are read; None where that of 128³ is not."""
    flow = generate(*law_of(name)[1], grid=2 * EDGE, schedule="deep", seed=SEED + 1)
    large = read(flow.field.numpy() > 0)
    if large is None:
        return None
    kept = {"truth": law_of(name)[0], "large": large.reading.windows, "amount": large.reading.amount}
    return kept | {"small": described.reading.windows, "small amount": described.reading.amount}


def propose(kept: dict[str, Any], described: Described, number: int) -> np.ndarray:
    """Return the parameters `(COUNT, 6)` of a round."""
    posterior, reading = load_posterior(), described.reading
    draws = posterior.draw(reading, 2000)[:, :-1]
    if number:
        grown = kept["parameters0"][kept["grown0"]], kept["rows0"].astype(float)
        draws = Mended.fit(posterior.emulator, *grown, reading.view, reading.amount).sample(kept["large"], draws)
    wide, (low, high) = draws.mean(0) + INFLATED * (draws - draws.mean(0)), posterior.emulator.box.T
    wide = wide[((wide >= low) & (wide <= high)).all(1)]
    return wide[np.random.default_rng(number).choice(len(wide), COUNT, replace=False)]


def make(name: str, end: float, cases: Cases) -> dict[str, Any] | None:
    """Grow what is missing of a law until the time is over; return what is kept, None without a reading."""
    path, described = FOLDER / f"{name}.npz", read(shape(name, SEED, cases))
    if described is None or described.background:
        return None
    if path.exists():
        with np.load(path) as file:
            kept = dict(file)
    elif (kept := begin(name, described)) is None:
        return None
    for number in (0, 1):
        if f"parameters{number}" not in kept:
            kept[f"parameters{number}"] = propose(kept, described, number)
            kept |= {f"grown{number}": np.zeros(0, bool), f"rows{number}": np.zeros((0, 351), np.float32)}
        grown, rows = list(kept[f"grown{number}"]), list(kept[f"rows{number}"])
        while len(grown) < COUNT and time.monotonic() < end:
            row = grow(described, kept[f"parameters{number}"][len(grown)], 1000 * number + len(grown))
            grown.append(row is not None)
            rows += [] if row is None else [row.astype(np.float32)]
            if len(grown) % 10 == 0 or len(grown) == COUNT:
                kept |= {f"grown{number}": np.array(grown), f"rows{number}": np.reshape(rows, (-1, 351))}
                write_whole(path, partial(keep, kept))
                print(f"  {name}: round {number + 1}, {len(grown)} shapes tried, {sum(grown)} grown", flush=True)
        if len(grown) < COUNT:
            break
    return kept


def keep(kept: dict[str, Any], path: Path) -> None:
    with path.open("wb") as file:  # a file's name would get an ending
        np.savez_compressed(file, **kept)


def answers(kept: dict[str, Any]) -> dict[tuple[str, int], np.ndarray]:
    """Return draws by mask and by how many rounds: 0 is the packaged posterior's."""
    posterior, found = load_posterior(), dict[tuple[str, int], np.ndarray]()
    readings = {"small": Reading(kept["small"], "mask", float(kept["small amount"])),
                "large": Reading(kept["large"], "mask", float(kept["amount"]))}  # fmt: skip
    draws = posterior.draw(readings["small"], 2000)[:, :-1]
    parameters = [kept[f"parameters{k}"][: len(kept[f"grown{k}"])][kept[f"grown{k}"]] for k in (0, 1)]
    for name, reading in readings.items():
        found[name, 0] = posterior.draw(reading, DRAWS)[:, :-1]
        for rounds in (1, 2):
            grown = np.concatenate(parameters[:rounds]), np.concatenate([kept[f"rows{k}"] for k in range(rounds)])
            mended = Mended.fit(posterior.emulator, *grown, "mask", readings["small"].amount)
            found[name, rounds] = mended.sample(reading.windows, draws)
    return found


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--laws", default=",".join(DRAWN[k] for k in (0, 2, 5, 7)), help="random ones of `completion`")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    rows = dict[tuple[str, int], list[np.ndarray]]()
    for name in options.laws.split(",")[: 1 if options.quick else None]:
        kept = make(name, 0.0 if options.quick else cases.end, cases)
        if kept is None or len(kept.get("grown1", ())) < COUNT:
            continue
        for key, draws in answers(kept).items():
            least, median, most = np.quantile(draws, (0.05, 0.5, 0.95), axis=0)
            covered = (least <= kept["truth"]) & (kept["truth"] <= most)
            means = [np.abs(median - kept["truth"]) / PRIOR, covered, (most - least) / PRIOR]
            rows.setdefault(key, []).append(np.array([each.mean() for each in means]))
    table = [[name, rounds, len(each), *np.mean(each, 0)] for (name, rounds), each in rows.items()]
    show(["mask", "rounds", "laws", "error", "in 90", "width"], table, "mean over six parameters and laws")
    if options.quick:
        return {}
    figures = {}
    for (mask, rounds), each in rows.items():
        for name, column in zip(("error", "in90", "width"), np.transpose(each), strict=True):
            figures[f"local.{mask}_{rounds}.{name}"] = bootstrap(column, np.mean)
    return figures
