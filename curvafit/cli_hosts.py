"""The command that connects the curvature prior with nnU-Net."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli_support import plainly, say

EXAMPLE = """[bold]Example[/bold]

eval "$(curvafit nnunet --prior bone/fit.json --weight 0.01)"

nnUNetv2_train 4 3d_fullres 0 -tr nnUNetTrainerCurvafit
"""


def nnunet(
    prior: Annotated[str, typer.Option(help="fit.json of an example, or a preset's name (curvafit presets).")],
    weight: Annotated[float, typer.Option(help="Of the prior beside Dice and cross-entropy, from 0.")],
    epsilon: Annotated[float | None, typer.Option(help="ε in mm; twice the finest voxel edge if not given.")] = None,
    warmup: Annotated[float, typer.Option(help="Epochs over which the weight grows to its full value.")] = 0.0,
) -> None:
    """Print the lines for a shell that let nnU-Net v2 train with the curvature prior.

    The loss is a mean over voxels; `CurvaturePrior.suggest_weight` tells a weight that balances it with another.
    """
    with plainly():
        from curvafit.priors import PRESETS, read_fit

        if prior not in PRESETS:
            if not prior.endswith(".json"):
                raise ValueError(f"expected --prior to be a fit.json or a preset ({', '.join(PRESETS)}), got {prior!r}")
            read_fit(prior)
            prior = str(Path(prior).resolve())
        if weight < 0 or warmup < 0 or (epsilon is not None and epsilon <= 0):
            raise ValueError(f"expected a weight and a warm-up from 0 and ε above, got {weight}, {warmup}, {epsilon}")
        folder = shlex.quote(str(Path(__file__).resolve().parent / "nnunet"))
        say(f"export nnUNet_extTrainer={folder}${{nnUNet_extTrainer:+:$nnUNet_extTrainer}}")
        told = {"PRIOR": prior, "WEIGHT": f"{weight:g}", "WARMUP": f"{warmup:g}"}
        for name, value in (told | ({} if epsilon is None else {"EPSILON": f"{epsilon:g}"})).items():
            say(f"export CURVAFIT_{name}={shlex.quote(value)}")
        say("# then: nnUNetv2_train DATASET 3d_fullres FOLD -tr nnUNetTrainerCurvafit")
