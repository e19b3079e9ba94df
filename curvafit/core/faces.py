"""The face of a package: its public names, loaded at their first use."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import Any


def offer(package: str, homes: Mapping[str, str]) -> None:
    """Let a package offer names of its modules; a module is imported at the first use of a name.

    Parameters
    ----------
    package
        `__name__` of the package.
    homes
        The module of each name.
    """
    face = sys.modules[package]
    face.__dict__["_homes"] = dict(homes)
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
