"""The parts of `python -m benchmarks.gpu --all`: each a function of its figures, kept in one JSON, printed as a table.

A part that is in the file, of the same device, versions and commit, is not measured again.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curvafit.core.files import write_content

#: What the file says that it is.
FORMAT = "curvafit-gpu-1"
#: Edge, and seeds of each of two groups, of textures made by both devices; diagrams whose distances are taken.
EDGE, SEEDS, DIAGRAMS = 64, 3, 200

Part = Callable[[], dict[str, Any]]


def machine() -> dict[str, Any]:
    """The device, the driver, versions and commit: what figures hold for."""
    import triton

    asked = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    return {
        "device": torch.cuda.get_device_name(),
        "driver": _said(asked).splitlines()[0],
        "torch": torch.__version__,
        "triton": triton.__version__,
        "commit": _said(["git", "describe", "--always", "--dirty"]),
    }


def _said(command: list[str]) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or "unknown"
    except OSError:
        return "unknown"


def measure(path: Path, about: dict[str, Any], parts: Mapping[str, Part]) -> dict[str, Any]:
    """Return the record of all parts; it is written after each part."""
    record = _former(path, about) or {"format": FORMAT, "machine": about, "parts": {}}
    for name, part in parts.items():
        if "failed" in record["parts"].get(name, {"failed": ""}):
            print(f"{name} …", flush=True)
            record["parts"][name] = _tried(part)
            write_content(path, json.dumps(record, indent=2, allow_nan=False) + "\n")
    return record


def _tried(part: Part) -> dict[str, Any]:
    """Return the figures of a part, or how it failed: the other parts go on, and this one is tried again next time."""
    try:
        return part()
    except (ImportError, RuntimeError, ValueError, OSError) as error:
        return {"failed": f"{type(error).__name__}: {error}"}


def _former(path: Path, about: dict[str, Any]) -> dict[str, Any] | None:
    """Return a file's record, if it is of this machine."""
    record = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return record if record.get("format") == FORMAT and record.get("machine") == about else None


def textures() -> dict[str, Any]:
    """Distances of diagrams: the same seed on both devices, and seeds of one device."""
    from itertools import combinations

    from curvafit.generation.flow import generate
    from curvafit.geometry.diagram import diagram
    from curvafit.geometry.transport import wasserstein
    from curvafit.priors.grid import WORKING_EPSILON

    def made(seed: int, device: str) -> Any:
        flow = generate("tubes", grid=EDGE, seed=seed, device=device)
        return diagram(flow.field, flow.grid, WORKING_EPSILON)

    cpu, cuda = ([made(seed, device) for seed in range(SEEDS)] for device in ("cpu", "cuda"))
    across = [wasserstein(a, b) for a in cpu for b in cuda]
    within = [wasserstein(a, b) for group in (cpu, cuda) for a, b in combinations(group, 2)]
    return {"cpu_to_gpu": float(np.mean(across)), "seed_to_seed": float(np.mean(within))}


def transfers(run: Callable[[], object], steps: int) -> dict[str, Any]:
    """Copies between host and device, and replays of graphs, in a run of so many steps that has been recorded."""
    from torch.profiler import ProfilerActivity, profile

    run()
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as seen:
        run()
        torch.cuda.synchronize()
    names = {event.key: event.count for event in seen.key_averages()}
    copies = sum(count for name, count in names.items() if "memcpy htod" in name.lower() or "dtoh" in name.lower())
    return {"steps": steps, "copies": copies, "graphs": names.get("cudaGraphLaunch", 0)}


def training() -> dict[str, Any]:
    """Milliseconds of losses, forward and backward, on logits (2, 1, 96³)."""
    from benchmarks import prior

    logits, target = prior.batch(96, "cuda")
    figures = {}
    for name, loss in prior.losses().items():
        taken = [prior.seconds(lambda loss=loss: prior.both_ways(loss, logits, target), "cuda") for _ in range(5)]
        figures[name] = 1e3 * min(taken[1:])
    return figures


def distances() -> dict[str, Any]:
    """Milliseconds a pair of the packaged atlas's diagrams, on either device, and the greatest difference."""
    from benchmarks import prior
    from curvafit.geometry.pairwise import pairwise
    from curvafit.inference.atlas import load_atlas

    diagrams = load_atlas(None).mask_diagrams[:DIAGRAMS]
    pairs, found, figures = DIAGRAMS * (DIAGRAMS - 1) / 2, {}, {}
    for device in ("cpu", "cuda"):
        pairwise(diagrams[:4], device=device)
        taken = prior.seconds(lambda d=device: found.update({d: pairwise(diagrams, device=d)}), device)
        figures[f"{device}_ms"] = 1e3 * taken / pairs
    return {**figures, "difference": float(np.abs(found["cpu"] - found["cuda"]).max())}


def table(record: dict[str, Any]) -> str:
    """Return a record in words, a part a row: of the docs' table."""
    about, parts = record["machine"], record["parts"]
    titles = f"{about['device']}, driver {about['driver']}, torch {about['torch']}, triton {about['triton']}"
    rows = [f"{titles}, commit {about['commit']}", "", "| what | figure |", "|---|---|"]
    for name, figures in parts.items():
        said = ", ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
                         for key, value in figures.items())  # fmt: skip
        rows.append(f"| {name} | {said} |")
    return "\n".join(rows)
