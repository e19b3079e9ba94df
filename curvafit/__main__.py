"""The program: `curvafit`, or `python -m curvafit`. It listens to signals before anything that takes long is loaded."""

import warnings

from curvafit.interrupts import exit_code, leave, listen


def main() -> None:
    """The entry point."""
    # What Zarr was about to read where a signal came: nothing that a user could do anything about.
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
