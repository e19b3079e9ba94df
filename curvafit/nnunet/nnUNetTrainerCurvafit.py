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
    weight grows to its full value over the warm-up. With a share there is no prior during the warm-up; then the weight
    is set once, so that the prior has that share of the gradient of Dice + cross-entropy. A training that is continued
    warms up no second time, and is balanced anew. The prior acts on whole patches, under nnU-Net's ignore label too.

    Raises
    ------
    ValueError
        If the prior is not set, a variable is not a number from 0, or the configuration is two-dimensional.
    """

    def _build_loss(self):
        loss = super()._build_loss()
        self._prior = self._make_prior()
        weight, self._warmup_epochs = _read_number("CURVAFIT_WEIGHT", 0.0), _read_number("CURVAFIT_WARMUP", 50.0)
        self._share = 0.0 if os.environ.get("CURVAFIT_WEIGHT") else _read_number("CURVAFIT_SHARE", 0.1)
        deep = isinstance(loss, DeepSupervisionWrapper)  # which calls the loss once for each level of weight > 0
        levels = sum(factor != 0 for factor in loss.weight_factors) if deep else 1
        self._calls_per_epoch = self.num_iterations_per_epoch * levels
        warmup = 0 if self._share else int(self._warmup_epochs * self.num_iterations_per_epoch) * levels
        self._combined = CombinedLoss(loss.loss if deep else loss, self._prior, weight, warmup)
        if not deep:
            return self._combined
        loss.loss = self._combined
        return loss

    def on_train_epoch_start(self):
        super().on_train_epoch_start()
        # A training that is continued has a new loss, whose warm-up goes on by the number of calls so far.
        self._combined.calls.fill_(int(self.current_epoch) * self._calls_per_epoch)
        if self._share and not self._combined.weight and self.current_epoch >= self._warmup_epochs:
            self._combined.weight = self._balance()
            self.print_to_log_file(f"weight of the curvature prior: {self._combined.weight:.3g}")

    def _balance(self) -> float:
        """Return the weight that gives the prior its share of the gradient: the median over some batches.

        It is 0 while no prediction has a surface; it is then computed again before the next epoch.
        """
        weights = []
        for _ in range(BATCHES):
            batch = next(self.dataloader_train)
            with torch.no_grad():
                output = self.network(batch["data"].to(self.device))
            output, target = (x[0] if isinstance(x, (list, tuple)) else x for x in (output, batch["target"]))  # finest
            try:
                pair = (output.float(), target.to(self.device))
                weights.append(self._prior.suggest_weight(self._combined.base, pair, self._share))
            except ValueError:  # no surface in this batch
                continue
        weight = torch.tensor(statistics.median(weights) if weights else 0.0, device=self.device)
        if self.is_ddp:
            torch.distributed.all_reduce(weight, torch.distributed.ReduceOp.AVG)
        return float(weight)

    def _make_prior(self) -> CurvaturePrior:
        spacing, patch = self.configuration_manager.spacing, self.configuration_manager.patch_size
        if len(patch) != 3:
            raise ValueError(
                f"the prior needs a 3D configuration, got {self.configuration_name} of patch size {list(patch)}"
            )
        law, epsilon = os.environ.get("CURVAFIT_PRIOR"), _read_number("CURVAFIT_EPSILON", 0.0)
        if not law:
            raise ValueError(
                "CURVAFIT_PRIOR must be a preset or a fit.json, but it is not set: see `python -m curvafit.nnunet`"
            )
        regions = self.label_manager.has_regions
        return CurvaturePrior(
            law, sigmoid=regions, softmax=not regions, include_background=regions, spacing=spacing,
            unit="mm" if Law.of(law).fitted else None, epsilon=epsilon or None, shape=patch,
        )  # fmt: skip


def _read_number(name: str, default: float) -> float:
    text = os.environ.get(name) or default
    try:
        value = float(text)
    except ValueError:
        value = -1.0  # which is refused below
    if not 0 <= value < float("inf"):
        raise ValueError(f"{name} must be a number from 0, got {text!r}")
    return value
