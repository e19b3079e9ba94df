"""The program: `curvafit`, or `python -m curvafit`. It listens to signals before anything that takes long is loaded."""

from curvafit.interrupts import exit_code, listen


def main() -> None:
    """The entry point."""
    try:
        listen()
        from curvafit.cli import main as run

        run()
    except KeyboardInterrupt as signal:
        raise SystemExit(exit_code(signal)) from None


if __name__ == "__main__":
    main()
