"""nnU-Net v2's trainer with the curvature prior beside its loss, found through `nnUNet_extTrainer`.

`curvafit nnunet --prior fit.json --weight 0.01` prints the lines to set; then
`nnUNetv2_train DATASET 3d_fullres FOLD -tr nnUNetTrainerCurvafit`.
"""

from __future__ import annotations

import os

from nnunetv2.training.loss.deep_supervision import DeepSupervisionWrapper  # pyright: ignore[reportMissingImports]
from nnunetv2.training.nnUNetTrainer.nnUNetTrainer import nnUNetTrainer  # pyright: ignore[reportMissingImports]
from torch import Tensor, nn

from curvafit.priors import CombinedLoss, CurvaturePrior


class nnUNetTrainerCurvafit(nnUNetTrainer):
    """Dice + cross-entropy + weight × F_ε of the predicted foreground classes, at every level of deep supervision.

    Read from the environment: `CURVAFIT_PRIOR` (a preset's name or a `fit.json`), `CURVAFIT_WEIGHT`, and, where they
    are set, `CURVAFIT_EPSILON` in mm and `CURVAFIT_WARMUP` in epochs. A continued training warms up no second time.

    Raises
    ------
    ValueError
        If the prior or its weight is not set, or the configuration is two-dimensional.
    """

    def _build_loss(self):
        loss, own = super()._build_loss(), self._prior()
        weight, epochs = _number("CURVAFIT_WEIGHT"), _number("CURVAFIT_WARMUP", 0.0)
        deep = isinstance(loss, DeepSupervisionWrapper)
        levels = sum(factor != 0 for factor in loss.weight_factors) if deep else 1
        warmup = int(epochs * self.num_iterations_per_epoch) * levels
        combined = CombinedLoss(loss.loss if deep else loss, own, weight, warmup)
        self._combined, self._calls_an_epoch = combined, self.num_iterations_per_epoch * levels
        if not deep:
            return combined
        loss.loss = combined
        return loss

    def on_train_epoch_start(self):
        super().on_train_epoch_start()
        self._combined.calls.fill_(int(self.current_epoch) * self._calls_an_epoch)

    def _prior(self) -> nn.Module:
        spacing, patch = self.configuration_manager.spacing, self.configuration_manager.patch_size
        if len(patch) != 3:
            raise ValueError(f"expected a 3D configuration, got {self.configuration_name} of patch size {list(patch)}")
        law, epsilon = os.environ.get("CURVAFIT_PRIOR"), _number("CURVAFIT_EPSILON", 0.0)
        if not law:
            raise ValueError("expected CURVAFIT_PRIOR to be a preset or a fit.json, got nothing: see `curvafit nnunet`")
        regions = self.label_manager.has_regions
        prior = CurvaturePrior(
            law,
            sigmoid=regions,
            softmax=not regions,
            include_background=regions,
            ignore_index=None if regions else self.label_manager.ignore_label,
            spacing=spacing,
            unit="mm",
            epsilon=epsilon or None,
            shape=patch,
        )
        return _Regions(prior) if regions and self.label_manager.has_ignore_label else prior


class _Regions(nn.Module):
    """With regions, the target's last channel is one where the label is ignored."""

    def __init__(self, prior: CurvaturePrior) -> None:
        super().__init__()
        self.prior = prior

    def forward(self, output: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
        known = 1 - target[:, -1:].float()
        return self.prior(output, mask=known if mask is None else mask * known)


def _number(name: str, missing: float | None = None) -> float:
    text = os.environ.get(name, "")
    if not text and missing is not None:
        return missing
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise ValueError(f"expected {name} to be a number from 0, got {text!r}: see `curvafit nnunet`")
    return value
