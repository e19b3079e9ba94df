"""From evidence and a prior to a volume: grey values, probabilities, or annotated slices."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.segmentation.completion import reconstruct
    from curvafit.segmentation.postprocessing import Refine
    from curvafit.segmentation.refine import Calibration, calibrate, refine
    from curvafit.segmentation.result import Segmentation
    from curvafit.segmentation.segment import segment
    from curvafit.segmentation.several import reconstruct_labels

__all__ = [
    "Calibration",
    "Refine",
    "Segmentation",
    "calibrate",
    "reconstruct",
    "reconstruct_labels",
    "refine",
    "segment",
]

_HOMES = {
    "Calibration": "curvafit.segmentation.refine",
    "Refine": "curvafit.segmentation.postprocessing",
    "Segmentation": "curvafit.segmentation.result",
    "calibrate": "curvafit.segmentation.refine",
    "reconstruct": "curvafit.segmentation.completion",
    "reconstruct_labels": "curvafit.segmentation.several",
    "refine": "curvafit.segmentation.refine",
    "segment": "curvafit.segmentation.segment",
}

offer(__name__, _HOMES)
