"""Whole commands and calls, now and at another checkout, in pairs.

`--beside FOLDER` names the other checkout; without it the other is this one, which tells the noise. Each job is timed
in a process of its own, the two checkouts by turns; what a job makes is compared by its hash. `generate fixed` is the
command with one step, from the shell and back: start, imports, files, picture.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.harness import ROOT, Cases, Figure, Values, paired_ratio, show

BEGIN = """
import hashlib, json, time, warnings
import numpy as np
def end(begun, values):
    digest = hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()[:12]
    print(json.dumps([time.perf_counter() - begun, digest]))
"""
COMPLETION = """
from curvafit import generate, reconstruct
from curvafit.generation.schedule import schedule
mask = (generate({law!r}, grid=48, seed=3, schedule=schedule("fast", steps=400)).field.numpy() > 0).astype(np.uint8)
reconstruct(mask[:16, :16, :16], {law!r}, every=8, stiffness=1e7)
begun = time.perf_counter()
end(begun, reconstruct(mask, {law!r}, every=8, stiffness=1e7).mask.values)
"""
INFER = """
import subprocess, sys
from curvafit import infer
samples = [sys.executable, "-m", "curvafit", "samples", "get", "synthetic", "-o", "scan.nii.gz"]
subprocess.run(samples, check=True, stdout=subprocess.DEVNULL)
begun = time.perf_counter()
fit = infer("scan.nii.gz", seed=0, fast={fast}).fit
end(begun, np.array([*fit.coefficients, fit.mass] if fit.coefficients else []))
"""
#: What is timed within a process, after a first call that compiles.
JOBS = {
    "step": """
from curvafit import generate
from curvafit.generation.schedule import schedule
generate("tubes", grid=64, schedule=schedule("fast", steps=300))
begun = time.perf_counter()
end(begun, generate("tubes", grid=64, schedule=schedule("fast", steps=300), seed=1).field.numpy())
""",
    "prior": """
import torch
from curvafit.priors import CurvaturePrior
prior = CurvaturePrior("tubes", sigmoid=True)
logits = 3 * torch.randn((2, 1, 64, 64, 64), generator=torch.Generator().manual_seed(0)).requires_grad_()
prior(logits).backward()
begun = time.perf_counter()
for _ in range(10):
    (gradient,) = torch.autograd.grad(prior(logits), logits)
end(begun, gradient.numpy())
""",
    "completion of tubes": COMPLETION.format(law="tubes"),
    "completion of trabec": COMPLETION.format(law="trabec"),
    "infer": INFER.format(fast=False),
    "infer fast": INFER.format(fast=True),
}
KEYS = {
    "completion of tubes": "tubes",
    "completion of trabec": "trabec",
    "generate fixed": "command",
    "infer fast": "infer_fast",
}


def job(name: str, checkout: Path) -> tuple[float, str]:
    """Return the seconds of a job in a checkout, and the hash of what it makes."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "PYTHONPATH": str(checkout)}
        if name == "generate fixed":
            out = f"{folder}/tubes.nii.gz"
            command = ["-m", "curvafit", "generate", "--preset", "tubes", "--shape", "100", "--steps", "1", "-o", out]
        else:
            command = ["-W", "ignore", "-c", BEGIN + JOBS[name]]
        begun = time.perf_counter()
        done = subprocess.run(
            [sys.executable, *command], capture_output=True, text=True, cwd=folder, env=environment, check=False
        )
        if done.returncode:
            raise SystemExit(f"{name} at {checkout} failed: {done.stderr[-2000:]}")
        if name == "generate fixed":
            return time.perf_counter() - begun, ""
        seconds, digest = json.loads(done.stdout.splitlines()[-1])
        return seconds, digest


def pairs(name: str, other: Path, count: int) -> Values:
    """Time a job in pairs; which checkout begins changes from pair to pair."""
    job(name, ROOT)
    job(name, other)
    after, before = [], []
    for k in range(count):
        turns = [(ROOT, after), (other, before)]
        for checkout, taken in turns[:: 1 if k % 2 else -1]:
            taken.append(job(name, checkout))
    return {
        "after": [seconds for seconds, _ in after],
        "before": [seconds for seconds, _ in before],
        "same": after[0][1] == before[0][1],
    }


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--beside", type=Path, default=ROOT, metavar="FOLDER", help="another checkout")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--jobs", default="step,prior,generate fixed", help=f"of generate fixed, {', '.join(JOBS)}")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    other, count = options.beside.resolve(), 1 if options.quick else options.pairs
    commit = subprocess.run(["git", "-C", other, "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    beside = commit.stdout.strip() if other != ROOT else "itself"
    names = options.jobs.split(",")[:1] if options.quick else options.jobs.split(",")
    jobs = {f"{name.replace(' ', '-')}-{beside}-{count}": lambda name=name: pairs(name, other, count) for name in names}
    rows, figures = [], {}
    for name, found in zip(names, cases.all(jobs).values(), strict=False):
        ratio = paired_ratio(found["after"], found["before"])
        rows.append([name, min(found["after"]), min(found["before"]), ratio, "same" if found["same"] else "other"])
        if beside != "itself":
            figures[f"pairs.{KEYS.get(name, name)}"] = ratio
    show(["job", "s now", f"s at {beside}", "ratio", "result"], rows, f"{count} pairs, least seconds")
    return figures
