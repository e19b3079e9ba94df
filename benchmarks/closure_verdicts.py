"""False alarms: how often `infer` finds no believable twin of shapes that the model made itself.

    python -m benchmarks.closure_verdicts STORE [--posterior FILE] [--cache FOLDER] [--queries 60] [--from 0]
                                          [--kinds mask,image] [--minutes 3]

The queries are STORE's first well-formed shapes, which the posterior must not have learnt from: as the mask of the
whole box, taken for one that does not repeat, and as the grey levels of `inference.views`'s degraded scan of a window.
One whole `infer`, with its twins, for each: some 100 s of a core; and, where the scan's voxels are kept, twins of the
true law, seen as the scan, to tell what the law misses from what a true one would. A run ends after some minutes with
the table so far, and the next one goes on; a file for each query and kind holds the fit, named after the posterior, and
each table judges the fits anew. What else the program does is not in the name: another state of it wants another
folder.

- law: what `infer` answers, or truth, where the true law is the only candidate.
- n: queries; other: those that `infer` refuses to measure, or whose true law was not grown; they do not count below.
- no twin, near, undecided, no law: the parts with these verdicts. far, strange: the parts whose twins lie beyond
  `candidates.CLOSE` seeds' distances, and whose misfit is below `misfit.UNBELIEVABLE`: the two reasons against a law.
- distance: of the best law's twins from the query, over that of two twins: median, 90 and 95 %.
- p < .05: part of the queries whose misfit is so low. seconds: median.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.closure_trials import key_of_posterior, queries_of
from curvafit.core.files import write_content
from curvafit.data_synth import open_store
from curvafit.data_synth.atlas.store import Store
from curvafit.inference.candidates import CLOSE, Candidate, best_of, noise_of
from curvafit.inference.fit import Fit
from curvafit.inference.infer import TWINS, infer
from curvafit.inference.misfit import UNBELIEVABLE
from curvafit.inference.posterior import Posterior, load_posterior
from curvafit.inference.twins import twin
from curvafit.inference.verdict import UNBELIEVED, UNDECIDED, verdict
from curvafit.inference.views import crop, degraded
from curvafit.priors.grid import Grid
from curvafit.volumes.scan import Field, ScanError


def as_mask(field: np.ndarray, rng: np.random.Generator) -> Field:
    return Field((field > 0).astype(np.uint8), (1.0, 1.0, 1.0), "voxel")


def as_image(field: np.ndarray, rng: np.random.Generator) -> Field:
    z, y, x = field.shape
    return degraded(crop(field, Grid((z, y, x)), rng).shape, rng)


#: What is made of a phase field, by the kind that `infer` takes it for.
KINDS: dict[str, Callable[[np.ndarray, np.random.Generator], Field]] = {"mask": as_mask, "image": as_image}


def answer(store: Store, index: int, kind: str, posterior: Posterior) -> dict[str, Any]:
    """What `infer` says of a shape, and what twins of its own law are, in JSON's types; only the reason where it
    refuses."""
    begun = time.perf_counter()
    try:
        scan = KINDS[kind](store.field(index), np.random.default_rng(index))
        answered = infer(scan, kind=kind, posterior=posterior)  # type: ignore[arg-type]
    except ScanError as error:
        return {"refused": str(error)}
    seconds, record, prepared = time.perf_counter() - begun, store.record(index), answered.prepared
    answer = {"fit": answered.fit.to_json(), "seconds": seconds}
    if answered.diagram is None or prepared.scale != (1.0, 1.0, 1.0):
        return answer
    grown = [twin(record.coefficients, record.mass, prepared, seed) for seed in range(TWINS)]
    truth = Candidate("match", record.coefficients, record.mass, {}).grown(answered.diagram, grown)
    return answer | {"truth": truth.as_dict()}


@dataclass(frozen=True)
class Judged:
    """One answer's verdict and the numbers behind it."""

    status: str
    distance: float
    noise: float
    misfit: float
    seconds: float


def judged(content: dict[str, Any], true: bool) -> Judged:
    """The verdict on what `infer` answered, by today's rules; on the true law."""
    fit = Fit.from_json(content["fit"])
    laws = (Candidate.from_dict(content["truth"]),) if true else fit.candidates
    best = best_of(laws)
    status = verdict(laws, fit.misfit, fit.morphometry)[1] if laws else fit.status
    distance = None if best is None else best.distance
    misfit = None if fit.misfit is None else fit.misfit.probability
    return Judged(status, _number(distance), _number(noise_of(laws)), _number(misfit), content["seconds"])


def figures(answers: list[dict[str, Any]], true: bool) -> str:
    """The columns of the table."""
    known = "truth" if true else "fit"
    told = [judged(each, true) for each in answers if known in each]
    ratio = np.array([each.distance / each.noise for each in told])
    misfit = np.array([each.misfit for each in told])
    begins = (UNBELIEVED, "Near", UNDECIDED, "No law")
    parts = [_part(each.status.startswith(begin) for each in told) for begin in begins]
    parts += [_part(ratio > CLOSE), _part(misfit < UNBELIEVABLE)]
    finite = ratio[np.isfinite(ratio)]
    quantiles = np.quantile(finite, (0.5, 0.9, 0.95)) if len(finite) else np.full(3, np.nan)
    seconds = np.median([each.seconds for each in told]) if told else np.nan
    numbers = [*parts, *quantiles, _part(misfit < 0.05)]
    counts = f"{len(answers):4} {len(answers) - len(told):7} "
    return counts + " ".join(f"{each:7.2f}" for each in numbers) + f" {seconds:7.0f}"


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _part(cases: Any) -> float:
    values = list(cases)
    return float(np.mean(values)) if values else np.nan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    parser.add_argument("--posterior", type=Path, default=None)
    parser.add_argument("--cache", type=Path, default=Path("closure_verdicts"))
    parser.add_argument("--queries", type=int, default=60)
    parser.add_argument("--from", type=int, default=0, dest="first", help="how many of them to leave out")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--minutes", type=float, default=3.0)
    options = parser.parse_args()
    end = time.monotonic() + 60 * options.minutes
    store, posterior = open_store(options.store), load_posterior(options.posterior)
    queries, kinds = queries_of(store, options.queries)[options.first :], options.kinds.split(",")
    key = key_of_posterior(posterior)
    paths = {
        (index, kind): options.cache / f"{store.path.stem}-{index:06d}-{kind}-{key}.json"
        for index in queries
        for kind in kinds
    }
    for (index, kind), path in paths.items():
        if not path.exists() and time.monotonic() < end:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_content(path, json.dumps(answer(store, index, kind, posterior)))
    columns = (
        "no twin",
        "near",
        "undec.",
        "no law",
        "far",
        "strange",
        "distance",
        "90 %",
        "95 %",
        "p < .05",
        "seconds",
    )
    print(f"{'kind':6} {'law':6} {'n':>4} {'other':>7} " + " ".join(f"{each:>7}" for each in columns))
    for kind in kinds:
        answers = [json.loads(path.read_text()) for (_, of), path in paths.items() if of == kind and path.exists()]
        for law, true in (("infer", False), ("truth", True)):
            print(f"{kind:6} {law:6} {figures(answers, true)}")
    left = sum(not path.exists() for path in paths.values())
    print(f"{left} files left: run again" if left else "all done")


if __name__ == "__main__":
    main()
