"""Two toy groups of bone, four micro-CT scans each, to try a comparison on; and the picture of docs/figure/bone.md.

python examples/bone.py [--edge 64] [-o bone] [--picture docs/figure/bone.webp]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from pictures import write_webp

from curvafit.data_synth.imaging.modality import MODALITIES, image
from curvafit.generation.flow import generate
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset
from curvafit.report.comparison import numbers_figure
from curvafit.studies.comparison import compare
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import save

#: The preset of each group, and the names of its animals.
GROUPS = {"control": ("trabec-3", (1, 2, 3, 4)), "treated": ("trabec", (5, 6, 7, 8))}
#: The voxel's edge, in mm, and what the picture shows.
EDGE, SHOWN = 0.0195, ("BV/TV", "Tb.Th", "Tb.Sp", "Conn.D")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edge", type=int, default=64, help="voxels along an edge of a scan")
    parser.add_argument("--picture", type=Path, help="compare the groups, and draw four numbers (WebP)")
    parser.add_argument("-o", "--output", type=Path, default=Path("bone"), help="folder of control/ and treated/")
    options = parser.parse_args()
    modality = MODALITIES["micro-ct"]
    imaging = modality.draw(0)  # one for all: the groups are scanned alike
    for group, (name, animals) in GROUPS.items():
        (options.output / group).mkdir(parents=True, exist_ok=True)
        for animal in animals:
            law = preset(name)
            field = generate(law.coefficients, law.mass, Grid((options.edge,) * 3), seed=animal).field
            scan = Volume(image(field, modality.voxel, imaging, animal).numpy(), (EDGE,) * 3, "mm")
            print(save(scan, options.output / group / f"mouse{animal}.tif", overwrite=True))
    if options.picture is not None:
        found = compare(*(options.output / group for group in GROUPS), primary=SHOWN[0])
        write_webp(numbers_figure(found, SHOWN), options.picture, width=1000, lossless=True)


if __name__ == "__main__":
    main()
