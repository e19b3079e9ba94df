"""`python -m curvafit.nnunet PRIOR` prints the two variables by which nnU-Net v2 finds the trainer and its prior."""

import shlex
import sys
from pathlib import Path

if __name__ == "__main__":  # nnU-Net imports each file of the folder
    from curvafit.priors.law import Law, preset_name

    try:
        Law.of(prior := " ".join(sys.argv[1:])).in_unit("mm")  # the unit of nnU-Net's lengths
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print(
        f"export nnUNet_extTrainer={shlex.quote(str(Path(__file__).parent))}${{nnUNet_extTrainer:+:$nnUNet_extTrainer}}"
    )
    print(f"export CURVAFIT_PRIOR={shlex.quote(preset_name(prior) or str(Path(prior).resolve()))}")
