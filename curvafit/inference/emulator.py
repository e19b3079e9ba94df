"""The emulator: from parameters to the descriptors of the shapes that they grow; and the parameters that fit best.

It states a mean, by an ensemble of small networks, and a covariance between seeds, from what the networks miss. So the
likelihood of descriptors has exact derivatives by the parameters.
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
#: Least deviation between seeds, of a direction whose mean one is 1.
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
        state: where shapes are few, the means of rows miss alike.
    """

    compression: Compression
    views: tuple[str, ...]
    box: np.ndarray
    mean: tuple[Layer, ...]
    spread: tuple[Layer, ...]
    basis: np.ndarray
    inflation: float

    def __call__(self, parameters: np.ndarray, views: np.ndarray, amount: np.ndarray) -> Emulated:
        """Return the mean and deviations of the compressed descriptors of parameters `(N, 6)`, each seen in a view, and
        so much of it; or all alike, where those have one element."""
        inputs = self.inputs(parameters, views, amount)
        mean, spread = forward(self.mean, inputs).mean(0), forward(self.spread, inputs).mean(0)
        return Emulated(mean, np.maximum(np.exp(spread), FAINTEST))

    def inputs(self, parameters: np.ndarray, views: np.ndarray, amount: np.ndarray) -> np.ndarray:
        """Return what the networks read: the parameters in deviations of the prior, how much is seen, and in what."""
        scaled = self.standardise(np.atleast_2d(parameters))
        seen = encode_seen(self.views, views, amount)
        return np.concatenate([scaled, np.broadcast_to(seen, (len(scaled), seen.shape[1]))], 1)

    @property
    def centre(self) -> np.ndarray:
        """Return the means `(6,)` of parameters uniform in the box."""
        return self.box.mean(1)

    @property
    def deviation(self) -> np.ndarray:
        """Return the deviations `(6,)` of parameters uniform in the box."""
        return (self.box[:, 1] - self.box[:, 0]) / np.sqrt(12)

    def standardise(self, parameters: np.ndarray) -> np.ndarray:
        """Return parameters in deviations of the prior."""
        return (parameters - self.centre) / self.deviation

    def decorrelate(self, descriptors: np.ndarray) -> np.ndarray:
        """Return descriptors `(N, 351)` along the rows of the basis `(N, k)`."""
        return self.compression(descriptors) @ self.basis.T

    def slopes(self, parameters: np.ndarray, views: np.ndarray, amount: np.ndarray) -> np.ndarray:
        """Return the derivatives `(N, k, 6)` of the whitened mean by parameters `(N, 6)` in deviations of the prior."""
        places = self.inputs(parameters, views, amount)
        slopes = call_in_double(_jacobian, self.mean, places)[..., : len(PARAMETERS)]
        return (self.basis @ slopes) / self(parameters, views, amount).deviation[..., None]


def best_parameters(emulator: Emulator, reading: Reading, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters `(6,)` of greatest posterior density given a reading, and their covariance.

    Levenberg and Marquardt's method from many starts `(n, 6)`, with exact derivatives in float64, by optimistix; the
    covariance between seeds is the mean of theirs. The covariance `(6, 6)` is Laplace's approximation. Both are in
    working units (`PARAMETERS`); the box is the prior.
    """
    seen = reading.columns
    parameters, slopes, _, values = _minimise(emulator, *seen, np.asarray(starts, dtype=np.float64)[None])
    best = int(values[0].argmin())
    slope, deviation = slopes[0, best], emulator.deviation
    # In deviations of the prior, whose own precision is 1.
    covariance = np.linalg.inv(slope.T @ slope + np.eye(len(PARAMETERS)))
    return parameters[0, best], np.outer(deviation, deviation) * covariance


def misfits(
    emulator: Emulator, descriptors: np.ndarray, views: np.ndarray, amount: np.ndarray, starts: np.ndarray
) -> np.ndarray:
    """Return the sums of squares `(N,)` of whitened descriptors that the best parameters leave unexplained.

    Rows of descriptors are `(N, 351)`, of views and how much was seen `(N,)`, the starts of each `(N, n, 6)`.
    """
    _, _, left, values = _minimise(emulator, descriptors, views, amount, starts)
    return left[np.arange(len(descriptors)), values.argmin(1)]


def forward(layers: tuple[Layer, ...], inputs: Any) -> Any:
    """Return the outputs `(members, N, outputs)` of each network of inputs `(N, inputs)`, NumPy's or JAX's."""
    values, tanh = inputs[None], np.tanh
    if not isinstance(values, np.ndarray):
        from jax.numpy import tanh
    for k, layer in enumerate(layers):
        values = values @ layer.weight.swapaxes(1, 2) + layer.bias[:, None]
        if k < len(layers) - 1:
            values = values * 0.5 * (1 + tanh(0.5 * values))
    return values


def _minimise(
    emulator: Emulator, descriptors: np.ndarray, views: np.ndarray, amount: np.ndarray, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return where the solver ends, for N rows from n starts `(N, n, 6)` each: parameters, slopes of the whitened
    descriptors by parameters in deviations of the prior, squares that are left, and -2 log posterior."""
    target = emulator.compression(descriptors)
    each = [np.repeat(column, starts.shape[1]) for column in (views, amount)]
    emulated = emulator(starts.reshape(-1, starts.shape[-1]), *each)
    deviation = np.sqrt(np.square(emulated.deviation).reshape(*starts.shape[:2], -1).mean(1))
    low, high = emulator.box.T
    share = np.clip((starts - low) / (high - low), 0.01, 0.99)
    rest = (deviation * np.sqrt(emulator.inflation), encode_seen(emulator.views, views, amount))
    ends = call_in_double(_minimiser, emulator.mean, emulator.basis, target, *rest, np.log(share / (1 - share)))
    free, jacobian, misfit, value = ends
    return low + (high - low) / (1 + np.exp(-free)), jacobian, misfit, value


@functools.cache
def _jacobian() -> Callable[..., Any]:
    """Return the derivative of the networks' mean by what they read, at many places."""
    import jax

    def mean(layers, place):
        return forward(layers, place[None])[:, 0].mean(0)

    return jax.jit(jax.vmap(jax.jacfwd(mean, 1), (None, 0)))


@functools.cache
def _minimiser() -> Callable[..., Any]:
    import jax
    import jax.numpy as jnp
    import optimistix

    # The solver moves logits `free` of the parameters' shares of the box, so that no step leaves it. It minimises twice
    # the negative log posterior as a sum of squares: |whitened misfit|² from the likelihood, and what the prior,
    # uniform in the box, becomes for logits.

    def scale(free):
        # From logits to parameters in deviations of the prior: a uniform share has deviation 1 / √12.
        return np.sqrt(12) * (jax.nn.sigmoid(free) - 0.5)

    def whiten(place, args):
        layers, basis, target, deviation, kind = args
        mean = forward(layers, jnp.concatenate([place, kind])[None])[:, 0].mean(0)
        return basis @ (target - mean) / deviation

    def uniform(free):
        """Return the root of twice the negative logarithm of a uniform prior's density in logits."""
        # With s = sigmoid(x), ds/dx = s (1 - s) = 1 / (4 cosh²(x/2)), so that -2 log density = 4 log cosh(x/2) + const.
        # Its root is sign(x) · 2 √(log cosh(x/2)), and x / √2 near 0, where the root of a rounded 0 has no slope.
        near = jnp.abs(free) < 1e-2
        far = jnp.where(near, 1.0, free)
        cosh = jnp.logaddexp(far / 2, -far / 2) - np.log(2)
        return jnp.where(near, free / np.sqrt(2), jnp.sign(far) * 2 * jnp.sqrt(cosh))

    def residual(free, args):
        return jnp.concatenate([whiten(scale(free), args), uniform(free)])

    def minimise(layers, basis, target, deviation, kind, start):
        args = (layers, basis, target, deviation, kind)
        solver = optimistix.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
        free = optimistix.least_squares(residual, solver, start, args=args, max_steps=STEPS, throw=False).value
        left = whiten(scale(free), args)
        slope = jax.jacfwd(whiten)(scale(free), args)
        return free, slope, jnp.sum(left**2), jnp.sum(residual(free, args) ** 2)

    starts = jax.vmap(minimise, (None, None, None, None, None, 0))
    return jax.jit(jax.vmap(starts, (None, None, 0, 0, 0, 0)))
