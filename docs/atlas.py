"""The page in docs/map: what `curvafit atlas map` writes of a shape of each preset.

    python docs/atlas.py [--shape 40] [-o docs/map/atlas.html]      # a minute on one core; `make docs` runs it once

Shapes are kept in `.cache/presets`: a killed run goes on. On the page they bear their presets' names.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from curvafit.core.runtime import log_stages, sub_progress
from curvafit.data_synth.atlas import build, shape_id
from curvafit.data_synth.design import Design, read_point
from curvafit.priors.law import PRESETS
from curvafit.report.atlas import write_map

STORE = Path(".cache") / "presets"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shape", type=int, default=40, help="voxels along an edge; 40 if not given")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/map/atlas.html"))
    options = parser.parse_args()
    design = Design("list", points=tuple(map(read_point, PRESETS)))
    progress = log_stages()
    STORE.parent.mkdir(exist_ok=True)
    store = build(STORE, len(PRESETS), options.shape, progress=sub_progress(progress, 0.0, 0.8), design=design)
    write_map([store], options.output, command="python docs/atlas.py", progress=sub_progress(progress, 0.8, 1.0))
    page = options.output.read_text(encoding="utf-8")
    for index in store.indices():
        again, k = divmod(index, len(PRESETS))  # where a shape was not viable, others follow from other noise
        page = page.replace(shape_id(store, index), tuple(PRESETS)[k] + ", again" * again)
    options.output.write_text(page, encoding="utf-8")
    print(options.output, f"{options.output.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
