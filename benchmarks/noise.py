"""A mask from grey levels under noise: smoothing, TV, the random walker, and F_ε, on generated shapes.

    python -m benchmarks.noise [--laws tubes,trabec,…] [--noise 1,3] [--target 0] [-o noise]

A shape of 64³ has levels 0 and 1 and Gaussian noise of so many contrasts; its box is not told to repeat. The law is
inferred from the mask of another seed, without growing anything (`benchmarks.completion`, whose folder this is too).

- `start`: what `segment` starts from, blind. `smoothing`, `TV`: with Otsu's threshold; `walker`: the random walker; at
  the best width, weight or β *in hindsight*, by Dice.
- `Willmore`: the Willmore energy on the engine of `segment`, with its classes, at the best weight *in hindsight*.
- `segment`: the inferred fit, law and weight and classes chosen blind. `Willmore blind`: the same without a fit.

Dice and the sum of the Betti numbers' errors. Finished cases stay in the folder: a second run goes on. `--seconds` ends
a run early. The table has medians over laws, and the least and the median gain of `segment` over each other way.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable
from itertools import product
from pathlib import Path

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu
from skimage.restoration import denoise_tv_chambolle

from benchmarks.bone import walked
from benchmarks.completion import LAWS, fitted, shape
from curvafit.core.files import write_content
from curvafit.geometry.topology import betti_numbers
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.engine import HALO, STEPS, weighed
from curvafit.segmentation.evidence import Classes, classes_of, grey_levels, of_classes
from curvafit.segmentation.segment import segment
from curvafit.segmentation.weighing import WEIGHTS, weighing
from curvafit.segmentation.working import WorkingGrid, laws_of
from curvafit.volumes.field import Field

WAYS = ("start", "smoothing", "TV", "walker", "Willmore", "Willmore blind", "segment")
#: Widths in voxels, weights in contrasts, and β among which hindsight chooses.
WIDTHS, TV, BETAS = (1.0, 1.5, 2.0, 2.5, 3.0), (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0), (1, 130)
WILLMORE = Coefficients.willmore()


def grey(law: str, seed: int, noise: float, folder: Path) -> tuple[np.ndarray, Field]:
    """A shape, and its grey levels."""
    truth = shape(law, seed, folder)
    values = truth + noise * np.random.default_rng(seed).standard_normal(truth.shape)
    return truth, Field(values.astype(np.float32), (1.0, 1.0, 1.0))


def dice(mask: np.ndarray, truth: np.ndarray) -> float:
    return 2 * float((mask & truth).sum()) / max(1.0, float(mask.sum() + truth.sum()))


def best(masks: Iterable[np.ndarray], truth: np.ndarray) -> np.ndarray:
    return max(masks, key=lambda mask: dice(mask, truth))


def split(values: np.ndarray) -> np.ndarray:
    return values > threshold_otsu(values)


def measured(scan: Field, law: str, seed: int, folder: Path) -> Classes:
    """The classes that `segment` ends with."""
    values = grey_levels(scan)
    laws = (*laws_of(fitted(law, seed + 1, folder), scan)[0], WILLMORE)
    return weighing(values, scan, classes_of(values, scan), laws, steps=STEPS).classes


def by_willmore(scan: Field, classes: Classes) -> Iterable[np.ndarray]:
    evidence, place = of_classes(grey_levels(scan), scan, classes), WorkingGrid.of(scan, None, halo=HALO)
    return (place.back(weighed(evidence, WILLMORE, nats, place, STEPS).field) > 0 for nats in WEIGHTS)


def mask_of(way: str, law: str, seed: int, noise: float, folder: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """A way's mask, the truth, and what the way says of itself."""
    truth, scan = grey(law, seed, noise, folder)
    values = scan.values
    hindsight: dict[str, Callable[[], Iterable[np.ndarray]]] = {
        "smoothing": lambda: (split(ndimage.gaussian_filter(values, width)) for width in WIDTHS),
        "TV": lambda: (split(denoise_tv_chambolle(values, weight=weight)) for weight in TV),
        "walker": lambda: (walked(values, beta) for beta in BETAS),
        "Willmore": lambda: by_willmore(scan, measured(scan, law, seed, folder)),
    }
    if way in hindsight:
        return best(hindsight[way](), truth), truth, ""
    if way == "start":
        clipped = grey_levels(scan)
        return of_classes(clipped, scan, classes_of(clipped, scan)).level > 0, truth, ""
    answer = segment(scan, WILLMORE if way == "Willmore blind" else fitted(law, seed + 1, folder))
    return answer.mask.values, truth, answer.status


def case(path: Path, way: str, law: str, seed: int, noise: float) -> dict:
    """Figures of a case, made or read."""
    if not path.exists():
        begun = time.perf_counter()
        mask, truth, status = mask_of(way, law, seed, noise, path.parent)
        error = sum(abs(a - b) for a, b in zip(betti_numbers(mask), betti_numbers(truth), strict=True))
        figures = {"dice": dice(mask, truth), "betti": error, "seconds": time.perf_counter() - begun}
        write_content(path, json.dumps({**figures, "status": status}))
    return json.loads(path.read_text())


def table(cases: dict[tuple[float, str], dict[str, dict]]) -> None:
    """A line a way of each noise: medians, and gains of `segment` over it on the same laws."""
    for noise in sorted({key[0] for key in cases}):
        print(f"\nnoise of {noise:g} contrasts")
        print(f"{'':16}{'n':>3}{'Dice':>8}{'Betti':>7}{'s':>6}   segment's gain: median, least")
        ours = cases.get((noise, "segment"), {})
        for way in WAYS:
            rows = cases.get((noise, way), {})
            if not rows:
                continue
            middle = {key: np.median([row[key] for row in rows.values()]) for key in ("dice", "betti", "seconds")}
            gains = [ours[law]["dice"] - row["dice"] for law, row in rows.items() if law in ours]
            more = f"   {np.median(gains):+.3f} {min(gains):+.3f}" if gains and way != "segment" else ""
            print(f"{way:16}{len(rows):3}{middle['dice']:8.3f}{middle['betti']:7.1f}{middle['seconds']:6.0f}{more}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laws", default=",".join(LAWS))
    parser.add_argument("--noise", default="1,3")
    parser.add_argument("--target", type=int, default=0, help="seed of the shapes; the next one's masks tell the laws")
    parser.add_argument("--ways", default=",".join(WAYS))
    parser.add_argument("--seconds", type=float, default=np.inf)
    parser.add_argument("-o", "--output", type=Path, default=Path("noise"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + options.seconds
    cases: dict[tuple[float, str], dict[str, dict]] = {}
    levels = [float(level) for level in options.noise.split(",")]
    for (law, way), noise in product(product(options.laws.split(","), options.ways.split(",")), levels):
        path = options.output / f"noise-{way.replace(' ', '_')}-{law}-{options.target}-{noise:g}.json"
        if path.exists() or time.monotonic() < end:
            cases.setdefault((noise, way), {})[law] = case(path, way, law, options.target, noise)
    table(cases)


if __name__ == "__main__":
    main()
