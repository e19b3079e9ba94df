"""Sentinels: one cheap case of each topic, whose values are kept, with tolerances that any processor holds.

    python -m benchmarks sentinel [TOPIC…] [--record]

The figures of a topic stand while its sentinel agrees with the last line of it in `benchmarks/results/sentinel.jsonl`.
A change that is meant to change numbers records the new values: what was measured before it then says in the ledger
that the sentinel disagrees, until it is measured again.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import warnings
from collections.abc import Callable
from functools import cache

import numpy as np
import torch
from scipy import ndimage

from benchmarks import centreline, completion, convergence, curvature, networks, prior, step
from benchmarks.harness import SENTINEL, append_lines, provenance, read_lines, show
from curvafit.geometry.diagrams import diagram
from curvafit.geometry.distances import wasserstein
from curvafit.inference.estimate import STARTS, measure_descriptors, measure_misfit
from curvafit.inference.posterior import load_posterior
from curvafit.priors import CurvaturePrior
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energies import energy
from curvafit.priors.grid import Grid
from curvafit.priors.profile import SIGMA, phase_field
from curvafit.scan.preparation import prepare
from curvafit.scan.tiles import measure
from curvafit.segmentation.labels import reconstruct_labels
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.segmentation import segment
from curvafit.segmentation.trials import dice
from curvafit.studies.comparison import compare
from curvafit.volumes.volume import Volume
from tests.exact import Sphere, centres, profile

#: Values with the differences that are allowed.
Checked = dict[str, tuple[float, float]]


@cache
def texture(size: int = 48, width: float = 3.0, seed: int = 0) -> np.ndarray:
    """Return a texture without a flow, which another processor would grow otherwise: a cut of blurred noise, uint8."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((size,) * 3), width, mode="wrap")
    return (noise > np.quantile(noise, 0.7)).astype(np.uint8)


def check_step() -> Checked:
    flow = step.fused_flow(24)
    for _ in range(3):
        flow.evaluate()
        flow.update(1e-3)
    return relative(1e-3, energy=float(np.sum(flow.evaluate())))


def check_prior() -> Checked:
    leaf = prior.batch(24)[0].requires_grad_()
    loss = CurvaturePrior("tubes", sigmoid=True)(leaf)
    (slope,) = torch.autograd.grad(loss, leaf)
    return relative(1e-3, loss=float(loss), slope=float(slope.norm()))


def check_examples() -> Checked:
    """Check the Willmore energy of a sphere's exact profile, of 16 π."""
    grid = Grid((56,) * 3, (1 / 56,) * 3, "replicate")
    field = profile(Sphere(0.3, (0.5, 0.5, 0.5)), centres(grid), 0.05)
    return relative(1e-3, ratio=float(energy(field, Coefficients.willmore(), grid, 0.05)) / SIGMA / (16 * np.pi))


def check_convergence() -> Checked:
    orders = convergence.sweep("limit", 2)["orders"]
    return relative(1e-3, least=min(orders), most=max(orders))


def check_curvature() -> Checked:
    return {name: (value, 2e-3) for name, value in curvature.mask_errors("sphere", 4, 2).items()}


def check_texture() -> Checked:
    grid = Grid((48,) * 3, (1.0, 1.0, 1.0))
    fields = (phase_field(torch.from_numpy(texture(width=width) > 0), grid, 2.0) for width in (2.5, 4.0))
    return {"distance": (wasserstein(*(diagram(field, grid, 2.0) for field in fields)), 5e-3)}


def check_reading() -> Checked:
    """Check what the posterior reads from a level cut, and the rank of what the best parameters leave unexplained."""
    found, posterior = measure_descriptors(prepare(Volume(texture(64)), kind="mask", one_scale=True)), load_posterior()
    assert found is not None
    medians = np.median(posterior.standardise(posterior.draw(found.reading, 2000)), axis=0)[:6]
    checked = {f"parameter {k + 1}": (float(value), 0.1) for k, value in enumerate(medians)}
    starts = posterior.draw(found.reading, STARTS)[:, :-1]
    misfit = measure_misfit(found, posterior, starts)
    return checked | {"rank": (math.nan if misfit is None else misfit.unexplained, 0.02)}


def check_completion() -> Checked:
    ways = {
        way: completion.filled(way, Volume(texture()), range(0, 48, 8), 0, dict, dict) for way in ("spline", "filler")
    }
    return {way: (row["dice"], 0.003) for way, row in ways.items()}


def check_image() -> Checked:
    truth = texture(32, 2.5)
    found = reconstruct(Volume(truth), every=8, image=Volume(networks.image_of(truth, 0)))
    return {"Dice": (dice(found.mask.values > 0, truth > 0), 0.02)}


def check_instances() -> Checked:
    number = np.asarray(ndimage.label(texture(48, 4.0))[0])  # type: ignore[index]
    cells = np.where(number % 4 < 3, number, 0).astype(np.uint16)
    found = reconstruct_labels(cells, every=8).labels
    assert found is not None
    return {"voxels that agree": (float((found.values == cells).mean()), 0.005)}


def check_measures() -> Checked:
    found = measure(texture(), kind="mask", periodic=True)
    return relative(2e-3, **{name: found[name].value for name in ("thickness", "spacing", "surface density")})


def check_groups() -> Checked:
    one, other = ([texture(32, width, seed) for seed in range(3)] for width in (2.0, 2.3))
    return relative(5e-3, statistic=compare(one, other).statistic)


def check_noise() -> Checked:
    truth = texture(24, 2.5)
    scan = truth + np.random.default_rng(0).standard_normal(truth.shape)
    found = segment(Volume(scan.astype(np.float32)), Coefficients.willmore())
    return {"Dice": (dice(found.mask.values > 0, truth > 0), 0.01)}


def check_networks() -> Checked:
    truth, net = texture(56, 4.0), networks.network(0)
    batch = networks.lessons(networks.image_of(truth, 0), networks.annotated(truth, (21, 42)), 0)
    networks.learn(net, batch, 1, 6e-3)
    x, y = batch(99)
    with torch.no_grad():
        return {"loss": (float(networks.dice_ce(networks.predict(net, x), y)), 0.05)}


def relative(share: float, **values: float) -> Checked:
    return {name: (value, share * abs(value)) for name, value in values.items()}


def check_centreline() -> Checked:
    tree = centreline.fill(centreline.lines_of("tree", 0), 3.5)
    found = centreline.ours(Volume(tree.astype(np.uint8)))
    return {"length": (found["length"], 0.5), "radius": (found["radius"], 0.02)}


#: What stands for topics.
SENTINELS: dict[str, Callable[[], Checked]] = {
    "step": check_step,
    "prior": check_prior,
    "examples": check_examples,
    "convergence": check_convergence,
    "curvature": check_curvature,
    "texture": check_texture,
    "closure belief scans reading learning resolution": check_reading,
    "completion": check_completion,
    "image": check_image,
    "instances": check_instances,
    "phantoms large windows": check_measures,
    "centreline": check_centreline,
    "groups": check_groups,
    "noise": check_noise,
    "networks": check_networks,
}


def main(arguments: list[str]) -> None:
    """Run sentinels, and compare them with what is kept; exit with 1 where one disagrees."""
    parser = argparse.ArgumentParser("python -m benchmarks sentinel", description=__doc__)
    parser.add_argument("topics", nargs="*", help="all, where none is named")
    parser.add_argument("--record", action="store_true", help="keep the values: figures from before them stand no more")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    kept, wrong = read_lines(SENTINEL, "sentinel"), []
    for topics, check in SENTINELS.items():
        if options.topics and not set(options.topics) & set(topics.split()):
            continue
        begun, found, before = time.process_time(), check(), kept.get(topics, {}).get("values", {})
        seconds = f"{time.process_time() - begun:.1f} s"
        off = {name for name, (value, most) in found.items() if not abs(value - before.get(name, np.nan)) <= most}
        rows = [[name, f"{value:.6g}", str(before.get(name, "")), f"{most:.1g}", "disagrees" * (name in off)]
                for name, (value, most) in found.items()]  # fmt: skip
        show([topics, "now", "kept", "allowed", seconds], rows)
        if off | (before.keys() - found.keys()):
            wrong.append(topics)
            if options.record:
                values = {name: round(value, 6) for name, (value, _) in found.items()}
                append_lines(SENTINEL, [{"sentinel": topics, "values": values} | provenance()])
    if wrong and not options.record:
        print(f"\nfigures of {', '.join(wrong)} stand no more: measure them again, or mend what changed them")
        sys.exit(1)
