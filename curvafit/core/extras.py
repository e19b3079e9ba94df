"""Packages that only some uses need."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType


def require(module: str, extra: str, purpose: str) -> ModuleType:
    """Import an optional module, or say what to install.

    Parameters
    ----------
    module
        Its name, as `import` takes it.
    extra
        The extra of curvafit that installs it, such as `infer`.
    purpose
        What needs it, for the message: `reading parameters`.

    Raises
    ------
    ImportError
        If the module is not installed; the message ends in the command that installs it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        if error.name is None or not module.startswith(error.name.partition(".")[0]):
            raise  # the module is there, and what it imports itself is not
        install = f'pip install "curvafit[{extra}]"'
        raise ImportError(f"{purpose} needs {error.name}, which is not installed: {install}", name=error.name) from None
