"""The command that connects the curvature prior with nnU-Net."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import Annotated

import typer

from curvafit.cli.console import say
from curvafit.cli.options import command


@command('eval "$(curvafit nnunet --prior bone/fit.json)"', "nnUNetv2_train 4 3d_fullres 0 -tr nnUNetTrainerCurvafit")
def nnunet(
    prior: Annotated[str, typer.Option(help="fit.json of an example, or a preset's name (curvafit presets).")],
    share: Annotated[float | None, typer.Option(help="Share of the other losses' gradient; by default 0.1.")] = None,
    weight: Annotated[float | None, typer.Option(help="Weight of the prior, instead of a share.")] = None,
    epsilon: Annotated[float | None, typer.Option(help="ε in mm; by default twice the smallest voxel edge.")] = None,
    warmup: Annotated[float, typer.Option(help="Epochs before the share is measured, or while weight grows.")] = 50,
) -> None:
    """Print shell commands that make nnU-Net v2 train with the curvature prior.

    Lengths of nnU-Net are in mm: a fit in another physical unit is converted.
    """
    from curvafit.priors.law import PRESETS, Law, preset_name

    name = preset_name(prior)
    if name is None:
        if not prior.endswith(".json"):
            raise ValueError(f"--prior must be a fit.json or a preset ({', '.join(PRESETS)}), got {prior!r}")
        Law.load(prior).in_unit("mm")
    prior = name or str(Path(prior).resolve())
    if share is not None and weight is not None:
        raise ValueError("give either --share or --weight, got both")
    share = 0.1 if share is None and weight is None else share
    settings = {"SHARE": share, "WEIGHT": weight, "WARMUP": warmup, "EPSILON": epsilon}
    for name, value in settings.items():
        least = 0 if name in ("WEIGHT", "WARMUP") else math.ulp(0)
        if value is not None and not least <= value < math.inf:
            raise ValueError(f"--{name.lower()} must be a positive number, got {value}")
    folder = shlex.quote(str(Path(__file__).resolve().parent.parent / "nnunet"))
    say(f"export nnUNet_extTrainer={folder}${{nnUNet_extTrainer:+:$nnUNet_extTrainer}}")
    say(f"export CURVAFIT_PRIOR={shlex.quote(prior)}")
    for name, value in settings.items():
        say(f"unset CURVAFIT_{name}" if value is None else f"export CURVAFIT_{name}={value:g}")
    say("# then: nnUNetv2_train DATASET 3d_fullres FOLD -tr nnUNetTrainerCurvafit")
