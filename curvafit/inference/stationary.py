"""Parameters of a phase field from its stationarity: the weak form of Σ a_α ∂F_α/∂u = λ, which is linear in (a, λ).

Each Gaussian test function gives one equation. The columns carry the error of the field itself, amplified by second
differences, so ordinary least squares is biased; here the misfit is measured in units of the misfit that such an error
causes (total least squares with the noise propagated through the columns), and the error's size is the one at which
both are equal.

Stationarity reads how a profile deviates from tanh, so it says nothing of a mask, whose profile is made up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from curvafit.core.checks import require
from curvafit.core.runtime import Progress, silent
from curvafit.inference.candidates import Candidate
from curvafit.priors.coefficients import NAMES, Coefficients
from curvafit.priors.curvature import jet
from curvafit.priors.energies import energy_terms
from curvafit.priors.grid import Float, Grid
from curvafit.priors.stencils import gaussian_blur, pad
from curvafit.scan.structure import is_rounded

#: Standard deviation of the test functions, in voxels; less in a crop, whose borders their support must not reach.
TEST_WIDTH, CROP_WIDTH = 4.0, 3.0
#: Least edge of a crop: in a smaller one the test functions, which include the blur k, would be narrower than k.
SMALLEST_CROP = 28
#: Reach in voxels of a density's gradient: one of the stencil, one of its adjoint.
_REACH = 2
#: Planes treated at once, which bounds the memory.
_SLAB = 24
#: The field's error is modelled as white noise of this width (voxels); its amplitude is searched from the first value.
_ERROR_WIDTH, _ERROR_START, _ERROR_LIMITS, _ERROR_STEPS = 1.0, 1e-3, (1e-6, 3e-2), 4


class Problem(NamedTuple):
    """Upper triangles `(6, 6)`: of the weak equations without the multiplier, and of what the field's error adds."""

    columns: np.ndarray
    error: np.ndarray


def energy_gradients(u: Float[Tensor, "z y x"], grid: Grid, epsilon: float) -> Float[Tensor, "6 z y x"]:
    """Return ∂F_α/∂u per volume for the six terms, in u's precision.

    Within a voxel of a border that is not periodic, the field is taken to continue as its mirror image.
    """
    padded = pad(u, grid, _REACH)
    slabs = []
    for start in range(0, grid.shape[0], _SLAB):
        slab = padded[start : start + _SLAB + 2 * _REACH].clone().requires_grad_()
        slab_grid = Grid(tuple(slab.shape), grid.spacing, "replicate")  # type: ignore[arg-type]
        terms = energy_terms(jet(slab, slab_grid), epsilon).sum((-3, -2, -1))
        gradients = [torch.autograd.grad(term, slab, retain_graph=True)[0] for term in terms]
        inside = slice(_REACH, -_REACH)
        slabs.append(torch.stack(gradients)[:, inside, inside, inside])
    return torch.cat(slabs, 1)


def stationarity(
    u: Float[Tensor, "z y x"],
    grid: Grid,
    epsilon: float,
    *,
    starts: Sequence[Coefficients] = (),
    seed: int = 0,
    progress: Progress = silent,
) -> Candidate:
    """Find the coefficients, up to scale, under which a phase field is stationary at fixed mass: Σ a_α k ∗ ∂F_α/∂u = λ.

    Minimises |R a| / |N a| over a20, a02 > 0: R the QR-compressed columns, λ eliminated, N those that an error of the
    field alone would cause. Its unconstrained minimiser, one of the starts, is the whitened columns' smallest singular
    vector. Levenberg and Marquardt's method, by optimistix, in float64. m₀ is the field's mean.

    The deviations are a jackknife over octants: they hold what varies over the box, not a bias common to all of it.
    Raises ValueError if the field is not finite, has another shape than the grid, or is a crop under 28 voxels along an
    axis.

    Parameters
    ----------
    u
        Phase field, periodic or a crop of a larger one (the test functions then stay off the border).
    starts
        Coefficients to start from besides the total least squares solution.
    seed
        Of the noise that is propagated.
    """
    values = torch.as_tensor(u).detach().to("cpu", torch.float64)
    if tuple(values.shape) != grid.shape:
        raise ValueError(f"expected a field of shape {grid.shape}, got {tuple(values.shape)}")
    if not bool(torch.isfinite(values).all()):
        raise ValueError("expected a finite field, got NaN or infinity in it")
    octants, problem, error_size = weak_form(values, grid, epsilon, seed, progress)
    progress("solving", 0.8)
    factors = unit_factors(epsilon)
    dimensionless = [np.array([float(value) for value in start]) / factors for start in starts]
    origins = np.stack([clip_to_domain(start) for start in (total_least_squares(problem)[0], *dimensionless)])
    solutions, residuals = solve([problem] * len(origins), origins)
    best = solutions[residuals.argmin()]
    coefficients, fixed = fix_gauge(best * factors)
    leave_one_out = [Problem(_join_triangles(np.delete(octants, k, 0)), problem.error) for k in range(len(octants))]
    replicas = solve(leave_one_out, np.stack([best] * len(octants)))[0] * factors
    replicas /= replicas[:, fixed : fixed + 1]
    # Replicas that leave one of n out share most of their data: their variance is too small by a factor of n - 1.
    n = len(replicas)
    deviations = np.sqrt((n - 1) / n * ((replicas - replicas.mean(0)) ** 2).sum(0))
    field_error = float(error_size * residuals.min())
    status = _status(coefficients, deviations, fixed, field_error, is_rounded(values.numpy()))
    progress("solved", 1.0)
    uncertainty = {str(name): float(d) for name, d in zip(NAMES, deviations, strict=True)}
    return Candidate("stationarity", coefficients, float(values.mean()), uncertainty, status=status)


def weak_form(
    values: Tensor, grid: Grid, epsilon: float, seed: int = 0, progress: Progress = silent
) -> tuple[np.ndarray, Problem, float]:
    """Set up the weak form of a field's stationarity. Returns the triangles of the box's octants `(8, 7, 7)`, the
    problem of the whole box, and the root mean square of the field error that explains the misfit."""
    if not grid.periodic and min(grid.shape) < SMALLEST_CROP:
        raise ValueError(f"expected a crop of at least {SMALLEST_CROP} voxels along each axis, got {grid.shape}")
    # In a crop a margin of 4 widths and the stencil's reach is lost on each side; a core of eight voxels must remain.
    width = TEST_WIDTH if grid.periodic else min(CROP_WIDTH, (min(grid.shape) - 8 - 2 * _REACH) // 2 / 4)
    progress("differentiating the energy", 0.0)
    gradients = energy_gradients(values, grid, epsilon)
    integrals = integrate_columns(gradients, grid, epsilon, width)
    boxes = [integrals]
    for axis in (1, 2, 3):
        boxes = [half for box in boxes for half in np.array_split(box, 2, axis)]
    octants = np.stack([_compress(box.reshape(6, -1)) for box in boxes]) / math.sqrt(integrals[0].size)
    progress("propagating the field's error", 0.2)
    return octants, *_propagate_error(values, gradients, _join_triangles(octants), grid, epsilon, width, seed)


def integrate_columns(columns: Tensor, grid: Grid, epsilon: float, width: float) -> np.ndarray:
    """Integrate columns `(6, Z, Y, X)` against Gaussians `width` voxels wide, whose support is periodic or in the box.

    Returns dimensionless integrals `(6, …)`, for Gaussians centred on every second voxel along each axis.
    """
    deviation = width * max(grid.spacing)
    core = []
    for n, h in zip(grid.shape, grid.spacing, strict=True):
        margin = 0 if grid.periodic else math.ceil(4 * deviation / h) + _REACH
        core.append(slice(margin, n - margin, 2))
    integrals = [gaussian_blur(column, grid, deviation)[tuple(core)].numpy() for column in columns]
    return np.stack(integrals) * unit_factors(epsilon).reshape(6, 1, 1, 1)


def _compress(columns: np.ndarray) -> np.ndarray:
    """Return the triangle `(7, 7)` of the QR factorisation of [1 | columns]."""
    triangle = np.linalg.qr(np.concatenate((np.ones((1, columns.shape[1])), columns)).T, mode="r")
    return np.pad(triangle, ((0, 7 - len(triangle)), (0, 0)))


def _join_triangles(stack: np.ndarray) -> np.ndarray:
    """Reduce triangles `(n, 7, 7)` to one `(6, 6)`, from which the first column, the multiplier's, is eliminated."""
    return np.asarray(np.linalg.qr(stack.reshape(-1, 7), mode="r"))[1:, 1:]


def _propagate_error(
    u: Tensor, clean: Tensor, columns: np.ndarray, grid: Grid, epsilon: float, width: float, seed: int
) -> tuple[Problem, float]:
    """Search for the size of a field error that alone causes the misfit; return the problem with it, and the size."""
    # A finite error, not its linearisation: the columns are singular where ∇u = 0 and at umbilics.
    error = torch.randn(u.shape, generator=torch.Generator().manual_seed(seed), dtype=u.dtype)
    error = gaussian_blur(error, grid, _ERROR_WIDTH * max(grid.spacing))
    error /= error.square().mean().sqrt()
    size = _ERROR_START
    for trial in range(1, _ERROR_STEPS + 1):
        change = integrate_columns(energy_gradients(u + size * error, grid, epsilon) - clean, grid, epsilon, width)
        # A root of the columns' mean squares; the first column's coefficient is fixed, and it drops out.
        triangle = _compress(change.reshape(6, -1))[1:, 1:] / math.sqrt(change[0].size)
        problem = Problem(columns, triangle)
        # The least misfit in units of what an error of this size causes, so that at the size sought it is 1.
        target = float(np.clip(size * total_least_squares(problem)[1][-1], *_ERROR_LIMITS))
        if trial == _ERROR_STEPS or abs(math.log(target / size)) < 0.1:
            break
        size = target
    return problem, size


def total_least_squares(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients a `(6,)`, a20 + a02 > 0, with the least |R a| / |N a|, and the singular values of R N⁻¹:
    R are the problem's columns, N its error."""
    whitened = np.linalg.solve(problem.error.T, problem.columns.T).T
    _, singular, rows = np.linalg.svd(whitened)
    a = np.linalg.solve(problem.error, rows[-1])
    return a * np.sign(a[0] + a[2]), singular


def solve(problems: Sequence[Problem], origins: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimisers `(n, 6)` of |R a| / |N a| with a20 + a02 = 2, both positive, and their values `(n,)`."""
    columns, errors = (np.stack(triangles) for triangles in zip(*problems, strict=True))
    return call_in_double(_minimiser, columns, errors, origins)


@cache
def _minimiser() -> Callable[..., Any]:
    """Return the solver of many problems at once, compiled once for each number of them."""
    import jax
    import jax.numpy as jnp
    import optimistix

    def coefficients(free):
        fraction = jax.nn.sigmoid(free[0])  # keeps a20 and a02 positive, with a sum of 2
        return jnp.stack([2 * fraction, free[1], 2 - 2 * fraction, free[2], free[3], free[4]])

    def residual(free, args):
        columns, error = args
        a = coefficients(free)
        return columns @ a / jnp.linalg.norm(error @ a)

    def minimise(columns, error, start):
        free = jnp.concatenate([jnp.log(start[:1] / start[2:3]), start[1:2], start[3:]])
        solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-10)
        free = optimistix.least_squares(residual, solver, free, (columns, error), max_steps=500, throw=False).value
        return coefficients(free), jnp.linalg.norm(residual(free, (columns, error)))

    return jax.jit(jax.vmap(minimise))


def _status(coefficients: Coefficients, deviations: np.ndarray, fixed: int, field_error: float, rounded: bool) -> str:
    """Say in a sentence how well stationarity supports the coefficients."""
    if rounded:
        reason = "the field was rounded to few values, which its second differences amplify"
        return f"Stationarity is not supported: {reason}."
    weak = [name for name, value, d in zip(NAMES, coefficients, deviations, strict=True) if d > abs(value) / 2]
    gauge = "" if fixed == 0 else " a20 is at the edge of the domain, so a02 = 1 fixes the scale."
    verdict = "Stationarity is weakly supported" if field_error > 0.005 else "Stationarity is supported"
    weakness = f"; weakly held: {', '.join(weak)}" if weak else ""
    return f"{verdict}: a field error of {field_error:.1e} would explain the misfit{weakness}.{gauge}"


def unit_factors(epsilon: float) -> np.ndarray:
    """Return the factors `(6,)` from dimensionless coefficients (lengths in ε) to those in spacing's unit."""
    return np.array([1, 1, 1, 1 / epsilon, 1 / epsilon, 1 / epsilon**2])


def fix_gauge(values: np.ndarray) -> tuple[Coefficients, int]:
    """Divide coefficients `(6,)` by a20, or by a02 where a20 is far smaller; return them, and the divisor's index."""
    fixed = 0 if values[0] > 1e-3 * values[2] else 2
    return Coefficients(*(float(value) for value in values / values[fixed])), fixed


def clip_to_domain(values: np.ndarray) -> np.ndarray:
    """Return the nearest coefficients `(6,)` with a20 + a02 = 2 and both positive, away from the edge."""
    scaled = 2 * values / max(values[0] + values[2], 1e-12)
    fraction = np.clip(scaled[0] / 2, 0.01, 0.99)
    return np.concatenate(([2 * fraction, scaled[1], 2 - 2 * fraction], scaled[3:]))


# ---- JAX -------------------------------------------------------------------------------------------------------------


@cache
def _import_jax() -> None:
    """Import JAX, and put NumPy's global generator back, from which JAX draws on the way."""
    state = np.random.get_state()  # noqa: NPY002
    try:
        require("jax", "infer", "fitting parameters")
        require("optimistix", "infer", "fitting parameters")
    finally:
        np.random.set_state(state)  # noqa: NPY002


def call_in_double(make: Callable[[], Callable[..., Any]], *arguments: Any) -> Any:
    """Call the JAX function that `make` returns in float64 on the CPU, and return NumPy's arrays.

    The precision is set in this thread alone: a program's other use of JAX is not touched.
    """
    _import_jax()
    import jax

    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        converted = jax.tree.map(lambda value: jax.numpy.asarray(value, float), arguments)
        return jax.tree.map(np.asarray, make()(*converted))
