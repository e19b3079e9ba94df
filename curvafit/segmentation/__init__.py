"""From evidence and a prior to a volume: grey values, probabilities, or annotated slices."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.faces import offer

if TYPE_CHECKING:
    from curvafit.segmentation.completion import reconstruct
    from curvafit.segmentation.result import Segmentation
    from curvafit.segmentation.segment import segment

__all__ = [
    "Segmentation",
    "reconstruct",
    "segment",
]

_HOMES = {
    "Segmentation": "curvafit.segmentation.result",
    "reconstruct": "curvafit.segmentation.completion",
    "segment": "curvafit.segmentation.segment",
}

offer(__name__, _HOMES)
