"""From evidence and a prior to a volume: grey values, probabilities, or annotated slices."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.segmentation.labels import reconstruct_labels as reconstruct_labels
    from curvafit.segmentation.reconstruct import reconstruct as reconstruct
    from curvafit.segmentation.result import Segmentation as Segmentation
    from curvafit.segmentation.result import write_mask as write_mask
    from curvafit.segmentation.segment import Calibration as Calibration
    from curvafit.segmentation.segment import calibrate as calibrate
    from curvafit.segmentation.segment import segment as segment
    from curvafit.segmentation.transforms import FillSlicesd as FillSlicesd

attach_lazy_names(__name__)
