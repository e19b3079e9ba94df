"""Freeze rows: `python -m tests.golden freeze [ROW ...]`."""

import sys
import tempfile
import time
from pathlib import Path

from tests.golden import rows
from tests.golden.frozen import compare, read, write


def main(words: list[str]) -> None:
    """Do what the words say."""
    if words[:1] != ["freeze"] or not set(words[1:]) <= set(rows.ROWS):
        raise SystemExit(f"{__doc__}\nrows: {' '.join(rows.ROWS)}")
    kept = read()
    for name in words[1:] or list(rows.ROWS):
        begun = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            got = rows.run(name, Path(folder))
        said = compare(kept[name], got, close=rows.closeness(name)) if name in kept else ["new"]
        print(f"{name}: {time.perf_counter() - begun:.1f} s", *said[:12], sep="\n    ", flush=True)
        if said:
            kept[name] = got
            write({name: kept[name] for name in rows.ROWS if name in kept})
    write({name: kept[name] for name in rows.ROWS if name in kept})


if __name__ == "__main__":
    main(sys.argv[1:])
