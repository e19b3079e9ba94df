"""Draws from the posterior of a scan's parameters, and the intervals that hold them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from curvafit.priors.coefficients import NAMES, POWERS

#: What is drawn, in the order of the columns; a20 = 1 is the gauge.
COLUMNS = ("a11", "a02", "a10", "a01", "a00", "mass")
#: Levels of the intervals, in percent.
LEVELS = (50, 90)
#: Significant digits of a draw in a file.
_DIGITS = 6


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws `(n, 6)` of (a11, a02, a10, a01, a00, m₀) in working units, with a20 = 1.

    Attributes
    ----------
    view
        What the scan was taken for: a kind of view that the posterior was trained on.
    method
        How they were drawn, in words.
    """

    values: np.ndarray
    view: str
    method: str

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] != len(COLUMNS) or not np.isfinite(self.values).all():
            raise ValueError(f"expected finite draws (n, {len(COLUMNS)}), got shape {self.values.shape}")

    @staticmethod
    def of(parameters: np.ndarray, view: str, method: str) -> Draws:
        """Return the draws of parameters `(n, 6)` with log a02 for a02 (`table.PARAMETERS`)."""
        values = np.array(parameters, dtype=np.float64)
        values[:, 1] = np.exp(values[:, 1])
        return Draws(values, view, method)

    @property
    def parameters(self) -> np.ndarray:
        """Return the draws as `table.PARAMETERS` has them, with log a02."""
        values = self.values.copy()
        values[:, 1] = np.log(values[:, 1])
        return values

    @property
    def deviations(self) -> dict[str, float]:
        """Return the standard deviations by name, 0 for a20."""
        return {"a20": 0.0} | {name: float(x) for name, x in zip(COLUMNS, self.values.std(0), strict=True)}

    def middle(self, scale: np.ndarray) -> np.ndarray:
        """Return the row of `parameters` nearest to the medians, in units of `scale` `(6,)`."""
        rows = self.parameters
        return rows[np.square((rows - np.median(rows, 0)) / scale).sum(1).argmin()]

    def intervals(self, length: float = 1.0) -> dict[str, dict[str, Any]]:
        """Return each parameter's median and central intervals, in the unit of which a working length is `length`."""
        parts = {}
        powers = (*(POWERS[name] for name in NAMES[1:]), 0)
        for name, power, column in zip(COLUMNS, powers, self.values.T, strict=True):
            values = column * length**-power
            parts[name] = {"median": float(np.median(values))} | {
                str(level): [float(x) for x in np.percentile(values, (50 - level / 2, 50 + level / 2))]
                for level in LEVELS
            }
        return parts

    def as_dict(self) -> dict[str, Any]:
        """Return the draws in JSON's types, a column for each parameter."""
        columns = {
            name: [float(f"{x:.{_DIGITS}g}") for x in column]
            for name, column in zip(COLUMNS, self.values.T, strict=True)
        }
        return {"view": self.view, "method": self.method, "draws": columns}

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Draws:
        """Return what `as_dict` wrote, to its digits.

        Raises
        ------
        ValueError
            If the columns have several lengths.
        """
        columns = [content["draws"][name] for name in COLUMNS]
        if len({len(column) for column in columns}) > 1:
            lengths = ", ".join(str(len(column)) for column in columns)
            raise ValueError(f"expected draws of one length in a fit's posterior, got {lengths}")
        return Draws(np.array(columns, dtype=np.float64).T, content["view"], content["method"])
