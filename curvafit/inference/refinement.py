"""What a refinement reports, and the bounded parameters and least-squares solver that its methods share."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache

import numpy as np

from curvafit.priors.coefficients import NAMES, Coefficients

#: A share of a20 + a02 that a start is kept away from the domain's edges, a20 = 0 and a02 = 0.
_EDGE = 0.01


@dataclass(frozen=True)
class Refinement:
    """Refined parameters (a, m₀) in working units, with what supports them.

    Attributes
    ----------
    method
        `"stationarity"` or `"fixed point"`.
    coefficients, mass
        In the gauge a20 = 1 (a02 = 1 where a20 is too small to divide by: `status` says so).
    uncertainty
        Standard deviation of each of the six coefficients; 0 for the one that fixes the scale.
    singular_values
        Of the least-squares problem at the solution, largest first: how firmly each direction of a is held.
    residual
        What is left of the misfit, in the method's own unit (each method's function says which).
    starts
        Each start's coefficients with the residual it ended at, best first.
    status
        A sentence on how well the answer is supported.
    evaluations
        Times that the costly part was evaluated.
    """

    method: str
    coefficients: Coefficients
    mass: float
    uncertainty: dict[str, float]
    singular_values: tuple[float, ...]
    residual: float
    starts: tuple[tuple[Coefficients, float], ...]
    status: str
    evaluations: int


def units(epsilon: float) -> np.ndarray:
    """Return the factors `(6,)` from dimensionless coefficients (lengths in ε) to those in spacing's unit."""
    return np.array([1, 1, 1, 1 / epsilon, 1 / epsilon, 1 / epsilon**2])


def in_gauge(values: np.ndarray) -> tuple[Coefficients, int]:
    """Return the coefficients with a20 = 1 and 0; or with a02 = 1 and 2, where a20 is under a thousandth of a02."""
    fixed = 0 if values[0] > 1e-3 * values[2] else 2
    return Coefficients(*(float(value) for value in values / values[fixed])), fixed


def admissible(values: np.ndarray) -> np.ndarray:
    """Return the nearest six with a20 + a02 = 2 and both positive, away from the edge."""
    share = np.clip(values[0] / max(values[0] + values[2], 1e-12), _EDGE, 1 - _EDGE)
    scaled = 2 * values / max(values[0] + values[2], 1e-12)
    return np.concatenate(([2 * share, scaled[1], 2 - 2 * share], scaled[3:]))


def named(deviations: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Return the deviations by the coefficients' names."""
    return {name: float(value) for name, value in zip(NAMES, deviations, strict=True)}


@cache
def import_jax() -> None:
    """Import JAX, which draws from NumPy's global generator on the way: that goes on as if it had not."""
    state = np.random.get_state()  # noqa: NPY002
    try:
        importlib.import_module("jax")
    finally:
        np.random.set_state(state)  # noqa: NPY002


@contextmanager
def double_precision_on_cpu():
    """Run JAX in float64 on the CPU while inside, in this thread alone; a program's other use of JAX is not touched.

    What JAX calls back runs in another one: see `called`.
    """
    import_jax()
    import jax

    if hasattr(jax, "enable_x64"):
        double_precision = jax.enable_x64
    else:  # an earlier JAX
        from jax.experimental import enable_x64 as double_precision  # pyright: ignore[reportAttributeAccessIssue]
    with double_precision(True), jax.default_device(jax.devices("cpu")[0]):
        yield


def called(function: Callable[[np.ndarray], np.ndarray], shape: tuple[int, ...], values, failures: list[BaseException]):
    """Call a NumPy function of a vector from within JAX, both in float64.

    JAX calls it in a thread where arrays may be rounded to float32, so the numbers go in and out as pairs of words.
    What the function raises, an interrupt too, goes into `failures`, for the caller to raise: JAX tells an error of its
    own instead.
    """
    import jax

    def of_words(pairs):
        free = np.array(pairs, dtype=np.uint32).view(np.float64).reshape(-1)
        try:
            return np.array(function(free), dtype=np.float64, order="C").view(np.uint32).reshape(*shape, 2)
        except BaseException as error:
            failures.append(error)
            raise

    pairs = jax.lax.bitcast_convert_type(values, np.uint32)
    words = jax.pure_callback(of_words, jax.ShapeDtypeStruct((*shape, 2), np.uint32), pairs)
    return jax.lax.bitcast_convert_type(words, np.float64)
