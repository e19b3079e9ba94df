"""The emulator: from parameters to the descriptors of the shapes that they grow; and the parameters that fit best.

It states a mean, by an ensemble of small networks, and a covariance between seeds, from what the networks miss. So the
likelihood of descriptors has exact derivatives with respect to the parameters.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from curvafit.inference.stationary import call_in_double
from curvafit.inference.table import PARAMETERS, Compression, encode_seen
from curvafit.scan.measures import Reading

#: Most steps from a start.
STEPS = 60
#: Least deviation between seeds along a direction, where the mean one is 1.
FAINTEST = 0.05


class Layer(NamedTuple):
    """Weights `(members, outputs, inputs)` and biases `(members, outputs)`."""

    weight: Any
    bias: Any


class Emulated(NamedTuple):
    """Compressed descriptors that parameters lead to: mean `(N, k)`, and deviations `(N, k)` along the rows of the
    emulator's basis, directions in which seeds differ independently."""

    mean: np.ndarray
    deviation: np.ndarray


@dataclass(frozen=True, eq=False)
class Emulator:
    """The compressed descriptors of a view, given parameters.

    Attributes
    ----------
    compression
        From descriptors to what is emulated.
    views
        Kinds of views that it was trained on.
    box
        `(6, 2)`: the parameters' least and greatest values.
    mean, spread
        Layers of the networks of the mean, and of the logarithms of the deviations.
    basis
        `(k, k)`: rows are directions in which what the mean misses is uncorrelated.
    inflation
        Mean square of what the mean misses along directions in which parameters move it, over what the deviations
        state: more than 1 where few shapes trained it, so that it errs by the same at similar parameters.
    """

    compression: Compression
    views: tuple[str, ...]
    box: np.ndarray
    mean: tuple[Layer, ...]
    spread: tuple[Layer, ...]
    basis: np.ndarray
    inflation: float

    def __call__(self, parameters: np.ndarray, views: np.ndarray, amount: np.ndarray) -> Emulated:
        """Return the mean and deviations of the compressed descriptors of parameters `(N, 6)`, seen in views and to
        amounts `(N,)`; of length 1 these are those of all."""
        inputs = self.inputs(parameters, views, amount)
        mean, spread = forward(self.mean, inputs).mean(0), forward(self.spread, inputs).mean(0)
        return Emulated(mean, np.maximum(np.exp(spread), FAINTEST))

    def inputs(self, parameters: np.ndarray, views: np.ndarray, amount: np.ndarray) -> np.ndarray:
        """Return the networks' inputs `(N, …)`: the parameters in deviations of the prior, the amount, and the view."""
        scaled = (np.atleast_2d(parameters) - self.box.mean(1)) / self.deviation
        conditions = encode_seen(self.views, views, amount)
        return np.concatenate([scaled, np.broadcast_to(conditions, (len(scaled), conditions.shape[1]))], 1)

    @property
    def deviation(self) -> np.ndarray:
        """Return the deviations `(6,)` of parameters uniform in the box."""
        return (self.box[:, 1] - self.box[:, 0]) / np.sqrt(12)


def best_parameters(emulator: Emulator, reading: Reading, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters `(6,)` of greatest posterior density given a reading, and their covariance.

    Levenberg and Marquardt's method from many starts `(n, 6)`, with exact derivatives in float64, by optimistix; the
    covariance between seeds is held at its mean over the starts. The covariance `(6, 6)` of the parameters is Laplace's
    approximation. Both results are in working units (`PARAMETERS`); the box is the prior.
    """
    starts = np.asarray(starts, dtype=np.float64)[None]
    parameters, slopes, _, values = _minimise(emulator, *reading.columns, starts)
    best = int(values[0].argmin())
    slope, deviation = slopes[0, best], emulator.deviation
    # The likelihood's precision and the prior's, which is 1 in deviations of the prior, add up.
    covariance = np.linalg.inv(slope.T @ slope + np.eye(len(PARAMETERS)))
    return parameters[0, best], np.outer(deviation, deviation) * covariance


def misfits(
    emulator: Emulator, descriptors: np.ndarray, views: np.ndarray, amount: np.ndarray, starts: np.ndarray
) -> np.ndarray:
    """Return the sums of squares `(N,)` of whitened descriptors that the best parameters leave unexplained.

    Descriptors are `(N, 351)`, views and amounts `(N,)`; `starts` `(N, n, 6)` are n parameters to start from for each.
    """
    _, _, unexplained, values = _minimise(emulator, descriptors, views, amount, starts)
    return unexplained[np.arange(len(descriptors)), values.argmin(1)]


def forward(layers: tuple[Layer, ...], inputs: Any) -> Any:
    """Return each network's outputs `(members, N, outputs)` for inputs `(N, inputs)`, an array of NumPy or of JAX."""
    values, tanh = inputs[None], np.tanh
    if not isinstance(values, np.ndarray):
        from jax.numpy import tanh
    for k, layer in enumerate(layers):
        values = values @ layer.weight.swapaxes(1, 2) + layer.bias[:, None]
        if k < len(layers) - 1:
            values = values * 0.5 * (1 + tanh(0.5 * values))  # SiLU; a tanh does not overflow, as exp would
    return values


def _minimise(
    emulator: Emulator, descriptors: np.ndarray, views: np.ndarray, amount: np.ndarray, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Minimise -2 log posterior of N rows from n starts `(N, n, 6)` each. Returns, for each start, the parameters, the
    slopes of the whitened residuals by parameters in deviations of the prior, the residuals' sum of squares, and the
    minimum."""
    target = emulator.compression(descriptors)
    conditions = [np.repeat(column, starts.shape[1]) for column in (views, amount)]
    emulated = emulator(starts.reshape(-1, starts.shape[-1]), *conditions)
    # One deviation a row, the mean over its starts: were it to change with parameters, the least squares would not be.
    deviation = np.sqrt(np.square(emulated.deviation).reshape(*starts.shape[:2], -1).mean(1))
    low, high = emulator.box.T
    fraction = np.clip((starts - low) / (high - low), 0.01, 0.99)
    logits = np.log(fraction / (1 - fraction))
    deviation, seen = deviation * np.sqrt(emulator.inflation), encode_seen(emulator.views, views, amount)
    rows = (target, deviation, seen, logits)
    logits, slopes, unexplained, values = call_in_double(_minimiser, emulator.mean, emulator.basis, *rows)
    return low + (high - low) / (1 + np.exp(-logits)), slopes, unexplained, values


@functools.cache
def _minimiser() -> Callable[..., Any]:
    import jax
    import jax.numpy as jnp
    import optimistix

    # The solver moves logits `free` of the parameters' positions in the box, from 0 to 1, so that no step leaves it. It
    # minimises twice the negative log posterior as a sum of squares: |whitened misfit|² from the likelihood, and what
    # the prior, uniform in the box, becomes for logits.

    def scale(free):
        # From logits to parameters in deviations of the prior: a uniform position has deviation 1 / √12.
        return np.sqrt(12) * (jax.nn.sigmoid(free) - 0.5)

    def whiten(scaled, args):
        layers, basis, target, deviation, seen = args
        mean = forward(layers, jnp.concatenate([scaled, seen])[None])[:, 0].mean(0)
        return basis @ (target - mean) / deviation

    def prior_residual(free):
        """Return the root of twice the negative logarithm of a uniform prior's density in logits."""
        # With s = sigmoid(x), ds/dx = s (1 - s) = 1 / (4 cosh²(x/2)), so that -2 log density = 4 log cosh(x/2) + const.
        # Its root is sign(x) · 2 √(log cosh(x/2)), and x / √2 near 0, where the root of a rounded 0 has no slope.
        near_zero = jnp.abs(free) < 1e-2
        safe = jnp.where(near_zero, 1.0, free)
        log_cosh = jnp.logaddexp(safe / 2, -safe / 2) - np.log(2)
        return jnp.where(near_zero, free / np.sqrt(2), jnp.sign(safe) * 2 * jnp.sqrt(log_cosh))

    def residual(free, args):
        return jnp.concatenate([whiten(scale(free), args), prior_residual(free)])

    def minimise(layers, basis, target, deviation, seen, start):
        args = (layers, basis, target, deviation, seen)
        solver = optimistix.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
        free = optimistix.least_squares(residual, solver, start, args=args, max_steps=STEPS, throw=False).value
        misfit = whiten(scale(free), args)
        slope = jax.jacfwd(whiten)(scale(free), args)
        return free, slope, jnp.sum(misfit**2), jnp.sum(residual(free, args) ** 2)

    over_starts = jax.vmap(minimise, (None, None, None, None, None, 0))
    return jax.jit(jax.vmap(over_starts, (None, None, 0, 0, 0, 0)))
