"""Descriptors of many shapes with the parameters that made them, in one file: what a posterior is trained on."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.geometry.descriptors import BLOCKS, Descriptors
from curvafit.inference.archive import Archive, encode
from curvafit.priors.coefficients import Coefficients

ARCHIVE = Archive(
    "a table of descriptors",
    "a table of descriptors",
    "curvafit descriptors",
    1,
    "describe the stores into another file, or with --overwrite",
    {"blocks": BLOCKS},
)
#: What is inferred, with a20 = 1 as the gauge, in working units.
PARAMETERS = ("a11", "log a02", "a10", "a01", "a00", "m0")


@dataclass(frozen=True, eq=False)
class Table:
    """N views of shapes: `shapes` and `views` name them (str, `(N,)`); `parameters` is `(N, 6)` (`PARAMETERS`),
    `descriptors` `(N, 351)` the blocks of `Descriptors` in their order, NaN where a view shows no surface.
    `provenance` says which stores and program made them."""

    shapes: np.ndarray
    views: np.ndarray
    parameters: np.ndarray
    descriptors: np.ndarray
    provenance: dict[str, Any]

    def __post_init__(self) -> None:
        n = len(self.shapes)
        expected = {"views": (n,), "parameters": (n, len(PARAMETERS)), "descriptors": (n, sum(BLOCKS.values()))}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"expected {name} of shape {shape}, got {getattr(self, name).shape}")

    def __len__(self) -> int:
        return len(self.shapes)

    def rows(self, chosen: np.ndarray) -> Table:
        """Return some rows, by their numbers or a mask."""
        i = np.asarray(chosen)
        return Table(self.shapes[i], self.views[i], self.parameters[i], self.descriptors[i], self.provenance)

    def of(self, views: Sequence[str]) -> Table:
        """Return the rows of some kinds of views.

        Raises
        ------
        ValueError
            If there is none of a kind.
        """
        kinds = set(self.views.tolist())
        if missing := [view for view in views if view not in kinds]:
            raise ValueError(f"expected views among {', '.join(sorted(kinds))}, got {', '.join(missing)}")
        return self.rows(np.isin(self.views, list(views)))

    @property
    def visible(self) -> Table:
        """Return the rows whose view shows a surface."""
        return self.rows(np.asarray(np.isfinite(self.descriptors).all(1)))


def parameters_of(law: Coefficients, mass: float) -> np.ndarray:
    """Return the six parameters of a law and a mass m₀, in the gauge a20 = 1 (`PARAMETERS`).

    Raises
    ------
    ValueError
        If a20 or a02 is not above 0.
    """
    a20, a11, a02, a10, a01, a00 = law
    if not (a20 > 0 and a02 > 0):
        raise ValueError(f"expected a law with a20 and a02 above 0, got a20 = {a20:g} and a02 = {a02:g}")
    return np.array([a11 / a20, np.log(a02 / a20), a10 / a20, a01 / a20, a00 / a20, mass])


def law_of(parameters: Sequence[float] | np.ndarray) -> tuple[Coefficients, float]:
    """Return the law and the mass of six parameters."""
    a11, log_a02, a10, a01, a00, mass = map(float, parameters)
    return Coefficients(1.0, a11, float(np.exp(log_a02)), a10, a01, a00), mass


def mirrored(parameters: np.ndarray) -> np.ndarray:
    """Return the parameters `(…, 6)` of the same shapes with inside and outside exchanged (`Coefficients.mirrored`)."""
    a11, log_a02, a10, a01, a00, mass = np.moveaxis(np.asarray(parameters, dtype=np.float64), -1, 0)
    a02 = np.exp(log_a02)
    return np.stack([a11 / a02, -log_a02, -a01 / a02, -a10 / a02, a00 / a02, -mass], -1)


def column_names() -> list[str]:
    """Return the block of each column of descriptors."""
    return [name for name, length in BLOCKS.items() for _ in range(length)]


def row_of(view: Descriptors | None) -> np.ndarray:
    """Return the row of a view's descriptors; NaN where there are none."""
    return np.full(sum(BLOCKS.values()), np.nan) if view is None else view.vector()


def save_table(table: Table, path: str | Path) -> None:
    """Write a table as one compressed `.npz`: arrays (descriptors in float32) and a JSON header."""
    arrays = {
        "names": encode([table.shapes.tolist(), table.views.tolist()]),
        "parameters": table.parameters,
        "descriptors": table.descriptors.astype(np.float32),
    }
    ARCHIVE.save(path, arrays, provenance=table.provenance)


def load_table(path: str | Path) -> Table:
    """Read a table of descriptors.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is not a table, is damaged, or has another format version or other blocks.
    """
    return ARCHIVE.load(path, _table)


def _table(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Table:
    """Return the table of a file's header and arrays."""
    shapes, views = (np.array(each, dtype=str) for each in json.loads(arrays["names"].tobytes()))
    if not np.isfinite(arrays["parameters"]).all():
        raise ValueError("parameters that are not finite")
    if arrays["descriptors"].dtype.kind != "f" or not isinstance(header["provenance"], dict):
        raise ValueError("descriptors that are no numbers, or no provenance")
    return Table(shapes, views, arrays["parameters"], arrays["descriptors"], header["provenance"])
