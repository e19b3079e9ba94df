"""F_ε with its gradient, and the step of the H⁻¹ flow, fused for processors (numba, float32).

All of numba's code is in this one file, so that a change to any of it renews the compiled cache.

Notation follows the plain-torch definition: s = |∇u|², d = s + ξ², G = √d, w = W'(u) = u³ - u, L = Δu, N = |Hess u|²,
Q = ∇uᵀ Hess u ∇u, T = Tr M, P = |M|², X = 2P - T², S = √(X⁺). In float32 the smooth positive part is 0 or X outside
|X| < 2e-5, and under the root's floor of 1e-6: X⁺ = max(X, 1e-6).

Rows of x are the unit of work. A loop over x reads and writes several rows; `_read` and `_write` tell the compiler that
the streams of one loop are disjoint, without which it would not vectorise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import get_num_threads, njit, prange, types
from numba.extending import intrinsic

from curvafit.priors.curvature import ROOT_FLOOR, XI
from curvafit.priors.grid import Grid
from curvafit.priors.stencils import gaussian_taps

#: All of fast-math but the leave to assume that no value is NaN or infinite: a diverged flow must show.
_FLAGS = {"reassoc", "contract", "arcp", "nsz", "afn"}
_SERIAL = {"cache": True, "fastmath": _FLAGS, "error_model": "numpy", "nogil": True}
_PARALLEL = {**_SERIAL, "parallel": True}

#: Partial derivatives kept for a row: one at the centre, then what goes to the six neighbours and along the diagonals.
_PARTIALS = 10
_C, _ZM, _ZP, _YM, _YP, _XM, _XP, _ZY, _ZX, _YX = range(_PARTIALS)
#: Taps are unrolled four pairs at a time; radii are padded with zero weights to a multiple of it.
_UNROLL = 4
#: Floats of a strip in the blur along z: 17 of them stay in the second-level cache.
_STRIP = 2048

_ONE, _TWO, _THREE, _FOUR = np.float32(1), np.float32(2), np.float32(3), np.float32(4)
_ZERO = np.float32(0)
_ξ2, _FLOOR = np.float32(XI**2), np.float32(ROOT_FLOOR)


class Statistics(NamedTuple):
    """What a step saw: the energy, and max and mean of |∂F_ε/∂A| over the voxels that are free."""

    energy: float
    gradient_max: float
    gradient_mean: float


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
    if u.shape != grid.shape:
        raise ValueError(f"expected a field of shape {grid.shape}, got {u.shape}")
    padded = np.pad(np.asarray(u, np.float32), ((0, 0), (0, 0), (1, 1)), mode="wrap" if grid.periodic else "edge")
    gradient = np.empty(grid.shape, np.float32)
    scratch = _density_scratch(grid, get_num_threads())
    planes = np.empty(grid.shape[0])
    _energy_gradient(
        padded.ravel(), gradient.ravel(), planes, scratch, _density_constants(a, grid, epsilon), *grid.shape, grid.periodic
    )
    return float(planes.sum()), gradient


def gaussian_blur(u: np.ndarray, grid: Grid, width: float) -> np.ndarray:
    """k ∗ u in float32, as `stencils.gaussian_blur`."""
    if u.shape != grid.shape:
        raise ValueError(f"expected a field of shape {grid.shape}, got {u.shape}")
    Z, Y, X = grid.shape
    threads = get_num_threads()
    blur = _Blur.of(grid, width)
    source = np.ascontiguousarray(u, np.float32)
    along_z, out = np.empty((Z, Y * X), np.float32), np.empty((Z, Y, X), np.float32)
    _blur_z(source.reshape(Z, -1), along_z, blur.index[0], blur.taps[0], _ZERO, np.empty((0, 0), np.float32), threads)
    scratch = np.empty((threads, X + 2 * len(blur.taps[2])), np.float32)
    _blur_planes(along_z.ravel(), out.ravel(), scratch, Z, Y, X, *blur.index[1:], *blur.taps[1:])
    return out


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
        self.grid = grid
        self.taken = 0
        self._betas, self._adam_eps = betas, adam_eps
        self._vector = np.array(start, np.float32, order="C").reshape(3, -1)
        self._first, self._second = np.zeros_like(self._vector), np.zeros_like(self._vector)
        self._blur = _Blur.of(grid, width)
        self._half = np.array([0.5 / h for h in grid.spacing], np.float32)
        self._constants = _density_constants(a, grid, epsilon)
        self._mass, self._base = _ZERO, np.empty((0, 0), np.float32)
        if np.ndim(base) == 0:
            self._mass = np.float32(base)
        else:
            self._base = _padded_rows(np.asarray(base, np.float32), grid).reshape(Z, -1)
        self._free = Z * Y * X
        self._keep = np.empty(0, np.float32)
        if frozen is not None:
            self._keep = np.where(np.asarray(frozen, bool), _ZERO, _ONE).ravel().astype(np.float32)
            self._free = int(self._keep.sum())
        self._between = np.empty((Z, Y * (X + 2)), np.float32)
        self._field = np.empty((Z, Y * (X + 2)), np.float32)
        self._gradient, self._blurred = np.empty((Z, Y * X), np.float32), np.empty((Z, Y * X), np.float32)
        self._energies, self._sums, self._highest = np.empty(Z), np.empty(Z), np.empty(Z)
        self._threads = threads = get_num_threads()
        self._scratch = _density_scratch(grid, threads)
        row = X + 2 * len(self._blur.taps[2])
        self._div_scratch = np.empty((threads, Y * X + row), np.float32)
        self._adam_scratch = np.empty((threads, 3 * Y * (X + 2) + row + X), np.float32)

    @property
    def field(self) -> np.ndarray:
        """The phase field last computed, `(Z, Y, X)`: a view that the next step overwrites."""
        Z, Y, X = self.grid.shape
        return self._field.reshape(Z, Y, X + 2)[:, :, 1:-1]

    @property
    def vector(self) -> np.ndarray:
        """A, `(3, Z, Y, X)`: a view that the next step overwrites."""
        return self._vector.reshape(3, *self.grid.shape)

    def evaluate(self) -> float:
        """Compute u and the gradient of F_ε with respect to it; returns F_ε."""
        self.blur_divergence()
        self.blur_along_z(self._between, self._field)
        return self.energy_gradient()

    def update(self, rate: float) -> tuple[float, float]:
        """One Adam step of length `rate` along the gradient last evaluated; returns max and mean of |∂F_ε/∂A|."""
        self.blur_gradient_along_z()
        return self.blur_adam(rate)

    def step(self, rate: float) -> Statistics:
        """Evaluate and update."""
        return Statistics(self.evaluate(), *self.update(rate))

    def blur_divergence(self) -> None:
        """First part of a step: div A, blurred along y and x."""
        blur = self._blur
        _divergence(
            self._vector,
            self._between.ravel(),
            self._div_scratch,
            self._half,
            *self.grid.shape,
            self.grid.periodic,
            *blur.index[1:],
            *blur.taps[1:],
        )

    def blur_along_z(self, source: np.ndarray | None = None, out: np.ndarray | None = None) -> None:
        """Second part: the blur along z, and the base added."""
        source, out = self._between if source is None else source, self._field if out is None else out
        _blur_z(source, out, self._blur.index[0], self._blur.taps[0], self._mass, self._base, self._threads)

    def energy_gradient(self) -> float:
        """Third part: F_ε and its gradient with respect to u."""
        _energy_gradient(
            self._field.ravel(),
            self._gradient.ravel(),
            self._energies,
            self._scratch,
            self._constants,
            *self.grid.shape,
            self.grid.periodic,
        )
        return float(self._energies.sum())

    def blur_gradient_along_z(self) -> None:
        """Fourth part: the gradient's blur along z."""
        nothing = np.empty((0, 0), np.float32)
        _blur_z(self._gradient, self._blurred, self._blur.index[0], self._blur.taps[0], _ZERO, nothing, self._threads)

    def blur_adam(self, rate: float) -> tuple[float, float]:
        """Last part: the gradient's blur along y and x, -∇ of it, and Adam."""
        self.taken += 1
        β1, β2 = self._betas
        length, spread = rate / (1 - β1**self.taken), 1 / math.sqrt(1 - β2**self.taken)
        blur = self._blur
        _adam(
            self._blurred.ravel(),
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
            *(_continuation(n, 1, self.grid.periodic) for n in self.grid.shape),
            *blur.index[1:],
            *blur.taps[1:],
        )
        return float(self._highest.max()), float(self._sums.sum()) / max(1, 3 * self._free)


class _Blur(NamedTuple):
    """Per axis: which sample continues the row at each index, and the weights of offsets 0, 1, … (padded)."""

    index: tuple[np.ndarray, np.ndarray, np.ndarray]
    taps: tuple[np.ndarray, np.ndarray, np.ndarray]

    @classmethod
    def of(cls, grid: Grid, width: float) -> _Blur:
        taps = [_one_sided(width / h) for h in grid.spacing]
        index = [_continuation(n, len(w) - 1, grid.periodic) for n, w in zip(grid.shape, taps, strict=True)]
        return cls(tuple(index), tuple(taps))  # type: ignore[arg-type]


def _one_sided(deviation: float) -> np.ndarray:
    """Weights of offsets 0 … r with r a multiple of the unrolling; a width of zero is the identity."""
    if deviation == 0:
        return np.array([1, *[0] * _UNROLL], np.float32)
    taps = gaussian_taps(deviation)
    one_sided = taps[len(taps) // 2 :]
    radius = _UNROLL * math.ceil((len(one_sided) - 1) / _UNROLL)
    return np.array(one_sided + (0.0,) * (radius + 1 - len(one_sided)), np.float32)


def _continuation(n: int, width: int, periodic: bool) -> np.ndarray:
    """Which of n samples stands at -width … n + width - 1."""
    index = np.arange(-width, n + width)
    if periodic:
        return index % n
    index = index % (2 * n)
    return np.where(index < n, index, 2 * n - 1 - index)


def _padded_rows(u: np.ndarray, grid: Grid) -> np.ndarray:
    return np.pad(u, ((0, 0), (0, 0), (1, 1)), mode="wrap" if grid.periodic else "edge")


def _density_scratch(grid: Grid, threads: int) -> np.ndarray:
    """For each thread three rows of partial derivatives, three planes of sums, and a row to discard into."""
    _, Y, X = grid.shape
    return np.zeros((threads, 3 * _PARTIALS * (X + 2) + 3 * Y * X + X), np.float32)


def _density_constants(a, grid: Grid, epsilon: float) -> np.ndarray:
    """ε and 1/ε, the six weights of the density (times the voxel's volume), and the nine stencils' factors."""
    a20, a11, a02, a10, a01, a00 = (float(value) * grid.voxel_volume for value in a)
    ε = float(epsilon)
    hz, hy, hx = grid.spacing
    weights = ((a20 + a02 - a11) / (2 * ε), a11 / (2 * ε), (a20 - a02) / (2 * ε), (a10 + a01) / 2, (a10 - a01) / 2, a00 * ε)
    first = (0.5 / hz, 0.5 / hy, 0.5 / hx)
    second = (1 / hz**2, 1 / hy**2, 1 / hx**2, 0.25 / (hz * hy), 0.25 / (hz * hx), 0.25 / (hy * hx))
    return np.array([ε, 1 / ε, *weights, *first, *second], np.float32)


def _scope_metadata(module, group: int, stream: int, streams: int):
    """Alias scopes of one stream: itself, and all others of its group."""
    domain = module.add_metadata([ir.MetaDataString(module, f"curvafit {group}")])
    scopes = [
        module.add_metadata([ir.MetaDataString(module, f"curvafit {group} {k}"), domain]) for k in range(streams)
    ]
    others = module.add_metadata([scope for k, scope in enumerate(scopes) if k != stream])
    return module.add_metadata([scopes[stream]]), others


def _tag(builder, instruction, group: int, stream: int):
    own, others = _scope_metadata(builder.module, group, stream, _STREAMS)
    instruction.set_metadata("alias.scope", own)
    instruction.set_metadata("noalias", others)


_STREAMS = 12


@intrinsic(prefer_literal=True)
def _read(typingctx, array, index, group, stream):
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


@intrinsic(prefer_literal=True)
def _write(typingctx, array, index, value, group, stream):
    """`array[index] = value`, with the promise of `_read`."""
    if not isinstance(group, types.IntegerLiteral) or not isinstance(stream, types.IntegerLiteral):
        return None
    numbers = group.literal_value, stream.literal_value

    def generate(context, builder, signature, values):
        data = context.make_array(signature.args[0])(context, builder, values[0]).data
        stored = builder.store(values[2], builder.gep(data, [values[1]]))
        _tag(builder, stored, *numbers)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.float32, group, stream), generate


# Streams of each group: 0 is only read.
_PARTIAL_GROUP, _GATHER_GROUP, _TAPS_GROUP, _DIV_GROUP, _ADAM_GROUP = 0, 1, 2, 3, 4


@njit(**_SERIAL)
def _partials_row(u, rows, ring, slot, X, k):
    """Energy of a row, and its partial derivatives into a slot of the ring, already times the stencils' factors.

    `rows` holds the nine rows of the neighbourhood, (z-1, z, z+1) × (y-1, y, y+1), as offsets into the padded field.
    """
    ε, i_ε = k[0], k[1]
    wP, wT2, wTS, wGT, wGS, ws = k[2], k[3], k[4], k[5], k[6], k[7]
    fz, fy, fx = k[8], k[9], k[10]
    fzz, fyy, fxx, fzy, fzx, fyx = k[11], k[12], k[13], k[14], k[15], k[16]
    mm, mc, mp, cm, cc, cp, pm, pc, pp = rows
    stride = X + 2
    ε2, i_ε2 = ε * ε, i_ε * i_ε
    total = _ZERO
    for x in range(X):
        i = x + 1
        u_ = _read(u, cc + i, 0, 0)
        zm, zp = _read(u, mc + i, 0, 0), _read(u, pc + i, 0, 0)
        ym, yp = _read(u, cm + i, 0, 0), _read(u, cp + i, 0, 0)
        xm, xp = _read(u, cc + x, 0, 0), _read(u, cc + i + 1, 0, 0)
        gz, gy, gx = fz * (zp - zm), fy * (yp - ym), fx * (xp - xm)
        twice = u_ + u_
        zz, yy, xx = fzz * (zp + zm - twice), fyy * (yp + ym - twice), fxx * (xp + xm - twice)
        zy = fzy * (
            (_read(u, pp + i, 0, 0) + _read(u, mm + i, 0, 0)) - (_read(u, pm + i, 0, 0) + _read(u, mp + i, 0, 0))
        )
        zx = fzx * (
            (_read(u, pc + i + 1, 0, 0) + _read(u, mc + x, 0, 0)) - (_read(u, pc + x, 0, 0) + _read(u, mc + i + 1, 0, 0))
        )
        yx = fyx * (
            (_read(u, cp + i + 1, 0, 0) + _read(u, cm + x, 0, 0)) - (_read(u, cp + x, 0, 0) + _read(u, cm + i + 1, 0, 0))
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
        total += wP * P + wT2 * T * T + wTS * T * S + G * (wGT * T + wGS * S) + ws * s
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
        dz, dy, dx = fz * (e_s * gz + e_q * hz), fy * (e_s * gy + e_q * hy), fx * (e_s * gx + e_q * hx)
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
def _close_row(ring, slot, X, periodic):
    """What of a row's partial derivatives the gather reads beyond its ends: the other end, or a mirror image in which
    what was differenced once along x is odd (the two neighbours' shares exchange)."""
    stride = X + 2
    xm, xp, zx, yx = slot + _XM * stride, slot + _XP * stride, slot + _ZX * stride, slot + _YX * stride
    if periodic:
        ring[xp], ring[xm + X + 1] = ring[xp + X], ring[xm + 1]
        for row in (zx, yx):
            ring[row], ring[row + X + 1] = ring[row + X], ring[row + 1]
    else:
        ring[xp], ring[xm + X + 1] = ring[xm + 1], ring[xp + X]
        for row in (zx, yx):
            ring[row], ring[row + X + 1] = -ring[row + 1], -ring[row + X]


@njit(**_SERIAL)
def _mirror_row(ring, slot, X):
    """A row's partial derivatives seen in a mirror across y."""
    stride = X + 2
    for i in range(1, X + 1):
        m, p = slot + _YM * stride + i, slot + _YP * stride + i
        ring[m], ring[p] = ring[p], ring[m]
        ring[slot + _ZY * stride + i] = -ring[slot + _ZY * stride + i]
        ring[slot + _YX * stride + i] = -ring[slot + _YX * stride + i]


@njit(**_SERIAL)
def _gather_row(ring, before, here, after, below, sums_below, centre, above, out, target, X, mirrored):
    """Apply the transposed stencils to a row: finish the plane below, add to this one, begin the one above.

    `before`, `here`, `after` are the slots of rows y-1, y, y+1; `sums_below` and `centre`, `above` offsets of the row's
    sums (in `ring`, beyond the slots); `mirrored` says that the plane is seen in a mirror across z.
    """
    stride = X + 2
    to_below, to_above, sign = (_ZP, _ZM, -_ONE) if mirrored else (_ZM, _ZP, _ONE)
    c, yp, ym = here + _C * stride, before + _YP * stride, after + _YM * stride
    xp, xm = here + _XP * stride, here + _XM * stride
    zm, zp = here + to_below * stride, here + to_above * stride
    zy_b, zy_a, zx = before + _ZY * stride, after + _ZY * stride, here + _ZX * stride
    yx_b, yx_a = before + _YX * stride, after + _YX * stride
    for x in range(X):
        i = x + 1
        within = _read(ring, c + i, 1, 0) + _read(ring, yp + i, 1, 0) + _read(ring, ym + i, 1, 0)
        within += _read(ring, xp + x, 1, 0) + _read(ring, xm + i + 1, 1, 0)
        within += _read(ring, yx_a + i + 1, 1, 0) - _read(ring, yx_a + x, 1, 0)
        within += _read(ring, yx_b + x, 1, 0) - _read(ring, yx_b + i + 1, 1, 0)
        across = _read(ring, zy_a + i, 1, 0) - _read(ring, zy_b + i, 1, 0)
        across += _read(ring, zx + i + 1, 1, 0) - _read(ring, zx + x, 1, 0)
        across *= sign
        _write(out, target + x, _read(below, sums_below + x, 1, 1) + _read(ring, zm + i, 1, 0) + across, 1, 4)
        _write(below, centre + x, _read(below, centre + x, 1, 2) + within, 1, 2)
        _write(below, above + x, _read(ring, zp + i, 1, 0) - across, 1, 3)


@njit(**_SERIAL)
def _energy_gradient_chunk(u, out, planes, scratch, k, first, last, Z, Y, X, periodic):
    """Planes first … last - 1 of the gradient, with a halo of one plane computed on either side."""
    stride = X + 2
    slot_size = _PARTIALS * stride
    sums = 3 * slot_size
    discard = sums + 3 * Y * X
    for j in range(sums, discard):
        scratch[j] = _ZERO
    for z in range(first - 1, last + 1):
        mirrored = not periodic and (z < 0 or z >= Z)
        zc = _within(z, Z, periodic)
        zm, zp = _within(zc - 1, Z, periodic), _within(zc + 1, Z, periodic)
        below, centre, above = sums + (z + 2) % 3 * Y * X, sums + (z + 3) % 3 * Y * X, sums + (z + 4) % 3 * Y * X
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
            row_energy = _partials_row(u, rows, scratch, slot, X, k)
            if 0 <= y < Y:
                energy += row_energy
            elif not periodic:
                _mirror_row(scratch, slot, X)
            _close_row(scratch, slot, X, periodic)
            if y < 1:
                continue
            row = (y - 1) * X
            before, here = (y - 1) % 3 * slot_size, y % 3 * slot_size
            if z - 1 >= first:
                _gather_row(
                    scratch, before, here, slot, scratch, below + row, centre + row, above + row,
                    out, ((z - 1) * Y + y - 1) * X, X, mirrored,
                )  # fmt: skip
            else:
                _gather_row(
                    scratch, before, here, slot, scratch, below + row, centre + row, above + row,
                    scratch, discard, X, mirrored,
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
def _energy_gradient(u, out, planes, scratch, k, Z, Y, X, periodic):
    chunks = scratch.shape[0]
    for chunk in prange(chunks):
        first, last = chunk * Z // chunks, (chunk + 1) * Z // chunks
        if first < last:
            _energy_gradient_chunk(u, out, planes, scratch[chunk], k, first, last, Z, Y, X, periodic)


@njit(**_SERIAL)
def _taps(out, target, source, n, c, a1, b1, a2, b2, a3, b3, a4, b4, w0, w1, w2, w3, w4, begin, shift):
    """Four pairs of taps on a row of n: begin it (with the centre's weight and a shift) or add to it."""
    if begin:
        for x in range(n):
            near = w1 * (_read(source, a1 + x, 2, 0) + _read(source, b1 + x, 2, 0))
            near += w2 * (_read(source, a2 + x, 2, 0) + _read(source, b2 + x, 2, 0))
            far = w3 * (_read(source, a3 + x, 2, 0) + _read(source, b3 + x, 2, 0))
            far += w4 * (_read(source, a4 + x, 2, 0) + _read(source, b4 + x, 2, 0))
            _write(out, target + x, w0 * _read(source, c + x, 2, 0) + shift + (near + far), 2, 1)
    else:
        for x in range(n):
            near = w1 * (_read(source, a1 + x, 2, 0) + _read(source, b1 + x, 2, 0))
            near += w2 * (_read(source, a2 + x, 2, 0) + _read(source, b2 + x, 2, 0))
            far = w3 * (_read(source, a3 + x, 2, 0) + _read(source, b3 + x, 2, 0))
            far += w4 * (_read(source, a4 + x, 2, 0) + _read(source, b4 + x, 2, 0))
            _write(out, target + x, _read(out, target + x, 2, 1) + (near + far), 2, 1)


@njit(**_SERIAL)
def _blur_row(out, target, source, origin, n, index, i, size, taps, shift):
    """Row i of a blur across rows: `index` says which row stands where, rows are `size` apart from `origin` on."""
    r = taps.size - 1
    m = i + r
    c = origin + index[m] * size
    for j in range(0, r, _UNROLL):
        _taps(
            out, target, source, n, c,
            origin + index[m + j + 1] * size, origin + index[m - j - 1] * size,
            origin + index[m + j + 2] * size, origin + index[m - j - 2] * size,
            origin + index[m + j + 3] * size, origin + index[m - j - 3] * size,
            origin + index[m + j + 4] * size, origin + index[m - j - 4] * size,
            taps[0], taps[j + 1], taps[j + 2], taps[j + 3], taps[j + 4], j == 0, shift,
        )  # fmt: skip


@njit(**_SERIAL)
def _blur_x(out, target, row, start, X, index, taps):
    """Blur along a row that stands in `row` from start + r on; its continuation is filled in here."""
    r = taps.size - 1
    for j in range(r):
        row[start + j] = row[start + r + index[j]]
        row[start + r + X + j] = row[start + r + index[r + X + j]]
    m = start + r
    for j in range(0, r, _UNROLL):
        _taps(
            out, target, row, X, m,
            m + j + 1, m - j - 1, m + j + 2, m - j - 2, m + j + 3, m - j - 3, m + j + 4, m - j - 4,
            taps[0], taps[j + 1], taps[j + 2], taps[j + 3], taps[j + 4], j == 0, _ZERO,
        )  # fmt: skip


@njit(**_PARALLEL)
def _blur_z(source, out, index, taps, shift, base, chunks):
    """Blur `(Z, L)` along z, plus a number and, where there is one, a field; strip by strip."""
    Z, L = source.shape
    flat, flat_out, flat_base = source.ravel(), out.ravel(), base.ravel()
    for chunk in prange(chunks):
        first, last = chunk * Z // chunks, (chunk + 1) * Z // chunks
        for strip in range(0, L, _STRIP):
            n = min(_STRIP, L - strip)
            for z in range(first, last):
                target = z * L + strip
                _blur_row(flat_out, target, flat, strip, n, index, z, L, taps, shift)
                if base.size > 0:
                    for x in range(n):
                        total = _read(flat_out, target + x, 2, 1) + _read(flat_base, target + x, 2, 0)
                        _write(flat_out, target + x, total, 2, 1)


@njit(**_PARALLEL)
def _blur_planes(source, out, scratch, Z, Y, X, index_y, index_x, taps_y, taps_x):
    """Blur along y and x."""
    chunks = scratch.shape[0]
    for chunk in prange(chunks):
        row = scratch[chunk]
        for z in range(chunk * Z // chunks, (chunk + 1) * Z // chunks):
            for y in range(Y):
                _blur_row(row, taps_x.size - 1, source, z * Y * X, X, index_y, y, X, taps_y, _ZERO)
                _blur_x(out, (z * Y + y) * X, row, 0, X, index_x, taps_x)


@njit(**_SERIAL)
def _divergence_plane(Az, Ay, Ax, plane, half, z, Z, Y, X, periodic):
    """div A on a plane: central differences of an odd continuation (no flux through mirrors)."""
    zm, zp = _within(z - 1, Z, periodic) * Y * X, _within(z + 1, Z, periodic) * Y * X
    odd = _ONE if periodic else -_ONE
    fz_m, fz_p = half[0] * (odd if z == 0 else _ONE), half[0] * (odd if z == Z - 1 else _ONE)
    fx = half[2]
    for y in range(Y):
        fy_m, fy_p = half[1] * (odd if y == 0 else _ONE), half[1] * (odd if y == Y - 1 else _ONE)
        ym, yp = (z * Y + _within(y - 1, Y, periodic)) * X, (z * Y + _within(y + 1, Y, periodic)) * X
        o, row = (z * Y + y) * X, y * X
        for x in range(X):
            across = fz_p * _read(Az, zp + row + x, 3, 0) - fz_m * _read(Az, zm + row + x, 3, 0)
            _write(plane, row + x, across + fy_p * _read(Ay, yp + x, 3, 0) - fy_m * _read(Ay, ym + x, 3, 0), 3, 1)
        for x in range(1, X - 1):
            along = fx * (_read(Ax, o + x + 1, 3, 0) - _read(Ax, o + x - 1, 3, 0))
            _write(plane, row + x, _read(plane, row + x, 3, 1) + along, 3, 1)
        left, right = Ax[o + _within(-1, X, periodic)], Ax[o + _within(X, X, periodic)]
        plane[row] += fx * (Ax[o + 1] - odd * left)
        plane[row + X - 1] += fx * (odd * right - Ax[o + X - 2])


@njit(**_PARALLEL)
def _divergence(A, out, scratch, half, Z, Y, X, periodic, index_y, index_x, taps_y, taps_x):
    """div A blurred along y and x, into rows with one more sample at either end."""
    chunks = scratch.shape[0]
    Az, Ay, Ax = A[0], A[1], A[2]
    for chunk in prange(chunks):
        plane = scratch[chunk]
        start = Y * X
        for z in range(chunk * Z // chunks, (chunk + 1) * Z // chunks):
            _divergence_plane(Az, Ay, Ax, plane, half, z, Z, Y, X, periodic)
            for y in range(Y):
                _blur_row(plane, start + taps_x.size - 1, plane, 0, X, index_y, y, X, taps_y, _ZERO)
                target = (z * Y + y) * (X + 2) + 1
                _blur_x(out, target, plane, start, X, index_x, taps_x)
                out[target - 1] = out[target + _within(-1, X, periodic)]
                out[target + X] = out[target + _within(X, X, periodic)]


@njit(**_SERIAL)
def _adam_row(A, m, v, o, g, before, after, factor, keep, highest, most, X, adam):
    """Adam on a row of one component, whose gradient is factor·(g[before] - g[after]); returns the sum of moduli.

    The moduli's maximum is kept sample by sample in `highest`, from `most` on.
    """
    β1c, β2, β2c, length, spread, eps = adam[0], adam[1], adam[2], adam[3], adam[4], adam[5]
    total = _ZERO
    held = keep.size > 0
    for x in range(X):
        slope = factor * (_read(g, before + x, 4, 0) - _read(g, after + x, 4, 0))
        if held:
            slope *= _read(keep, o + x, 4, 0)
        first = _read(m, o + x, 4, 1)
        first += β1c * (slope - first)
        second = β2 * _read(v, o + x, 4, 2) + β2c * slope * slope
        _write(m, o + x, first, 4, 1)
        _write(v, o + x, second, 4, 2)
        step = length * first / (spread * math.sqrt(second) + eps)
        _write(A, o + x, _read(A, o + x, 4, 3) - step, 4, 3)
        size = abs(slope)
        most_ = _read(highest, most + x, 4, 4)
        _write(highest, most + x, size if size > most_ else most_, 4, 4)
        total += size
    return total


@njit(**_PARALLEL)
def _adam(
    g, A, m, v, keep, scratch, sums, highest, half, adam, Z, Y, X, near_z, near_y, near_x,
    index_y, index_x, taps_y, taps_x,
):  # fmt: skip
    """Blur along y and x, three planes at a time; -∇, the transpose of div; Adam."""
    chunks = scratch.shape[0]
    size = Y * (X + 2)
    for chunk in prange(chunks):
        work = scratch[chunk]
        first, last = chunk * Z // chunks, (chunk + 1) * Z // chunks
        start, most = 3 * size, 3 * size + X + 2 * taps_x.size
        for z in range(first - 1, last + 1) if first < last else range(0):
            plane = (z + 3) % 3 * size
            for y in range(Y):
                _blur_row(work, start + taps_x.size - 1, g, near_z[z + 1] * Y * X, X, index_y, y, X, taps_y, _ZERO)
                target = plane + y * (X + 2) + 1
                _blur_x(work, target, work, start, X, index_x, taps_x)
                work[target - 1] = work[target + near_x[0]]
                work[target + X] = work[target + near_x[X + 1]]
            if z > first:
                total = 0.0
                for x in range(X):
                    work[most + x] = _ZERO
                below, here = (z + 1) % 3 * size + 1, (z + 2) % 3 * size + 1
                for y in range(Y):
                    o, row = ((z - 1) * Y + y) * X, y * (X + 2)
                    ym, yp = here + near_y[y] * (X + 2), here + near_y[y + 2] * (X + 2)
                    total += _adam_row(
                        A[0], m[0], v[0], o, work, below + row, plane + 1 + row, half[0], keep, work, most, X, adam
                    )
                    total += _adam_row(A[1], m[1], v[1], o, work, ym, yp, half[1], keep, work, most, X, adam)
                    total += _adam_row(
                        A[2], m[2], v[2], o, work, here + row - 1, here + row + 1, half[2], keep, work, most, X, adam
                    )
                sums[z - 1] = total
                top = _ZERO
                for x in range(X):
                    top = max(top, work[most + x])
                highest[z - 1] = top
