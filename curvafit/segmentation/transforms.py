"""A transform of MONAI that fills the volume between annotated slices, for a network to be trained with."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from curvafit.segmentation.labels import reconstruct_labels
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.volumes.volume import ScanError, Volume

try:
    from monai.transforms.transform import MapTransform
    from monai.utils.type_conversion import convert_to_dst_type, convert_to_numpy
except ImportError as error:
    raise ImportError("FillSlicesd needs MONAI: pip install monai", name="monai") from error


class FillSlicesd(MapTransform):
    """A transform of MONAI's dictionaries that fills a label between its annotated slices, as `reconstruct` does.

    It takes a tensor or array (1, A, B, C) and gives one of its type, on its device and with its affine, by which the
    voxels are spaced. It is not random, so MONAI's `CacheDataset` runs it once.

    Parameters
    ----------
    keys, allow_missing_keys
        Which entries of the dictionary are labels, as in MONAI.
    soft
        Whether the label becomes the probability, float32, of what is positive in it.
    sure, ignored
        Where a label is less probable than `sure`, it becomes `ignored`, by default the highest label + 1. Give it
        where some volumes lack the highest label.
    options
        Those of `reconstruct`: every, known, ignore, axis and others. The axis across the slices is counted without the
        channel: for a NIfTI file that `LoadImaged` reads, slices along its last axis are across axis 2.

    Raises
    ------
    ValueError
        When it is called: if a label does not have one channel and three axes, or as `reconstruct`.
    """

    def __init__(
        self,
        keys: Hashable | Sequence[Hashable],
        *,
        soft: bool = False,
        sure: float | None = None,
        ignored: int | None = None,
        allow_missing_keys: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(keys, allow_missing_keys)  # type: ignore[arg-type]
        if soft and sure is not None:
            raise ValueError("give either soft or sure: probabilities, or labels where they are sure")
        self.soft, self.sure, self.ignored = soft, sure, ignored
        self.options = options

    def __call__(self, data: Mapping[Hashable, Any]) -> dict[Hashable, Any]:
        """Return the dictionary with its labels filled."""
        filled = dict(data)
        for key in self.key_iterator(filled):
            label = filled[key]
            values = self._fill(convert_to_numpy(label), getattr(label, "pixdim", (1.0, 1.0, 1.0)))
            filled[key] = convert_to_dst_type(values[None], label, dtype=values.dtype)[0]
        return filled

    def _fill(self, label: np.ndarray, spacing: Sequence[float]) -> np.ndarray:
        """Fill a label (1, A, B, C); return its new values (A, B, C)."""
        if label.ndim != 4 or len(label) != 1:
            raise ScanError(f"a label must have one channel and three axes, (1, A, B, C), got {label.shape}")
        volume = Volume(label[0], spacing)  # type: ignore[arg-type]
        if self.soft:
            return reconstruct(volume, **self.options).probability.values  # type: ignore[union-attr]
        filled = reconstruct_labels(volume, **self.options)
        values = (filled.labels if self.sure is None else filled.keep_sure(self.sure, self.ignored)).values  # type: ignore[union-attr]
        return values.astype(np.promote_types(values.dtype, label.dtype))
