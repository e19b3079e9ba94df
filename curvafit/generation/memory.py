"""What fits into memory: asked before anything is allocated, by one estimate of what a job holds at least."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

import torch

from curvafit.machine import memory as installed

#: Bytes a voxel that a flow holds at least: A, Adam's two moments and the start, three float32 numbers each; u, its
#: gradient, and what is between two passes of the blur.
FLOW = 60
#: Those of a flow on an NVIDIA device.
DEVICE = 70
#: Those of a field that is written: itself and its copy in the file's layout.
FILE = 8
#: Those of a field that is kept.
FIELD = 4


def check_memory(voxels: Sequence[int], each: int, what: str, device: torch.device | str = "cpu") -> None:
    """Raise ValueError where so many voxels (z, y, x), of `each` bytes, are more than the machine or device holds."""
    need, there = math.prod(map(int, voxels)) * each, memory(device)
    if need > there:
        size = " x ".join(map(str, voxels))
        has = f"where there are {_gibibytes(there)}" if there < sys.maxsize else "more than any machine has"
        least = f"at least {_gibibytes(need)}, {has}"
        raise ValueError(f"expected {what} that fits into memory, got {size} voxels: {least}")


def memory(device: torch.device | str = "cpu") -> int:
    """Bytes of memory that a device has, or this machine; as many as can be counted where that is not known."""
    if torch.device(device).type == "cuda" and torch.cuda.is_available():
        return torch.cuda.get_device_properties(device).total_memory
    return installed()


def _gibibytes(size: int) -> str:
    return f"{size / 2**30:.3g} GiB"
