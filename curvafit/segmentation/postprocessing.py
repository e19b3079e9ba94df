"""`refine` as a callable for a chain of transforms, such as MONAI's."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from curvafit.core.checks import SEEDS, check_int, quoted
from curvafit.segmentation.engine import STEPS
from curvafit.segmentation.refine import Calibration, calibrate, check_judge, refine
from curvafit.segmentation.working import Law
from curvafit.volumes.field import ScanError
from curvafit.volumes.source import Source, field_of

__all__ = ["Refine"]


class Refine:
    """A callable that refines one class of a network's probabilities, for MONAI's `Compose` after the softmax.

    Parameters
    ----------
    prior
        As in `refine`.
    weight
        As in `refine`, in place of an example.
    example
        Probabilities and true mask (Z, Y, X) of another volume, which are tried out now; or a `Calibration`.
    channel
        The class, counted from 0.
    spacing, unit
        Voxel edges along the tensor's three axes, or one for all, and their unit.
    epsilon, steps
        As in `refine`.

    Raises
    ------
    ValueError
        As `refine`.
    """

    def __init__(
        self,
        prior: Law,
        *,
        weight: float | None = None,
        example: tuple[Source, Source] | Calibration | None = None,
        channel: int = 1,
        spacing: Sequence[float] | float = 1.0,
        unit: str = "voxel",
        epsilon: float | None = None,
        steps: int = STEPS,
    ) -> None:
        check_judge(example, weight)
        self.channel = check_int(channel, "a channel that is a whole number from 0", 0, SEEDS)
        self.place = {"spacing": spacing, "unit": unit}
        if isinstance(example, tuple):
            example = calibrate(*example, prior, epsilon=epsilon, steps=steps, **self.place)
        self.prior, self.example = prior, example
        self.options = {"weight": weight, "epsilon": epsilon, "steps": steps}

    def __call__(self, probabilities: Tensor) -> Tensor:
        """Return the mask (1, Z, Y, X) of probabilities (C, Z, Y, X), 0 and 1, of their type and on their device.

        Raises
        ------
        ValueError
            If the probabilities are not a tensor of four axes with such a channel, or as `refine`.
        """
        if not isinstance(probabilities, Tensor) or probabilities.ndim != 4:
            got = tuple(probabilities.shape) if isinstance(probabilities, Tensor) else quoted(probabilities)
            raise ScanError(f"expected probabilities (C, Z, Y, X) as a tensor, got {got}")
        if self.channel >= len(probabilities):
            raise ScanError(f"expected a channel from 0 to {len(probabilities) - 1}, got {self.channel}")
        field = field_of(probabilities[self.channel].as_subclass(Tensor), **self.place)
        found = refine(field, self.prior, example=self.example, **self.options)
        mask = torch.zeros_like(probabilities[:1])
        mask[0] = torch.from_numpy(found.mask.values)
        return mask
