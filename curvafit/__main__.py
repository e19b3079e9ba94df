"""The program `curvafit`, or `python -m curvafit`, which listens to signals before its long imports."""

import ctypes
import gc
import os
import warnings
from contextlib import suppress

from curvafit.core.runtime import exit_code, leave, listen


def main() -> None:
    """Run the program."""
    # What the start makes stays: to look through it for garbage takes a fifth of the start's time.
    gc.set_threshold(20_000)
    # Threads that wait for the others of a loop sleep soon: where two runs share the cores, spinning holds the others
    # up. Without the few microseconds of spinning that remain, scikit-learn's short loops take four times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    _keep_memory()
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
        gc.freeze()  # to look for garbage once more at the end would take half a second


def _keep_memory() -> None:
    """Let glibc keep memory that is freed for what comes next, in this process and its workers: fresh pages, which the
    system fills with zeros, took a quarter of the time of filling slices."""
    # Arrays of 32 MiB and more still come from the system, and go back to it.
    for name, option, size in (("MALLOC_TRIM_THRESHOLD_", -1, 2**28), ("MALLOC_MMAP_THRESHOLD_", -3, 2**25)):
        os.environ.setdefault(name, str(size))
        with suppress(AttributeError, OSError, TypeError, ValueError):  # another C library, or a number of the user's
            ctypes.CDLL(None).mallopt(option, int(os.environ[name]))


if __name__ == "__main__":
    main()
