"""The loops of the fused kernels for processors (numba, float32).

All of numba's code is in this one file, so that a change to any of it renews the compiled cache.

The blurs, -∇, Adam and div are plain loops, which LLVM vectorises for the processor at hand. It can where a loop's
arrays are arguments of a parallel loop whose body is one call, all inlined (numba then knows that they do not overlap),
where an index cannot be negative (`_at`), and where a blur's sums are not reassociated (that would push its weights out
of the registers: half the speed; the density gains a twentieth by it). The density takes `WIDE` floats at a time in
vectors of our own: in plain loops it was a quarter slower on AVX2 and two thirds slower on AVX-512. Square roots and
quotients come from the processor's estimates and a Newton step where LLVM has them.

Volumes that one pass hands to the next are flat: `SLACK` floats, then planes `pitch` apart of (Y + 4) × (X + 4), the
field with two samples of its continuation on every side, then `SLACK` floats. So a stencil reads its neighbours at
fixed distances wherever it stands, and a loop runs over several rows in one go; what it computes on the continuation is
right for one sample beyond the box and finite and unused for the second. A and Adam's moments are `(3, Z, Y, X)`
between the same slack. The last vector of a run overshoots its end, into what is computed later or never read.

Notation follows the plain-torch definition: s = |∇u|², d = s + ξ², G = √d, r = s/d, w = W'(u) = u³ - u, N = |Hess u|²,
q = ∇uᵀ Hess u ∇u / d, T = Tr M, P = |M|², X = 2P - T², S = √(X⁺), all in the units of `cpu._make_constants`. The root
and what is taken as its derivative at umbilics, X = 0, are `curvature.positive_root`.

The density and its adjoint (`_differentiate`), by hand since autograd would store some thirty fields. Write g = ∇u and
D = Hess u, so that M = w g⊗g/d - D in these units (paper, eq. 7), and

    T = w r - tr D,    P = |M|² = N - 2 w q + (w r)²,    X = 2P - T².

With |M|² = (X + T²)/2 in eq. 20 the density is a polynomial in T, S, G and one term in X, with weights `of_…`:

    e = of_X X + of_T2 T² + of_TS T S + G (of_GT T + of_GS S) + of_s s.

Derivatives from the outside in, e_y being that by y. S depends on X alone, with S' = 1/2S (0 where X is not resolved),
and X on P and T, so

    e_S = of_TS T + of_GS G,            e_P = 2 of_X + e_S/S,           e_G = of_GT T + of_GS S,
    e_T = (2 of_T2 - e_P) T + of_TS S + of_GT G.

T and P depend on u's three derivatives u, g, D through w, r, q, N and tr D. By the product w r it is
e_wr = e_T + 2 e_P w r. From ∂q/∂g = 2 (D g - q g)/d, ∂r/∂g = 2 ξ² g/d², ∂G/∂g = g/G and ∂s/∂g = 2 g,

    ∂e/∂u = W''(u) (r e_wr - 2 q e_P),
    ∂e/∂g = (2 of_s + e_G/G + 4 w e_P q/d + 2 ξ² w e_wr/d²) g - (4 w e_P/d) D g,
    ∂e/∂D = 2 e_P D - e_T I - (2 w e_P/d) g⊗g.

The gradient with respect to the voxels is the transpose of the stencils applied to these: a central difference sends
±∂e/∂g to two neighbours, a second difference ∂e/∂D to two and -2 of it to the centre, a mixed one ±∂e/∂D to the four
on the diagonals. The sums go to each receiver (`PARTIALS`), and `_gather` adds them plane by plane, as soon as
the three planes that a voxel hears from are there: no field but u and the gradient is ever held.

The order of every sum does not depend on the number of threads.
"""

from __future__ import annotations

import math
import operator
from functools import partial
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import config, njit, prange, types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

from curvafit.priors.kernels.threads import Kernel

#: Fast-math without the assumption that no value is NaN or infinite: a diverged flow must show.
_FLAGS = {"contract", "arcp", "nsz", "afn"}
_PLAIN: dict[str, Any] = {"fastmath": _FLAGS, "error_model": "numpy", "nogil": True}
#: Parts are compiled into their callers and need no wrappers for Python.
_PART: dict[str, Any] = {**_PLAIN, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_INLINE: dict[str, Any] = {**_PART, "forceinline": True}
_SUMS = {"fastmath": _FLAGS | {"reassoc"}}
_SERIAL: dict[str, Any] = {**_PART, **_SUMS}
_SUMMING: dict[str, Any] = {**_INLINE, **_SUMS}
_COUNTING: dict[str, Any] = {**_PLAIN, "forceinline": True, "cache": True}
_PARALLEL: dict[str, Any] = {**_PLAIN, **_SUMS, "cache": True}

#: The processor's features that numba compiles for: the host's, unless numba's settings give others.
_CONFIGURED = getattr(config, "CPU_FEATURES", None)
_FEATURES = llvm.get_host_cpu_features().flatten() if _CONFIGURED is None else _CONFIGURED
#: Floats of a vector of the density: two of the processor's where it has the registers.
WIDE = 32 if "+avx512f" in _FEATURES.split(",") else 8
#: Floats before and after a flat volume.
SLACK = 64
#: Samples of the continuation on every side of a plane.
EDGE = 2
#: Rows that a blur computes at once, and weights that are unrolled (they are padded with zeros to a multiple of it).
BLUR_ROWS, TAPS = 4, 17
#: Rows that Adam takes at a time: whole vectors whatever X.
ADAM_ROWS = 16
#: Partial derivatives kept for a row: what goes to the six neighbours, to the centre, and along the diagonals.
PARTIALS = 10
_YM, _C, _ZM, _ZP, _XM, _XP, _ZX, _YP, _ZY, _YX = range(PARTIALS)
#: Floats of a strip in the blur along z: the twenty rows that four outputs need stay in the second-level cache.
_STRIP = 2048

_ZERO, _ONE, _TINY = (np.float32(value) for value in (0, 1, 1e-37))
#: Row lengths are rounded up to a multiple of so many floats.
LANES = 16
#: The phases of `adam_step`.
MOVE, ENDS, ALL = range(3)
#: An index that is not negative, so that numba need not count from the end.
_at = np.uint64


@njit(**_COUNTING)
def pitch(Y, X):
    """Return the number of floats from one plane to the next, with room for rounding up the last row."""
    return ((Y + 2 * EDGE) * (X + 2 * EDGE) + 2 * LANES - 1) & -LANES


@njit(**_COUNTING)
def row_length(X, taps):
    """Return the number of floats of a row with its continuation, rounded up."""
    return (X + taps + 2 * LANES) & -LANES


class _Vector(types.Type):
    def __init__(self, width: int) -> None:
        self.width = width
        super().__init__(f"float32x{width}")


# numba's decorators have no types that a checker can read.
_register: Any = register_model(_Vector)
_infer: Any = infer_global
_intrinsic: Any = intrinsic


@_register
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, vector) -> None:
        super().__init__(manager, vector, _ir(vector.width))


def _ir(width: int) -> ir.VectorType:
    """Return LLVM's type of a vector of floats."""
    return ir.VectorType(ir.FloatType(), width)


def _shuffle(builder, first, second, indices):
    return builder.shuffle_vector(first, second, ir.Constant(ir.VectorType(ir.IntType(32), len(indices)), indices))


def _splat(builder, number, width: int):
    """Fill a vector with one number."""
    undef = ir.Constant(_ir(width), ir.Undefined)
    return _shuffle(builder, builder.insert_element(undef, number, ir.IntType(32)(0)), undef, [0] * width)


def _declare(builder, name: str, result, arguments):
    """Declare an LLVM function once in a module."""
    declared = builder.module.globals.get(name)
    return declared or ir.Function(builder.module, ir.FunctionType(result, arguments), name)


def _define_operators(vector: _Vector) -> None:
    """Define v + v, v - v, v · v and v / v, also with a number on either side."""
    operand_types = ((vector, vector), (vector, types.float32), (types.float32, vector))
    cases = [signature(vector, *pair) for pair in operand_types]
    names = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
    for symbol, name in names.items():
        _infer(symbol)(type(f"{name}_{vector}", (ConcreteTemplate,), {"cases": cases}))

        def lower(context, builder, sig, values, name=name):
            first, second = (
                value if numba_type == vector else _splat(builder, value, vector.width)
                for value, numba_type in zip(values, sig.args, strict=True)
            )
            return getattr(builder, name)(first, second)

        for pair in operand_types:
            lower_builtin(symbol, *pair)(lower)


_VECTOR = _Vector(WIDE)
_define_operators(_VECTOR)


def _address(context, builder, array_type, values, width: int):
    """Return a vector's address in an array; the first two values are the array and an index from 0."""
    data = context.make_array(array_type)(context, builder, values[0]).data
    return builder.bitcast(builder.gep(data, [values[1]]), _ir(width).as_pointer())


@_intrinsic
def _load(typingctx, array, index):
    """Load floats `index` … of a flat float32 array."""

    def generate(context, builder, sig, values):
        return builder.load(_address(context, builder, sig.args[0], values, WIDE), align=4)

    return _VECTOR(array, types.intp), generate


@_intrinsic
def _fill(typingctx, number):
    """Fill a vector with one float."""

    def generate(context, builder, sig, values):
        return _splat(builder, values[0], WIDE)

    return _VECTOR(types.float32), generate


@_intrinsic
def _store(typingctx, array, index, value):
    """Store: `array[index …] = value`."""

    def generate(context, builder, sig, values):
        builder.store(values[2], _address(context, builder, sig.args[0], values, sig.args[2].width), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), generate


@_intrinsic
def _store_first(typingctx, array, index, value, count):
    """Store the first `count` floats of a vector."""

    def generate(context, builder, sig, values):  # emits a store of the lanes whose number is below `count`
        width = value.width
        integers = ir.VectorType(ir.IntType(64), width)
        undef = ir.Constant(integers, ir.Undefined)
        limits = _shuffle(builder, builder.insert_element(undef, values[3], ir.IntType(32)(0)), undef, [0] * width)
        mask = builder.icmp_signed("<", ir.Constant(integers, list(range(width))), limits)
        address = _address(context, builder, sig.args[0], values, width)
        argument_types = [_ir(width), address.type, ir.IntType(32), mask.type]
        store = _declare(builder, f"llvm.masked.store.v{width}f32.p0", ir.VoidType(), argument_types)
        builder.call(store, [values[2], address, ir.IntType(32)(4), mask])
        return context.get_dummy_value()

    return types.void(array, types.intp, value, types.intp), generate


@_intrinsic
def _inverse_root(typingctx, value, one):
    """Compute 1/√value of positive floats. `one` is a vector of ones.

    LLVM takes the processor's estimate and a Newton step.
    """

    def generate(context, builder, sig, values):
        x, one = values
        root = _declare(builder, f"llvm.sqrt.v{value.width}f32", _ir(value.width), [_ir(value.width)])
        return builder.fdiv(one, builder.call(root, [x], fastmath=tuple(_FLAGS)), flags=tuple(_FLAGS))

    return value(value, value), generate


@_intrinsic
def _where_above(typingctx, value, bound, yes, no):
    """Choose `yes` where value > bound, else `no`."""

    def generate(context, builder, sig, values):
        x, bound, yes, no = values
        return builder.select(builder.fcmp_ordered(">", x, bound), yes, no)

    return value(value, value, value, value), generate


@_intrinsic
def _sum(typingctx, value):
    """Add a vector's floats."""

    def generate(context, builder, sig, values):
        name = f"llvm.vector.reduce.fadd.v{value.width}f32"
        function = _declare(builder, name, ir.FloatType(), [ir.FloatType(), _ir(value.width)])
        return builder.call(function, [ir.FloatType()(0.0), *values], fastmath=("reassoc",))

    return types.float32(value), generate


@njit(**_SERIAL)
def _scale(value, ratios, which):
    """Multiply by one of the spacings' ratios, where they differ."""
    if ratios is None:
        return value
    return value * ratios[which]


@njit(**_SERIAL)
def _read_cost(k, mask, cell):
    """Read (h/ε)², the floor of X, the weights of X, T², TS, GT, GS and s, and twice those of X, T² and s: constants of
    `k`, times the `mask` where it is not None."""
    if mask is None:
        return (
            _fill(k[7]), _fill(k[8]), _fill(k[9]), _fill(k[10]), _fill(k[11]), _fill(k[12]), _fill(k[13]), _fill(k[14]),
            _fill(k[15]), _fill(k[16]), _fill(k[17]),
        )  # fmt: skip
    m = _load(mask, cell)
    return (
        _fill(k[7]), _fill(k[8]), m * k[9], m * k[10], m * k[11], m * k[12], m * k[13], m * k[14], m * k[15],
        m * k[16], m * k[17],
    )  # fmt: skip


@njit(**_SERIAL)
def _differentiate(u, m, c, p, stride, n, ring, size, at, inside, inside_at, k, ratios, mask):
    """Compute the energy of n cells; store the partial derivatives from `at` on in the ring's ten arrays, `size` apart.

    `m`, `c`, `p` are the cells' offsets in the planes z-1, z, z+1 of u; `inside`, from `inside_at` on, is 1 in cells of
    the box, else 0. Differences are in units of the spacing, and the constants `k` are scaled so; these are read where
    they are used, since in registers they would push the variables out. A `mask` multiplies the density.
    """
    energy = _fill(k[1])
    for i in range(0, n, WIDE):
        ξ2, zero, quarter = _fill(k[0]), _fill(k[1]), _fill(k[3])
        one, two, three = _fill(k[4]), _fill(k[5]), _fill(k[6])
        well, low, of_X, of_T2, of_TS, of_GT, of_GS, of_s, two_X, two_T2, two_s = _read_cost(k, mask, c + i)
        u_ = _load(u, c + i)
        zm, zp = _load(u, m + i), _load(u, p + i)
        ym, yp = _load(u, c + i - stride), _load(u, c + i + stride)
        xm, xp = _load(u, c + i - 1), _load(u, c + i + 1)
        gz, gy, gx = _scale(zp - zm, ratios, 0), _scale(yp - ym, ratios, 1), _scale(xp - xm, ratios, 2)
        twice = u_ + u_
        zz, yy = _scale((zp + zm) - twice, ratios, 3), _scale((yp + ym) - twice, ratios, 4)
        xx = _scale((xp + xm) - twice, ratios, 5)
        zy = (_load(u, p + i + stride) + _load(u, m + i - stride)) - (
            _load(u, p + i - stride) + _load(u, m + i + stride)
        )
        zx = (_load(u, p + i + 1) + _load(u, m + i - 1)) - (_load(u, p + i - 1) + _load(u, m + i + 1))
        yx = (_load(u, c + i + stride + 1) + _load(u, c + i - stride - 1)) - (
            _load(u, c + i + stride - 1) + _load(u, c + i - stride + 1)
        )
        zy, zx = _scale(quarter * zy, ratios, 6), _scale(quarter * zx, ratios, 7)
        yx = _scale(quarter * yx, ratios, 8)
        # The density; `i_…` are inverses. Shared terms are computed once, and late, since registers run out.
        gzz, gyy, gxx = gz * gz, gy * gy, gx * gx
        s = gzz + gyy + gxx
        d = s + ξ2
        i_G = _inverse_root(d, one)
        i_d, G = i_G * i_G, d * i_G
        damping = ξ2 * i_d  # 1 - r, by which ξ dampens the normal
        r = one - damping
        u2 = u_ * u_
        w = u_ * (well * u2 - well)
        N = (zz * zz + yy * yy + xx * xx) + two * (zy * zy + zx * zx + yx * yx)
        hz = gz * zz + gy * zy + gx * zx
        hy = gz * zy + gy * yy + gx * yx
        hx = gz * zx + gy * yx + gx * xx
        q = (gz * hz + gy * hy + gx * hx) * i_d
        wr = w * r
        T = wr - (zz + yy + xx)
        T2 = T * T
        squares = N + wr * wr
        X = two * (squares - (w + w) * q) - T2
        floored = _where_above(X, low, X, low)
        i_S = _inverse_root(floored, one)
        S = floored * i_S
        TS = of_TS * T
        e_S = TS + of_GS * G
        e_G = of_GT * T + of_GS * S
        e = of_X * X + of_T2 * T2 + TS * S + G * e_G + of_s * s
        energy = energy + e * _load(inside, inside_at + i)
        # Its derivatives, from the outside in, as at the file's head. The root's is zero where X is not resolved
        # (`curvature.positive_root`); `e_q` and `e_s` are the factors of D g and g in ∂e/∂g.
        slope = _where_above(X, low, i_S, zero)
        e_P = two_X + e_S * _where_above(X, squares * k[18], slope, zero)
        e_T = T * (two_T2 - e_P) + (of_TS * S + of_GT * G)
        P2 = e_P + e_P
        e_wr = e_T + P2 * wr
        half_Q = w * e_P * i_d
        Q = half_Q + half_Q
        e_q = Q + Q
        e_w = r * e_wr - P2 * q
        e_s = two_s + e_G * i_G + e_q * q + two * damping * i_d * (w * e_wr)
        dz, dy, dx = e_s * gz - e_q * hz, e_s * gy - e_q * hy, e_s * gx - e_q * hx
        dz, dy, dx = _scale(dz, ratios, 0), _scale(dy, ratios, 1), _scale(dx, ratios, 2)
        dzz, dyy = _scale(P2 * zz - e_T - Q * gzz, ratios, 3), _scale(P2 * yy - e_T - Q * gyy, ratios, 4)
        dxx = _scale(P2 * xx - e_T - Q * gxx, ratios, 5)
        # What each neighbour receives: the stencils' coefficients times the derivatives. Off the diagonal, N and q
        # count a component twice and the stencil divides by four, so a half of ∂e/∂D is left.
        o = at + i
        _store(ring, o + _C * size, e_w * (well * (three * u2) - well) - two * (dzz + dyy + dxx))
        _store(ring, o + _ZM * size, dzz - dz)
        _store(ring, o + _ZP * size, dzz + dz)
        _store(ring, o + _YM * size, dyy - dy)
        _store(ring, o + _YP * size, dyy + dy)
        _store(ring, o + _XM * size, dxx - dx)
        _store(ring, o + _XP * size, dxx + dx)
        Qz, Qy = half_Q * gz, half_Q * gy
        _store(ring, o + _ZY * size, _scale(e_P * zy - Qz * gy, ratios, 6))
        _store(ring, o + _ZX * size, _scale(e_P * zx - Qz * gx, ratios, 7))
        _store(ring, o + _YX * size, _scale(e_P * yx - Qy * gx, ratios, 8))
    return _sum(energy)


@njit(**_SERIAL)
def _gather(ring, size, at, stride, n, sums, below, centre, above, out, target):
    """Apply the transposed stencils to the partials of n cells, from `at` of the ring on: finish the plane below in
    `out`, and in `sums` add to this plane and begin the one above; `below`, `centre` and `above` are their offsets."""
    c, zm, zp = at + _C * size, at + _ZM * size, at + _ZP * size
    xm, xp, zx = at + _XM * size, at + _XP * size, at + _ZX * size
    yp, ym = at + _YP * size - stride, at + _YM * size + stride
    zy_m, zy_p = at + _ZY * size - stride, at + _ZY * size + stride
    yx_m, yx_p = at + _YX * size - stride, at + _YX * size + stride
    for i in range(0, n, WIDE):
        in_plane = _load(ring, c + i) + _load(ring, yp + i) + (_load(ring, ym + i) + _load(ring, xp + i - 1))
        in_plane = in_plane + _load(ring, xm + i + 1) + (_load(ring, yx_p + i + 1) - _load(ring, yx_p + i - 1))
        in_plane = in_plane + (_load(ring, yx_m + i - 1) - _load(ring, yx_m + i + 1))
        across = (_load(ring, zy_p + i) - _load(ring, zy_m + i)) + (_load(ring, zx + i + 1) - _load(ring, zx + i - 1))
        _store(out, target + i, _load(sums, below + i) + _load(ring, zm + i) + across)
        _store(sums, above + i, _load(ring, zp + i) - across)
        # This plane's sums are added to: a vector that overshoots would add to rows that have some already.
        if i + WIDE <= n:
            _store(sums, centre + i, _load(sums, centre + i) + in_plane)
        else:
            _store_first(sums, centre + i, _load(sums, centre + i) + in_plane, n - i)


@njit(**_SERIAL)
def _carry(ring, size, stride, count):
    """Move the rows that the next block still reads from the end of the ring's arrays to their beginning.

    Of `count` new rows, which start at row 2, these are the last one, or the last two in the arrays from `_YP` on.
    """
    distance = count * stride
    for array in range(_C, _YP):
        first = SLACK + array * size + stride
        for i in range(first, first + stride, WIDE):
            _store(ring, i, _load(ring, i + distance))
    for array in range(_YP, PARTIALS):
        first = SLACK + array * size
        for i in range(first, first + 2 * stride, WIDE):
            _store(ring, i, _load(ring, i + distance))


@njit(**_SERIAL)
def _fill_gradient_chunk(
    u, out, energies, ring, sums, inside, k, ratios, mask, index, first, last, y0, y1, block, Z, Y, stride,
):  # fmt: skip
    """Compute the gradient in planes first to last - 1, rows y0 to y1 - 1, from partials of one cell more around."""
    plane, size = pitch(Y, stride - 2 * EDGE), (ring.size - 2 * SLACK) // PARTIALS
    slot = (sums.size - 2 * SLACK) // 4
    for z in range(first - 1, last + 1):
        m, c, p = SLACK + index[z + 1] * plane, SLACK + index[z + 2] * plane, SLACK + index[z + 3] * plane
        below, centre, above = SLACK + (z + 2) % 3 * slot, SLACK + (z + 3) % 3 * slot, SLACK + (z + 4) % 3 * slot
        energy = 0.0
        y = y0 - 1
        while y <= y1:
            in_tile = y0 <= y < y1
            count = min(block, y1 - y) if in_tile else 1
            o = (y + EDGE) * stride
            # `inside` is `block` rows of ones, then of zeros: the energy of rows beyond the tile counts elsewhere.
            inside_at = (block - count if in_tile else block) * stride
            at = SLACK + 2 * stride
            energy += _differentiate(
                u, m + o, c + o, p + o, stride, count * stride, ring, size, at, inside, inside_at, k,
                ratios, mask,
            )  # fmt: skip
            # A row is gathered after the next one has its partials, so that the rows gathered are one behind.
            begin = max(y - 1, y0)
            n = (y + count - 1 - begin) * stride
            at += (begin - y) * stride
            row = (begin - y0) * stride
            if z > first:
                target = SLACK + (z - 1) * plane + (begin + EDGE) * stride
                _gather(ring, size, at, stride, n, sums, below + row, centre + row, above + row, out, target)
            else:  # the plane below is another chunk's
                discard = SLACK + 3 * slot
                _gather(ring, size, at, stride, n, sums, below + row, centre + row, above + row, sums, discard)
            _carry(ring, size, stride, count)
            y += count
        if first <= z < last:
            energies[z] = energy


@partial(Kernel, **_PARALLEL)
def fill_gradient(u, out, energies, rings, sums, inside, k, ratios, mask, index, block, tile, Z, Y, X):
    """Compute the energies of tiles of rows in planes, and the gradient."""
    chunks = rings.shape[0]
    for chunk in prange(chunks):
        first, last = chunk * Z // chunks, (chunk + 1) * Z // chunks
        if first < last:
            for y0 in range(0, Y, tile):
                _fill_gradient_chunk(
                    u, out, energies[y0 // tile], rings[chunk], sums[chunk], inside, k, ratios, mask, index,
                    first, last, y0, min(Y, y0 + tile), block, Z, Y, X + 2 * EDGE,
                )  # fmt: skip


def _blur_across(begins: bool):
    """Return the loop over the first `TAPS` weights of a blur across rows, or over the next ones."""

    @njit(**_INLINE)
    def blur(source, source_at, stride, index, first, out, target, out_stride, n, taps, j0, shift):
        """Add source rows times `TAPS` weights, from j0 on, to four output rows, which begin as the number `shift`."""
        for i in range(n):
            if begins:
                a = b = c = d = shift
            else:
                a, b = out[_at(target + i)], out[_at(target + out_stride + i)]
                c, d = out[_at(target + 2 * out_stride + i)], out[_at(target + 3 * out_stride + i)]
            for j in range(TAPS + BLUR_ROWS - 1):
                row = source[_at(source_at + index[_at(first + j0 + j)] * stride + i)]
                if j < TAPS:
                    a += row * taps[_at(j0 + j)]
                if 1 <= j <= TAPS:
                    b += row * taps[_at(j0 + j - 1)]
                if 2 <= j <= TAPS + 1:
                    c += row * taps[_at(j0 + j - 2)]
                if j >= 3:
                    d += row * taps[_at(j0 + j - 3)]
            out[_at(target + i)], out[_at(target + out_stride + i)] = a, b
            out[_at(target + 2 * out_stride + i)], out[_at(target + 3 * out_stride + i)] = c, d

    return blur


_begin_across, _add_across = _blur_across(True), _blur_across(False)


@njit(**_INLINE)
def _blur_rows(source, source_at, stride, index, first, out, target, out_stride, n, taps, shift):
    """Blur across rows: compute four rows of n floats, `out_stride` apart in `out` from `target` on.

    Weight t of the first output row multiplies the source row `index[first + t]`, of rows `stride` apart.
    """
    _begin_across(source, source_at, stride, index, first, out, target, out_stride, n, taps, 0, shift)
    for j0 in range(TAPS, taps.size, TAPS):
        _add_across(source, source_at, stride, index, first, out, target, out_stride, n, taps, j0, shift)


@njit(**_INLINE)
def _blur_z(chunk, chunks, source, out, base, Z, plane, index, taps, shift):
    """Blur a chunk of planes along z."""
    first, last = chunk * Z // chunks, (chunk + 1) * Z // chunks
    for strip in range(0, plane, _STRIP):
        n = min(_STRIP, plane - strip) & -LANES  # no other number: so LLVM sees that it is whole vectors
        for next_z in range(first, last, BLUR_ROWS):
            z = max(0, min(next_z, last - BLUR_ROWS))  # the last four overlap those before
            target = SLACK + strip + z * plane
            _blur_rows(source, SLACK + strip, plane, index, z, out, target, plane, n, taps, shift)
            if base.size > 0:
                for row in range(target, target + BLUR_ROWS * plane, plane):
                    for i in range(n):
                        out[_at(row + i)] += base[_at(row + i)]


@partial(Kernel, **_PARALLEL)
def blur_z(source, out, base, chunks, Z, plane, index, taps, shift):
    """Blur along z, and add the number `shift` and, where it is not empty, the field `base`; four planes at a time.

    Every chunk has four planes or is the whole volume, which has room for four.
    """
    for chunk in prange(chunks):
        _blur_z(np.int64(chunk), chunks, source, out, base, Z, plane, index, taps, shift)


@njit(**_INLINE)
def _continue_rows(rows, start, length, X, r, index):
    """Continue four rows, `length` apart, by r samples on both sides; their samples are from start + r on."""
    for j in range(r):
        left, right = r + index[_at(j)], r + index[_at(r + X + j)]
        for k in range(BLUR_ROWS):
            row = start + k * length
            rows[_at(row + j)] = rows[_at(row + left)]
            rows[_at(row + r + X + j)] = rows[_at(row + right)]


def _blur_along(begins: bool):
    """Return the loop over the first `TAPS` weights of a blur along rows, or over the next ones."""

    @njit(**_INLINE)
    def blur(rows, first, out, target, n, taps, j0):
        """Add samples, from `first` on, times `TAPS` weights, from j0 on, to the n outputs of a row."""
        for i in range(n):
            total = _ZERO if begins else out[_at(target + i)]
            for j in range(TAPS):
                total += rows[_at(first + j0 + j + i)] * taps[_at(j0 + j)]
            out[_at(target + i)] = total

    return blur


_begin_along, _add_along = _blur_along(True), _blur_along(False)


@njit(**_INLINE)
def _blur_x(rows, start, length, count, out, target, X, taps, ends):
    """Blur along `count` continued rows, `length` apart from `start` on, into rows X + 2·EDGE apart, and continue these
    by two samples at both ends."""
    n = (X + LANES - 1) & -LANES
    for k in range(count):
        o, first = target + k * (X + 2 * EDGE), start + k * length
        _begin_along(rows, first, out, o, n, taps, 0)
        for j0 in range(TAPS, taps.size, TAPS):
            _add_along(rows, first, out, o, n, taps, j0)
        out[_at(o - 2)], out[_at(o - 1)] = out[_at(o + ends[0])], out[_at(o + ends[1])]
        out[_at(o + X)], out[_at(o + X + 1)] = out[_at(o + ends[2])], out[_at(o + ends[3])]


@njit(**_INLINE)
def _blur_plane(source, origin, size, rows, out, target, edge, Y, X, blur):
    """Blur a plane along y and x: from rows `size` apart, to rows -edge … Y + edge - 1 of `out`, row 0 at `target`.

    Four rows are blurred along y, then the previous four along x, whose values have arrived in memory by then.
    """
    index_y, taps_y, index_x, taps_x, ends, r = blur
    length = row_length(X, taps_x.size)
    n = (X + LANES - 1) & -LANES
    current, previous = 0, BLUR_ROWS * length
    for y in range(-edge, Y + edge + BLUR_ROWS, BLUR_ROWS):
        if y < Y + edge:
            _blur_rows(source, origin, size, index_y, y + EDGE, rows, current + r, length, n, taps_y, _ZERO)
            _continue_rows(rows, current, length, X, r, index_x)
        if y > -edge:
            done = y - BLUR_ROWS
            count = min(BLUR_ROWS, Y + edge - done)
            _blur_x(rows, previous, length, count, out, target + done * (X + 2 * EDGE), X, taps_x, ends)
        current, previous = previous, current


@njit(**_INLINE)
def _blur_in_planes(chunk, chunks, source, out, rows, shape, blur):
    """Blur a chunk of planes along y and x."""
    Z, Y, X = shape
    stride = X + 2 * EDGE
    for z in range(chunk * Z // chunks, (chunk + 1) * Z // chunks):
        o = SLACK + z * pitch(Y, X) + EDGE * stride + EDGE
        _blur_plane(source, o, stride, rows[chunk], out, o, 0, Y, X, blur)


@partial(Kernel, **_PARALLEL)
def blur_in_planes(source, out, rows, shape, blur):
    """Blur along y and x."""
    chunks = rows.shape[0]
    for chunk in prange(chunks):
        _blur_in_planes(np.int64(chunk), chunks, source, out, rows, shape, blur)


@njit(**_INLINE)
def _wrap_index(i, n, periodic):
    """Return the index inside for one that is at most 1 outside: at the other end if periodic, else at the nearest."""
    if i < 0:
        return n - 1 if periodic else 0
    if i >= n:
        return 0 if periodic else n - 1
    return i


@njit(**_INLINE)
def _divergence_plane(A, flux, half, z, shape, periodic):
    """Compute div A on a plane: central differences; beyond a mirror A changes sign, so that no flux crosses it."""
    Z, Y, X = shape
    size, n = Y * X, (X + LANES - 1) & -LANES
    Az, Ay, Ax = SLACK, SLACK + (Z + z) * size, SLACK + (2 * Z + z) * size
    odd = _ONE if periodic else -_ONE
    zm, zp = Az + _wrap_index(z - 1, Z, periodic) * size, Az + _wrap_index(z + 1, Z, periodic) * size
    half_zm, half_zp = half[0] * (odd if z == 0 else _ONE), half[0] * (odd if z == Z - 1 else _ONE)
    half_x, left, right = half[2], _wrap_index(-1, X, periodic), _wrap_index(X, X, periodic)
    for y in range(Y):
        half_ym, half_yp = half[1] * (odd if y == 0 else _ONE), half[1] * (odd if y == Y - 1 else _ONE)
        row, ym, yp = y * X, Ay + _wrap_index(y - 1, Y, periodic) * X, Ay + _wrap_index(y + 1, Y, periodic) * X
        o = Ax + row
        for i in range(n):
            total = A[_at(zp + row + i)] * half_zp - A[_at(zm + row + i)] * half_zm
            total += A[_at(yp + i)] * half_yp - A[_at(ym + i)] * half_ym
            flux[_at(row + i)] = total + (A[_at(o + i + 1)] - A[_at(o + i - 1)]) * half_x
        # The loop read the neighbouring rows' samples beyond both ends: put the continuation in their place.
        flux[_at(row)] += half_x * (A[_at(o - 1)] - odd * A[_at(o + left)])
        flux[_at(row + X - 1)] += half_x * (odd * A[_at(o + right)] - A[_at(o + X)])


@njit(**_SUMMING)
def _measure_sizes(slopes, n):
    """Return the sum of the moduli of n slopes, and the greatest modulus as the bits of its float32."""
    # As integers, the bits of positive floats have the order of the floats, and a NaN's are above all: it is not lost.
    bits = slopes.view(np.int32)
    total, highest = _ZERO, np.int32(0)
    for i in range(n):
        total += abs(slopes[_at(i)])
    for i in range(n):
        highest = max(highest, bits[_at(i)] & np.int32(0x7FFFFFFF))
    return total, highest


@njit(**_INLINE)
def _adam_rows(A, m, v, o, slopes, n, adam):
    """Make Adam's step on n samples of a component, from `o` on, by n slopes; `m` and `v` are Adam's moments.

    `adam` is 1 - β1, β2, 1 - β2, the corrected rate, the corrected factor of √v, and eps.
    """
    for i in range(n):
        slope = slopes[_at(i)]
        first = m[_at(o + i)]
        first += (slope - first) * adam[0]
        second = v[_at(o + i)] * adam[1] + slope * slope * adam[2]
        # A product with 1/√v, which processors estimate fast. Roots of less than `_TINY` are negligible beside eps.
        root = second * (_ONE / math.sqrt(max(second, _TINY)))
        m[_at(o + i)], v[_at(o + i)] = first, second
        A[_at(o + i)] -= first * adam[3] / (root * adam[4] + adam[5])


@njit(**_INLINE)
def _adam_plane(A, m, v, ring, slopes, below, here, above, half, adam, z, shape):
    """Make Adam's step of plane z of A along -∇, some rows at a time; return `_measure_sizes` of the plane's slopes.

    `below`, `here`, `above` are the first samples' offsets in the ring, which has planes with continued borders; A and
    the moments have none. `half` is 1 / 2h along each axis.
    """
    Z, Y, X = shape
    stride, whole = X + 2 * EDGE, (X + LANES - 1) & -LANES
    total, highest = 0.0, np.int32(0)
    for y in range(0, Y, ADAM_ROWS):
        count = min(ADAM_ROWS, Y - y)
        at = SLACK + (z * Y + y) * X
        for component in range(3):
            before, after = here - 1, here + 1
            if component == 0:
                before, after = below, above
            elif component == 1:
                before, after = here - stride, here + stride
            for k in range(count):
                row = (y + k) * stride
                for i in range(whole):
                    difference = ring[_at(before + row + i)] - ring[_at(after + row + i)]
                    slopes[_at(k * X + i)] = difference * half[_at(component)]
            _adam_rows(A, m, v, component * Z * Y * X + at, slopes, count * X, adam)
            rows_total, rows_highest = _measure_sizes(slopes, count * X)
            total += rows_total
            highest = max(highest, rows_highest)
    return total, highest


@njit(**_INLINE)
def _adam_chunk(
    chunk, phase, g, A, m, v, next_g, rows, rings, slopes, fluxes, sums, highest, half, adam, shape, periodic,
    index_z, blur,
):  # fmt: skip
    """Make `adam_step`'s step on a chunk of planes."""
    Z, Y, X = shape
    chunks, stride, plane = rows.shape[0], X + 2 * EDGE, pitch(Y, X)
    corner = EDGE * stride + EDGE
    first, last = chunk * Z // chunks, (chunk + 1) * Z // chunks
    for z in range(first - 1, last + 2):
        # Plane z of the gradient, then div A two planes behind: one call, which is inlined, blurs them in turn.
        for is_divergence in (False, True):
            if is_divergence:
                # The newest plane of A whose neighbours in this chunk have made Adam's step.
                z_moved = z - 2
                inner = first < z_moved < last - 1
                if not first <= z_moved < last or (phase != ALL and inner != (phase == MOVE)):
                    continue
                source, origin, size, out, edge = fluxes[chunk], 0, X, next_g, EDGE
                target = SLACK + z_moved * plane + corner
                _divergence_plane(A, source, half, z_moved, shape, periodic)
            else:
                if phase != MOVE or z > last:
                    continue
                source, size, out, edge = g, stride, rings[chunk], 1
                origin = SLACK + index_z[_at(z + 2)] * plane + corner
                target = SLACK + (z + 3) % 3 * plane + corner
            _blur_plane(source, origin, size, rows[chunk], out, target, edge, Y, X, blur)
            if not is_divergence and z > first:
                below, here = SLACK + (z + 1) % 3 * plane + corner, SLACK + (z + 2) % 3 * plane + corner
                sums[z - 1], highest[z - 1] = _adam_plane(
                    A, m, v, rings[chunk], slopes[chunk], below, here, target, half, adam, z - 1, shape
                )


@partial(Kernel, **_PARALLEL)
def adam_step(
    phase, g, A, m, v, out, rows, rings, slopes, fluxes, sums, highest, half, adam, shape, periodic, index_z, blur
):
    """Run the last pass of a step, in the phases `MOVE` and `ENDS`, or compute div A alone, of `ALL` planes.

    `MOVE` blurs the gradient along y and x, three planes at a time, applies -∇, the transpose of div, and Adam; as soon
    as a plane's neighbours have moved, while A is in the cache, it computes the next step's div A, blurred along y and
    x. `ENDS` does so for the planes whose neighbours another thread moved.
    """
    for chunk in prange(rows.shape[0]):
        # numba infers a signed counter but makes an unsigned one: without int64, both would be compiled.
        _adam_chunk(
            np.int64(chunk), phase, g, A, m, v, out, rows, rings, slopes, fluxes, sums, highest, half, adam,
            shape, periodic, index_z, blur,
        )  # fmt: skip
