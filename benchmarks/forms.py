"""Forms of F_ε as a loss, on free logits: what each says of a shape, and what it makes of noisy evidence.

- `product`: F_ε of u = 2p - 1, as `CurvaturePrior` has it; `willmore`, `area`: the Willmore energy of u, and ∫|∇p|.
- `levels`: ∫ p(κ1, κ2) |∇p| with the curvatures of the level sets of p: by the co-area formula the mean of the sharp
  energy over all of them.
- `distance`: F_ε of tanh(d / √2ε), d = z / |∇z|, which does not know how steep the logits z are.
- `mask`: F_ε of the phase field of p > 1/2, which has no gradient: a number to watch.
- `flow`: no loss but `segment`, which lowers F_ε of the law by a flow that holds nothing; its weight in hindsight, too.
- `…+mass`: with the mean of u held at the law's mass, as in the paper's flow.

`value`: of exact logits s d, d the distance from the surface of a grown shape, the ratio of the values at s = 20 and
.707 (the profile of ε = 2), and what 12 cuts and 12 specks add at either. `alone`: minimised over the logits of a ball
with specks, without data; the Dice that is left, and the share of voxels that are neither in nor out. `evidence`: log
likelihoods of noise of two contrasts, 250 steps of Adam, the best weight (a share of the gradient) and the best
threshold in hindsight, as for `smoothing`. 40³ voxels, textures chosen before the first run.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from benchmarks.completion import SOBOL, shape
from benchmarks.harness import Cases, Figure, Values, bootstrap, show
from curvafit.data_synth.design import design_box
from curvafit.priors import CurvaturePrior
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.curvature import jet
from curvafit.priors.grid import Grid
from curvafit.priors.law import Law
from curvafit.priors.profile import phase_field
from curvafit.segmentation.segmentation import segment
from curvafit.segmentation.trials import dice

TEXTURES = ("tubes", "trabec", "sponge", "metatubes", "draw-0", "draw-5", "draw-9", "draw-12")
EDGE, SEED, EPSILON, NOISE, BLUR = 40, 2, 2.0, 2.0, 0.7
FORMS = ("area", "willmore", "product", "levels", "distance")
WAYS = (*FORMS, *(f"{form}+mass" for form in FORMS))
#: Shares of the gradient that hindsight chooses from, widths of a Gaussian in voxels, and steps.
SHARES, WIDTHS, STEPS, RATE = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0), (1.0, 1.5, 2.0, 2.5, 3.0), 250, 0.1
#: Weights of `segment`, in multiples of its default.
FLOWS = (0.3, 1.0, 3.0)
#: Slopes of logits: the profile of ε, and a confident network's. How firmly a mass is held; widths of flat logits.
SLOPES, FIRM, FLAT = (2**-0.5, 20.0), 10.0, 0.02
#: Cuts and specks, and their radius in voxels.
FAULTS, RADIUS = 12, 3

Form = Callable[[Tensor], Tensor]


def parameters(texture: str) -> tuple[tuple[float, ...], float]:
    """Return a texture's coefficients with lengths in voxels, and its mass."""
    if texture.startswith("draw-"):
        draw = design_box("sobol", ["a02"]).draw(SOBOL, int(texture.removeprefix("draw-")))
        law, mass = draw.coefficients, draw.mass
    else:
        preset = Law.of(texture)
        law, mass = preset.coefficients, preset.mass
        assert mass is not None
    return tuple(law.in_unit(0.01)), float(mass)


def form_of(way: str, law: tuple[float, ...]) -> Form:
    """Return the energy of logits (Z, Y, X), summed, by a form's name."""
    form = way.partition("+")[0]
    chosen = Coefficients.willmore() if form == "willmore" else Coefficients(*law)
    energy = CurvaturePrior(chosen, reduction="sum", border=0, epsilon=EPSILON)

    def measure(z: Tensor) -> Tensor:
        p, grid = z.sigmoid(), Grid(tuple(z.shape), 1.0, "replicate")  # type: ignore[arg-type]
        if form == "area":
            value = (jet(p, grid).gradient.square().sum(-4) + 1e-6).sqrt().sum()
        elif form == "levels":
            value = levels(p, law, grid)
        elif form == "distance":
            slope = (jet(z, grid).gradient.square().sum(-4) + FLAT).sqrt()
            value = energy((2**0.5 / EPSILON * z / slope).sigmoid()[None, None])  # tanh(d / √2ε) = 2 σ(√2 d / ε) - 1
        elif form == "mask":
            value = energy((phase_field(z > 0, grid, EPSILON)[None, None] + 1) / 2)
        else:
            value = energy(p[None, None])
        return value

    return measure


def levels(p: Tensor, law: tuple[float, ...], grid: Grid) -> Tensor:
    """Return ∫ p(κ1, κ2) |∇p| with the curvatures of the level sets of p; flat voxels have none."""
    _, gradient, hessian = jet(p, grid)
    (gz, gy, gx), (zz, yy, xx, zy, zx, yx) = gradient.unbind(-4), hessian.unbind(-4)
    slope2 = gz**2 + gy**2 + gx**2
    length2 = slope2 + FLAT**2
    normal = gz * (gz * zz + 2 * (gy * zy + gx * zx)) + gy * (gy * yy + 2 * gx * yx) + gx**2 * xx
    mean = -(zz + yy + xx - normal / length2) / length2.sqrt()
    diagonal = gz**2 * (yy * xx - yx**2) + gy**2 * (zz * xx - zx**2) + gx**2 * (zz * yy - zy**2)
    cross = gz * gy * (zx * yx - zy * xx) + gz * gx * (zy * yx - zx * yy) + gy * gx * (zy * zx - zz * yx)
    root = ((mean**2 - 4 * (diagonal + 2 * cross) / length2**2).clamp_min(0) + 1e-6).sqrt()
    κ1, κ2 = (mean + root) / 2, (mean - root) / 2
    a20, a11, a02, a10, a01, a00 = law
    density = a20 * κ1**2 + a11 * κ1 * κ2 + a02 * κ2**2 + a10 * κ1 + a01 * κ2 + a00
    return (density * slope2.clamp_min(1e-12).sqrt()).sum()


# ---- what a value says -----------------------------------------------------------------------------------------------


def truth_of(texture: str, cases: Cases) -> np.ndarray:
    return shape(texture, SEED, cases)[:EDGE, :EDGE, :EDGE]


def damaged(mask: np.ndarray) -> np.ndarray:
    """Return a mask with balls cut out of its structure, and balls set beside it."""
    random, found = np.random.default_rng(5), mask.copy()
    z, y, x = np.mgrid[:EDGE, :EDGE, :EDGE]
    depth = ndimage.distance_transform_edt(mask), ndimage.distance_transform_edt(~mask)
    for phase, value in zip((depth[0] > 1, depth[1] > RADIUS + 1), (False, True), strict=True):
        places = np.argwhere(phase)
        for centre in places[random.choice(len(places), min(FAULTS, len(places)), replace=False)]:
            found[np.hypot(np.hypot(z - centre[0], y - centre[1]), x - centre[2]) < RADIUS] = value
    return found


def signed(mask: np.ndarray) -> Tensor:
    """Return distances from a mask's surface, positive inside, smoothed by half a voxel."""
    distance = ndimage.distance_transform_edt(mask) - ndimage.distance_transform_edt(~mask)
    return torch.from_numpy(ndimage.gaussian_filter(distance - 0.5 * np.sign(distance), 0.7)).float()


def value_case(way: str, texture: str, cases: Cases) -> Values:
    """Return the ratio of a form's values at two slopes, and by how much damage raises it at either."""
    truth = truth_of(texture, cases)
    form = form_of(way, parameters(texture)[0])
    first, second = ([float(form(slope * signed(mask))) for mask in (truth, damaged(truth))] for slope in SLOPES)
    return {"steep": second[0] / first[0], "fault": first[1] / first[0] - 1, "fault_steep": second[1] / second[0] - 1}


def alone_case(way: str, texture: str, cases: Cases) -> Values:
    """Minimise a form alone from a ball with specks."""
    law, mass = parameters(texture)
    z, y, x = np.mgrid[:EDGE, :EDGE, :EDGE] - (EDGE - 1) / 2
    ball = np.sqrt(z**2 + y**2 + x**2) < 10
    start = np.where(np.random.default_rng(0).random(ball.shape) < 0.03, ~ball, ball)
    if "+" in way:
        mass = float(2 * ball.mean() - 1)
    logits = descend(form_of(way, law), None, torch.from_numpy(np.where(start, 4.0, -4.0)).float(), 1.0, 400,
                     mass if "+" in way else None)  # fmt: skip
    p = logits.sigmoid().numpy()
    return {"dice": dice(p > 0.5, ball), "undecided": float((np.abs(p - 0.5) < 0.25).mean())}


# ---- from evidence ---------------------------------------------------------------------------------------------------


def descend(
    form: Form, evidence: Tensor | None, start: Tensor, weight: float, steps: int, mass: float | None = None
) -> Tensor:
    """Return the logits that Adam finds from evidence, log-odds of each voxel, and a weighted form."""
    z = start.clone().requires_grad_()
    adam = torch.optim.Adam([z], RATE)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    for _ in range(steps):
        adam.zero_grad()
        p = z.sigmoid()
        loss = weight * form(z) if weight else z.sum() * 0
        if evidence is not None:
            loss = loss - (evidence * p).sum() + 0.02 * (p * z - torch.nn.functional.softplus(z)).sum()
        if mass is not None:
            loss = loss + FIRM * z.numel() * ((2 * p - 1).mean() - mass) ** 2
        loss.backward()
        adam.step()
        rate.step()
    return z.detach()


def best_dice(values: np.ndarray, truth: np.ndarray) -> float:
    """Return the Dice at the best threshold."""
    return max(dice(values > level, truth) for level in np.quantile(values, np.linspace(0.4, 0.98, 60)))


def evidence_case(way: str, share: float, texture: str, cases: Cases) -> Values:
    """Return the Dice of a form with a weight, from noisy evidence."""
    truth, (law, mass) = truth_of(texture, cases), parameters(texture)
    clear = ndimage.gaussian_filter(truth.astype(np.float32), BLUR, mode="nearest")
    image = clear + NOISE * np.random.default_rng(0).standard_normal(truth.shape)
    if way == "smoothing":
        return {"dice": best_dice(ndimage.gaussian_filter(image, share), truth)}
    if way in ("flow", "flow willmore"):
        prior = Coefficients(*law) if way == "flow" else Coefficients.willmore()
        found = segment(image, prior, weight=share * 0.6 / (prior.a20 + prior.a02))
        return {"dice": best_dice(found.phase.values, truth), "half": dice(found.mask.values > 0, truth)}
    evidence = torch.from_numpy((image - 0.5) / NOISE**2).float()
    form, held = form_of(way, law), mass if "+" in way else None
    smooth = torch.from_numpy(ndimage.gaussian_filter(evidence.numpy(), 1.5)).mul(4).requires_grad_()
    (pull,) = torch.autograd.grad((evidence * smooth.sigmoid()).sum(), smooth)
    (push,) = torch.autograd.grad(form(smooth), smooth)
    z = descend(form, evidence, evidence, share * float(pull.norm() / push.norm()), STEPS, held)
    return {"dice": best_dice(z.numpy(), truth), "half": dice(z.numpy() > 0, truth)}


# ---- runs ------------------------------------------------------------------------------------------------------------


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", help="textures, by default all")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", category=UserWarning)
    textures = TEXTURES if options.only is None else tuple(options.only.split(","))
    ways = WAYS
    if cases.quick:
        textures, ways = ("tubes",), ("product", "levels")
    shares = dict.fromkeys(ways, SHARES[2:3] if cases.quick else SHARES)
    shares |= {"smoothing": WIDTHS, "flow": FLOWS, "flow willmore": FLOWS}
    told: dict[str, list[Values]] = {}
    for way, texture in product((*FORMS, "mask"), textures if not cases.quick else ()):
        made = cases.all({f"value-{way}-{texture}": partial(value_case, way, texture, cases)})
        told.setdefault(way, []).extend(made.values())
    left = {way: list(cases.all({f"alone-{way}-{texture}": partial(alone_case, way, texture, cases)
            for texture in textures if not cases.quick}).values()) for way in ways}  # fmt: skip
    gained: dict[str, list[float]] = {}
    for way, texture in product(shares, textures):
        jobs = {f"evidence-{way}-{share:g}-{texture}": partial(evidence_case, way, share, texture, cases)
                for share in shares[way]}  # fmt: skip
        made = cases.all(jobs)
        if len(made) == len(jobs):
            gained.setdefault(way, []).append(max(values["dice"] for values in made.values()))
    figures = {f"forms.mask.value_{key}": bootstrap([values[key] for values in told["mask"]])
               for key in ("steep", "fault", "fault_steep") if len(told.get("mask", [])) == len(TEXTURES)}  # fmt: skip
    for way, rows in gained.items():
        if len(rows) < len(TEXTURES):
            continue
        figures[f"forms.{way}.dice"] = bootstrap(rows, np.mean)
        for name, part in (("alone", left.get(way, [])), ("value", told.get(way.partition("+")[0], []))):
            for key in part[0] if part else ():
                figures[f"forms.{way}.{name}_{key}"] = bootstrap([values[key] for values in part])
    show(["figure", "value"], list(figures.items()))
    return figures
