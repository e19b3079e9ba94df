"""Numbers of a law as a posterior has them, and the components of descriptors that it sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curvafit.geometry.description import BLOCKS
from curvafit.priors.coefficients import Coefficients

#: Parameters that are inferred, in working units with a20 = 1 as the gauge; and with them the thickness of the law's
#: shapes in their own voxels, from which the length of such a voxel on a scan follows.
PARAMETERS = ("a11", "log a02", "a10", "a01", "a00", "m0")
TARGETS = (*PARAMETERS, "log thickness")
#: The same without logarithms, as columns of draws.
COLUMNS = ("a11", "a02", "a10", "a01", "a00", "mass", "thickness")
#: Blocks whose logarithm is taken, and the least value that goes into it.
LOGARITHMIC = ("fraction", "chords", "gaps", "depths", "clearances")
LEAST = 1e-3
#: Of the densities of ∫H and χ, in these units, the inverse sinh is taken.
BENDS, EULERS = 50.0, 100.0
#: Most deviations from its mean to which a column is clipped.
FURTHEST = 6.0
#: Typical amount seen of a texture, and the most that training shows, in cubes of a thickness.
USUAL, MOST_SEEN = 500.0, 8000.0


def parameters_of(law: Coefficients, mass: float) -> np.ndarray:
    """Return the six parameters of a law and a mass m₀, in the gauge a20 = 1 (`PARAMETERS`).

    Raises ValueError if a20 or a02 is not above 0.
    """
    a20, a11, a02, a10, a01, a00 = law
    if not (a20 > 0 and a02 > 0):
        raise ValueError(f"expected a law with a20 and a02 above 0, got a20 = {a20:g} and a02 = {a02:g}")
    return np.array([a11 / a20, np.log(a02 / a20), a10 / a20, a01 / a20, a00 / a20, mass])


def law_of(parameters: Sequence[float] | np.ndarray) -> tuple[Coefficients, float]:
    """Return the law and the mass of six parameters."""
    a11, log_a02, a10, a01, a00, mass = map(float, parameters)
    return Coefficients(1.0, a11, float(np.exp(log_a02)), a10, a01, a00), mass


def to_columns(draws: np.ndarray) -> np.ndarray:
    """Return draws `(n, 7)` of `TARGETS`, or `(n, 6)` of `PARAMETERS`, as columns `COLUMNS`, without logarithms."""
    columns = draws.T.copy()
    for k in {1, 6} & set(range(len(columns))):  # a02, and thickness where there is one
        columns[k] = np.exp(columns[k])
    return columns


def mirror_parameters(parameters: np.ndarray) -> np.ndarray:
    """Return the parameters `(…, 6)` of the same shapes with inside and outside exchanged (`Coefficients.mirror`)."""
    a11, log_a02, a10, a01, a00, mass = np.moveaxis(np.asarray(parameters, dtype=np.float64), -1, 0)
    a02 = np.exp(log_a02)
    return np.stack([a11 / a02, -log_a02, -a01 / a02, -a10 / a02, a00 / a02, -mass], -1)


def encode_seen(kinds: Sequence[str], views: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """Encode how textures were seen as numbers `(N, 1 + kinds)`: the amount's logarithm, and the view one-hot.

    Amounts are clipped to `MOST_SEEN`, as training shows no more. Raises ValueError if a view is not among `kinds`.
    """
    if unknown := sorted(set(views.tolist()) - set(kinds)):
        raise ValueError(f"expected views among {', '.join(kinds)}, got {', '.join(unknown)}")
    log_amount = np.log10(np.minimum(amount, MOST_SEEN) / USUAL)
    return np.concatenate([log_amount[:, None], views[:, None] == np.array(kinds)], axis=1)


def column_names() -> list[str]:
    """Return the name of the block that each column of descriptors belongs to."""
    return [name for name, length in BLOCKS.items() for _ in range(length)]


# ---- compression -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Compression:
    """From descriptors to their principal components: means and scales by column `(c,)`, basis `(k, c)`."""

    mean: np.ndarray
    scale: np.ndarray
    basis: np.ndarray

    def __call__(self, descriptors: np.ndarray) -> np.ndarray:
        """Return the components `(N, k)`, their mean square 1, of descriptors `(N, 351)`."""
        columns = columns_of(descriptors)
        return np.clip((columns - self.mean) / self.scale, -FURTHEST, FURTHEST) @ self.basis.T


def columns_of(descriptors: np.ndarray, blocks: Sequence[str] = tuple(BLOCKS)) -> np.ndarray:
    """Return the columns of some blocks, lengths and densities as logarithms."""
    names = np.array(column_names())
    columns = np.array(descriptors, dtype=np.float64)
    logarithmic = np.isin(names, LOGARITHMIC)
    columns[:, logarithmic] = np.log(np.maximum(columns[:, logarithmic], LEAST))
    area, bend, euler = np.flatnonzero(names == "densities")
    columns[:, area] = np.log(np.maximum(columns[:, area], LEAST))
    columns[:, bend] = np.arcsinh(columns[:, bend] / BENDS)
    columns[:, euler] = np.arcsinh(columns[:, euler] / EULERS)
    return columns[:, np.isin(names, list(blocks))]
