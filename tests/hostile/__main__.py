"""`python -m tests.hostile`: run the suite, print its table, end with 1 if anything went wrong."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

#: Before any library starts its threads: cases are forked from this process.
SETTINGS = {
    **dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "NUMBA_THREADING_LAYER": "workqueue",
    "MPLBACKEND": "agg",
    "COLUMNS": "200",
    "PYTHONWARNINGS": "ignore",
    "HDF5_USE_FILE_LOCKING": "FALSE",
}


def main() -> int:
    """Read the options, set the stage, run."""
    options = _options()
    os.environ.update(SETTINGS)
    os.environ.pop("CURVAFIT_DEBUG", None)
    package = Path(options.package).resolve()
    sys.path.insert(0, str(package))
    os.environ["PYTHONPATH"] = str(package)
    import curvafit

    where = Path(curvafit.__file__).resolve().parent.parent
    if where != package:
        raise SystemExit(f"expected the package of {package}, got that of {where}")
    from .runner import run_suite

    return run_suite(options)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.hostile", description=__doc__)
    root = Path(__file__).resolve().parent.parent.parent
    parser.add_argument("--quick", action="store_true", help="a part that is spread over all classes")
    parser.add_argument("--seed", type=int, default=0, help="of everything that is random")
    parser.add_argument("--only", metavar="CLASS", help="cases whose name starts so: damage, damage/flip …")
    parser.add_argument("--case", metavar="ID", help="one case; what it said is printed, its folder kept")
    parser.add_argument("--jobs", type=int, default=2, help="cases at once")
    parser.add_argument("--package", metavar="PATH", default=str(root), help="the working tree whose curvafit is run")
    parser.add_argument("--report", metavar="FILE", help="JSON of the cases that went wrong")
    parser.add_argument("--list", action="store_true", help="list the cases, run none")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
