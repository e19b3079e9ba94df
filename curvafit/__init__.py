"""curvafit: read, make and enforce the shape texture of tubes and membranes in 3D.

The public names are loaded when first used: importing the package imports nothing.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from curvafit.diagram import Diagram, diagram
    from curvafit.generation.batch import generate_batch
    from curvafit.generation.flow import descend, generate
    from curvafit.infer import infer
    from curvafit.priors.coefficients import Coefficients, preset
    from curvafit.priors.grid import Grid
    from curvafit.scan import Field, load, save
    from curvafit.segment import reconstruct, segment
    from curvafit.transport import wasserstein

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
    "Diagram": "curvafit.diagram",
    "Field": "curvafit.scan",
    "Grid": "curvafit.priors.grid",
    "descend": "curvafit.generation.flow",
    "diagram": "curvafit.diagram",
    "generate": "curvafit.generation.flow",
    "generate_batch": "curvafit.generation.batch",
    "infer": "curvafit.infer",
    "load": "curvafit.scan",
    "preset": "curvafit.priors.coefficients",
    "reconstruct": "curvafit.segment",
    "save": "curvafit.scan",
    "segment": "curvafit.segment",
    "wasserstein": "curvafit.transport",
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
