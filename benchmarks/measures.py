"""What `measure` says of itself: how often its intervals hold the truth, by the length of the blocks.

    python -m benchmarks.measures [--count 100] [--edge 72] [--widths 2,3] [--periods 0.5,1,1.5]

Volumes are windows of level sets of Gaussian random fields (white noise, smoothed by so many voxels, cut so that 30 %
of the whole field are inside), which have no end and no defects. The truth is the mean over all volumes. Columns:
width, periods a block, blocks a volume, and of each quantity the share of volumes whose 95 % interval holds it.
"""

from __future__ import annotations

import argparse
from itertools import product

import numpy as np
from scipy import ndimage

from curvafit.studies import blocks
from curvafit.studies.measure import measure

#: Quantities that are shown.
SHOWN = ("BV/TV", "Tb.Th", "Tb.Sp", "Conn.D", "BS/TV", "DA", "H", "K", "C", "sponge")


def volume(width: float, edge: int, seed: int) -> np.ndarray:
    """A window of a level set, uint8, in whose field it takes an eighth of the volume."""
    field = np.random.default_rng(seed).standard_normal((2 * edge,) * 3, dtype=np.float32)
    smooth = ndimage.gaussian_filter(field, width, mode="wrap")
    return (smooth > np.quantile(smooth, 0.7))[:edge, :edge, :edge].astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--edge", type=int, default=72)
    parser.add_argument("--widths", default="2,3")
    parser.add_argument("--periods", default="0.5,1,1.5")
    args = parser.parse_args()
    print(f"{'width':>6}{'periods':>8}{'blocks':>8}" + "".join(f"{name:>8}" for name in SHOWN))
    for width, periods in product(*([float(each) for each in text.split(",")] for text in (args.widths, args.periods))):
        blocks.PERIODS = periods
        found = [measure(volume(width, args.edge, seed), kind="mask") for seed in range(args.count)]
        values, halves = (
            np.array([[getattr(each[name], kind) for name in SHOWN] for each in found]) for kind in ("value", "half")
        )
        held = (np.abs(values - values.mean(0)) <= halves).mean(0)
        count = np.mean([np.prod(each.blocks) for each in found])
        print(f"{width:6g}{periods:8g}{count:8.0f}" + "".join(f"{share:8.2f}" for share in held), flush=True)


if __name__ == "__main__":
    main()
