"""Descriptors of many shapes with the parameters that made them, in one file: what a posterior is trained on."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.files import write_content
from curvafit.geometry.descriptors import BLOCKS, Descriptors
from curvafit.priors.bounds import quoted
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.json_text import parse_json
from curvafit.volumes.formats import read_archive

FORMAT = "curvafit descriptors"
VERSION = 1
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
        there = set(self.views.tolist())
        if missing := [view for view in views if view not in there]:
            raise ValueError(f"expected views among {', '.join(sorted(there))}, got {', '.join(missing)}")
        return self.rows(np.isin(self.views, list(views)))

    @property
    def seen(self) -> Table:
        """Return the rows whose view shows a surface."""
        return self.rows(np.asarray(np.isfinite(self.descriptors).all(1)))


def parameters_of(law: Coefficients, mass: float) -> np.ndarray:
    """Return the six parameters of a law and a mass m₀, in the gauge a20 = 1 (`PARAMETERS`)."""
    a20, a11, a02, a10, a01, a00 = law
    return np.array([a11 / a20, np.log(a02 / a20), a10 / a20, a01 / a20, a00 / a20, mass])


def law_of(parameters: Sequence[float] | np.ndarray) -> tuple[Coefficients, float]:
    """Return the law and the mass of six parameters."""
    a11, log_a02, a10, a01, a00, mass = map(float, parameters)
    return Coefficients(1.0, a11, float(np.exp(log_a02)), a10, a01, a00), mass


def column_names() -> list[str]:
    """Return the block of each column of descriptors."""
    return [name for name, length in BLOCKS.items() for _ in range(length)]


def row_of(seen: Descriptors | None) -> np.ndarray:
    """Return the row of a view's descriptors; NaN where there are none."""
    return np.full(sum(BLOCKS.values()), np.nan) if seen is None else seen.vector()


def save_table(table: Table, path: str | Path) -> None:
    """Write a table as one compressed `.npz`: arrays (descriptors in float32) and a JSON header."""
    header = {"format": FORMAT, "version": VERSION, "blocks": BLOCKS, "provenance": table.provenance}
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        header=np.frombuffer(json.dumps(header).encode(), dtype=np.uint8),
        names=np.frombuffer(json.dumps([table.shapes.tolist(), table.views.tolist()]).encode(), dtype=np.uint8),
        parameters=table.parameters,
        descriptors=table.descriptors.astype(np.float32),
    )
    write_content(Path(path), buffer.getvalue())


def load_table(path: str | Path) -> Table:
    """Read a table of descriptors.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is not a table, is damaged, or has another format version or other blocks.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"expected a table of descriptors, got {path}, where there is none")
    try:
        arrays = read_archive(path)
        header = parse_json(arrays["header"].tobytes(), "a table's header", path)
        known = header["format"] == FORMAT
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"expected a table of descriptors, got {path}, which is damaged or something else") from error
    if not known:
        raise ValueError(f"expected a table of descriptors, got {path}, which is something else")
    if (version := header.get("version")) != VERSION or header.get("blocks") != BLOCKS:
        raise ValueError(
            f"expected descriptors of version {VERSION} with the blocks of this program, got version {quoted(version)} "
            f"or other blocks in {path}: describe the stores into another file, or with --overwrite"
        )
    try:
        shapes, views = (np.array(each, dtype=str) for each in json.loads(arrays["names"].tobytes()))
        if not np.isfinite(arrays["parameters"]).all():
            raise ValueError("parameters that are not finite")
        if arrays["descriptors"].dtype.kind != "f" or not isinstance(header["provenance"], dict):
            raise ValueError("descriptors that are no numbers, or no provenance")
        return Table(shapes, views, arrays["parameters"], arrays["descriptors"], header["provenance"])
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(f"expected a whole table of descriptors, got {path} ({str(error)[:200]})") from error


def is_table(path: Path) -> bool:
    """Return whether a file bears a table's format; all else of it may be wrong."""
    try:
        header = read_archive(path)["header"].tobytes() if path.is_file() else b""
        return parse_json(header, "a table's header", path)["format"] == FORMAT
    except (OSError, ValueError, KeyError, TypeError):
        return False
