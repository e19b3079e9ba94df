"""Sentinels: one cheap case of each topic, whose values are kept with the tolerance that any processor holds.

    python -m benchmarks sentinel [TOPIC…] [--record]

The figures of a topic stand while its sentinel agrees with the last line of it in `benchmarks/results/sentinel.jsonl`.
A change that is meant to change numbers records the new values: what was measured before it then says in the ledger
that the sentinel disagrees, until it is measured again.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from functools import cache, lru_cache

import numpy as np
from scipy import ndimage

from benchmarks.harness import RESULTS, all_lines, append_lines, provenance, read_lines, show

PATH = RESULTS / "sentinel.jsonl"
#: Values with the differences that are allowed.
Checked = dict[str, tuple[float, float]]


@lru_cache
def changed() -> dict[str, str]:
    """Return since when a topic's sentinel gives what it gives, of topics where it once gave something else."""
    first: dict[str, dict[str, float]] = {}
    found: dict[str, str] = {}
    for line in all_lines(PATH, "sentinel"):
        topic, values = line["sentinel"], line["values"]
        if first.setdefault(topic, values) != values:
            found[topic], first[topic] = line["date"], values
    return found


# ---- what is measured ------------------------------------------------------------------------------------------------


@cache
def texture(size: int = 48, width: float = 3.0, seed: int = 0) -> np.ndarray:
    """Return a texture without a flow, which another processor would grow otherwise: a cut of blurred noise, uint8."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((size,) * 3), width, mode="wrap")
    return (noise > np.quantile(noise, 0.7)).astype(np.uint8)


def step() -> Checked:
    from benchmarks.step import fused_flow, plain_stepper

    fused, plain = fused_flow(24), plain_stepper(24)
    for _ in range(3):
        energy = fused.evaluate()
        fused.update(1e-3)
        plain.step(1e-3)
    return {"energy": (float(np.sum(energy)), 1e-3 * abs(float(np.sum(energy))))}


def prior() -> Checked:
    from benchmarks.prior import batch
    from curvafit.priors import CurvaturePrior

    logits, _ = batch(24)
    leaf = logits.double().requires_grad_()
    loss = CurvaturePrior("tubes", sigmoid=True)(leaf)
    loss.backward()
    assert leaf.grad is not None
    slope = float(leaf.grad.norm())
    return {"loss": (float(loss), 1e-3 * abs(float(loss))), "slope": (slope, 1e-3 * slope)}


def convergence() -> Checked:
    from benchmarks.convergence import sweep

    orders = sweep("limit", [1 / 4, 1 / 6])["orders"]
    return {"least": (min(orders), 1e-3), "most": (max(orders), 1e-3)}


def curvature() -> Checked:
    from benchmarks.curvature import mask_errors

    found = mask_errors("sphere", 4, 2)
    return {"bias": (found["bias"], 2e-3), "error": (found["error"], 2e-3)}


def examples() -> Checked:
    """Willmore energy of a sphere's exact profile, over 16 π."""
    import torch

    from curvafit.priors.coefficients import Coefficients
    from curvafit.priors.energy import energy
    from curvafit.priors.grid import Grid
    from curvafit.priors.profile import SIGMA
    from tests.exact import Sphere, centres, profile

    grid = Grid((56,) * 3, (1 / 56,) * 3, "replicate")
    field = profile(Sphere(0.3, (0.5, 0.5, 0.5)), centres(grid), 0.05)
    found = float(energy(field.to(torch.float64), Coefficients.willmore(), grid, 0.05)) / SIGMA / (16 * np.pi)
    return {"of 16 π": (found, 1e-3)}


def texture_distance() -> Checked:
    import torch

    from curvafit.geometry.diagram import diagram
    from curvafit.geometry.distances import wasserstein
    from curvafit.priors.grid import Grid
    from curvafit.priors.profile import phase_field

    grid = Grid((48,) * 3, (1.0, 1.0, 1.0))
    masks = (texture(width=width) > 0 for width in (2.5, 4.0))
    one, other = (diagram(phase_field(torch.from_numpy(mask), grid, 2.0), grid, 2.0) for mask in masks)
    return {"distance": (wasserstein(one, other), 5e-3)}


@cache
def reading() -> Checked:
    """What the posterior reads from a texture, and how much that looks like a level cut, which it is."""
    from benchmarks.belief import level_cuts
    from curvafit.inference.estimate import measure_descriptors
    from curvafit.inference.posterior import load_posterior
    from curvafit.scan.prepare import prepare
    from curvafit.volumes.field import Field

    found = measure_descriptors(prepare(Field(texture(64)), kind="mask", one_scale=True))
    assert found is not None
    posterior = load_posterior()
    medians = np.median(posterior.standardise(posterior.draw(found.reading, 2000)), axis=0)[:6]
    checked = {f"parameter {k + 1}": (float(value), 0.1) for k, value in enumerate(medians)}
    return checked | {"rank of level cuts": (float(level_cuts(posterior, [found.reading.windows])[0]), 0.02)}


def completion() -> Checked:
    from benchmarks.completion import filled
    from curvafit.volumes.field import Field

    truth = Field(texture())
    ways = {way: filled(way, truth, range(0, 48, 8), 0, lambda: None, lambda: None) for way in ("spline", "filler")}
    checked = {f"Dice, {way}": (row["dice"], 0.003) for way, row in ways.items()}
    return checked | {"calibration": (ways["filler"]["calibration"], 0.003)}


def image() -> Checked:
    from benchmarks.unets import image_of
    from curvafit.segmentation.reconstruct import reconstruct
    from curvafit.segmentation.trials import dice
    from curvafit.volumes.field import Field

    truth = texture(32, 2.5)
    found = reconstruct(Field(truth), every=8, image=Field(image_of(truth, 0)))
    return {"Dice": (dice(found.mask.values > 0, truth > 0), 0.02)}


def instances() -> Checked:
    from curvafit.segmentation.reconstruct import reconstruct_labels

    labels = np.asarray(ndimage.label(texture(48, 4.0))[0])  # type: ignore[index]
    cells = np.where(labels % 4 < 3, labels, 0).astype(np.uint16)
    found = reconstruct_labels(cells, every=8).labels
    assert found is not None
    return {"voxels that agree": (float((found.values == cells).mean()), 0.005)}


def measures() -> Checked:
    from curvafit.scan.measure import measure

    found = measure(texture(), kind="mask", periodic=True)
    names = ("thickness", "spacing", "surface density", "mean curvature")
    return {name: (found[name].value, 0.002 * abs(found[name].value)) for name in names}


def windows() -> Checked:
    from benchmarks.windows import case

    return {"R² of thickness": (case("graded", 0)["thickness"], 0.02)}


def groups() -> Checked:
    from curvafit.studies.compare import compare

    one, other = ([texture(32, width, seed) for seed in range(3)] for width in (2.0, 2.3))
    return {"p": (compare(one, other).p, 1e-6)}


def noise() -> Checked:
    from curvafit.priors.coefficients import Coefficients
    from curvafit.segmentation.segment import segment
    from curvafit.segmentation.trials import dice
    from curvafit.volumes.field import Field

    truth = texture(32)
    scan = truth + np.random.default_rng(0).standard_normal(truth.shape)
    found = segment(Field(scan.astype(np.float32)), Coefficients.willmore())
    return {"Dice": (dice(found.mask.values > 0, truth > 0), 0.01)}


def networks() -> Checked:
    import torch

    from benchmarks.unets import annotated, dice_ce, image_of, learn, lessons, network, predict

    torch.set_num_threads(1)
    truth = texture(56, 4.0)
    net, batch = network(0), lessons([(image_of(truth, 0), annotated(truth, (21, 42)))], 0)
    learn(net, batch, 4, 6e-3)
    x, y = batch(99)
    with torch.no_grad():
        return {"loss": (float(dice_ce(predict(net, x), y)), 0.05)}


#: What stands for a topic; one case stands for several.
SENTINELS: dict[str, Callable[[], Checked]] = {
    "step": step,
    "prior": prior,
    "examples": examples,
    "convergence": convergence,
    "curvature": curvature,
    "texture": texture_distance,
    "closure": reading,
    "belief": reading,
    "scans": reading,
    "completion": completion,
    "image": image,
    "instances": instances,
    "phantoms": measures,
    "large": measures,
    "windows": windows,
    "groups": groups,
    "noise": noise,
    "refine": noise,
    "transductive": networks,
    "sets": networks,
}


def main(arguments: list[str]) -> None:
    """Run sentinels, and compare them with what is kept; exit with 1 where one disagrees."""
    parser = argparse.ArgumentParser("python -m benchmarks sentinel")
    parser.add_argument("topics", nargs="*", choices=[[], *SENTINELS], help="all, where none is named")
    parser.add_argument("--record", action="store_true", help="keep the values: figures from before them stand no more")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    kept, rows, wrong, cached = read_lines(PATH, "sentinel"), [], [], dict[Callable[[], Checked], Checked]()
    for topic in options.topics or SENTINELS:
        begun, function = time.process_time(), SENTINELS[topic]
        found = cached.setdefault(function, {}) or function()
        cached[function] = found
        before = kept.get(topic, {}).get("values", {})
        off = [name for name, (value, most) in found.items() if abs(value - before.get(name, np.inf)) > most]
        off += sorted(before.keys() - found.keys())
        wrong += [topic] * bool(off)
        for name, (value, most) in found.items():
            rows.append([f"{topic}: {name}", value, before.get(name, ""), f"{most:.2g}", "*" * (name in off)])
        rows[-1].append(f"{time.process_time() - begun:.1f} s")
        if options.record and off:
            values = {name: round(value, 6) for name, (value, _) in found.items()}
            append_lines(PATH, [{"sentinel": topic, "values": values} | provenance()])
    columns = ["sentinel", "now", "kept", "allowed", ""]
    show([*columns, "processor time"], [[*row, ""][:6] for row in rows])
    if wrong and not options.record:
        print(f"figures of {', '.join(wrong)} stand no more: measure them again, or mend what changed them")
    sys.exit(bool(wrong) and not options.record)
