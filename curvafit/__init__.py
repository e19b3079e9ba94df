"""curvafit: read, make and enforce the shape texture of tubes and membranes in 3D.

A texture is six coefficients and a mass: shapes that minimise the integral of a quadratic polynomial of the principal
curvatures at constant volume.

- Infer: `infer(scan)` gives the parameters of a scanned volume, with `.fit`, `.plot()` and a report.
- Synthesise: `generate(law)` grows a shape of a texture.
- Prior: `segment(scan, law)` gives a mask of grey levels or of a network's probabilities, `reconstruct(labels, law)`
  one of annotated slices; `curvafit.priors` has the loss for networks.
- Files: `load(path)` and `save(volume, path)` read and write volumes with their spacing and unit.
- Compare: `compare(*groups)` or `compare(table, by="age")` tells whether scans differ by group or number, in what.
- Map: `windows(scan)` measures a scan in windows: where its texture differs, in maps.
- Measure: `measure(scan)`, `measure_instances(labels)`, `diagram(u, grid, epsilon)` and `wasserstein(a, b)`; more in
  `curvafit.geometry`.

A law is `Coefficients`, the name of a preset (`preset`), or the path of a `fit.json`. The public names are loaded when
they are first used: importing the package imports nothing.
"""

from __future__ import annotations

import lazy_loader

__version__ = "0.2.0"

#: The function that draws each type with a picture, as `module:function`; see `curvafit.core.runtime`.
_FIGURES = {
    "Comparison": "curvafit.report.comparison:comparison_figure",
    "Diagram": "curvafit.drawing.plot:diagram_figure",
    "Volume": "curvafit.drawing.plot:field_figure",
    "Fit": "curvafit.drawing.plot:fit_figure",
    "Flow": "curvafit.drawing.plot:flow_figure",
    "Inference": "curvafit.report.inference:inference_figure",
    "Measures": "curvafit.report.measures:measures_figure",
    "Segmentation": "curvafit.segmentation.result:segmentation_figure",
    "Windows": "curvafit.report.measures:windows_figure",
}

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
