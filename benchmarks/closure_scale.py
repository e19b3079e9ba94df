"""Whether a scan's descriptors tell at what scale the model made it.

    CURVAFIT_DATA=… python -m benchmarks.closure_scale [--scales 0.8,1,1.25] [--cache closure_cache]

ε is a number of voxels, so a scan is read at some working voxel, and a law read at another one is the same law but for
what ε changes: a10 and a01 over the scale, a00 over its square. The author's volumes, as masks, are resampled to so
many times as many voxels and read by the packaged posterior:

- p: `misfit`, by the best fit, of each scale; believed: how often a scale has the greatest p, which would be the
  evidence for it.
- error: of the posterior's middle, its law brought back to the volume's own scale, in deviations of the prior's box
  (uniform; a mass is left as it is read); in 90: part of the true values in the central 90 % intervals.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import nibabel
import numpy as np
from scipy import ndimage

from benchmarks.closure import truth_of
from curvafit.core.files import write_atomically
from curvafit.geometry.descriptors import descriptors
from curvafit.inference.check import amortised_p
from curvafit.inference.emulator import optimum
from curvafit.inference.estimate import DRAWS, STARTS
from curvafit.inference.posterior import load_posterior
from curvafit.inference.table import PARAMETERS
from curvafit.priors.grid import Grid

#: What a law's parameters are divided by, as a power of the scale.
POWERS = np.array([0, 0, 1, 1, 2, 0])


def row_of(path: Path, scale: float, cache: Path) -> np.ndarray:
    """The descriptors of an author's volume as a mask of `scale` times as many voxels a side, measured once."""
    kept = cache / f"{path.name.partition(' coeffs')[0].replace(' ', '')}-{scale:g}.npy"
    if not kept.exists():
        u = np.asarray(nibabel.load(path).dataobj, dtype=np.float32)  # type: ignore[attr-defined]
        mask = np.asarray(ndimage.zoom(u, scale, order=3, mode="grid-wrap", grid_mode=True)) > 0
        z, y, x = mask.shape
        row = descriptors(mask, Grid((z, y, x))).vector()
        write_atomically(kept, lambda temporary: np.save(temporary, row))
    return np.load(kept)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scales", default="0.8,1,1.25")
    parser.add_argument("--cache", type=Path, default=Path("closure_cache"))
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    scales = [float(each) for each in options.scales.split(",")]
    paths = sorted((Path(os.environ["CURVAFIT_DATA"]) / "gallery").glob("*coeffs*.nii.gz"))
    posterior = load_posterior()
    prior = np.ptp(posterior.box, axis=1) / np.sqrt(12)
    p, errors, held = (np.empty((len(paths), len(scales), *rest)) for rest in ((), (6,), (6,)))
    print(f"{'volume':12}" + "".join(f"  p at {scale:g}" for scale in scales), flush=True)
    for i, path in enumerate(paths):
        for j, scale in enumerate(scales):
            row = row_of(path, scale, options.cache)
            draws = posterior.sample(row, "mask", DRAWS)
            p[i, j] = amortised_p(posterior, "mask", optimum(posterior.emulator, row, "mask", draws[:STARTS]).misfit)
            own = draws * scale**POWERS
            errors[i, j] = np.abs(np.median(own, axis=0) - truth_of(path)) / prior
            low, high = np.quantile(own, (0.05, 0.95), axis=0)
            held[i, j] = (low <= truth_of(path)) & (truth_of(path) <= high)
        print(f"{path.name.partition(' coeffs')[0]:12}" + "".join(f"{each:10.3f}" for each in p[i]), flush=True)
    print(f"\n{'scale':8}{'p':>8}{'believed':>10}   median error: {', '.join(PARAMETERS)}; in 90")
    for j, scale in enumerate(scales):
        believed, error = np.mean(p.argmax(1) == j), np.median(errors[:, j], axis=0)
        figures = " ".join(f"{each:.2f}" for each in error)
        print(f"{scale:<8g}{np.median(p[:, j]):8.2f}{believed:10.2f}   {figures}; {held[:, j].mean():.2f}")


if __name__ == "__main__":
    main()
