"""The energy and the flow's step, fused for processors (numba, float32), as callers use them; `loops` has the loops.

A step is four passes, each parallel over z: blur of div A along z; energy and gradient; blur of that along z; along y
and x, with -∇, Adam, and the next step's blur of div A along y and x.

Why these four: a step moves bytes more than it computes. A and Adam's two moments are nine volumes, which are read and
written once at least; each pass beyond that reads and writes another. A pass must end where the next needs planes that
other threads have yet to write, which is so along z only: both blurs along z, and the stencils of the energy, which
reach two planes. What stays within a plane, the blurs along y and x, the divergence's and Adam's work, is done while
the plane is in the cache.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided

from curvafit.priors.curvature import ROOT_FLOOR, ROOT_ROUNDING, XI
from curvafit.priors.grid import Grid
from curvafit.priors.kernels import loops
from curvafit.priors.kernels.loops import ALL, BLUR_ROWS, EDGE, ENDS, MOVE, SLACK, TAPS
from curvafit.priors.kernels.threads import count_threads
from curvafit.priors.stencils import gaussian_taps

#: Fewest voxels for which another thread saves more than its start costs.
_VOXELS_PER_THREAD = 32768
#: Cells of a block of rows whose partial derivatives fit into the first-level cache, and of a tile, of which three
#: planes of u and three of sums fit into the second-level cache.
_BLOCK, _TILE = 432, 43_000
#: Floats of a cache line.
_LINE = 16
#: Stands for a field that is not there.
_NO_FIELD = np.empty(0, np.float32)


def fused_energy_gradient(u: np.ndarray, a, grid: Grid, epsilon, mask=None) -> tuple[float, np.ndarray]:
    """Return F_ε(u) and its gradient in float32, as `energies.energy_gradient` does, from arrays `(Z, Y, X)` and six
    coefficients (a20 first)."""
    density = _Density(a, grid, epsilon, _choose_threads(grid), mask)
    gradient = _make_volume(grid)
    value = density(_pad_field(u, grid), gradient)
    return value, _view_field(gradient, grid).copy()


def gaussian_blur(u: np.ndarray, grid: Grid, width: float) -> np.ndarray:
    """Return k ∗ u in float32, as `stencils.gaussian_blur` does; ValueError where its shape is not the grid's."""
    blur = _Blur(grid, width, _choose_threads(grid))
    volume, blurred_along_z = _pad_field(u, grid), _make_volume(grid)
    blur.along_z(volume, blurred_along_z, 0.0, _NO_FIELD)
    blur.in_planes(blurred_along_z, volume)
    return _view_field(volume, grid).copy()


class FusedFlow:
    """The flow u = k ∗ (div A + base) under Adam on A, stepped in place; its cost is as in `fused_energy_gradient`.

    `start` is A at the first step, `(3, Z, Y, X)`, components z, y, x. `base` is k ∗ base: the mass m₀, or a blurred
    field. `width` is the blur's standard deviation in spacing's unit; `betas` and `adam_eps` are `torch.optim.Adam`'s.
    """

    def __init__(self, start, base, a, grid: Grid, epsilon, width: float, *, betas, adam_eps) -> None:
        Z, Y, X = grid.shape
        self.grid, self.taken = grid, 0
        self._adam_eps = adam_eps
        #: Adam's decay rates, which may change between steps.
        self.betas = betas
        self._threads = threads = _choose_threads(grid)
        voxels = Z * Y * X
        self._vector, self._first, self._second = (_make_zeros(3 * voxels + 2 * SLACK) for _ in range(3))
        #: Whether `_gradient` holds div A, blurred along y and x, which the last step computed for the next one.
        self._divergence_ready = False
        self.vector[...] = start
        self._half = np.array([0.5 / h for h in grid.spacing], np.float32)
        self._blur, self._density = _Blur(grid, width, threads), _Density(a, grid, epsilon, threads)
        self._mass, self._base = (base, _NO_FIELD) if np.ndim(base) == 0 else (0.0, _pad_field(base, grid))
        self._field, self._gradient, self._gradient_along_z = (_make_volume(grid) for _ in range(3))
        #: Of each plane, the sum of |∂F_ε/∂A|, and the bits of its maximum (see `loops._measure_sizes`).
        self._sums, self._highest = np.empty(Z), np.empty(Z, np.int32)
        self._index_z = _continue_index(Z, EDGE, EDGE, grid.periodic)
        sizes = 3 * loops.pitch(Y, X) + 2 * SLACK, loops.ADAM_ROWS * X + SLACK, Y * X + SLACK
        self._rings, self._slopes, self._fluxes = (_make_scratch(threads, size) for size in sizes)

    @property
    def field(self) -> np.ndarray:
        """The last phase field, `(Z, Y, X)`: a view that the next step overwrites."""
        return _view_field(self._field, self.grid)

    @property
    def vector(self) -> np.ndarray:
        """A, `(3, Z, Y, X)`: a view that the next step overwrites, and that may be written to between steps."""
        self._divergence_ready = False
        return self._vector[SLACK:-SLACK].reshape(3, *self.grid.shape)

    def state(self) -> dict[str, Any]:
        """Copy the state that determines all later steps: A, Adam's moments, the mass, and the number of steps."""
        moments = {"vector": self._vector, "first": self._first, "second": self._second}
        arrays = {name: values[SLACK:-SLACK].reshape(3, *self.grid.shape).copy() for name, values in moments.items()}
        return {**arrays, "mass": self._mass, "taken": self.taken}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state of a flow with the same parameters."""
        for name, values in (("vector", self._vector), ("first", self._first), ("second", self._second)):
            values[SLACK:-SLACK] = np.asarray(state[name], np.float32).ravel()
        self._mass, self.taken, self._divergence_ready = state["mass"], state["taken"], False

    def shift(self, amount: float) -> None:
        """Add a constant to u from the next step on."""
        self._mass += amount

    def evaluate(self) -> float:
        """Compute u and the gradient of F_ε with respect to u, the first two passes of a step; return F_ε."""
        if not self._divergence_ready:
            self._adam_step(ALL, np.zeros(6, np.float32))
        self._divergence_ready = False
        self._blur.along_z(self._gradient, self._field, self._mass, self._base)
        return self._density(self._field, self._gradient)

    def update(self, rate: float) -> tuple[float, float]:
        """Make an Adam step of length `rate` along the last gradient; return maximum and mean of |∂F_ε/∂A|.

        These are the last two passes. The next step's div A, blurred along y and x, is then in `_gradient`.
        """
        self._blur.along_z(self._gradient, self._gradient_along_z, 0.0, _NO_FIELD)
        self.taken, self._divergence_ready = self.taken + 1, True
        β1, β2 = self.betas
        # With Adam's corrections of the bias of its moments, which begin at 0.
        corrected_rate, root_factor = rate / (1 - β1**self.taken), 1 / math.sqrt(1 - β2**self.taken)
        adam = np.array([1 - β1, β2, 1 - β2, corrected_rate, root_factor, self._adam_eps], np.float32)
        self._adam_step(MOVE, adam)
        self._adam_step(ENDS, adam)
        highest, total = self._highest.max().view(np.float32), self._sums.sum()
        return float(highest), float(total) / (3 * math.prod(self.grid.shape))

    def _adam_step(self, phase: int, adam: np.ndarray) -> None:
        """Run a phase of `loops.adam_step`, the last pass of a step."""
        loops.adam_step(
            self._threads, phase, self._gradient_along_z, self._vector, self._first, self._second,
            self._gradient, self._blur.rows, self._rings, self._slopes, self._fluxes, self._sums, self._highest,
            self._half, adam, self.grid.shape, self.grid.periodic, self._index_z, self._blur.planes,
        )  # fmt: skip


class _Blur:
    """The blur k on a grid: along each axis the weights, and the samples that they meet, also beyond the box."""

    def __init__(self, grid: Grid, width: float, threads: int) -> None:
        (z, rz), (y, ry), (x, rx) = (_pad_taps(width / h) for h in grid.spacing)
        Z, Y, X = grid.shape
        periodic = grid.periodic
        self._grid, self._threads = grid, threads
        # Loops run over all weights, whose number is rounded up, and over `BLUR_ROWS` rows: so beyond the radius.
        self._index, self._taps = _continue_index(Z, rz, len(z) + BLUR_ROWS, periodic), z
        #: Index and weights along y and along x, the samples that continue a row at its ends, and the radius along x.
        self.planes = (
            _continue_index(Y, ry + EDGE, len(y) + EDGE + BLUR_ROWS, periodic),
            y,
            _continue_index(X, rx, rx, periodic),
            x,
            _continue_index(X, EDGE, EDGE, periodic)[[0, 1, X + EDGE, X + EDGE + 1]],
            rx,
        )
        self.rows = _make_scratch(threads, 2 * BLUR_ROWS * loops.row_length(X, len(x)) + SLACK)

    def along_z(self, source: np.ndarray, out: np.ndarray, shift: float, base: np.ndarray) -> None:
        """Blur along z, and add the number `shift` and, where it is not empty, the field `base`."""
        Z, *plane = self._grid.shape
        pitch, number = loops.pitch(*plane), np.float32(shift)
        loops.blur_z(self._threads, source, out, base, self._threads, Z, pitch, self._index, self._taps, number)

    def in_planes(self, source: np.ndarray, out: np.ndarray) -> None:
        """Blur along y and x."""
        loops.blur_in_planes(self._threads, source, out, self.rows, self._grid.shape, self.planes)


class _Density:
    """F_ε on a grid: its constants and scratch arrays."""

    def __init__(self, a, grid: Grid, epsilon, threads: int, mask=None) -> None:
        Z, Y, X = grid.shape
        stride = X + 2 * EDGE
        self._grid, self._threads = grid, threads
        self._block, self._tile = max(1, min(8, _BLOCK // stride)), min(Y, max(8, _TILE // stride))
        self._constants, self._ratios = _make_constants(a, grid, epsilon), _compute_ratios(grid, mask is not None)
        self._mask = None if mask is None else _pad_field(mask, grid)
        self._index = _continue_index(Z, EDGE, EDGE, grid.periodic)
        row = np.zeros(stride, np.float32)
        row[EDGE:-EDGE] = 1
        outside = np.zeros(self._block * stride + SLACK, np.float32)
        self._inside = np.concatenate([np.tile(row, self._block), outside])
        self._energies = np.empty((math.ceil(Y / self._tile), Z))
        partial_size = _round_up((self._block + 2) * stride) + SLACK
        self._rings = _make_scratch(threads, loops.PARTIALS * partial_size + 2 * SLACK)
        # Three planes of sums, and a block to discard into.
        plane_size = _round_up(max(self._tile, self._block + 1) * stride) + SLACK
        self._sums = _make_scratch(threads, 4 * plane_size + 2 * SLACK)

    def __call__(self, u: np.ndarray, gradient: np.ndarray) -> float:
        """Fill `gradient` with ∂F_ε/∂u of the volume `u`; return the energy."""
        loops.fill_gradient(
            self._threads, u, gradient, self._energies, self._rings, self._sums, self._inside, self._constants,
            self._ratios, self._mask, self._index, self._block, self._tile, *self._grid.shape,
        )  # fmt: skip
        return float(self._energies.sum())


def _choose_threads(grid: Grid) -> int:
    """Return the number of threads that a grid makes use of, at most as many as numba may take."""
    useful = min(math.prod(grid.shape) // _VOXELS_PER_THREAD, grid.shape[0] // BLUR_ROWS)
    return min(count_threads(), useful) if useful > 1 else 1


def _round_up(size: int) -> int:
    """Round a number of floats up to whole cache lines."""
    return -(-size // _LINE) * _LINE


def _make_scratch(threads: int, size: int) -> np.ndarray:
    """Make a scratch array `(threads, ≥ size)` whose rows share no cache line."""
    return _make_zeros(threads * _round_up(size)).reshape(threads, -1)


def _make_zeros(size: int) -> np.ndarray:
    """Make zeros that begin at a cache line."""
    array = np.zeros(size + _LINE, np.float32)
    first = -array.ctypes.data // 4 % _LINE
    return array[first : first + size]


def _make_volume(grid: Grid) -> np.ndarray:
    """Make a flat volume (see `loops`) for the grid's planes, at least as many as a blur along z writes at once."""
    return _make_zeros(max(grid.shape[0], BLUR_ROWS) * loops.pitch(*grid.shape[1:]) + 2 * SLACK)


def _view_padded(volume: np.ndarray, grid: Grid) -> np.ndarray:
    """View a flat volume as a field with its continuation in planes, `(Z, Y + 2·EDGE, X + 2·EDGE)`."""
    Z, Y, X = grid.shape
    row_bytes = (X + 2 * EDGE) * 4
    return as_strided(volume[SLACK:], (Z, Y + 2 * EDGE, X + 2 * EDGE), (loops.pitch(Y, X) * 4, row_bytes, 4))


def _view_field(volume: np.ndarray, grid: Grid) -> np.ndarray:
    """View a flat volume as a field `(Z, Y, X)`, without its continuation."""
    return _view_padded(volume, grid)[:, EDGE:-EDGE, EDGE:-EDGE]


def _pad_field(u: np.ndarray, grid: Grid) -> np.ndarray:
    """Copy a field `(Z, Y, X)` into a flat volume and continue it in planes."""
    if u.shape != grid.shape:
        raise ValueError(f"expected a field of shape {grid.shape}, got {u.shape}")
    volume = _make_volume(grid)
    padded = _view_padded(volume, grid)
    y, x = (EDGE + _continue_index(n, EDGE, EDGE, grid.periodic) for n in grid.shape[1:])
    padded[:, EDGE:-EDGE, EDGE:-EDGE] = u
    sides = [0, 1, -2, -1]
    padded[:, :, sides] = padded[:, :, x[sides]]
    padded[:, sides] = padded[:, y[sides]]
    return volume


def _pad_taps(deviation: float) -> tuple[np.ndarray, int]:
    """Return a blur's weights, with zeros up to a multiple of `TAPS`, and its radius; deviation 0 is the identity."""
    taps = gaussian_taps(deviation) if deviation > 0 else (1.0,)
    return np.array(taps + (0.0,) * (-len(taps) % TAPS), np.float32), len(taps) // 2


def _continue_index(n: int, before: int, after: int, periodic: bool) -> np.ndarray:
    """Return the index of the sample at each position from -before to n + after - 1, periodic or mirrored."""
    return np.pad(np.arange(n), (before, after), mode="wrap" if periodic else "symmetric")


def _make_constants(a, grid: Grid, epsilon: float) -> np.ndarray:
    """Return the constants `k` of `loops._differentiate`: ξ², literals, (h/ε)², the floor of X, the weights of X, T²,
    TS, GT, GS and s in the density, twice those of X, T² and s, and `ROOT_ROUNDING`.

    Differences are in units of the spacing h along x: with g = 2h∇u, D = h² Hess u, T = (ε/h²) T', where
    T' = w (h/ε)² r - tr D, and likewise X and P. The voxel's volume is included.
    """
    a20, a11, a02, a10, a01, a00 = a
    h = grid.spacing[2]
    # In eq. 20, |M|²/2ε has (ε/h²)² and the ½ of |M|² = (X + T²)/2, |∇u|/2 has G/2h, and |∇u|² has s/4h²: with the
    # factors 0.75 and 0.5 below, all three are ε V / 4h^power.
    second, first, zeroth = (epsilon * grid.voxel_volume / (power * h**power) for power in (4, 3, 2))
    X = (a20 + a02 - a11) * second
    T2, s = 2 * a11 * second + X, a00 * 0.5 * zeroth
    terms = (X, T2, 2 * (a20 - a02) * second, (a10 + a01) * 0.75 * first, (a10 - a01) * 0.75 * first, s)
    well = (h / epsilon) ** 2
    floor = ROOT_FLOOR * h**2 * well  # of X, in units of (ε/h²)²
    literals = (0, 0.5, 0.25, 1, 2, 3)
    constants = [(2 * h * XI) ** 2, *literals, well, floor, *terms, 2 * X, 2 * T2, 2 * s, ROOT_ROUNDING]
    return np.array(constants, np.float32)


def _compute_ratios(grid: Grid, masked: bool) -> np.ndarray | None:
    """Return the ratios of the spacing along x to that along z, y, x, and their products; None if all are one and there
    is no mask, whose loop has one compiled form."""
    z, y, x = (grid.spacing[2] / h for h in grid.spacing)
    if z == y == 1 and not masked:
        return None
    return np.array([z, y, x, z * z, y * y, x * x, z * y, z * x, y * x], np.float32)
