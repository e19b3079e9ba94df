"""Tensors as a loss reads them: without subclasses, and as single numbers where tracing permits."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import Tensor

_Values = TypeVar("_Values", bound=Tensor | None)


def plain(values: _Values) -> _Values:
    """Return a tensor without its subclass (MONAI's `MetaTensor`)."""
    return values if values is None or type(values) is Tensor else values.as_subclass(Tensor)  # type: ignore[return-value]


def number_of(value: Tensor) -> float | None:
    """Return a tensor's single number, or None where it has none yet: in compiled code and under `torch.func.vmap`."""
    if torch.compiler.is_compiling():
        return None
    try:
        return float(value)
    except RuntimeError as error:
        if "vmap" not in str(error):
            raise
        return None
