"""F_ε with its gradient, and the step of the H⁻¹ flow, fused for processors (numba, float32).

All of numba's code is in this one file, so that a change to any of it renews the compiled cache.

Notation follows the plain-torch definition: s = |∇u|², d = s + ξ², G = √d, w = W'(u) = u³ - u, L = Δu, N = |Hess u|²,
Q = ∇uᵀ Hess u ∇u, T = Tr M, P = |M|², X = 2P - T², S = √(X⁺). In float32 the smooth positive part is 0 or X outside
|X| < 2e-5, and under the root's floor of 1e-6: X⁺ = max(X, 1e-6).

Layout. Volumes that one pass hands to the next are `(Z, Y, lanes + 2)`: samples at 1 … X of a row, their neighbours
beyond the ends at 0 and X + 1, and X rounded up to whole vectors, `lanes`, so that no loop over x leaves a remainder
(what it computes beyond X is finite and never used). A loop over x reads and writes several rows; `_read` and `_write`
tell the compiler that the streams of one loop are disjoint, without which it would not vectorise.

A step is five passes, each parallel over z: blur of div A along y and x; along z; energy and gradient; blur of that
along z; along y and x, with -∇ and Adam. The order of every sum does not depend on the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from llvmlite import ir
from numba import get_num_threads, njit, prange, set_num_threads, types
from numba.extending import intrinsic

from curvafit.priors.curvature import ROOT_FLOOR, XI
from curvafit.priors.grid import Grid
from curvafit.priors.stencils import gaussian_taps

#: All of fast-math but the leave to assume that no value is NaN or infinite: a diverged flow must show.
_FLAGS = {"reassoc", "contract", "arcp", "nsz", "afn"}
_SERIAL = {"cache": True, "fastmath": _FLAGS, "error_model": "numpy", "nogil": True}
_PARALLEL = {**_SERIAL, "parallel": True}

#: Floats of the widest vector. Rows are rounded up to a multiple of it; A has as many to spare at either end.
_LANES = 16
#: Partial derivatives kept for a row: one at the centre, then what goes to the six neighbours and along the diagonals.
_PARTIALS = 10
_C, _ZM, _ZP, _YM, _YP, _XM, _XP, _ZY, _ZX, _YX = range(_PARTIALS)
#: Taps are unrolled nine at a time (weights are padded with zeros to a multiple), for four rows of output at once.
_TAPS, _TOGETHER = 9, 4
#: Floats of a strip in the blur along z: the twenty rows that four outputs need stay in the second-level cache.
_STRIP = 2048
#: Voxels that are worth a thread: below, starting it costs more than it saves.
_WORTH = 32768
#: Rows that Adam takes at a time: whole vectors whatever X.
_ROWS = 16

_ONE, _TWO, _THREE = np.float32(1), np.float32(2), np.float32(3)
_ZERO = np.float32(0)
_ξ2, _FLOOR = np.float32(XI**2), np.float32(ROOT_FLOOR)


def energy_gradient(u: np.ndarray, a, grid: Grid, epsilon: float) -> tuple[float, np.ndarray]:
    """F_ε(u) and its gradient with respect to every voxel (the voxel's volume included).

    Parameters
    ----------
    u
        Phase field `(Z, Y, X)`; computed in float32.
    a
        The six coefficients (a20, a11, a02, a10, a01, a00), numbers.
    grid, epsilon
        The sampling, either boundary, and the interface parameter in spacing's unit.

    Raises
    ------
    ValueError
        If the field's shape is not the grid's.
    """
    density = _Density(a, grid, epsilon, _threads(grid))
    gradient = _volume(grid)
    value = density(_padded(u, grid), gradient)
    return value, _inner(gradient, grid).copy()


def gaussian_blur(u: np.ndarray, grid: Grid, width: float) -> np.ndarray:
    """k ∗ u in float32, as `stencils.gaussian_blur`.

    Raises
    ------
    ValueError
        If the field's shape is not the grid's.
    """
    blur = _Blur(grid, width, _threads(grid))
    volume, along_z = _padded(u, grid), _volume(grid)
    blur.along_z(volume, along_z, 0.0, _NO_FIELD)
    blur.in_planes(along_z, volume)
    return _inner(volume, grid).copy()


class FusedFlow:
    """The state of the flow u = k ∗ (div A + base) under Adam on A, stepped in place.

    Parameters
    ----------
    start
        A at the first step, `(3, Z, Y, X)`, components z, y, x.
    base
        k ∗ base: the mass m₀, or a field `(Z, Y, X)` that has been blurred already.
    a, grid, epsilon, width
        The six numbers, the sampling (either boundary), ε and the blur's standard deviation in spacing's unit.
    frozen
        Voxels `(Z, Y, X)` whose A is held, or None.
    betas, adam_eps
        Adam's decay rates and the number added to its root (`torch.optim.Adam`'s betas and eps).
    """

    def __init__(
        self, start, base, a, grid: Grid, epsilon: float, width: float, frozen=None, *, betas, adam_eps
    ) -> None:
        Z, Y, X = grid.shape
        self.grid, self.taken = grid, 0
        self._betas, self._adam_eps = betas, adam_eps
        self._threads = threads = _threads(grid)
        size = 3 * Z * Y * X
        self._vector = np.zeros(size + 2 * _LANES, np.float32)
        self.vector[...] = start
        self._first, self._second = np.zeros(size, np.float32), np.zeros(size, np.float32)
        self._half = np.array([0.5 / h for h in grid.spacing], np.float32)
        self._blur, self._density = _Blur(grid, width, threads), _Density(a, grid, epsilon, threads)
        self._mass, self._base = (base, _NO_FIELD) if np.ndim(base) == 0 else (0.0, _padded(base, grid))
        self._keep, self._free = np.empty(0, np.float32), size
        if frozen is not None:
            self._keep = 1 - np.asarray(frozen, np.float32).ravel()
            self._free = 3 * int(np.count_nonzero(self._keep))
        self._between, self._field, self._gradient = _volume(grid), _volume(grid), _volume(grid)
        self._sums, self._highest = np.empty(Z), np.empty(Z)
        rows = self._blur.scratch.shape[1]
        lanes = _lanes(X)
        self._div_scratch = np.zeros((threads, rows + Y * lanes + _LANES), np.float32)
        self._adam_scratch = np.zeros((threads, rows + 3 * Y * (lanes + 2) + 2 * _ROWS * X + 2 * _LANES), np.float32)

    @property
    def field(self) -> np.ndarray:
        """The phase field last computed, `(Z, Y, X)`: a view that the next step overwrites."""
        return _inner(self._field, self.grid)

    @property
    def vector(self) -> np.ndarray:
        """A, `(3, Z, Y, X)`: a view that the next step overwrites."""
        return self._vector[_LANES:-_LANES].reshape(3, *self.grid.shape)

    def evaluate(self) -> float:
        """Compute u and the gradient of F_ε with respect to it; returns F_ε."""
        self.blur_divergence()
        self.blur_along_z()
        return self.energy_gradient()

    def update(self, rate: float) -> tuple[float, float]:
        """One Adam step of length `rate` along the gradient last evaluated; returns max and mean of |∂F_ε/∂A|."""
        self.blur_gradient_along_z()
        return self.blur_adam(rate)

    def blur_divergence(self) -> None:
        """First part of a step: div A, blurred along y and x."""
        with _limited(self._threads):
            _divergence(
                self._vector,
                self._between.ravel(),
                self._div_scratch,
                self._half,
                *self.grid.shape,
                self.grid.periodic,
                *self._blur.planes,
            )

    def blur_along_z(self) -> None:
        """Second part: the blur along z, and the base added."""
        self._blur.along_z(self._between, self._field, self._mass, self._base)

    def energy_gradient(self) -> float:
        """Third part: F_ε and its gradient with respect to u."""
        return self._density(self._field, self._gradient)

    def blur_gradient_along_z(self) -> None:
        """Fourth part: the gradient's blur along z."""
        self._blur.along_z(self._gradient, self._between, 0.0, _NO_FIELD)

    def blur_adam(self, rate: float) -> tuple[float, float]:
        """Last part: the gradient's blur along y and x, -∇ of it, and Adam."""
        self.taken += 1
        β1, β2 = self._betas
        length, spread = rate / (1 - β1**self.taken), 1 / math.sqrt(1 - β2**self.taken)
        with _limited(self._threads):
            _adam(
                self._between.ravel(),
                self._vector,
                self._first,
                self._second,
                self._keep,
                self._adam_scratch,
                self._sums,
                self._highest,
                self._half,
                np.array([1 - β1, β2, 1 - β2, length, spread, self._adam_eps], np.float32),
                *self.grid.shape,
                self.grid.periodic,
                *self._blur.planes,
            )
        return float(self._highest.max()), float(self._sums.sum()) / max(1, self._free)


class _Blur:
    """k on a grid. Per axis: which sample stands at -r, -r + 1, …, and the weights of offsets -r … r (then zeros)."""

    def __init__(self, grid: Grid, width: float, threads: int) -> None:
        taps = [_padded_taps(width / h) for h in grid.spacing]
        index = [_continuation(n, len(w) - 1, r, grid.periodic) for n, (w, r) in zip(grid.shape, taps, strict=True)]
        (self._index, *planes), (self._taps, *weights) = index, [w for w, _ in taps]
        self._grid, self._threads = grid, threads
        #: Index and weights along y, along x, and the radius along x.
        self.planes = (planes[0], weights[0], planes[1], weights[1], taps[2][1])
        self.scratch = np.zeros((threads, _TOGETHER * _row_length(grid.shape[2], weights[1])), np.float32)

    def along_z(self, source: np.ndarray, out: np.ndarray, shift: float, base: np.ndarray) -> None:
        """Blur along z, and add a number and, where it is not empty, a field."""
        Z = self._grid.shape[0]
        flat = source.ravel(), out.ravel(), base.ravel()
        with _limited(self._threads):
            _blur_z(*flat, Z, source.size // Z, self._index, self._taps, np.float32(shift), self._threads)

    def in_planes(self, source: np.ndarray, out: np.ndarray) -> None:
        """Blur along y and x."""
        with _limited(self._threads):
            _blur_planes(source.ravel(), out.ravel(), self.scratch, *self._grid.shape, *self.planes)


class _Density:
    """F_ε's constants and scratch on a grid."""

    def __init__(self, a, grid: Grid, epsilon: float, threads: int) -> None:
        _, Y, X = grid.shape
        lanes = _lanes(X)
        self._grid, self._threads = grid, threads
        self._constants = _density_constants(a, grid, epsilon)
        self._inside = (np.arange(lanes) < X).astype(np.float32)
        self._energies = np.empty(grid.shape[0])
        # Three rows of partial derivatives, three planes of sums, and a row to discard into.
        self._scratch = np.zeros((threads, 3 * _PARTIALS * (lanes + 2) + 3 * Y * lanes + lanes), np.float32)

    def __call__(self, u: np.ndarray, gradient: np.ndarray) -> float:
        with _limited(self._threads):
            _energy_gradient(
                u.ravel(),
                gradient.ravel(),
                self._energies,
                self._scratch,
                self._constants,
                self._inside,
                *self._grid.shape,
                self._grid.periodic,
            )
        return float(self._energies.sum())


_NO_FIELD = np.empty(0, np.float32)


def _threads(grid: Grid) -> int:
    """How many threads a grid is worth, of those allowed."""
    return max(1, min(get_num_threads(), math.prod(grid.shape) // _WORTH))


@contextmanager
def _limited(threads: int) -> Iterator[None]:
    """Run numba's loops on so many threads at most."""
    allowed = get_num_threads()
    set_num_threads(min(threads, allowed))
    try:
        yield
    finally:
        set_num_threads(allowed)


def _lanes(n: int) -> int:
    return -(-n // _LANES) * _LANES


def _volume(grid: Grid) -> np.ndarray:
    Z, Y, X = grid.shape
    return np.zeros((Z, Y, _lanes(X) + 2), np.float32)


def _inner(volume: np.ndarray, grid: Grid) -> np.ndarray:
    return volume[:, :, 1 : 1 + grid.shape[2]]


def _padded(u: np.ndarray, grid: Grid) -> np.ndarray:
    if u.shape != grid.shape:
        raise ValueError(f"expected a field of shape {grid.shape}, got {u.shape}")
    volume, X = _volume(grid), grid.shape[2]
    _inner(volume, grid)[...] = u
    before, after = (X, 1) if grid.periodic else (1, X)
    volume[:, :, 0], volume[:, :, X + 1] = volume[:, :, before], volume[:, :, after]
    return volume


def _padded_taps(deviation: float) -> tuple[np.ndarray, int]:
    """The weights with zeros after them, and the radius; a deviation of zero is the identity."""
    taps = gaussian_taps(deviation) if deviation > 0 else (1.0,)
    return np.array(taps + (0.0,) * (-len(taps) % _TAPS), np.float32), len(taps) // 2


def _continuation(n: int, more: int, radius: int, periodic: bool) -> np.ndarray:
    """Which of n samples stands at -radius, … , n + more - radius - 1."""
    index = np.arange(n + more) - radius
    if periodic:
        return index % n
    index = index % (2 * n)
    return np.where(index < n, index, 2 * n - 1 - index)


def _row_length(n: int, taps: np.ndarray) -> int:
    """Floats of a row that is blurred along x, with its continuation."""
    return _lanes(n) + len(taps) + _LANES


def _density_constants(a, grid: Grid, epsilon: float) -> np.ndarray:
    """ε and 1/ε, the six weights of the density (times the voxel's volume), and the nine stencils' factors."""
    a20, a11, a02, a10, a01, a00 = (float(value) * grid.voxel_volume for value in a)
    ε = float(epsilon)
    hz, hy, hx = grid.spacing
    quadratic = ((a20 + a02 - a11) / (2 * ε), a11 / (2 * ε), (a20 - a02) / (2 * ε))
    linear = ((a10 + a01) / 2, (a10 - a01) / 2)
    first = (0.5 / hz, 0.5 / hy, 0.5 / hx)
    second = (1 / hz**2, 1 / hy**2, 1 / hx**2, 0.25 / (hz * hy), 0.25 / (hz * hx), 0.25 / (hy * hx))
    return np.array([ε, 1 / ε, *quadratic, *linear, a00 * ε, *first, *second], np.float32)


def _scope_metadata(module, group: int, stream: int, streams: int):
    """Alias scopes of one stream: itself, and all others of its group."""
    domain = module.add_metadata([ir.MetaDataString(module, f"curvafit {group}")])
    scopes = [module.add_metadata([ir.MetaDataString(module, f"curvafit {group} {k}"), domain]) for k in range(streams)]
    others = module.add_metadata([scope for k, scope in enumerate(scopes) if k != stream])
    return module.add_metadata([scopes[stream]]), others


def _tag(builder, instruction, group: int, stream: int):
    own, others = _scope_metadata(builder.module, group, stream, _STREAMS)
    instruction.set_metadata("alias.scope", own)
    instruction.set_metadata("noalias", others)


_STREAMS = 12


def _type_read(typingctx, array, index, group, stream):
    """`array[index]` of a flat float32 array, index from 0; streams of one group are promised to be disjoint."""
    if not isinstance(group, types.IntegerLiteral) or not isinstance(stream, types.IntegerLiteral):
        return None
    numbers = group.literal_value, stream.literal_value

    def generate(context, builder, signature, values):
        data = context.make_array(signature.args[0])(context, builder, values[0]).data
        loaded = builder.load(builder.gep(data, [values[1]]))
        _tag(builder, loaded, *numbers)
        return loaded

    return types.float32(array, types.intp, group, stream), generate


def _type_write(typingctx, array, index, value, group, stream):
    """`array[index] = value`, with the promise of `_type_read`."""
    if not isinstance(group, types.IntegerLiteral) or not isinstance(stream, types.IntegerLiteral):
        return None
    numbers = group.literal_value, stream.literal_value

    def generate(context, builder, signature, values):
        data = context.make_array(signature.args[0])(context, builder, values[0]).data
        stored = builder.store(values[2], builder.gep(data, [values[1]]))
        _tag(builder, stored, *numbers)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.float32, group, stream), generate


_read: Any = intrinsic(prefer_literal=True)(_type_read)
_write: Any = intrinsic(prefer_literal=True)(_type_write)


@njit(**_SERIAL)
def _partials_row(u, rows, ring, slot, lanes, inside, k):
    """Energy of a row, and its partial derivatives into a slot of the ring, already times the stencils' factors.

    `rows` holds the nine rows of the neighbourhood, (z-1, z, z+1) × (y-1, y, y+1), as offsets into the padded field.
    """
    ε, i_ε = k[0], k[1]
    wP, wT2, wTS, wGT, wGS, ws = k[2], k[3], k[4], k[5], k[6], k[7]
    fz, fy, fx = k[8], k[9], k[10]
    fzz, fyy, fxx, fzy, fzx, fyx = k[11], k[12], k[13], k[14], k[15], k[16]
    mm, mc, mp, cm, cc, cp, pm, pc, pp = rows
    stride = lanes + 2
    ε2 = ε * ε
    total = _ZERO
    for x in range(lanes):
        i = x + 1
        u_ = _read(u, cc + i, 0, 0)
        zm, zp = _read(u, mc + i, 0, 0), _read(u, pc + i, 0, 0)
        ym, yp = _read(u, cm + i, 0, 0), _read(u, cp + i, 0, 0)
        xm, xp = _read(u, cc + x, 0, 0), _read(u, cc + i + 1, 0, 0)
        gz, gy, gx = fz * (zp - zm), fy * (yp - ym), fx * (xp - xm)
        twice = u_ + u_
        zz, yy, xx = (fzz * (zp + zm - twice), fyy * (yp + ym - twice), fxx * (xp + xm - twice))
        zy = fzy * (
            (_read(u, pp + i, 0, 0) + _read(u, mm + i, 0, 0)) - (_read(u, pm + i, 0, 0) + _read(u, mp + i, 0, 0))
        )
        zx = fzx * (
            (_read(u, pc + x + 2, 0, 0) + _read(u, mc + x, 0, 0))
            - (_read(u, pc + x, 0, 0) + _read(u, mc + x + 2, 0, 0))
        )
        yx = fyx * (
            (_read(u, cp + x + 2, 0, 0) + _read(u, cm + x, 0, 0))
            - (_read(u, cp + x, 0, 0) + _read(u, cm + x + 2, 0, 0))
        )
        # The density.
        s = gz * gz + gy * gy + gx * gx
        d = s + _ξ2
        i_d = _ONE / d
        r = s * i_d
        G = math.sqrt(d)
        u2 = u_ * u_
        w = u_ * (u2 - _ONE)
        L = zz + yy + xx
        N = zz * zz + yy * yy + xx * xx + _TWO * (zy * zy + zx * zx + yx * yx)
        hz = gz * zz + gy * zy + gx * zx
        hy = gz * zy + gy * yy + gx * yx
        hx = gz * zx + gy * yx + gx * xx
        q = (gz * hz + gy * hy + gx * hx) * i_d
        wr = w * r * i_ε
        T = wr - ε * L
        P = ε2 * N - _TWO * w * q + wr * wr
        X_ = _TWO * P - T * T
        above = X_ > _FLOOR
        S = math.sqrt(X_ if above else _FLOOR)
        e = wP * P + wT2 * T * T + wTS * T * S + G * (wGT * T + wGS * S) + ws * s
        total += e if _read(inside, x, 0, 11) > _ZERO else _ZERO
        # Its derivatives, from the outside in.
        e_S = wTS * T + wGS * G
        κ = e_S / (S + S)
        κ = κ if above else _ZERO
        e_P = wP + κ + κ
        e_T = _TWO * T * (wT2 - κ) + wTS * S + wGT * G
        e_G = wGT * T + wGS * S
        e_L = -ε * e_T
        e_N = _TWO * ε2 * e_P
        e_Q = -_TWO * w * e_P * i_d
        e_r = w * (e_T * i_ε + _TWO * e_P * wr * i_ε)
        e_w = r * (e_T * i_ε + _TWO * e_P * wr * i_ε) - _TWO * e_P * q
        e_s = _TWO * ws + e_G * G * i_d - _TWO * e_Q * q + _TWO * e_r * _ξ2 * i_d * i_d
        e_q = e_Q + e_Q
        e_n = e_N + e_N
        dz, dy, dx = (fz * (e_s * gz + e_q * hz), fy * (e_s * gy + e_q * hy), fx * (e_s * gx + e_q * hx))
        dzz = fzz * (e_L + e_N * zz + e_Q * gz * gz)
        dyy = fyy * (e_L + e_N * yy + e_Q * gy * gy)
        dxx = fxx * (e_L + e_N * xx + e_Q * gx * gx)
        o = slot + i
        _write(ring, o + _C * stride, e_w * (_THREE * u2 - _ONE) - _TWO * (dzz + dyy + dxx), 0, 1)
        _write(ring, o + _ZM * stride, dzz - dz, 0, 2)
        _write(ring, o + _ZP * stride, dzz + dz, 0, 3)
        _write(ring, o + _YM * stride, dyy - dy, 0, 4)
        _write(ring, o + _YP * stride, dyy + dy, 0, 5)
        _write(ring, o + _XM * stride, dxx - dx, 0, 6)
        _write(ring, o + _XP * stride, dxx + dx, 0, 7)
        _write(ring, o + _ZY * stride, fzy * (e_n * zy + e_q * gz * gy), 0, 8)
        _write(ring, o + _ZX * stride, fzx * (e_n * zx + e_q * gz * gx), 0, 9)
        _write(ring, o + _YX * stride, fyx * (e_n * yx + e_q * gy * gx), 0, 10)
    return total


@njit(**_SERIAL)
def _close_row(ring, slot, X, lanes, periodic):
    """What of a row's partial derivatives the gather reads beyond its ends: the other end, or a mirror image in which
    what was differenced once along x is odd (the two neighbours' shares exchange)."""
    stride = lanes + 2
    xm, xp, zx, yx = (slot + _XM * stride, slot + _XP * stride, slot + _ZX * stride, slot + _YX * stride)
    if periodic:
        ring[xp], ring[xm + X + 1] = ring[xp + X], ring[xm + 1]
        for row in (zx, yx):
            ring[row], ring[row + X + 1] = ring[row + X], ring[row + 1]
    else:
        ring[xp], ring[xm + X + 1] = ring[xm + 1], ring[xp + X]
        for row in (zx, yx):
            ring[row], ring[row + X + 1] = -ring[row + 1], -ring[row + X]


@njit(**_SERIAL)
def _mirror_row(ring, slot, lanes):
    """A row's partial derivatives seen in a mirror across y."""
    stride = lanes + 2
    for i in range(1, lanes + 1):
        m, p = slot + _YM * stride + i, slot + _YP * stride + i
        ring[m], ring[p] = ring[p], ring[m]
        ring[slot + _ZY * stride + i] = -ring[slot + _ZY * stride + i]
        ring[slot + _YX * stride + i] = -ring[slot + _YX * stride + i]


@njit(**_SERIAL)
def _gather_row(ring, before, here, after, below, centre, above, out, target, lanes, mirrored):
    """Apply the transposed stencils to a row: finish the plane below, add to this one, begin the one above.

    `before`, `here`, `after` are the slots of rows y-1, y, y+1; `below`, `centre`, `above` the offsets of the row's
    sums for the three planes (in `ring`, beyond the slots); `mirrored`: the plane is seen in a mirror across z.
    """
    stride = lanes + 2
    to_below, to_above, sign = (_ZP, _ZM, -_ONE) if mirrored else (_ZM, _ZP, _ONE)
    c, yp, ym = here + _C * stride, before + _YP * stride, after + _YM * stride
    xp, xm = here + _XP * stride, here + _XM * stride
    zm, zp = here + to_below * stride, here + to_above * stride
    zy_b, zy_a, zx = before + _ZY * stride, after + _ZY * stride, here + _ZX * stride
    yx_b, yx_a = before + _YX * stride, after + _YX * stride
    for x in range(lanes):
        i = x + 1
        within = _read(ring, c + i, 1, 0) + _read(ring, yp + i, 1, 0) + _read(ring, ym + i, 1, 0)
        within += _read(ring, xp + x, 1, 0) + _read(ring, xm + i + 1, 1, 0)
        within += _read(ring, yx_a + i + 1, 1, 0) - _read(ring, yx_a + x, 1, 0)
        within += _read(ring, yx_b + x, 1, 0) - _read(ring, yx_b + i + 1, 1, 0)
        across = _read(ring, zy_a + i, 1, 0) - _read(ring, zy_b + i, 1, 0)
        across += _read(ring, zx + i + 1, 1, 0) - _read(ring, zx + x, 1, 0)
        across *= sign
        _write(out, target + x, _read(ring, below + x, 1, 1) + _read(ring, zm + i, 1, 0) + across, 1, 4)
        _write(ring, centre + x, _read(ring, centre + x, 1, 2) + within, 1, 2)
        _write(ring, above + x, _read(ring, zp + i, 1, 0) - across, 1, 3)


@njit(**_SERIAL)
def _energy_gradient_chunk(u, out, planes, scratch, k, inside, first, last, Z, Y, X, periodic):
    """Planes first … last - 1 of the gradient, with a halo of one plane computed on either side."""
    lanes = inside.size
    stride = lanes + 2
    slot_size = _PARTIALS * stride
    sums, plane = 3 * slot_size, Y * lanes
    discard = sums + 3 * plane
    for z in range(first - 1, last + 1):
        mirrored = not periodic and (z < 0 or z >= Z)
        zc = _within(z, Z, periodic)
        zm, zp = _within(zc - 1, Z, periodic), _within(zc + 1, Z, periodic)
        below, centre, above = (sums + (z + 2) % 3 * plane, sums + (z + 3) % 3 * plane, sums + (z + 4) % 3 * plane)
        energy = 0.0
        for y in range(-1, Y + 1):
            yc = _within(y, Y, periodic)
            ym, yp = _within(yc - 1, Y, periodic), _within(yc + 1, Y, periodic)
            m, c, p = zm * Y, zc * Y, zp * Y
            rows = (
                (m + ym) * stride,
                (m + yc) * stride,
                (m + yp) * stride,
                (c + ym) * stride,
                (c + yc) * stride,
                (c + yp) * stride,
                (p + ym) * stride,
                (p + yc) * stride,
                (p + yp) * stride,
            )
            slot = (y + 1) % 3 * slot_size
            row_energy = _partials_row(u, rows, scratch, slot, lanes, inside, k)
            if 0 <= y < Y:
                energy += row_energy
            elif not periodic:
                _mirror_row(scratch, slot, lanes)
            _close_row(scratch, slot, X, lanes, periodic)
            if y < 1:
                continue
            row = (y - 1) * lanes
            before, here = (y - 1) % 3 * slot_size, y % 3 * slot_size
            if z > first:
                _gather_row(
                    scratch, before, here, slot, below + row, centre + row, above + row,
                    out, ((z - 1) * Y + y - 1) * stride + 1, lanes, mirrored,
                )  # fmt: skip
            else:
                _gather_row(
                    scratch, before, here, slot, below + row, centre + row, above + row,
                    scratch, discard, lanes, mirrored,
                )  # fmt: skip
        if first <= z < last:
            planes[z] = energy


@njit(**_SERIAL)
def _within(i, n, periodic):
    """Index i, at most one beyond either end, brought back: to the other end, or to the nearest."""
    if i < 0:
        return n - 1 if periodic else 0
    if i >= n:
        return 0 if periodic else n - 1
    return i


@njit(**_PARALLEL)
def _energy_gradient(u, out, planes, scratch, k, inside, Z, Y, X, periodic):
    chunks = scratch.shape[0]
    for chunk in prange(chunks):
        first, last = chunk * Z // chunks, (chunk + 1) * Z // chunks
        if first < last:
            _energy_gradient_chunk(u, out, planes, scratch[chunk], k, inside, first, last, Z, Y, X, periodic)


@njit(**_SERIAL)
def _nine(source, r0, r1, r2, r3, r4, r5, r6, r7, r8, x, w):
    """Nine weighted rows at x."""
    near = w[0] * _read(source, r0 + x, 2, 0) + w[1] * _read(source, r1 + x, 2, 0) + w[2] * _read(source, r2 + x, 2, 0)
    here = w[3] * _read(source, r3 + x, 2, 0) + w[4] * _read(source, r4 + x, 2, 0) + w[5] * _read(source, r5 + x, 2, 0)
    far = w[6] * _read(source, r6 + x, 2, 0) + w[7] * _read(source, r7 + x, 2, 0) + w[8] * _read(source, r8 + x, 2, 0)
    return near + (here + far)


@njit(**_SERIAL)
def _row_of_nine(out, target, source, rows, n, w, begin, shift):
    """Nine taps of a blur into a row of n: begin it (with a shift), or add to it."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = rows
    if begin:
        for x in range(n):
            _write(out, target + x, shift + _nine(source, r0, r1, r2, r3, r4, r5, r6, r7, r8, x, w), 2, 1)
    else:
        for x in range(n):
            total = _read(out, target + x, 2, 1) + _nine(source, r0, r1, r2, r3, r4, r5, r6, r7, r8, x, w)
            _write(out, target + x, total, 2, 1)


@njit(**_SERIAL)
def _four_rows_of_nine(out, target, apart, source, rows, n, w, begin, shift):
    """The same for four neighbouring rows at once, which share eight of their nine sources each."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8, r9, r10, r11 = rows
    t1, t2, t3 = target + apart, target + 2 * apart, target + 3 * apart
    if begin:
        for x in range(n):
            _write(out, target + x, shift + _nine(source, r0, r1, r2, r3, r4, r5, r6, r7, r8, x, w), 2, 1)
            _write(out, t1 + x, shift + _nine(source, r1, r2, r3, r4, r5, r6, r7, r8, r9, x, w), 2, 2)
            _write(out, t2 + x, shift + _nine(source, r2, r3, r4, r5, r6, r7, r8, r9, r10, x, w), 2, 3)
            _write(out, t3 + x, shift + _nine(source, r3, r4, r5, r6, r7, r8, r9, r10, r11, x, w), 2, 4)
    else:
        for x in range(n):
            total = _read(out, target + x, 2, 1) + _nine(source, r0, r1, r2, r3, r4, r5, r6, r7, r8, x, w)
            _write(out, target + x, total, 2, 1)
            total = _read(out, t1 + x, 2, 2) + _nine(source, r1, r2, r3, r4, r5, r6, r7, r8, r9, x, w)
            _write(out, t1 + x, total, 2, 2)
            total = _read(out, t2 + x, 2, 3) + _nine(source, r2, r3, r4, r5, r6, r7, r8, r9, r10, x, w)
            _write(out, t2 + x, total, 2, 3)
            total = _read(out, t3 + x, 2, 4) + _nine(source, r3, r4, r5, r6, r7, r8, r9, r10, r11, x, w)
            _write(out, t3 + x, total, 2, 4)


@njit(**_SERIAL)
def _weights(taps, j):
    return (
        taps[j], taps[j + 1], taps[j + 2], taps[j + 3], taps[j + 4], taps[j + 5], taps[j + 6], taps[j + 7], taps[j + 8],
    )  # fmt: skip


@njit(**_SERIAL)
def _blur_rows(out, target, apart, source, origin, size, n, index, i, count, taps, shift):
    """Rows i … i + count - 1 (four or one) of a blur across rows, which are `size` apart in the source from `origin`
    on: `index` says which of them stands where."""
    for j in range(0, taps.size, _TAPS):
        m = i + j
        r0, r1, r2 = (origin + index[m] * size, origin + index[m + 1] * size, origin + index[m + 2] * size)
        r3, r4, r5 = (origin + index[m + 3] * size, origin + index[m + 4] * size, origin + index[m + 5] * size)
        r6, r7, r8 = (origin + index[m + 6] * size, origin + index[m + 7] * size, origin + index[m + 8] * size)
        w = _weights(taps, j)
        if count == _TOGETHER:
            r9, r10, r11 = (origin + index[m + 9] * size, origin + index[m + 10] * size, origin + index[m + 11] * size)
            rows = (r0, r1, r2, r3, r4, r5, r6, r7, r8, r9, r10, r11)
            _four_rows_of_nine(out, target, apart, source, rows, n, w, j == 0, shift)
        else:
            _row_of_nine(out, target, source, (r0, r1, r2, r3, r4, r5, r6, r7, r8), n, w, j == 0, shift)


@njit(**_SERIAL)
def _blur_x(out, target, row, start, X, lanes, index, taps, r):
    """Blur along a row whose samples stand in `row` from start + r on; its continuation is filled in here."""
    first = start + r
    for j in range(r):
        row[start + j] = row[first + index[j]]
    for j in range(r + X, index.size):
        row[start + j] = row[first + index[j]]
    for j in range(0, taps.size, _TAPS):
        m = start + j
        rows = (m, m + 1, m + 2, m + 3, m + 4, m + 5, m + 6, m + 7, m + 8)
        _row_of_nine(out, target, row, rows, lanes, _weights(taps, j), j == 0, _ZERO)


@njit(**_PARALLEL)
def _blur_z(source, out, base, Z, L, index, taps, shift, chunks):
    """Blur `(Z, L)` along z, plus a number and, where there is one, a field; strip by strip, four planes at a time."""
    blocks = -(-Z // _TOGETHER)
    for chunk in prange(chunks):
        first, last = chunk * blocks // chunks, (chunk + 1) * blocks // chunks
        for strip in range(0, L, _STRIP):
            n = min(_STRIP, L - strip)
            for block in range(first, last):
                z, end = block * _TOGETHER, min(Z, block * _TOGETHER + _TOGETHER)
                while z < end:
                    count = _TOGETHER if end - z == _TOGETHER else 1
                    _blur_rows(out, z * L + strip, L, source, strip, L, n, index, z, count, taps, shift)
                    z += count
                if base.size > 0:
                    for z in range(block * _TOGETHER, end):
                        target = z * L + strip
                        for x in range(n):
                            _write(out, target + x, _read(out, target + x, 2, 1) + _read(base, target + x, 2, 0), 2, 1)


@njit(**_SERIAL)
def _blur_plane(source, origin, size, out, target, stride, row, start, Y, X, lanes, ends, planes):
    """Blur a plane along y and x: rows `size` apart from `origin` on, to rows `stride` apart from `target` on, with the
    samples beyond their ends (`ends` says which those are). `row` is scratch from `start` on."""
    index_y, taps_y, index_x, taps_x, r = planes
    length = lanes + taps_x.size + _LANES
    y = 0
    while y < Y:
        count = _TOGETHER if Y - y >= _TOGETHER else 1
        _blur_rows(row, start + r, length, source, origin, size, lanes, index_y, y, count, taps_y, _ZERO)
        for k in range(count):
            o = target + (y + k) * stride
            _blur_x(out, o, row, start + k * length, X, lanes, index_x, taps_x, r)
            out[o - 1], out[o + X] = out[o + ends[0]], out[o + ends[1]]
        y += count


@njit(**_PARALLEL)
def _blur_planes(source, out, scratch, Z, Y, X, index_y, taps_y, index_x, taps_x, r):
    """Blur along y and x."""
    chunks = scratch.shape[0]
    lanes = -(-X // _LANES) * _LANES
    for chunk in prange(chunks):
        for z in range(chunk * Z // chunks, (chunk + 1) * Z // chunks):
            o = z * Y * (lanes + 2) + 1
            planes = (index_y, taps_y, index_x, taps_x, r)
            _blur_plane(source, o, lanes + 2, out, o, lanes + 2, scratch[chunk], 0, Y, X, lanes, (0, X - 1), planes)


@njit(**_SERIAL)
def _divergence_plane(A, plane, start, half, z, Z, Y, X, lanes, periodic):
    """div A on a plane, rows of `lanes`: central differences of an odd continuation (no flux through mirrors)."""
    Az, Ay, Ax = _LANES, _LANES + Z * Y * X, _LANES + 2 * Z * Y * X
    odd = _ONE if periodic else -_ONE
    zm, zp = (Az + _within(z - 1, Z, periodic) * Y * X, Az + _within(z + 1, Z, periodic) * Y * X)
    fz_m, fz_p = (half[0] * (odd if z == 0 else _ONE), half[0] * (odd if z == Z - 1 else _ONE))
    fx = half[2]
    for y in range(Y):
        fy_m, fy_p = (half[1] * (odd if y == 0 else _ONE), half[1] * (odd if y == Y - 1 else _ONE))
        ym, yp = (Ay + (z * Y + _within(y - 1, Y, periodic)) * X, Ay + (z * Y + _within(y + 1, Y, periodic)) * X)
        o, m, p, row = Ax + (z * Y + y) * X, zm + y * X, zp + y * X, start + y * lanes
        for x in range(lanes):
            total = fz_p * _read(A, p + x, 3, 0) - fz_m * _read(A, m + x, 3, 0)
            total += fy_p * _read(A, yp + x, 3, 0) - fy_m * _read(A, ym + x, 3, 0)
            _write(plane, row + x, total + fx * (_read(A, o + x + 1, 3, 0) - _read(A, o + x - 1, 3, 0)), 3, 1)
        left, right = A[o + _within(-1, X, periodic)], A[o + _within(X, X, periodic)]
        plane[row] += fx * (A[o - 1] - odd * left)
        plane[row + X - 1] += fx * (odd * right - A[o + X])


@njit(**_PARALLEL)
def _divergence(A, out, scratch, half, Z, Y, X, periodic, index_y, taps_y, index_x, taps_x, r):
    """div A blurred along y and x."""
    chunks = scratch.shape[0]
    lanes = -(-X // _LANES) * _LANES
    ends = (X - 1, 0) if periodic else (0, X - 1)
    for chunk in prange(chunks):
        work = scratch[chunk]
        planes = (index_y, taps_y, index_x, taps_x, r)
        for z in range(chunk * Z // chunks, (chunk + 1) * Z // chunks):
            _divergence_plane(A, work, 0, half, z, Z, Y, X, lanes, periodic)
            target = z * Y * (lanes + 2) + 1
            _blur_plane(work, 0, lanes, out, target, lanes + 2, work, Y * lanes, Y, X, lanes, ends, planes)


@njit(**_SERIAL)
def _slopes(work, target, before, after, factor, lanes):
    """factor·(before - after) of a row."""
    for x in range(lanes):
        _write(work, target + x, factor * (_read(work, before + x, 4, 0) - _read(work, after + x, 4, 0)), 4, 1)


@njit(**_SERIAL)
def _adam_rows(A, m, v, o, keep, free, work, slopes, most, n, adam):
    """Adam on n samples of a component, from `o` on; returns the sum of the slopes' moduli.

    Their maximum is kept sample by sample in `work`, from `most` on.
    """
    β1c, β2, β2c, length, spread, eps = (adam[0], adam[1], adam[2], adam[3], adam[4], adam[5])
    held = keep.size > 0
    a = _LANES + o
    total = _ZERO
    for x in range(n):
        slope = _read(work, slopes + x, 5, 0)
        if held:
            slope *= _read(keep, free + x, 5, 0)
        first = _read(m, o + x, 5, 1)
        first += β1c * (slope - first)
        second = β2 * _read(v, o + x, 5, 2) + β2c * slope * slope
        _write(m, o + x, first, 5, 1)
        _write(v, o + x, second, 5, 2)
        _write(A, a + x, _read(A, a + x, 5, 3) - length * first / (spread * math.sqrt(second) + eps), 5, 3)
        size = abs(slope)
        top = _read(work, most + x, 5, 4)
        _write(work, most + x, size if size > top else top, 5, 4)
        total += size
    return total


@njit(**_SERIAL)
def _adam_plane(A, m, v, keep, work, below, here, above, slopes, most, half, adam, z, Z, Y, X, lanes, periodic):
    """-∇ of a plane and Adam, some rows at a time; returns sum and maximum of the slopes' moduli."""
    stride = lanes + 2
    for x in range(_ROWS * X):
        work[most + x] = _ZERO
    total = 0.0
    for y in range(0, Y, _ROWS):
        count = min(_ROWS, Y - y)
        for component in range(3):
            for k in range(count):
                row = (y + k) * stride
                if component == 0:
                    before, after = below + row, above + row
                elif component == 1:
                    before = here + _within(y + k - 1, Y, periodic) * stride
                    after = here + _within(y + k + 1, Y, periodic) * stride
                else:
                    before, after = here + row - 1, here + row + 1
                _slopes(work, slopes + k * X, before, after, half[component], lanes)
            free = (z * Y + y) * X
            o = component * Z * Y * X + free
            total += _adam_rows(A, m, v, o, keep, free, work, slopes, most, count * X, adam)
    top = _ZERO
    for x in range(_ROWS * X):
        top = max(top, work[most + x])
    return total, top


@njit(**_PARALLEL)
def _adam(
    g, A, m, v, keep, scratch, sums, highest, half, adam, Z, Y, X, periodic, index_y, taps_y, index_x, taps_x, r
):  # fmt: skip
    """Blur along y and x, three planes at a time; -∇, the transpose of div; Adam."""
    chunks = scratch.shape[0]
    lanes = -(-X // _LANES) * _LANES
    ends = (X - 1, 0) if periodic else (0, X - 1)
    stride = lanes + 2
    size = Y * stride
    for chunk in prange(chunks):
        work = scratch[chunk]
        planes = (index_y, taps_y, index_x, taps_x, r)
        first, last = chunk * Z // chunks, (chunk + 1) * Z // chunks
        slopes = 3 * size
        most = slopes + _ROWS * X + _LANES
        rows = most + _ROWS * X
        for z in range(first - 1, last + 1) if first < last else range(0):
            above = (z + 3) % 3 * size + 1
            source = _within(z, Z, periodic) * size + 1
            _blur_plane(g, source, stride, work, above, stride, work, rows, Y, X, lanes, ends, planes)
            if z > first:
                below, here = (z + 1) % 3 * size + 1, (z + 2) % 3 * size + 1
                sums[z - 1], highest[z - 1] = _adam_plane(
                    A, m, v, keep, work, below, here, above, slopes, most, half, adam, z - 1, Z, Y, X, lanes, periodic
                )
