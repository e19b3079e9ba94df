"""From evidence and a prior to a volume: grey values, probabilities, or annotated slices."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.faces import offer

if TYPE_CHECKING:
    from curvafit.segmentation.segment import Segmentation, reconstruct, segment

__all__ = [
    "Segmentation",
    "reconstruct",
    "segment",
]

_HOMES = {
    "Segmentation": "curvafit.segmentation.segment",
    "reconstruct": "curvafit.segmentation.segment",
    "segment": "curvafit.segmentation.segment",
}

offer(__name__, _HOMES)
