"""Packages that only some uses need, and links that are no packages."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType


def require(module: str, extra: str, purpose: str) -> ModuleType:
    """Import an optional module, or raise ImportError with the command that installs the `extra` that has it.

    `purpose` is what needs the module, for the message: `"reading NRRD files"`. A module that no extra has, `""`, is
    installed by its own name.
    """
    try:
        return import_module(module)
    except ImportError as error:
        if error.name is None or not module.startswith(error.name.partition(".")[0]):
            raise  # the module is there, and what it imports itself is not
        install = f'pip install "curvafit[{extra}]"' if extra else f"pip install {module}"
        raise ImportError(f"{purpose} needs {error.name}, which is not installed: {install}", name=error.name) from None


def refuse_link(package: str) -> None:
    """Raise ImportError for `import priors` where the project's root has a link of that name into the package."""
    if not package.startswith("curvafit"):
        here = "the folder at the project's root is a link into the package"
        raise ImportError(f"import curvafit.{package}, not {package}: {here}")
