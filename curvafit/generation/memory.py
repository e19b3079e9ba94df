"""Checks of memory before anything is allocated, by the least number of bytes that a job holds."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from curvafit.core.runtime import memory as installed

if TYPE_CHECKING:
    import torch

#: The least number of bytes for each voxel of a flow: A, Adam's two moments and the start, three float32 numbers each;
#: u, the gradient, and the field between two passes of the blur.
FLOW = 60
#: Bytes for each voxel of a flow in plain torch, where autograd stores what the energy's gradient needs.
EAGER = 400
#: Bytes for each voxel of a field that is written: the field and a copy in the file's layout.
FILE = 8
#: Bytes for each voxel of a field.
FIELD = 4


def check_memory(voxels: Sequence[int], each: int, what: str, device: torch.device | str = "cpu") -> None:
    """Raise ValueError where voxels along axes, of `each` bytes, need more memory than a device or this machine has."""
    need, capacity = math.prod(map(int, voxels)) * each, memory(device)
    if need > capacity:
        size = " x ".join(map(str, voxels))
        limit = f"where there are {_gibibytes(capacity)}" if capacity < sys.maxsize else "more than any machine has"
        least = f"which need at least {_gibibytes(need)}, {limit}"
        raise ValueError(f"expected {what} that fits into memory, got {size} voxels, {least}")


def memory(device: torch.device | str = "cpu") -> int:
    """Return the bytes of memory of a device or of this machine; `sys.maxsize` where the number is unknown."""
    import torch

    if torch.device(device).type == "cuda" and torch.cuda.is_available():
        return torch.cuda.get_device_properties(device).total_memory
    return installed()


def _gibibytes(size: int) -> str:
    """Return a number of bytes in GiB."""
    return f"{size / 2**30:.3g} GiB"
