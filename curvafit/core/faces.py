"""The face of a room: its public names, each loaded at its first use."""

from __future__ import annotations

import ast
import sys
from importlib import import_module
from inspect import getsource
from types import ModuleType
from typing import Any


def attach_lazy_names(package: str) -> None:
    """Offer the names that a package imports under `if TYPE_CHECKING:`; each module is imported at their first use.

    The imports stand once, as `from room.module import name as name`, where type checkers and editors read them; here
    they are read from the source of the package's `__init__.py`.

    Parameters
    ----------
    package
        `__name__` of the package.
    """
    face = sys.modules[package]
    blocks = (node for node in ast.parse(getsource(face)).body if isinstance(node, ast.If))
    imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
    homes = {alias.name: node.module for node in imports for alias in node.names if alias.asname == alias.name}
    face.__dict__["_homes"] = homes
    face.__dict__["__all__"] = sorted([*homes, *({"__version__"} & face.__dict__.keys())])
    face.__class__ = _Face


class _Face(ModuleType):
    """A package whose names win over its modules: `curvafit.geometry.diagram` is the function in the module so named.

    Importing that module would otherwise bind it in the function's place; `importlib.import_module` gives the module.
    """

    def __getattr__(self, name: str) -> Any:
        homes = self.__dict__["_homes"]
        if name not in homes:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        value = getattr(import_module(homes[name]), name)
        self.__dict__[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in self.__dict__["_homes"] and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted(self.__dict__["__all__"])
