"""The flow, the training loss and the filler on an NVIDIA GPU: right, how fast eager and compiled, and in what memory.

One run of some five minutes. Each way runs in a process of its own: it compares what it computes with plain torch on
the processor (largest difference over the largest value), times it, and reads the most memory that it took. A step is
the difference of two runs of the flow over their steps. Last comes a shape of the paper at 100³ by its 8000 steps, for
which the paper states up to 150 s. Without a GPU, `--device cpu --quick` shows that the code runs.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from functools import partial
from typing import Any

import torch

from benchmarks.harness import ROOT, Cases, Figure, Values, show

SCRIPT = """
import json, sys, time
import torch
from curvafit import generate, generate_batch
from curvafit.generation.schedule import schedule
from curvafit.priors import CurvaturePrior
from curvafit.segmentation.filler import Filler, Gaps
what, size, rounds, small, device, way = json.loads(sys.argv[1])
def wait():
    torch.cuda.synchronize() if device == "cuda" else None
def clock(action):
    wait()
    begun = time.perf_counter()
    action()
    wait()
    return time.perf_counter() - begun
def ready(module, device, way):
    module = module.to(device)
    return torch.compile(module) if way == "compiled" else module
backend = {"eager": "torch", "compiled": "compiled", "fused": "auto"}
def flow(size, steps, device, way, name="fast"):
    plan = schedule(name, steps=steps)
    return generate("tubes", grid=size, schedule=plan, seed=0, device=device, backend=backend[way]).field
def batch(size, steps, device, way):
    plan, options = schedule("fast", steps=steps), {"device": device, "backend": backend[way]}
    flows = generate_batch("tubes", grid=size, schedule=plan, seeds=range(8), **options)
    return torch.stack([each.field for each in flows])
def loss(size, device, way):
    prior = ready(CurvaturePrior("tubes", sigmoid=True), device, way)
    logits = torch.randn((2, 1, size, size, size), generator=torch.manual_seed(0)).to(device).requires_grad_()
    def once():
        logits.grad = None
        prior(logits).backward()
        return logits.grad
    return once
def filler(size, device, way):
    torch.manual_seed(0)
    network = Filler(16).eval()
    for weight in network.parameters():
        torch.nn.init.normal_(weight, std=0.1)
    network = ready(network, device, way)
    gaps = Gaps(torch.randn(4, 4, size, size).to(device), torch.full((4,), 8.0, device=device),
                torch.zeros(4, 7, size, size, device=device))
    def once():
        with torch.inference_mode():
            return network(gaps)
    return once
if what in ("step", "batch"):
    run = {"step": flow, "batch": batch}[what]
    got, right = run(small, 5, device, way), run(small, 5, "cpu", "eager")
    run(size, 4, device, way)
    seconds = min(clock(lambda: run(size, rounds + 20, device, way)) - clock(lambda: run(size, 20, device, way))
                  for _ in range(2)) / rounds
elif what == "paper":
    got, right = flow(small, 5, device, way, "paper"), flow(small, 5, "cpu", "eager", "paper")
    seconds = clock(lambda: flow(size, rounds, device, way, "paper"))
else:
    make = {"loss": loss, "filler": filler}[what]
    got, right, once = make(small, device, way)(), make(small, "cpu", "eager")(), make(size, device, way)
    once()
    seconds = min(clock(once) for _ in range(rounds))
error = float((got.cpu() - right.cpu()).abs().max() / right.abs().max())
memory = torch.cuda.max_memory_allocated() / 1e9 if device == "cuda" else 0.0
print(json.dumps({"ms": 1e3 * seconds, "GB": memory, "error": error}))
"""
#: What is timed: edge in voxels, steps or rounds, and the edge at which it is compared with the processor.
WHAT = {
    "step": (100, 200, 32),
    "batch": (64, 100, 24),
    "loss": (96, 10, 32),
    "filler": (256, 10, 64),
    "paper": (100, 8000, 32),
}
QUICK = (24, 4, 16)
WAYS = ("eager", "compiled")


def measure(*what: Any) -> Values:
    """Compute and time one thing in a process of its own; the reason where it fails."""
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT, json.dumps(what)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    if done.returncode:
        return {"failed": done.stderr.strip().splitlines()[-1] if done.stderr else "killed"}
    return json.loads(done.stdout.splitlines()[-1])


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    if options.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit(
            "no GPU: this benchmark needs an NVIDIA device (--device cpu --quick shows that the code runs)"
        )
    device = torch.cuda.get_device_name() if options.device == "cuda" else "cpu"
    rows, figures = [], {}
    for what, sizes in WHAT.items():
        size, rounds, small = QUICK if options.quick else sizes
        ways = {f"{what}-{size}-{way}-{device.replace(' ', '-')}": way for way in WAYS}
        jobs = {name: partial(measure, what, size, rounds, small, options.device, way) for name, way in ways.items()}
        for name, found in cases.all(jobs).items():
            row = (found.get("ms", found.get("failed")), found.get("GB", ""), found.get("error", ""))
            rows.append([what, f"{size}³", ways[name], *row])
            if "ms" in found and options.device == "cuda":
                scale = 1e-3 if what == "paper" else 1.0
                figures[f"gpu.{what}_{ways[name]}"] = Figure(scale * found["ms"])
                figures[f"gpu.{what}_{ways[name]}_error"] = Figure(found["error"])
                figures[f"gpu.{what}_{ways[name]}_memory"] = Figure(found["GB"])
    show(["what", "size", "way", "ms", "GB", "error"], rows, device)
    return figures
