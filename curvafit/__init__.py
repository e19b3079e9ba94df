"""curvafit: read, make and enforce the shape texture of tubes and membranes in 3D.

The public names are loaded when first used: importing the package imports nothing.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from curvafit.generation.batch import generate_batch
    from curvafit.generation.flow import descend, generate
    from curvafit.geometry.diagram import Diagram, diagram
    from curvafit.geometry.transport import wasserstein
    from curvafit.inference.infer import infer
    from curvafit.priors.coefficients import Coefficients, preset
    from curvafit.priors.grid import Grid
    from curvafit.segmentation.segment import reconstruct, segment
    from curvafit.volumes.scan import Field, load, save

    __version__: str

__all__ = [
    "Coefficients",
    "Diagram",
    "Field",
    "Grid",
    "__version__",
    "descend",
    "diagram",
    "generate",
    "generate_batch",
    "infer",
    "load",
    "preset",
    "reconstruct",
    "save",
    "segment",
    "wasserstein",
]

_SOURCES = {
    "Coefficients": "curvafit.priors.coefficients",
    "Diagram": "curvafit.geometry.diagram",
    "Field": "curvafit.volumes.scan",
    "Grid": "curvafit.priors.grid",
    "descend": "curvafit.generation.flow",
    "diagram": "curvafit.geometry.diagram",
    "generate": "curvafit.generation.flow",
    "generate_batch": "curvafit.generation.batch",
    "infer": "curvafit.inference.infer",
    "load": "curvafit.volumes.scan",
    "preset": "curvafit.priors.coefficients",
    "reconstruct": "curvafit.segmentation.segment",
    "save": "curvafit.volumes.scan",
    "segment": "curvafit.segmentation.segment",
    "wasserstein": "curvafit.geometry.transport",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("curvafit")
    if name not in _SOURCES:
        raise AttributeError(f"module 'curvafit' has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(_SOURCES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """`curvafit.diagram`, `infer` and `segment` are functions, in modules of the same names: the functions win.

    Importing such a module would otherwise bind it here in the function's place.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _SOURCES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
