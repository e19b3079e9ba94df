"""What `infer` says in seconds: of shapes of laws that taught nothing, by three schedules, and of what no law made.

Laws are the presets and the random ones of `completion`; each grows a shape of 64³ by `deep`, by `fast` and by `paper`
with half its steps, in a periodic box. `published` are laws that no choice has seen, near presets and of the box, at
100³ by the whole of `paper`; the paper author's own volumes ($CURVAFIT_DATA) are of 100³. Each is seen as a mask, cut
open, and as a bad scan, on a scanner's voxels, as `examples/train.py` sees them. Other textures are those that
teach the network that fills volumes: level cuts, walls of cells, grains, trees of tubes, fibres, so many of each, seen
in the same way.

`quick` is the part of shapes whose p is below .05 (the size of the test for laws, its power for others). Errors are
those of the posterior's medians, in deviations of the box; `in90` is the part of the parameters that lie within the
central 90 % of the draws. What cannot be read, as nothing grew or noise did, is left out.
"""

from __future__ import annotations

import argparse
import zlib
from functools import partial
from itertools import product

import numpy as np
from scipy import stats

from benchmarks.closure import PRIOR, SLUGS, over_laws
from benchmarks.completion import DRAWN, EDGE, LAWS, SOBOL, shape
from benchmarks.harness import Cases, Figure, Values, show
from benchmarks.texture import author_field, author_volumes
from curvafit.data_synth.design import design_box
from curvafit.generation.flow import generate
from curvafit.generation.result import is_well_formed
from curvafit.generation.schedule import Schedule, schedule
from curvafit.inference.candidates import UNBELIEVABLE
from curvafit.inference.inference import infer
from curvafit.inference.table import law_of as coefficients_of
from curvafit.inference.table import parameters_of
from curvafit.priors import preset
from curvafit.volumes.volume import ScanError
from examples.mixed import KINDS
from examples.train import VIEWS

SEED = 2
SCHEDULES: dict[str, Schedule] = {
    "deep": schedule("deep"),
    "fast": schedule("fast"),
    "paper": schedule("paper", 4000),
    "published": schedule("paper"),
}
SEEN = ("mask", "scan")
TEXTURES = 20
#: Laws near presets, and further draws of the box: half of the draws grow nothing.
PUBLISHED = (*(f"near-{k}" for k in range(12)), *(f"draw-{k}" for k in range(50, 74)))
#: How far from a preset a law near it is, in deviations of the box, in the root mean square of the parameters.
NEAR = 0.15


def law_of(name: str) -> tuple[np.ndarray, tuple]:
    """Return the parameters `(6,)` of a law, and what `generate` takes."""
    if name.startswith("draw-"):
        draw = design_box("sobol", ["a02"]).draw(SOBOL, int(name.removeprefix("draw-")))
        return parameters_of(draw.coefficients, draw.mass), (draw.coefficients, draw.mass)
    if name.startswith("near-"):
        number = int(name.removeprefix("near-"))
        way = np.random.default_rng([SEED, number]).standard_normal(6)
        around = law_of(LAWS[number % len(LAWS)])[0] + NEAR * PRIOR * way * np.sqrt(6) / np.linalg.norm(way)
        return around, coefficients_of(around)
    law = preset(name)
    return parameters_of(law.coefficients, law.mass), (name,)


def grow(name: str, by: str, cases: Cases) -> np.ndarray:
    """Return the mask of a law by a schedule, grown once, or by the paper's author."""
    if by == "author":
        return author_field(name).numpy() > 0
    if by == "deep":
        return shape(name, SEED, cases)

    edge = 100 if by == "published" else EDGE

    def made() -> np.ndarray:
        law = law_of(name)[1]
        flow = generate(*law, grid=edge, schedule=SCHEDULES[by], seed=SEED, reject_early=by == "published")
        return np.packbits((flow.field.numpy() > 0) & (by != "published" or is_well_formed(flow.viability)))

    return np.unpackbits(cases.array(f"{by}-{name}", made)).reshape(edge, edge, edge) > 0


def read(mask: np.ndarray, name: str, seen: str, truth: np.ndarray | None) -> Values:
    """Return what `infer` says of a mask as it is seen: p, and of a law errors in deviations, and what is covered."""
    if mask.all() or not mask.any():
        return {"status": "nothing grew"}
    random = np.random.default_rng([SEED, zlib.crc32(f"{name}-{seen}".encode())])
    try:
        scan, kind, periodic = VIEWS[seen](np.where(mask, 1.0, -1.0).astype(np.float32), random)
        fit = infer(scan, kind=kind, periodic=periodic).fit
    except ScanError as error:
        return {"status": str(error)}
    found: Values = {"status": fit.status, "p": None if fit.misfit is None else fit.misfit.probability}
    if truth is not None and fit.draws is not None:
        draws = fit.draws[:, :-1]
        least, median, most = np.quantile(draws, (0.05, 0.5, 0.95), axis=0)
        found["error"] = np.round((median - truth) / PRIOR, 3).tolist()
        found["in 90"] = ((least <= truth) & (truth <= most)).tolist()
    return found


def law_case(name: str, by: str, seen: str, cases: Cases) -> Values:
    return read(grow(name, by, cases), name, seen, law_of(name)[0])


def texture_case(kind: str, number: int, seen: str) -> Values:
    random = np.random.default_rng([SEED, *kind.encode(), number])  # other textures than those that taught
    return read(KINDS[kind](random) > 0, f"{kind}-{number}", seen, None)


def part_below(rows: list[Values]) -> Figure:
    """Return the part of cases that the test rules out, of those that can be read, with Wilson's interval."""
    p = [row["p"] for row in rows if row.get("p") is not None]
    hits = sum(value < UNBELIEVABLE for value in p)
    interval = stats.binomtest(hits, len(p)).proportion_ci(method="wilson") if p else (np.nan, np.nan)
    return Figure(hits / max(len(p), 1), *map(float, interval))


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--share", default="0/1", help="of the cases, for several processes")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    laws, number = (LAWS[:1], 1) if options.quick else ((*LAWS, *DRAWN), TEXTURES)
    grown = dict.fromkeys(SCHEDULES, laws)
    grown |= (
        {"published": (), "author": ()} if options.quick else {"published": PUBLISHED, "author": (*author_volumes(),)}
    )
    jobs = {f"{by}-{name}-{seen}": partial(law_case, name, by, seen, cases)
            for by, names in grown.items() for name, seen in product(names, SEEN)}  # fmt: skip
    jobs |= {f"{kind}-{k}-{seen}": partial(texture_case, kind, k, seen)
             for kind, k, seen in product(KINDS, range(number), SEEN)}  # fmt: skip
    share, shares = map(int, options.share.split("/"))
    found = cases.all(dict(list(jobs.items())[share::shares]), SEED)
    figures: dict[str, Figure] = {}
    for seen in SEEN:
        of_laws: list[Values] = []
        for by, names in grown.items():
            rows = [found[case] for name in names if (case := f"{by}-{name}-{seen}") in found]
            of_laws += rows
            if known := [row for row in rows if "error" in row]:
                away, order = np.abs([row["error"] for row in known]), np.arange(len(known))
                covered = np.mean([row["in 90"] for row in known], axis=1, keepdims=True)
                for slug, each in zip(SLUGS, over_laws(away, order, np.median), strict=True):
                    figures[f"reading.{seen}_{by}.{slug}"] = each
                figures[f"reading.{seen}_{by}.in90"] = over_laws(covered, order, np.mean)[0]
        figures[f"quick.laws.{seen}"] = part_below(of_laws)
        for kind in KINDS:
            rows = [found[case] for k in range(number) if (case := f"{kind}-{k}-{seen}") in found]
            figures[f"quick.{kind.replace(' ', '_')}.{seen}"] = part_below(rows)
    show(["", ""], list(figures.items()))
    return {} if options.quick or shares > 1 else figures
