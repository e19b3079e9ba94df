"""The command that connects the curvature prior with nnU-Net."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli.support import plainly, say

EXAMPLE = """[bold]Example[/bold]

eval "$(curvafit nnunet --prior bone/fit.json)"

nnUNetv2_train 4 3d_fullres 0 -tr nnUNetTrainerCurvafit
"""


def nnunet(
    prior: Annotated[str, typer.Option(help="fit.json of an example, or a preset's name (curvafit presets).")],
    share: Annotated[
        float | None, typer.Option(help="Of the gradient of Dice and cross-entropy; 0.1 where no weight is given.")
    ] = None,
    weight: Annotated[float | None, typer.Option(help="Of the prior's value, instead of a share.")] = None,
    epsilon: Annotated[float | None, typer.Option(help="ε in mm; twice the finest voxel edge if not given.")] = None,
    warmup: Annotated[float, typer.Option(help="Epochs before a share is set, or over which a weight grows.")] = 50,
) -> None:
    """Print the lines for a shell that let nnU-Net v2 train with the curvature prior.

    nnU-Net takes lengths for mm: a fit in another physical unit is converted.
    """
    with plainly():
        from curvafit.priors.coefficients import PRESETS, preset_name
        from curvafit.priors.fit_file import read_fit

        name = preset_name(prior)
        if name is None:
            if not prior.endswith(".json"):
                raise ValueError(f"expected --prior to be a fit.json or a preset ({', '.join(PRESETS)}), got {prior!r}")
            read_fit(prior).in_unit("mm")
        prior = name or str(Path(prior).resolve())
        if share is not None and weight is not None:
            raise ValueError("expected either --share or --weight, got both")
        share = 0.1 if share is None and weight is None else share
        given = {"SHARE": share, "WEIGHT": weight, "WARMUP": warmup, "EPSILON": epsilon}
        for name, value in given.items():
            if value is not None and not (0 <= value < math.inf and (value or name in ("WEIGHT", "WARMUP"))):
                raise ValueError(f"expected --{name.lower()} to be a positive number, got {value}")
        folder = shlex.quote(str(Path(__file__).resolve().parent.parent / "nnunet"))
        say(f"export nnUNet_extTrainer={folder}${{nnUNet_extTrainer:+:$nnUNet_extTrainer}}")
        say(f"export CURVAFIT_PRIOR={shlex.quote(prior)}")
        for name, value in given.items():
            say(f"unset CURVAFIT_{name}" if value is None else f"export CURVAFIT_{name}={value:g}")
        say("# then: nnUNetv2_train DATASET 3d_fullres FOLD -tr nnUNetTrainerCurvafit")
