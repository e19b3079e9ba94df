"""Networks from every so many annotated slices: from these alone, and from volumes that are completed from them.

    python -m benchmarks.pseudo_labels [--data tubes,trabec,sponge,bone] [--every 12] [--seeds 4] [-o pseudo_labels]

Recipes: slices -> a network -> the law of what it predicts on its own image (`infer --fast`) -> `reconstruct` from the
slices, or `refine` of what it predicts -> a network on the whole volume's labels. Nothing but the annotated slices is
known of the image that is trained on.

- data: a shape of 64³ of a preset, for each seed another, blurred by a voxel, lit unevenly, with Gaussian noise of two
  contrasts; bone: a corner of 64³ of the lhdl scan (CURVAFIT_DATA) with noise of 60 grey levels, whose truth is Otsu's
  mask of the scan without it. Tested on another seed's shape, or on the corner opposite.
- `slices`: Dice + CE on the annotated slices. `spline`, `nearest`: on plain interpolations between them. `Willmore`,
  `reconstruct`: on what `reconstruct` completes, tried out on slices left out, with the Willmore energy or the law of
  what `slices` predicts. `itself`: on what `slices` predicts, as self-distillation does; `refine`: on that, refined by
  its law at 1 nat (chosen on seed 0 of tubes and trabec). `all`: on all labels, which nobody has.

All take the same steps, patches and rate, which was chosen with `slices` on a seed of its own. Columns: Dice of the
labels that were trained on (outside the annotated slices), of the network on the other volume, its Betti error; the
gain over `slices` and over `spline`, in points of Dice, with 95 % intervals of the mean over seeds (Student's t).
Finished cases stay in the folder: a second run goes on; `--seconds` ends a run early.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from itertools import product
from pathlib import Path

import numpy as np
import tifffile
import torch
from monai.inferers.utils import sliding_window_inference
from monai.networks.nets.dynunet import DynUNet
from scipy import ndimage, stats
from torch import Tensor, nn

from benchmarks.completion import shape
from benchmarks.vessel_data import UNKNOWN
from benchmarks.vessel_training import BATCH, FILTERS, Plan, Training, dice_ce
from curvafit.core.files import write_atomically, write_content
from curvafit.geometry.topology import betti_numbers
from curvafit.inference.fit import Fit
from curvafit.inference.infer import infer
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.completion import reconstruct
from curvafit.segmentation.engine import BENDING, bending
from curvafit.segmentation.refine import refine
from curvafit.segmentation.slices import Slices
from curvafit.volumes.scan import ScanError

WAYS = ("slices", "spline", "nearest", "Willmore", "reconstruct", "itself", "refine", "all")
EDGE, PATCH = 64, 40
#: Contrasts of the noise on shapes, and grey levels of that on bone.
NOISE, BONE_NOISE = 2.0, 60.0
PLAN = Plan(300, 300, 1e-2)
#: Nats of a unit of the Willmore energy by which a law refines what a network predicts.
WEIGHT = 1.0


class Volumes(Training):
    """A network in training on one volume, with labels where they are known."""

    def __init__(self, image: np.ndarray, target: np.ndarray, plan: Plan, seed: int) -> None:
        super().__init__(None, plan, seed)
        self.image, self.target = image, target
        self.model = DynUNet(3, 1, 1, [3] * 3, [1, 2, 2], [2, 2], filters=FILTERS[:3], norm_name="batch")
        self.optimiser = torch.optim.AdamW(self.model.parameters(), plan.rate)

    def batch(self, step: int) -> tuple[Tensor, Tensor]:
        """Random patches, turned and mirrored, each with a slice that is annotated."""
        rng = np.random.default_rng((self.seed, step % 2**32))
        pairs = [self._patch(rng) for _ in range(BATCH)]
        x, y = (torch.from_numpy(np.stack(each)[:, None]) for each in zip(*pairs, strict=True))
        return x, y

    def _patch(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        corner = [int(rng.integers(n - PATCH + 1)) for n in self.image.shape]
        box = tuple(slice(start, start + PATCH) for start in corner)
        axes, mirrors = rng.permutation(3), tuple(k for k in range(3) if rng.random() < 0.5)
        x, y = (np.flip(values[box].transpose(axes), mirrors) for values in (self.image, self.target))
        return np.ascontiguousarray(x, dtype=np.float32), np.ascontiguousarray(y, dtype=np.float32)


def chances(model: nn.Module, image: np.ndarray) -> np.ndarray:
    """A network's probabilities for an image."""
    model.eval()
    with torch.no_grad():
        x = torch.from_numpy(image)[None, None]
        logits = sliding_window_inference(x, (PATCH,) * 3, 4, model, 0.5, mode="gaussian")
        return torch.sigmoid(logits[0, 0]).numpy()  # type: ignore[index]


def predicted(model: nn.Module, image: np.ndarray) -> np.ndarray:
    """A network's mask of an image."""
    return chances(model, image) > 0.5


def pair(data: str, seed: int, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """An image, standardised, and its true mask."""
    rng = np.random.default_rng((seed, 5))
    if data == "bone":
        scans = Path(os.environ["CURVAFIT_DATA"]) / "scans"
        grey = tifffile.imread(scans / "lhdl_trabecular_200.tif").astype(np.float32)
        mask = tifffile.imread(scans / "lhdl_trabecular_200_otsu_mask.tif") > 0
        corner = list(product((0, grey.shape[0] - EDGE), repeat=3))[seed % 8]
        box = tuple(slice(start, start + EDGE) for start in corner)
        image, truth, noise = grey[box], mask[box], BONE_NOISE
    else:
        truth, noise = shape(data, seed, folder), NOISE
        light = ndimage.gaussian_filter(rng.standard_normal(truth.shape), 16)
        image = ndimage.gaussian_filter(truth.astype(np.float32), 1.0) * (1 + 0.3 * light / light.std())
    image = image + noise * rng.standard_normal(truth.shape)
    return ((image - image.mean()) / image.std()).astype(np.float32), truth


def labels(way: str, data: str, seed: int, every: int, folder: Path) -> np.ndarray:
    """What is trained on, made once."""
    path = folder / f"labels-{way}-{data}-{seed}-{every}.npy"
    if not path.exists():
        target = annotated(way, data, seed, every, folder)
        write_atomically(path, lambda temporary: np.save(temporary, target))
    return np.load(path)


def annotated(way: str, data: str, seed: int, every: int, folder: Path) -> np.ndarray:
    """Labels 0 and 1, and `UNKNOWN` elsewhere."""
    _, truth = pair(data, seed, folder)
    places = range(0, EDGE, every)
    if way == "all":
        return truth.astype(np.uint8)
    if way == "slices":
        target = np.full(truth.shape, UNKNOWN, np.uint8)
        target[places] = truth[places]
        return target
    if way in ("spline", "nearest"):
        return (Slices(truth[places], tuple(places), EDGE, (1.0, 1.0, 1.0)).level(way) > 0).astype(np.uint8)
    if way in ("itself", "refine"):
        p = chances(trained("slices", data, seed, every, folder), pair(data, seed, folder)[0])
        p[places] = truth[places]
        return (p > 0.5).astype(np.uint8) if way == "itself" else refined(p, fitted(data, seed, every, folder))
    law = Coefficients.willmore() if way == "Willmore" else fitted(data, seed, every, folder)
    result = reconstruct(truth.astype(np.uint8), law, every=every)
    print(f"{data} {seed} {way}: {result.status}", flush=True)
    return result.mask.values.astype(np.uint8)


def refined(p: np.ndarray, law: Fit | Coefficients) -> np.ndarray:
    """Labels of probabilities, refined by a law at `WEIGHT` nats of a unit of the Willmore energy."""
    first = law if isinstance(law, Coefficients) else law.coefficients
    assert first is not None
    return refine(p, law, weight=WEIGHT * BENDING / bending(first)).mask.values.astype(np.uint8)


def fitted(data: str, seed: int, every: int, folder: Path) -> Fit | Coefficients:
    """The law of what the network of `slices` predicts on its own image; Willmore's where that has none."""
    path = folder / f"fit-{data}-{seed}-{every}.json"
    if not path.exists():
        mask = predicted(trained("slices", data, seed, every, folder), pair(data, seed, folder)[0])
        write_content(path, infer(mask.astype(np.uint8), kind="mask", fast=True).fit.to_json())
    fit = Fit.load(path)
    return fit if fit.coefficients is not None else Coefficients.willmore()


def trained(way: str, data: str, seed: int, every: int, folder: Path) -> nn.Module:
    """The network of a way, trained once."""
    path, image = folder / f"network-{way}-{data}-{seed}-{every}.pt", pair(data, seed, folder)[0]
    training = Volumes(image, labels(way, data, seed, every, folder), PLAN, seed)
    if path.exists():
        training.load(path)
    else:
        training.run(dice_ce, PLAN.steps)
        training.save(path)
    return training.model


def dice(mask: np.ndarray, truth: np.ndarray) -> float:
    return 2 * float((mask & truth).sum()) / max(float(mask.sum() + truth.sum()), 1.0)


def case(way: str, data: str, seed: int, every: int, folder: Path) -> dict[str, float]:
    """The scores of a way, made once."""
    path = folder / f"case-{way}-{data}-{seed}-{every}.json"
    if not path.exists():
        begun = time.perf_counter()
        target, truth = labels(way, data, seed, every, folder), pair(data, seed, folder)[1]
        between = np.arange(EDGE) % every != 0
        image, other = pair(data, 7 - seed if data == "bone" else seed + 50, folder)
        mask = predicted(trained(way, data, seed, every, folder), image)
        errors = zip(betti_numbers(mask), betti_numbers(other), strict=True)
        scores = {
            "labels": float("nan") if way == "slices" else dice(target[between] == 1, truth[between]),
            "dice": dice(mask, other),
            "betti": float(sum(abs(a - b) for a, b in errors)),
            "seconds": time.perf_counter() - begun,
        }
        write_content(path, json.dumps(scores))
    return json.loads(path.read_text())


def interval(gains: list[float]) -> str:
    """The mean of gains in points, with its 95 % interval."""
    if len(gains) < 2:
        return f"{100 * np.mean(gains):+.1f}"
    half = stats.t.ppf(0.975, len(gains) - 1) * np.std(gains, ddof=1) / np.sqrt(len(gains))
    return f"{100 * np.mean(gains):+.1f} ± {100 * half:.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="tubes,trabec,sponge,bone")
    parser.add_argument("--every", type=int, default=12)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--ways", default=",".join(WAYS))
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("-o", "--output", type=Path, default=Path("pseudo_labels"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    end, ways, sets = time.monotonic() + options.seconds, options.ways.split(","), options.data.split(",")
    rows: dict[tuple[str, str], list[dict[str, float]]] = {}
    for seed in range(options.first, options.first + options.seeds):
        for data, way in product(sets, ways):
            if time.monotonic() > end:
                break
            try:
                scores = case(way, data, seed, options.every, options.output)
            except ScanError as error:
                print(f"{data} {seed} {way}: {error}", flush=True)
                continue
            rows.setdefault((data, way), []).append({"seed": seed, **scores})
    print(f"{'data':10}{'way':14}{'n':>3}{'labels':>8}{'dice':>7}{'betti':>7}{'over slices':>16}{'over spline':>16}")
    for (data, way), mine in rows.items():
        means = [float(np.mean([each[name] for each in mine])) for name in ("labels", "dice", "betti")]
        cells = "".join(f"{interval(_gains(mine, rows.get((data, base), []))):>16}" for base in ("slices", "spline"))
        print(f"{data:10}{way:14}{len(mine):3}{means[0]:8.3f}{means[1]:7.3f}{means[2]:7.1f}{cells}")


def _gains(mine: list[dict[str, float]], base: list[dict[str, float]]) -> list[float]:
    """Gains in Dice over another way, on the same seeds."""
    known = {each["seed"]: each["dice"] for each in base}
    return [each["dice"] - known[each["seed"]] for each in mine if each["seed"] in known] or [float("nan")]


if __name__ == "__main__":
    main()
