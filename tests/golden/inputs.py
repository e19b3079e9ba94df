"""How the inputs of the corpus were made; they are committed, since another processor would round some otherwise.
`fit.json` was written by an inference.

python -m tests.golden.inputs
"""

import shutil
from pathlib import Path

import numpy as np

from curvafit.volumes import Volume, save
from tests.calling import done
from tests.golden import FOLDER

EDGE = 0.0195


def make(folder: Path = FOLDER) -> None:
    """Write every input into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    phase = tubes((30, 32, 34), 14, 3.2)
    _nifti(phase[:24, :24, :24], folder / "field.nii.gz")
    _nifti((phase > 0).astype(np.uint8), folder / "mask.nii.gz")
    grey = np.clip(110 + 50 * phase + rng.normal(0, 14, phase.shape), 0, 255).astype(np.uint8)
    save(Volume(grey, EDGE, "mm"), folder / "scan.tif")
    halves = np.ones(phase.shape, np.uint8)
    halves[:, :, 17:] = 2
    _nifti(halves, folder / "halves.nii.gz")
    inside = np.clip(0.5 + 0.4 * phase + rng.normal(0, 0.1, phase.shape), 0, 1)
    _nifti(np.round(inside, 2).astype(np.float32), folder / "probabilities.nii.gz")
    cells, light = nuclei((26, 40, 44), 5, rng)
    save(Volume(cells, EDGE, "mm"), folder / "cells.tif")
    save(Volume(light, EDGE, "mm"), folder / "light.tif")
    for group, radius in (("control", 3.0), ("treated", 3.8)):
        (folder / group).mkdir(exist_ok=True)
        for k in range(4):
            shape = tubes((24, 24, 24), 12 + 0.3 * k, radius + 0.1 * k, k) > 0
            _nifti(shape.astype(np.uint8), folder / group / f"{k}.nii.gz")
    law = {"a20": 1, "a11": 2, "a02": 6, "a10": -40, "a01": -40, "a00": 400}
    values = {name: np.full((16,) * 3, value, np.float32) for name, value in law.items()}
    np.savez_compressed(folder / "maps.npz", **values, mass=np.float32(-0.6))
    for name, spread in (("near.yaml", 0.05), ("around.yaml", 0.1)):
        (folder / name).write_text(f"around: tubes\nspread: {spread}\n")
    store = folder / "store"
    shutil.rmtree(store, ignore_errors=True)
    build = "--shape 20 --steps 200 --workers 0 --count 6 --design"
    done("atlas", "build", store, *build.split(), folder / "around.yaml")


def tubes(shape: tuple[int, int, int], period: float, radius: float, shift: float = 0.0) -> np.ndarray:
    """The profile of tubes along three axes that meet, with bends so that no two places are alike."""
    z, y, x = (axis + shift for axis in np.meshgrid(*map(np.arange, shape), indexing="ij"))
    y, x = y + 1.5 * np.sin(z / 5), x + 1.2 * np.cos(y / 6)
    far = [np.abs((axis + 0.5) % period - period / 2) for axis in (z, y, x)]
    near = np.minimum.reduce([np.hypot(far[(k + 1) % 3], far[(k + 2) % 3]) for k in range(3)])
    return np.tanh((radius - near) / (2 * np.sqrt(2))).astype(np.float32)


def nuclei(shape: tuple[int, int, int], count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Ellipsoids with numbers of their own, and a noisy image of them."""
    places = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    labels = np.zeros(shape, np.uint16)
    for number in range(1, count + 1):
        centre = rng.uniform(0.2, 0.8, 3) * shape
        radii = rng.uniform(4, 7, 3)
        labels[(np.square((places - centre) / radii).sum(-1) <= 1) & (labels == 0)] = number
    light = 60.0 + 90 * (labels > 0) + rng.normal(0, 12, shape)
    return labels, np.clip(light, 0, 255).astype(np.uint8)


def _nifti(values: np.ndarray, path: Path) -> None:
    affine = np.diag([EDGE, EDGE, EDGE, 1.0])
    affine[:3, 3] = 1, -2, 3
    save(Volume(values, EDGE, "mm", affine), path)


if __name__ == "__main__":
    make()
