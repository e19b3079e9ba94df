"""The program `curvafit`, or `python -m curvafit`, which listens to signals before its long imports."""

import gc
import os
import warnings

from curvafit.core.runtime import exit_code, leave, listen


def main() -> None:
    """Run the program."""
    # What the start makes stays: to look through it for garbage takes a fifth of the start's time.
    gc.set_threshold(20_000)
    # Threads that wait for the others of a loop sleep: where two runs share the cores, spinning holds the others up.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # A signal leaves coroutines of Zarr that were about to read: no matter for a user.
    warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
    try:
        listen()
        from curvafit.cli.app import main as run

        run()
    except KeyboardInterrupt as signal:
        raise SystemExit(exit_code(signal)) from None
    finally:
        leave()


if __name__ == "__main__":
    main()
