"""Two annotated slices of the very volume to segment: what a curvature loss adds to labels that `reconstruct` fills.

A volume of 64³ (twelve random laws, `trabec`, two bones, mitochondria: each texture once, and it is the unit) is
blurred, under noise of two contrasts; slices 21 and 42 are annotated. `plain` learns them alone; `pseudo` what
`reconstruct --image` fills, each voxel as sure as it is; the others start as `pseudo` does, and from the second third
on add a form of the energy (`benchmarks.forms`) of all voxels: `area`, `willmore`, the law of another volume's mask
(`law`), or another texture's (`wrong`, at the share of `law`). `…+volume` holds the mean of p besides, at the fraction
of the volume that the law was read from (of a network's sharp p that is the mass of the paper's flow), and `volume`
does that alone. `flow` learns, from then on and renewed twice, the mask to which F_ε is lowered from what the network
says, and `refine` does so once, afterwards (`segment --probabilities`). `filled` is no network.

Shares of the gradient (of `flow` and `refine` weights) are chosen for each way by eight slices, `SLAB`, of four other
random laws. Dice counts the slices that nobody annotated.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import product

import numpy as np
import torch
from scipy import ndimage, stats
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.completion import EDGE, fitted, shape, sides
from benchmarks.forms import FIRM, form_of
from benchmarks.harness import Cases, Figure, Values, bootstrap, scores, show
from curvafit.inference.fit import Fit
from curvafit.inference.inference import infer
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.law import Law
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.segmentation import segment
from curvafit.segmentation.trials import dice

#: Textures that are reported, and those that choose.
DRAWS = tuple(f"draw-{k}" for k in (0, 1, 2, 5, 6, 9, 11, 12, 13, 20, 21, 22))
TEXTURES = (*DRAWS, "trabec", "bone", "cortical", "mitochondria-32")
TUNING = tuple(f"draw-{k}" for k in (24, 26, 29, 34))
#: Corners of real blocks: of the volume, and of the one that the law is read from.
BLOCKS = {"bone": ((64, 64, 0), (64, 64, 0)), "cortical": ((0, 64, 0), (64, 0, 0)),
          "mitochondria-32": ((32, 0, 0), (64, 0, 64))}  # fmt: skip
KNOWN, SLAB, UNKNOWN = (21, 42), range(50, 58), 2
#: The seeds of a volume and of the one whose law is read.
SEED, OTHER = 2, 3
STEPS, RATE, PATCH, NOISE, BLUR, WARM = 240, 6e-3, 48, 2.0, 0.7, 24
LAW_FORMS = {"law": "product", "law+volume": "product", "wrong": "product"}
FORMS = {"area": "area", "area+volume": "area", "willmore": "willmore", "volume": ""} | LAW_FORMS
SHARES = (0.1, 1.0, 3.0, 10.0)
#: Ways that lower F_ε, and their weights, in multiples of `segment`'s default.
LOWERING, WEIGHTS = ("flow", "refine"), (0.1, 0.3, 1.0, 3.0)
WAYS = ("plain", "filled", "pseudo", *FORMS, *LOWERING)
KEYS = ("dice", "cldice", "betti")
Loss = Callable[[Tensor, Tensor], Tensor]


# ---- volumes ---------------------------------------------------------------------------------------------------------


def truth_of(texture: str, cases: Cases, seed: int = SEED) -> np.ndarray:
    """Return a mask of 64³: a grown shape, or a block of a real structure."""
    if texture not in BLOCKS:
        return shape(texture, seed, cases)
    place = int(seed == OTHER)
    z, y, x = BLOCKS[texture][place]
    side = 1 if texture == "cortical" else place  # the first side of it is compact bone
    return sides(texture)[side].values[z : z + EDGE, y : y + EDGE, x : x + EDGE] > 0


def image_of(truth: np.ndarray, seed: int) -> np.ndarray:
    """Return a noisy image of a mask, standardised."""
    clear = ndimage.gaussian_filter(truth.astype(np.float32), BLUR, mode="nearest")
    values = clear + NOISE * np.random.default_rng(seed).standard_normal(truth.shape, dtype=np.float32)
    return (values - values.mean()) / values.std()


def annotated(truth: np.ndarray, slices: Iterable[int]) -> np.ndarray:
    """Return the labels of some slices, `UNKNOWN` elsewhere."""
    target = np.full(truth.shape, UNKNOWN, np.float32)
    target[list(slices)] = truth[list(slices)]
    return target


def law_of(texture: str, cases: Cases) -> Coefficients:
    """Return the law of another volume's mask with lengths in voxels."""
    if texture not in BLOCKS:
        return Law.of(fitted(texture, OTHER, cases)).in_unit(None, 1.0)
    mask = truth_of(texture, cases, OTHER).astype(np.uint8)
    path = cases.text(f"fit-{texture}.json", lambda: infer(mask, kind="mask", growth=None).fit.to_json())
    return Law.of(Fit.load(path)).in_unit(None, 1.0)


def filled(texture: str, cases: Cases) -> np.ndarray:
    """Return the probabilities that `reconstruct` gives a volume, from two slices and its image."""

    def fill() -> np.ndarray:
        truth = truth_of(texture, cases)
        slices = np.zeros(truth.shape, np.uint8)
        slices[list(KNOWN)] = truth[list(KNOWN)]
        found = reconstruct(slices, known=KNOWN, image=image_of(truth, SEED))
        assert found.probability is not None
        return found.probability.values.astype(np.float16)

    return cases.array(f"filled-{texture}", fill).astype(np.float32)


# ---- training --------------------------------------------------------------------------------------------------------


def network(seed: int) -> nn.Module:
    from monai.networks.nets.dynunet import DynUNet

    torch.manual_seed(seed)
    net = DynUNet(3, 1, 1, [3, 3, 3], [1, 2, 2], [2, 2], filters=(8, 16, 32), norm_name="batch")
    return net.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]


def predict(net: nn.Module, x: Tensor) -> Tensor:
    """Return logits in single precision, of convolutions in half: on processors that have them they take a seventh."""
    with torch.autocast("cpu", torch.bfloat16):
        return net(x).float()


def predict_whole(net: nn.Module, image: np.ndarray) -> np.ndarray:
    """Return the probabilities of a whole image."""
    net.eval()
    with torch.no_grad():
        return predict(net, torch.from_numpy(image)[None, None])[0, 0].sigmoid().numpy()


def dice_ce(logits: Tensor, target: Tensor) -> Tensor:
    """Return soft Dice and cross-entropy of the labelled voxels."""
    known = target != UNKNOWN
    z, y = logits[known], target[known]
    p = z.sigmoid()
    overlap = (2 * (p * y).sum() + 1) / (p.sum() + y.sum() + 1)
    return 1 - overlap + functional.binary_cross_entropy_with_logits(z, y)


def soft_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return Dice and cross-entropy of probabilities, each voxel weighed by how sure it is."""
    sure, y = (2 * target - 1).abs(), (target > 0.5).float()
    p = logits.sigmoid()
    overlap = (2 * (sure * p * y).sum() + 1) / ((sure * (p + y)).sum() + 1)
    return 1 - overlap + functional.binary_cross_entropy_with_logits(logits, y, sure)


def lessons(image: np.ndarray, target: np.ndarray, seed: int) -> Callable[[int], tuple[Tensor, Tensor]]:
    """Return patches of an image and its target by step, turned, mirrored and with their grey values changed."""

    def batch(step: int) -> tuple[Tensor, Tensor]:
        random = np.random.default_rng([seed, step % 2**32])
        corner = [int(random.integers(n - PATCH + 1)) for n in image.shape]
        box = tuple(slice(a, a + PATCH) for a in corner)
        axes = tuple(axis for axis in range(3) if random.random() < 0.5)
        x, y = (np.flip(each[box], axes).astype(np.float32) for each in (image, target))
        x = random.uniform(0.9, 1.1) * x + random.uniform(-0.1, 0.1)
        return torch.from_numpy(x.astype(np.float32))[None, None], torch.from_numpy(y.copy())[None, None]

    return batch


def learn(
    net: nn.Module,
    batch: Callable[[int], tuple[Tensor, Tensor]],
    steps: int,
    rate: float,
    loss_at: Callable[[int], Loss] = lambda step: dice_ce,
) -> None:
    """Teach a network by the loss of logits and target at each step; the rate falls to 0."""
    adam = torch.optim.AdamW(net.parameters(), rate)
    net.train()
    for step in range(steps):
        loss = loss_at(step)
        net.train()
        adam.param_groups[0]["lr"] = rate * (1 + np.cos(np.pi * step / steps)) / 2
        x, y = batch(step)
        adam.zero_grad()
        loss(predict(net, x), y).backward()
        nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        adam.step()


def lowered(p: np.ndarray, law: Coefficients, weight: float) -> np.ndarray:
    """Return the mask to which F_ε is lowered from probabilities, by a multiple of `segment`'s default weight."""
    found = segment(p, law, probabilities=True, weight=weight * 0.6 / (law.a20 + law.a02))
    return found.mask.values > 0


def train(way: str, share: float, texture: str, steps: int, cases: Cases) -> np.ndarray:
    """Return the probabilities of a network that was taught two slices of a volume, for all of it."""
    truth, net = truth_of(texture, cases), network(SEED)
    image = image_of(truth, SEED)
    target = annotated(truth, KNOWN) if way == "plain" else filled(texture, cases)
    base = dice_ce if way == "plain" else soft_loss
    others = (*TEXTURES, *TUNING)
    source = others[(others.index(texture) + 1) % len(others)] if way == "wrong" else texture
    law = law_of(source, cases) if way in LAW_FORMS or way == "flow" else Coefficients.willmore()
    fraction = float(truth_of(texture, cases, OTHER).mean())
    lesson, losses = [lessons(image, target, SEED)], list[Loss]()

    def loss_at(step: int) -> Loss:
        if way in FORMS and step == steps // 3:
            form = form_of(FORMS[way], tuple(law)) if FORMS[way] else lambda z: z.sum() * 0
            pairs = [(predict(net, x).detach(), y) for x, y in map(lesson[0], range(-5, 0))]
            weight = share and share * float(np.median([norm(soft_loss, *pair) / norm(lambda z, _: form(z[0, 0]), *pair)
                                              for pair in pairs]))  # fmt: skip

            def both(logits: Tensor, y: Tensor, begun: int = steps // 3) -> Tensor:
                grown = min(1.0, (counted[0] - begun) / WARM)
                loss = base(logits, y) + grown * weight * form(logits[0, 0])
                if way.endswith("volume"):
                    loss = loss + 4 * FIRM * (logits.sigmoid().mean() - fraction) ** 2
                return loss

            losses.append(both)
        if way == "flow" and step in (steps // 3, steps // 2, 2 * steps // 3):
            mask = lowered(predict_whole(net, image), law, share).astype(np.float32)
            mask[list(KNOWN)] = truth[list(KNOWN)]
            lesson[0] = lessons(image, (target + mask) / 2, SEED)  # sure where the two agree
        counted[0] = step
        return losses[0] if losses else base

    counted = [0]
    learn(net, lambda step: lesson[0](step), steps, RATE, loss_at)
    return predict_whole(net, image)


def norm(loss: Loss, logits: Tensor, target: Tensor) -> float:
    """Return the norm of a loss's gradient by the logits."""
    z = logits.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(z, target), z)
    return float(gradient.norm())


def predicted(way: str, share: float, texture: str, steps: int, cases: Cases) -> np.ndarray:
    """Return the probabilities of a way's network, trained once."""
    make = partial(train, way, share, texture, steps, cases)
    name = f"p-{texture}-{way}-{share:g}-{steps}"
    return cases.array(name, lambda: make().astype(np.float16)).astype(np.float32)


def case(way: str, share: float, texture: str, steps: int, cases: Cases) -> Values:
    """Return the scores of a way on the slices that nobody annotated, and on those that choose."""
    truth = truth_of(texture, cases)
    if way == "filled":
        p = filled(texture, cases)
    else:
        p = predicted("pseudo" if way == "refine" else way, 0.0 if way == "refine" else share, texture, steps, cases)
    mask = lowered(p, law_of(texture, cases), share) if way == "refine" else p > 0.5
    rest = np.setdiff1d(np.arange(len(truth)), KNOWN)
    return {"dice": dice(mask[rest], truth[rest]), "betti": scores(mask, truth)["betti"], "cldice": cldice(mask, truth),
            "slab": dice(mask[SLAB], truth[SLAB])}  # fmt: skip


def cldice(mask: np.ndarray, truth: np.ndarray) -> float:
    from skimage.morphology import skeletonize

    thin, true_thin = skeletonize(mask), skeletonize(truth)
    parts = ((thin & truth).sum() / max(thin.sum(), 1), (true_thin & mask).sum() / max(true_thin.sum(), 1))
    return float(2 * parts[0] * parts[1] / max(sum(parts), 1e-9))


# ---- runs ------------------------------------------------------------------------------------------------------------


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--share", default="0/1", help="which part of the textures, of how many processes")
    parser.add_argument("--ways", default=",".join(WAYS))


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", category=UserWarning)
    steps, ways = (6, ("pseudo", "law+volume")) if cases.quick else (STEPS, tuple(options.ways.split(",")))
    part, parts = map(int, options.share.split("/"))

    def scored(way: str, share: float, textures: Sequence[str]) -> list[Values]:
        """Make this process's part; return the values of all textures, if all are there."""
        names = {texture: f"{texture}-{way}-{share:g}-{steps}" for texture in textures}
        cases.all(
            {names[texture]: partial(case, way, share, texture, steps, cases) for texture in textures[part::parts]}
        )
        rows = [cases.kept[name]["values"] for name in names.values() if name in cases.kept]
        return rows if len(rows) == len(textures) else []

    chosen = dict.fromkeys(ways, SHARES[0]) if cases.quick else choose(ways, scored)
    found = {way: scored(way, share, TEXTURES[: 1 if cases.quick else None]) for way, share in chosen.items()}
    if cases.quick or not found.get("pseudo"):
        return {}
    table = {way: np.array([[row[key] for key in KEYS] for row in rows]) for way, rows in found.items() if rows}
    show(["way", "share", *KEYS], [[way, f"{chosen[way]:g}", *rows.mean(0).tolist()] for way, rows in table.items()])
    return compare_ways(table)


def choose(ways: Sequence[str], scored: Callable[[str, float, Sequence[str]], list[Values]]) -> dict[str, float]:
    """Return the share of each way that is best on the slabs; without ways of which not all is made."""
    chosen = {}
    for way in ways:
        shares = WEIGHTS if way in LOWERING else SHARES if way in FORMS and way not in ("wrong", "volume") else (0.0,)
        slabs = {share: [row["slab"] for row in scored(way, share, TUNING)] if share else [0.0] for share in shares}
        if all(slabs.values()):
            chosen[way] = max(slabs, key=lambda share: float(np.mean(slabs[share])))
            if len(slabs) > 1:
                show(["share", *TUNING], [[f"{share:g}", *rows] for share, rows in slabs.items()], way)
    return chosen | ({"wrong": chosen["law"]} if "wrong" in ways and "law" in chosen else {})


def compare_ways(table: dict[str, np.ndarray]) -> dict[str, Figure]:
    """Return gains on `pseudo`, and what laws gain on rivals, in points of Dice: with p, and with the gain that a
    paired test of so many textures, which spread so, finds with a probability of .8."""
    figures = {f"networks.{way}.{key}": bootstrap(rows[:, k] - table["pseudo"][:, k], np.mean)
               for way, rows in table.items() if way != "pseudo" for k, key in enumerate(KEYS)}  # fmt: skip
    for way, rival in product(table, ("area", "willmore", "wrong", "area+volume", "volume")):
        if way not in (*LAW_FORMS, *LOWERING) or rival not in table or way == rival:
            continue
        less = 100 * (table[way] - table[rival])[:, 0]
        figures[f"networks.{way}_less_{rival}"] = bootstrap(less, np.mean)
        figures[f"networks.{way}_less_{rival}.p"] = Figure(float(stats.wilcoxon(less)[1]))
        figures[f"networks.{way}_less_{rival}.power"] = Figure(float(2.8 * less.std(ddof=1) / len(less) ** 0.5))
    show(["figure", "value"], list(figures.items()))
    return figures
