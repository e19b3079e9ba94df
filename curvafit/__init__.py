"""curvafit: read, make and enforce the shape texture of tubes and membranes in 3D.

A texture is six coefficients and a mass: shapes that minimise the integral of a quadratic polynomial of the principal
curvatures at constant volume.

- Infer: `infer(scan)` gives the parameters of a scanned volume, with `.fit`, `.plot()` and a report.
- Synthesise: `generate(law)` grows a shape of a texture; `generate_batch` grows several at once.
- Prior: `segment(scan, law)`, `refine(probabilities, law)` and `reconstruct(labels, law)` give a mask;
  `curvafit.priors` has the loss for networks.
- Files: `load(path)` and `save(volume, path)` read and write volumes with their spacing and unit.
- Measure: `measure(scan)`, `diagram(u, grid, epsilon)` and `wasserstein(a, b)`; more in `curvafit.geometry`.

A law is `Coefficients`, the name of a preset (`preset`), or the path of a `fit.json`. The public names are loaded when
they are first used: importing the package imports nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.generation.batch import generate_batch
    from curvafit.generation.flow import descend, generate
    from curvafit.generation.result import Flow
    from curvafit.geometry.diagram import Diagram, diagram
    from curvafit.geometry.distances import wasserstein
    from curvafit.inference.fit import Fit
    from curvafit.inference.infer import Inference, infer
    from curvafit.priors.coefficients import Coefficients, preset
    from curvafit.priors.grid import Grid
    from curvafit.scan.measure import Measures, measure
    from curvafit.segmentation.completion import reconstruct
    from curvafit.segmentation.refine import refine
    from curvafit.segmentation.result import Segmentation
    from curvafit.segmentation.segment import segment
    from curvafit.volumes.scan import Field, load, save

__version__ = "0.1.0"

__all__ = [
    "Coefficients",
    "Diagram",
    "Field",
    "Fit",
    "Flow",
    "Grid",
    "Inference",
    "Measures",
    "Segmentation",
    "__version__",
    "descend",
    "diagram",
    "generate",
    "generate_batch",
    "infer",
    "load",
    "measure",
    "preset",
    "reconstruct",
    "refine",
    "save",
    "segment",
    "wasserstein",
]

_HOMES = {
    "Coefficients": "curvafit.priors.coefficients",
    "Diagram": "curvafit.geometry.diagram",
    "Field": "curvafit.volumes.scan",
    "Fit": "curvafit.inference.fit",
    "Flow": "curvafit.generation.result",
    "Grid": "curvafit.priors.grid",
    "Inference": "curvafit.inference.infer",
    "Measures": "curvafit.scan.measure",
    "Segmentation": "curvafit.segmentation.result",
    "descend": "curvafit.generation.flow",
    "diagram": "curvafit.geometry.diagram",
    "generate": "curvafit.generation.flow",
    "generate_batch": "curvafit.generation.batch",
    "infer": "curvafit.inference.infer",
    "load": "curvafit.volumes.scan",
    "measure": "curvafit.scan.measure",
    "preset": "curvafit.priors.coefficients",
    "reconstruct": "curvafit.segmentation.completion",
    "refine": "curvafit.segmentation.refine",
    "save": "curvafit.volumes.scan",
    "segment": "curvafit.segmentation.segment",
    "wasserstein": "curvafit.geometry.distances",
}

#: The function that draws each type with a picture, as `module:function`; see `curvafit.core.pictures`.
_FIGURES = {
    "Diagram": "curvafit.drawing.plot:diagram_figure",
    "Field": "curvafit.drawing.sections:field_figure",
    "Fit": "curvafit.drawing.figures:fit_figure",
    "Flow": "curvafit.drawing.figures:flow_figure",
    "Inference": "curvafit.report.pictures:inference_figure",
    "Segmentation": "curvafit.segmentation.mask_files:segmentation_figure",
}

offer(__name__, _HOMES)
