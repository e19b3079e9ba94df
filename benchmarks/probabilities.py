"""A mask from a network's probabilities: p > 1/2, smoothing, TV, the random walker, and F_ε, on generated shapes.

    python -m benchmarks.probabilities [--laws tubes,trabec,…] [--target 2] [--ways …] [-o probabilities]

A shape of 64³ has levels 0 and 1, a blur and Gaussian noise. The network is a random forest on Gaussian features, as of
a trained pixel classifier: it learns from three slices of another seed's scan, and is surer than it is right. The law
is inferred from the mask of a third seed, which is also the example (`benchmarks.completion` may share the folder).

- `p > 1/2`: the network's own mask. `smoothing`, `TV`: of p, then p > 1/2; `walker`: the random walker on p, from seeds
  where p is sure; at the best width, weight or β *in hindsight*, by Dice on the target itself.
- `Willmore`: the Willmore energy on the engine of `refine`, at the best weight *in hindsight*.
- `refine`: law and weight chosen on the example, blind. `one nat`: the first law at 1 nat, as a fixed weight would be.

Dice and the sum of the Betti numbers' errors. Finished flows stay in the folder: a second run goes on. `--seconds` ends
a run early. The table has medians over laws, and the median and the least gain of `refine` over each other way.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable, Iterable
from itertools import product
from pathlib import Path

import numpy as np
from scipy import ndimage
from skimage.restoration import denoise_tv_chambolle
from skimage.segmentation import random_walker

from benchmarks.completion import fitted, shape
from benchmarks.completion_ways import scores
from curvafit.core.files import write_atomically, write_content
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.calibration import Setting, Task, choice
from curvafit.segmentation.engine import BENDING, STEPS, bending
from curvafit.segmentation.refine import FIRST, NATS, PLAIN, refine
from curvafit.segmentation.working import laws_of
from curvafit.volumes.field import Field

LAWS = ("tubes", "trabec", "sponge", "metatubes")
WAYS = ("p > 1/2", "smoothing", "TV", "walker", "Willmore", "one nat", "refine")
#: Deviation of the scan's noise in contrasts, and of its blur in voxels.
NOISE, BLUR = 2.5, 0.7
#: Widths of the network's features, in voxels, and the slices that it learns from.
FEATURES, LEARNT = (0.7, 1.0, 1.6, 2.5, 4.0), (16, 32, 48)
WIDTHS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8)
WEIGHTS = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
BETAS = (1, 10, 130, 1000)
WILLMORE = Coefficients.willmore()
#: Distance of a probability from 0 and 1 that makes a seed of the random walker.
SURE = 0.1


def scan(law: str, seed: int, folder: Path) -> np.ndarray:
    """The grey levels of a shape."""
    clear = ndimage.gaussian_filter(shape(law, seed, folder).astype(np.float32), BLUR, mode="nearest")
    return clear + NOISE * np.random.default_rng(1000 + seed).standard_normal(clear.shape).astype(np.float32)


def features(values: np.ndarray) -> np.ndarray:
    """Smoothed levels, gradients and Laplacians of a scan at each width, (voxels, features)."""
    filters = (ndimage.gaussian_filter, ndimage.gaussian_gradient_magnitude, ndimage.gaussian_laplace)
    return np.stack([each(values, width).ravel() for width, each in product(FEATURES, filters)], axis=1)


def probabilities(law: str, seed: int, trained: int, folder: Path) -> np.ndarray:
    """A network's probabilities (Z, Y, X) for a seed's scan, float16 as networks store them, made once."""
    path = folder / f"p-{law}-{seed}-{trained}.npy"
    if not path.exists():
        from sklearn.ensemble import RandomForestClassifier

        known = np.zeros(shape(law, trained, folder).shape, dtype=bool)
        known[list(LEARNT)] = True
        truth = shape(law, trained, folder)[known]
        network = RandomForestClassifier(60, min_samples_leaf=3, random_state=0)
        network.fit(features(scan(law, trained, folder))[known.ravel()], truth)
        p = np.asarray(network.predict_proba(features(scan(law, seed, folder))))[:, 1].reshape(known.shape)
        odds = (p / np.maximum(1 - p, 1e-6)).clip(1e-6, 1e6) ** 3  # as sure as networks are
        write_atomically(path, lambda temporary: np.save(temporary, (odds / (1 + odds)).astype(np.float16)))
    return np.load(path).astype(np.float32)


def dice(mask: np.ndarray, truth: np.ndarray) -> float:
    return 2 * float((mask & truth).sum()) / max(float(mask.sum() + truth.sum()), 1.0)


def best(masks: Iterable[np.ndarray], truth: np.ndarray) -> np.ndarray:
    """The mask with the largest Dice."""
    return max(masks, key=lambda mask: dice(mask, truth))


def walked(p: np.ndarray, beta: float) -> np.ndarray:
    """skimage's random walker on p, from seeds where p is sure."""
    seeds = np.where(p > 1 - SURE, 1, np.where(p < SURE, 2, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of probabilities a little beyond [0, 1]
        return random_walker(p, seeds, beta=beta, mode="cg_j", tol=1e-3) == 1


class Bench:
    """A law's target and its example, and the flows from them, each made once.

    Parameters
    ----------
    seed
        The target's; the example has the next, and the network learns from the one after.
    end
        Time after which no flow begins.
    """

    def __init__(self, law: str, seed: int, folder: Path, end: float) -> None:
        self.law, self.seed, self.folder, self.end = law, seed, folder, end
        self.fit = fitted(law, seed + 1, folder)
        self.laws = (*laws_of(self.fit, Field(self.truth(seed)))[0], WILLMORE)

    def truth(self, seed: int) -> np.ndarray:
        return shape(self.law, seed, self.folder)

    def chances(self, seed: int) -> np.ndarray:
        return probabilities(self.law, seed, self.seed + 2, self.folder)

    def filled(self, seed: int, setting: Setting) -> np.ndarray:
        """The mask of a seed by a setting, as `calibrate` and `refine` fill it."""
        if setting.law is None:
            return self.chances(seed) > 0.5
        name = f"flow-{self.law}-{seed}-{self.seed}-{self.laws.index(setting.law)}-{setting.strength:g}.npy"
        path = self.folder / name
        if not path.exists():
            if time.monotonic() > self.end:
                raise TimeoutError
            weight = setting.strength * BENDING / bending(setting.law)
            mask = refine(self.chances(seed), setting.law, weight=weight).mask.values
            write_atomically(path, lambda temporary: np.save(temporary, np.packbits(mask)))
        return np.unpackbits(np.load(path)).reshape(self.truth(seed).shape) > 0

    def mask(self, way: str) -> tuple[np.ndarray, str]:
        """A way's mask of the target, and what was chosen."""
        p, truth = self.chances(self.seed), self.truth(self.seed)
        plain: dict[str, Callable[[], np.ndarray]] = {
            "p > 1/2": lambda: p > 0.5,
            "smoothing": lambda: best((ndimage.gaussian_filter(p, width) > 0.5 for width in WIDTHS), truth),
            "TV": lambda: best((denoise_tv_chambolle(p, weight) > 0.5 for weight in WEIGHTS), truth),
            "walker": lambda: best((walked(p, beta) for beta in BETAS), truth),
            "Willmore": lambda: best((self.filled(self.seed, self.setting(WILLMORE, nats)) for nats in NATS), truth),
            "one nat": lambda: self.filled(self.seed, self.setting(self.laws[0], 1.0)),
        }
        if way in plain:
            return plain[way](), ""
        task = Task(self.seed + 1, self.truth(self.seed + 1), range(len(truth)))
        chosen = choice(task, lambda _: [self.setting(law, FIRST) for law in self.laws], self.filled, (PLAIN,), NATS)
        number = "none" if chosen.setting.law is None else f"law {self.laws.index(chosen.setting.law)}"
        said = f"{number} at {chosen.setting.strength:g} nats: {chosen.plain:.3f} to {chosen.dice:.3f}"
        return self.filled(self.seed, chosen.setting), f"{said} ± {chosen.noise:.3f}"

    @staticmethod
    def setting(law: Coefficients, nats: float) -> Setting:
        return Setting(PLAIN, law, nats, STEPS)


def case(bench: Bench, way: str) -> dict:
    """A way's scores, made once."""
    path = bench.folder / f"probability-{''.join(filter(str.isalnum, way))}-{bench.law}-{bench.seed}.json"
    if not path.exists():
        mask, chosen = bench.mask(way)
        write_content(path, json.dumps({**scores(mask, bench.truth(bench.seed)), "chosen": chosen}))
    return json.loads(path.read_text())


def table(cases: dict[str, dict[str, dict]]) -> None:
    """A line a way: medians over laws, gains of `refine` over it on the same laws, and Dice by law."""
    print(f"\n{'':11}{'Dice':>7}{'Betti':>7}   refine's gain: median, least   Dice by law")
    ours = cases.get("refine", {})
    for way, rows in cases.items():
        middle = {key: np.median([row[key] for row in rows.values()]) for key in ("dice", "betti")}
        gains = [100 * (ours[law]["dice"] - row["dice"]) for law, row in rows.items() if law in ours]
        more = f"{np.median(gains):+6.1f} {min(gains):+6.1f}" if gains and way != "refine" else " " * 13
        each = " ".join(f"{law} {row['dice']:.3f}/{row['betti']:.0f}" for law, row in rows.items())
        print(f"{way:11}{middle['dice']:7.3f}{middle['betti']:7.1f}   {more}   {each}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laws", default=",".join(LAWS))
    parser.add_argument("--target", type=int, default=2, help="seed; the law's and example's, the network's are next")
    parser.add_argument("--ways", default=",".join(WAYS))
    parser.add_argument("--seconds", type=float, default=np.inf)
    parser.add_argument("-o", "--output", type=Path, default=Path("probabilities"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + options.seconds
    cases: dict[str, dict[str, dict]] = {}
    for law in options.laws.split(","):
        bench = Bench(law, options.target, options.output, end)
        for way in options.ways.split(","):
            try:
                found = cases.setdefault(way, {})[law] = case(bench, way)
            except TimeoutError:
                continue
            print(f"{way} {law}: {found['dice']:.4f} {found['betti']:.0f} {found['chosen']}", flush=True)
    table({way: rows for way, rows in cases.items() if rows})


if __name__ == "__main__":
    main()
