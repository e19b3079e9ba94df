"""The face of a room: its public names, each loaded at its first use."""

from __future__ import annotations

import dis
import sys
from importlib import import_module
from types import ModuleType
from typing import Any


def attach_lazy_names(package: str) -> None:
    """Offer the names that a package imports under `if TYPE_CHECKING:`; each module is imported at their first use.

    The imports stand once, as `from room.module import name as name`, where type checkers and editors read them. Python
    compiles them without running them: the names and their modules are in the package's bytecode.
    """
    if not package.startswith("curvafit"):
        here = "the folder at the project's root is a link into the package"
        raise ImportError(f"import curvafit.{package}, not {package}: {here}")
    face = sys.modules[package]
    assert face.__spec__ is not None
    homes, module = {}, ""
    for instruction in dis.get_instructions(face.__spec__.loader.get_code(package)):  # type: ignore[union-attr]
        if instruction.opname == "IMPORT_NAME":
            module = instruction.argval
        elif instruction.opname == "IMPORT_FROM" and instruction.argval not in face.__dict__:  # not run
            homes[instruction.argval] = module
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
