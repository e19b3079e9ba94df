"""Parameters of a phase field from its stationarity: the weak form of Σ a_α ∂F_α/∂u = λ, which is linear in (a, λ).

Each Gaussian test function gives one equation. The columns carry the error of the field itself, amplified by second
differences, so ordinary least squares is biased; here the misfit is measured in units of the misfit that such an error
causes (total least squares with the noise propagated through the columns), and the error's size is the one at which
the two agree.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from curvafit.core.extras import require
from curvafit.core.runtime import Progress, silent
from curvafit.priors.coefficients import NAMES, Coefficients
from curvafit.priors.curvature import jet
from curvafit.priors.energy import energy_terms
from curvafit.priors.grid import Float, Grid
from curvafit.priors.stencils import gaussian_blur, pad
from curvafit.scan.structure import is_rounded

#: Standard deviation of the test functions, in voxels; in a crop less, for what their support takes from each side.
TEST_WIDTH, CROP_WIDTH = 4.0, 3.0
#: Reach in voxels of a density's gradient: one of the stencil, one of its adjoint.
_REACH = 2
#: Planes treated at once, which bounds the memory.
_SLAB = 24
#: Test functions are centred on every second voxel.
_STRIDE = 2
#: The field's error is modelled as white noise of this width (voxels); its amplitude is searched from the first value.
_ERROR_WIDTH, _ERROR_START, _ERROR_LIMITS, _ERROR_STEPS = 1.0, 1e-3, (1e-6, 3e-2), 4
#: A field error above which stationarity says little.
_LARGE_ERROR = 0.005
#: A share of a20 + a02 that a start is kept away from the domain's edges, a20 = 0 and a02 = 0.
_EDGE = 0.01


class _Problem(NamedTuple):
    """Triangles `(6, 6)`, multiplier eliminated: of the equations, and of what the field's error adds to them."""

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
        part = Grid(tuple(slab.shape), grid.spacing, "replicate")  # type: ignore[arg-type]
        terms = energy_terms(jet(slab, part), epsilon).sum((-3, -2, -1))
        each = [torch.autograd.grad(term, slab, retain_graph=True)[0] for term in terms]
        inside = slice(_REACH, -_REACH)
        slabs.append(torch.stack(each)[:, inside, inside, inside])
    return torch.cat(slabs, 1)


def stationarity(
    u: Float[Tensor, "z y x"],
    grid: Grid,
    epsilon: float,
    *,
    starts: Sequence[Coefficients] = (),
    width: float | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Refinement:
    """Find the coefficients, up to scale, under which a phase field is stationary at fixed mass: Σ a_α k ∗ ∂F_α/∂u = λ.

    Minimises |R a| / |N a| over a20, a02 > 0: R the QR-compressed columns, λ eliminated, N those that an error of the
    field alone would cause. Its unconstrained minimiser, one of the starts, is the whitened columns' smallest singular
    vector. Posed with optimistix (Levenberg–Marquardt) in float64. m₀ is the field's mean.

    The deviations are a jackknife over octants; they hold what varies over the box, not a bias common to all of it.

    Parameters
    ----------
    u
        Phase field, periodic or a crop of a larger one (the test functions then stay off the border).
    starts
        Coefficients to start from besides the total least squares solution.
    width
        Standard deviation of the test functions in voxels; `TEST_WIDTH`, in a crop `CROP_WIDTH` or less.
    seed
        Of the noise that is propagated.

    Returns
    -------
    Refinement
        `residual` is the root mean square error of the field that would explain the misfit.

    Raises
    ------
    ValueError
        If the field is not finite, has another shape than the grid, or is a crop under 24 voxels along an axis.
    """
    values = _checked(u, grid)
    width = _width(grid) if width is None else width
    progress("differentiating the energy", 0.0)
    gradients = energy_gradients(values, grid, epsilon)
    octants = _equations(gradients, grid, epsilon, width)
    progress("propagating the field's error", 0.2)
    problem, size = _with_error(values, gradients, _triangle(octants), grid, epsilon, width, seed)
    progress("solving", 0.8)
    tls, singular = _total_least_squares(problem)
    matches = [np.array([float(value) for value in start]) / unit_factors(epsilon) for start in starts]
    origins = np.stack([clip_to_domain(start) for start in (tls, *matches)])
    solutions, residuals = _solve([problem] * len(origins), origins)
    order = np.argsort(residuals)
    coefficients, fixed = fix_gauge(solutions[order[0]] * unit_factors(epsilon))
    replicas = _replicas(octants, problem.error, solutions[order[0]]) * unit_factors(epsilon)
    deviations = _jackknife_deviation(replicas / replicas[:, fixed : fixed + 1])
    residual = float(size * residuals[order[0]])
    progress("solved", 1.0)
    return Refinement(
        method="stationarity",
        coefficients=coefficients,
        mass=float(values.mean()),
        uncertainty=by_name(deviations),
        singular_values=tuple(float(value) for value in singular),
        residual=residual,
        starts=tuple((fix_gauge(origins[k] * unit_factors(epsilon))[0], float(size * residuals[k])) for k in order),
        status=_status(coefficients, deviations, fixed, residual, is_rounded(values.numpy())),
    )


def _checked(u: Tensor, grid: Grid) -> Tensor:
    values = torch.as_tensor(u).detach().to("cpu", torch.float64)
    if tuple(values.shape) != grid.shape:
        raise ValueError(f"expected a field of shape {grid.shape}, got {tuple(values.shape)}")
    if not bool(torch.isfinite(values).all()):
        raise ValueError("expected a finite field, got NaN or infinity in it")
    return values


def _width(grid: Grid) -> float:
    """Return the default test width; in a small crop the one that leaves a core of eight voxels."""
    if grid.periodic:
        return TEST_WIDTH
    if min(grid.shape) < 24:
        raise ValueError(f"expected a crop of at least 24 voxels along each axis, got {grid.shape}")
    return min(CROP_WIDTH, (min(grid.shape) - 8 - 2 * _REACH) // 2 / 4)


def _equations(gradients: Tensor, grid: Grid, epsilon: float, width: float) -> np.ndarray:
    """Return each octant's equations [1 | columns], dimensionless and QR-compressed, `(8, 7, 7)`."""
    tested = _tested(gradients, grid, epsilon, width)
    halves = [np.array_split(np.arange(n), 2) for n in tested.shape[1:]]
    parts = [tested[:, z][:, :, y][..., x] for z in halves[0] for y in halves[1] for x in halves[2]]
    scale = math.sqrt(tested[0].size)
    return np.stack([_compressed(part.reshape(6, -1)) / scale for part in parts])


def _tested(columns: Tensor, grid: Grid, epsilon: float, width: float) -> np.ndarray:
    """Return the columns `(6, …)` against Gaussian test functions whose support stays in the box (or goes round it)."""
    deviation = width * max(grid.spacing)
    core = []
    for n, h in zip(grid.shape, grid.spacing, strict=True):
        margin = 0 if grid.periodic else math.ceil(4 * deviation / h) + _REACH
        if n - 2 * margin < 2 * _STRIDE:
            raise ValueError(f"expected a test width under {n / 8 - 1:.1f} voxels in a crop of {n}, got {width}")
        core.append(slice(margin, n - margin, _STRIDE))
    tested = [gaussian_blur(column, grid, deviation)[tuple(core)].numpy() for column in columns]
    return np.stack(tested) * unit_factors(epsilon).reshape(6, 1, 1, 1)


def _compressed(columns: np.ndarray) -> np.ndarray:
    """Return the triangle `(7, 7)` of the QR factorisation of [1 | columns]."""
    rows = np.concatenate((np.ones((1, columns.shape[1])), columns)).T
    triangle = np.linalg.qr(rows, mode="r")
    return np.pad(triangle, ((0, 7 - len(triangle)), (0, 0)))


def _triangle(stack: np.ndarray) -> np.ndarray:
    """Return stacked triangles `(n, 7, 7)` as one, `(6, 6)`: the multiplier's column is eliminated."""
    triangle = np.asarray(np.linalg.qr(stack.reshape(-1, 7), mode="r"))
    return triangle[1:, 1:]


def _with_error(
    u: Tensor, clean: Tensor, columns: np.ndarray, grid: Grid, epsilon: float, width: float, seed: int
) -> tuple[_Problem, float]:
    """Return the problem whitened by a field error, and that error's root mean square.

    A finite error, not its linearisation: the columns are singular where ∇u = 0 and at umbilics. Its size is searched
    until the misfit is what it causes (smallest singular value 1).
    """
    error = torch.randn(u.shape, generator=torch.Generator().manual_seed(seed), dtype=u.dtype)
    error = gaussian_blur(error, grid, _ERROR_WIDTH * max(grid.spacing))
    error /= error.square().mean().sqrt()
    size = _ERROR_START
    for trial in range(1, _ERROR_STEPS + 1):
        change = _tested(energy_gradients(u + size * error, grid, epsilon) - clean, grid, epsilon, width)
        triangle = _compressed(change.reshape(6, -1))[1:, 1:] / math.sqrt(change[0].size)
        problem = _Problem(columns, triangle)
        least = _total_least_squares(problem)[1][-1]
        target = float(np.clip(size * least, *_ERROR_LIMITS))
        if trial == _ERROR_STEPS or abs(math.log(target / size)) < 0.1:
            break
        size = target
    return problem, size


def _total_least_squares(problem: _Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return the least singular vector (a20 + a02 > 0) and the singular values of the columns whitened by the error."""
    whitened = np.linalg.solve(problem.error.T, problem.columns.T).T
    _, singular, rows = np.linalg.svd(whitened)
    a = np.linalg.solve(problem.error, rows[-1])
    return a * np.sign(a[0] + a[2]), singular


def _solve(problems: Sequence[_Problem], origins: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimisers `(n, 6)` of |R a| / |N a| with a20 + a02 = 2, both positive, and their values `(n,)`."""
    with double_precision_on_cpu():
        import jax.numpy as jnp

        columns, errors = (jnp.asarray(np.stack(part)) for part in zip(*problems, strict=True))
        solutions, residuals = _minimiser()(columns, errors, jnp.asarray(origins))
        return np.asarray(solutions), np.asarray(residuals)


@functools.cache
def _minimiser() -> Callable[..., Any]:
    """Return the solver of many problems at once, compiled once for each number of them."""
    import jax
    import jax.numpy as jnp
    import optimistix

    def coefficients(free):
        share = jax.nn.sigmoid(free[0])
        return jnp.stack([2 * share, free[1], 2 - 2 * share, free[2], free[3], free[4]])

    def residual(free, args):
        columns, error = args
        a = coefficients(free)
        return columns @ a / jnp.linalg.norm(error @ a)

    def minimise(columns, error, start):
        begin = jnp.concatenate([jnp.log(start[:1] / start[2:3]), start[1:2], start[3:]])
        solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-10)
        end = optimistix.least_squares(residual, solver, begin, args=(columns, error), max_steps=500, throw=False).value
        return coefficients(end), jnp.linalg.norm(residual(end, (columns, error)))

    return jax.jit(jax.vmap(minimise))


def _replicas(octants: np.ndarray, error: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Return the solutions `(n, 6)` with one octant left out each."""
    problems = [_Problem(_triangle(np.delete(octants, k, 0)), error) for k in range(len(octants))]
    return _solve(problems, np.stack([best] * len(problems)))[0]


def _jackknife_deviation(replicas: np.ndarray) -> np.ndarray:
    """Return the standard deviation over delete-one replicas `(n, …)`."""
    n = len(replicas)
    return np.sqrt((n - 1) / n * ((replicas - replicas.mean(0)) ** 2).sum(0))


def _status(coefficients: Coefficients, deviations: np.ndarray, fixed: int, residual: float, rounded: bool) -> str:
    """Say in a sentence how well stationarity supports the coefficients."""
    if rounded:
        return (
            "Stationarity is not supported: the field was rounded to few values, which its second differences amplify."
        )
    weak = [name for name, value, d in zip(NAMES, coefficients, deviations, strict=True) if d > max(abs(value) / 2, 0)]
    gauge = "" if fixed == 0 else " a20 is at the edge of the domain, so a02 = 1 fixes the scale."
    verdict = "Stationarity is weakly supported" if residual > _LARGE_ERROR else "Stationarity is supported"
    weakness = f"; weakly held: {', '.join(weak)}" if weak else ""
    return f"{verdict}: a field error of {residual:.1e} would explain the misfit{weakness}.{gauge}"


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
    """

    method: str
    coefficients: Coefficients
    mass: float
    uncertainty: dict[str, float]
    singular_values: tuple[float, ...]
    residual: float
    starts: tuple[tuple[Coefficients, float], ...]
    status: str


def unit_factors(epsilon: float) -> np.ndarray:
    """Return the factors `(6,)` from dimensionless coefficients (lengths in ε) to those in spacing's unit."""
    return np.array([1, 1, 1, 1 / epsilon, 1 / epsilon, 1 / epsilon**2])


def fix_gauge(values: np.ndarray) -> tuple[Coefficients, int]:
    """Return the coefficients with a20 = 1 and 0; or with a02 = 1 and 2, where a20 is under a thousandth of a02."""
    fixed = 0 if values[0] > 1e-3 * values[2] else 2
    return Coefficients(*(float(value) for value in values / values[fixed])), fixed


def clip_to_domain(values: np.ndarray) -> np.ndarray:
    """Return the nearest six with a20 + a02 = 2 and both positive, away from the edge."""
    share = np.clip(values[0] / max(values[0] + values[2], 1e-12), _EDGE, 1 - _EDGE)
    scaled = 2 * values / max(values[0] + values[2], 1e-12)
    return np.concatenate(([2 * share, scaled[1], 2 - 2 * share], scaled[3:]))


def by_name(deviations: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Return the deviations by the coefficients' names."""
    return {name: float(value) for name, value in zip(NAMES, deviations, strict=True)}


@cache
def import_jax() -> None:
    """Import JAX, which draws from NumPy's global generator on the way: that goes on as if it had not."""
    state = np.random.get_state()  # noqa: NPY002
    try:
        require("jax", "infer", "fitting parameters")
        require("optimistix", "infer", "fitting parameters")
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
