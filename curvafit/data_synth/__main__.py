"""python -m curvafit.data_synth STORE --count 240 --shape 56: build or resume an atlas's store."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from curvafit.data_synth.atlas import build
from curvafit.data_synth.store import Record


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, build, say each draw on the error stream; 2 where the input was wrong."""
    parser = argparse.ArgumentParser(prog="python -m curvafit.data_synth", description=__doc__)
    parser.add_argument("store", help="folder of the store")
    parser.add_argument("--count", type=int, default=240, help="viable shapes to end with")
    parser.add_argument("--shape", type=int, default=56, help="voxels along each axis")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--schedule", default="fast")
    given = parser.parse_args(arguments)
    try:
        build(given.store, given.count, given.shape, given.seed, given.schedule, _say)
    except (ValueError, FileNotFoundError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _say(record: Record, viable: int, draws: int) -> None:
    verdict = "viable" if record.viability.viable else f"rejected: {record.viability.reason}"
    print(f"draw {record.index}: {verdict} ({viable} of {draws}, {record.seconds:.1f} s)", file=sys.stderr, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
