"""nnU-Net v2's trainer with the curvature prior beside its loss, found through `nnUNet_extTrainer`.

`python -m curvafit.nnunet fit.json` prints the lines to set; then
`nnUNetv2_train DATASET 3d_fullres FOLD -tr nnUNetTrainerCurvafit`.
"""

from __future__ import annotations

import os
import statistics

import torch
from nnunetv2.training.loss.deep_supervision import DeepSupervisionWrapper  # pyright: ignore[reportMissingImports]
from nnunetv2.training.nnUNetTrainer.nnUNetTrainer import nnUNetTrainer  # pyright: ignore[reportMissingImports]

from curvafit.priors import CombinedLoss, CurvaturePrior
from curvafit.priors.law import Law

#: Batches over whose median the prior is balanced.
BATCHES = 9


class nnUNetTrainerCurvafit(nnUNetTrainer):
    """Dice + cross-entropy + weight × F_ε of the predicted foreground classes, at every level of deep supervision.

    Read from the environment: `CURVAFIT_PRIOR` (a preset's name or a `fit.json`) and, where they are set,
    `CURVAFIT_WEIGHT`, or `CURVAFIT_SHARE` (0.1), `CURVAFIT_WARMUP` in epochs (50) and `CURVAFIT_EPSILON` in mm. A
    weight grows to its full value over the warm-up. With a share there is no prior until then; then the weight is set
    once, to what gives the prior that share of the gradient of Dice + cross-entropy. A training that is continued warms
    up no second time, and is balanced anew. The prior acts on all of a patch, on what nnU-Net's ignore label hides too.

    Raises
    ------
    ValueError
        If the prior is not set, a number is none, or the configuration is two-dimensional.
    """

    def _build_loss(self):
        loss, self._own = super()._build_loss(), self._prior()
        weight, epochs = _number("CURVAFIT_WEIGHT", 0.0), _number("CURVAFIT_WARMUP", 50.0)
        self._share = 0.0 if os.environ.get("CURVAFIT_WEIGHT") else _number("CURVAFIT_SHARE", 0.1)
        deep = isinstance(loss, DeepSupervisionWrapper)
        levels = sum(factor != 0 for factor in loss.weight_factors) if deep else 1
        warmup = 0 if self._share else int(epochs * self.num_iterations_per_epoch) * levels
        self._balanced_from = epochs
        combined = CombinedLoss(loss.loss if deep else loss, self._own, weight, warmup)
        self._combined, self._calls_an_epoch = combined, self.num_iterations_per_epoch * levels
        if not deep:
            return combined
        loss.loss = combined
        return loss

    def on_train_epoch_start(self):
        super().on_train_epoch_start()
        self._combined.calls.fill_(int(self.current_epoch) * self._calls_an_epoch)
        if self._share and not self._combined.weight and self.current_epoch >= self._balanced_from:
            self._combined.weight = self._balance()
            self.print_to_log_file(f"weight of the curvature prior: {self._combined.weight:.3g}")

    def _balance(self) -> float:
        """The weight that gives the prior its share of the gradient, the median of some batches; 0 where none has a
        surface yet: it is then asked again after the next epoch."""
        found = []
        for _ in range(BATCHES):
            batch = next(self.dataloader_train)
            with torch.no_grad():
                output = self.network(batch["data"].to(self.device))
            target = batch["target"]
            finest = [each[0] if isinstance(each, (list, tuple)) else each for each in (output, target)]
            try:
                pair = (finest[0].float(), finest[1].to(self.device))
                found.append(self._own.suggest_weight(self._combined.base, pair, self._share))
            except ValueError:
                continue
        weight = torch.tensor(statistics.median(found) if found else 0.0, device=self.device)
        if self.is_ddp:
            torch.distributed.all_reduce(weight, torch.distributed.ReduceOp.AVG)
        return float(weight)

    def _prior(self) -> CurvaturePrior:
        spacing, patch = self.configuration_manager.spacing, self.configuration_manager.patch_size
        if len(patch) != 3:
            raise ValueError(
                f"the prior needs a 3D configuration, got {self.configuration_name} of patch size {list(patch)}"
            )
        law, epsilon = os.environ.get("CURVAFIT_PRIOR"), _number("CURVAFIT_EPSILON", 0.0)
        if not law:
            raise ValueError(
                "CURVAFIT_PRIOR must be a preset or a fit.json, but it is not set: see `python -m curvafit.nnunet`"
            )
        regions = self.label_manager.has_regions
        return CurvaturePrior(
            law,
            sigmoid=regions,
            softmax=not regions,
            include_background=regions,
            spacing=spacing,
            unit="mm" if Law.of(law).fitted else None,
            epsilon=epsilon or None,
            shape=patch,
        )


def _number(name: str, missing: float) -> float:
    text = os.environ.get(name) or missing
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise ValueError(f"{name} must be a number from 0, got {text!r}")
    return value
