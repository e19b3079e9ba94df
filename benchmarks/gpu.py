"""The flow and the training loss on an NVIDIA GPU: eager torch, compiled torch, and another checkout.

`--beside FOLDER` names a checkout whose default is timed too: commit f62076a had kernels by hand in Triton. Each way is
timed in a process of its own, in one run: a step is the difference of two runs of the flow over their steps. Without a
GPU, `--device cpu` shows that the code runs. It prints the device, since a figure holds for one.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks.harness import ROOT, Cases, Figure, Values, show

SCRIPT = """
import json, sys, time
import torch
from curvafit import generate, generate_batch
from curvafit.generation.schedule import schedule
from curvafit.priors import CurvaturePrior
what, size, steps, device, backend = json.loads(sys.argv[1])
options = {"grid": size, "device": device} | ({"backend": backend} if backend else {})
def wait():
    torch.cuda.synchronize() if device == "cuda" else None
def clock(action):
    wait()
    begun = time.perf_counter()
    action()
    wait()
    return time.perf_counter() - begun
def flow(count):
    generate("tubes", schedule=schedule("fast", steps=count), seed=0, **options)
def batch(count):
    list(generate_batch("tubes", schedule=schedule("fast", steps=count), seeds=range(8), **options))
if what == "loss":
    prior = CurvaturePrior("tubes", sigmoid=True).to(device)
    prior = torch.compile(prior) if backend == "compiled" else prior
    logits = torch.randn((2, 1, size, size, size), device=device).requires_grad_()
    def loss():
        prior(logits).backward()
    loss()
    seconds = min(clock(loss) for _ in range(steps))
else:
    run = {"step": flow, "batch": batch}[what]
    run(4)
    seconds = min(clock(lambda: run(steps + 20)) - clock(lambda: run(20)) for _ in range(2)) / steps
memory = torch.cuda.max_memory_allocated() / 1e9 if device == "cuda" else 0.0
print(json.dumps({"ms": 1e3 * seconds, "GB": memory}))
"""
#: What is timed: cube's edge, and steps or rounds.
WHAT = {"step": (100, 200), "batch": (64, 100), "loss": (96, 10)}


def measure(checkout: Path, *what: Any) -> Values:
    """Time one thing in a process of its own; the reason where it fails."""
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT, json.dumps(what)]
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=checkout, check=False)
    if done.returncode:
        return {"failed": done.stderr.strip().splitlines()[-1] if done.stderr else "killed"}
    return json.loads(done.stdout.splitlines()[-1])


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--beside", type=Path, metavar="FOLDER", help="another checkout")
    parser.add_argument("--what", default=",".join(WHAT))


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    if options.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("no GPU: this benchmark needs an NVIDIA device (--device cpu shows that the code runs)")
    device = torch.cuda.get_device_name() if options.device == "cuda" else "cpu"
    ways = {"eager": (ROOT, "torch"), "compiled": (ROOT, "compiled")}
    if options.device == "cpu":
        ways["fused"] = (ROOT, "auto")
    if options.beside is not None:
        ways["beside"] = (options.beside.resolve(), "auto")
    rows, figures = [], {}
    for what in options.what.split(","):
        size, steps = (24, 4) if options.quick else WHAT[what]
        names = {way: f"{what}-{size}-{way}-{device.replace(' ', '-')}" for way in ways}
        jobs = {names[way]: partial(measure, place, what, size, steps, options.device, backend)
                for way, (place, backend) in ways.items()}  # fmt: skip
        for way, found in zip(ways, cases.all(jobs).values(), strict=False):
            rows.append([what, f"{size}³", way, found.get("ms", found.get("failed")), found.get("GB", "")])
            if "ms" in found and options.device == "cuda":
                figures[f"gpu.{what}_{way}"] = Figure(found["ms"])
    show(["what", "size", "way", "ms", "GB"], rows, device)
    return figures
