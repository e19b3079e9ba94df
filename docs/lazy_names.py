"""Let the API pages list the names that a room imports as `from module import name as name`."""

from __future__ import annotations

import ast
from typing import Any

import griffe


class LazyNames(griffe.Extension):
    """Take a package's redundant imports for its `__all__`, as type checkers do."""

    def on_module_members(self, *, node: Any, mod: griffe.Module, **_: Any) -> None:
        if mod.is_init_module and not mod.exports and isinstance(node, ast.AST):
            imports = [each for each in ast.walk(node) if isinstance(each, ast.ImportFrom)]
            mod.exports = [alias.name for each in imports for alias in each.names if alias.asname == alias.name]
