"""What a loss asks of the tensors that it is given: their plain form, and single numbers where there are any."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import Tensor

_Given = TypeVar("_Given", bound=Tensor | None)


def plain(values: _Given) -> _Given:
    """Without what subclasses (MONAI's `MetaTensor`) add."""
    return values if values is None or type(values) is Tensor else values.as_subclass(Tensor)  # type: ignore[return-value]


def seen(value: Tensor) -> float | None:
    """A tensor's one number; None where none is to be seen: when compiled, and under `torch.func.vmap`."""
    if torch.compiler.is_compiling():
        return None
    try:
        return float(value)
    except RuntimeError as error:
        if "vmap" not in str(error):
            raise
        return None
