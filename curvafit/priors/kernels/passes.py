"""Triton's part of `cuda`: one function per launch, each thread a cell of a plane. It needs triton to be imported.

Threads of a warp stand side by side along x, so that every access of a warp is one piece. Where a thread takes a group
of WIDTH neighbouring cells, rows hold G groups, and arrays begin at multiples of 16 bytes. Nothing is shared between
threads but through global memory, and no two write to one place. Sizes are plain arguments: a kernel is compiled once
for a boundary and a blur, whatever the grid. Places within a shape are 32-bit numbers. Sums have a fixed order.

A walk along an axis visits n samples and their continuation beyond the ends by counting up to a period: n, or 2n where
the second half is the mirror image.
"""
# ruff: noqa: RUF005, SIM108 (tuples grow by addition, branches on constants are statements)
# pyright: reportMissingImports=false, reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportReturnType=false, reportAttributeAccessIssue=false

from __future__ import annotations

import triton
import triton.language as tl

from curvafit.priors.curvature import ROOT_FLOOR, ROOT_ROUNDING, XI

_XI2 = tl.constexpr(XI**2)
_FLOOR = tl.constexpr(ROOT_FLOOR)
_ROUNDING = tl.constexpr(ROOT_ROUNDING)

#: Volumes of partial derivatives that `density` leaves for `gather`: what stays, what comes from the cell after and
#: before along y and along x, and what goes along the four diagonals of the plane.
VOLUMES = 6
_STAY, _Y_AFTER, _Y_BEFORE, _X_AFTER, _X_BEFORE, _DIAGONAL = (tl.constexpr(k) for k in range(VOLUMES))


@triton.jit(do_not_specialize=["Z", "Y", "G"])
def divergence_blur_z(
    A, out, Z, Y, G, half_y, half_x,
    TAPS: tl.constexpr, SLOPES: tl.constexpr, RADIUS: tl.constexpr, PERIODIC: tl.constexpr,
    ROWS: tl.constexpr, LANES: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Blur div A along z. SLOPES are the taps after a central difference, one longer at either end than TAPS, which
    has a zero there; both have 2 RADIUS + 1 entries."""
    X = G * WIDTH
    plane = Y * X
    first, place, group, y, x = _columns(Z, Y, G, ROWS, LANES, WIDTH)
    volume = Z * plane
    shape = tl.program_id(1).to(tl.int64)
    Az = A + shape * 3 * volume
    Ay, Ax = Az + volume, Az + 2 * volume
    cell = _wide(group * WIDTH, WIDTH)
    yb, ya = _wide(_before(y, Y, PERIODIC) * X + x, WIDTH), _wide(_after(y, Y, PERIODIC) * X + x, WIDTH)
    xb, xa = y * X + _before(x, X, PERIODIC), y * X + _after(x + WIDTH - 1, X, PERIODIC)
    wyb, wya, wxb, wxa = half_y, half_y, half_x, half_x
    if not PERIODIC:  # what is differenced is odd in a mirror: no flux
        wyb, wya = tl.where(y == 0, -half_y, half_y), tl.where(y == Y - 1, -half_y, half_y)
        wyb, wya = _lift(wyb, WIDTH), _lift(wya, WIDTH)
        wxb, wxa = tl.where(x == 0, -half_x, half_x), tl.where(x == X - WIDTH, -half_x, half_x)
    total = (_zero(LANES, WIDTH),) * ROWS
    walk = _begin(first, RADIUS, Z, PERIODIC)
    for j in tl.static_range(2 * RADIUS + ROWS):
        z, mirrored = _sample(walk, Z, PERIODIC)
        row = z * plane
        along = tl.load(Az + (row + cell))
        if not PERIODIC:
            along = tl.where(mirrored, -along, along)
        total = _spread(total, along, SLOPES, RADIUS, j, ROWS)
        if (j > 0) and (j < 2 * RADIUS + ROWS - 1):
            across = wya * tl.load(Ay + (row + ya)) - wyb * tl.load(Ay + (row + yb))
            across += _difference_x(Ax + row, cell, xb, xa, wxb, half_x, wxa, WIDTH)
            total = _spread(total, across, TAPS, RADIUS, j, ROWS)
        walk = _next(walk, Z, PERIODIC)
    out += shape * volume
    place = _lift(place, WIDTH)
    for k in tl.static_range(ROWS):
        z = first + k
        tl.store(out + (z * plane + cell), total[k], mask=_below(place, Y * G, z < Z))


@triton.jit(do_not_specialize=["numbers", "Z", "Y", "G", "apart_padded", "apart_out"])
def blur_plane(
    source, padded, out, base, numbers, Z, Y, G, apart_padded, apart_out,
    TAPS_Y: tl.constexpr, RADIUS_Y: tl.constexpr, TAPS_X: tl.constexpr, RADIUS_X: tl.constexpr, PAD: tl.constexpr,
    PERIODIC: tl.constexpr, ADD: tl.constexpr, ROWS: tl.constexpr, LANES: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Blur along y into rows of `padded`, which have room for PAD samples beyond either end; continue them; blur them
    along x into `out`. A program reads only those rows of `padded` that it wrote.

    ADD: nothing, a `"number"` a shape, or a `"field"` and a number. The shapes of `padded` and `out` stand so many
    groups apart.
    """
    blocks = tl.cdiv(Y, ROWS)
    first = tl.program_id(0) % blocks * ROWS
    z = (tl.program_id(0) // blocks).to(tl.int64)
    shape = tl.program_id(1).to(tl.int64)
    lane = tl.arange(0, LANES)
    X = G * WIDTH
    W = X + 2 * PAD
    source += (shape * Z + z) * Y * X
    padded += shape * apart_padded * WIDTH + z * Y * W + PAD
    for begin in range(0, G, LANES):
        cell = _wide(tl.minimum(begin + lane, G - 1) * WIDTH, WIDTH)
        place = _lift(begin + lane, WIDTH)
        total = (_zero(LANES, WIDTH),) * ROWS
        walk = _begin(first, RADIUS_Y, Y, PERIODIC)
        for j in tl.static_range(2 * RADIUS_Y + ROWS):
            y, _ = _sample(walk, Y, PERIODIC)
            total = _spread(total, tl.load(source + (y * X + cell)), TAPS_Y, RADIUS_Y, j, ROWS)
            walk = _next(walk, Y, PERIODIC)
        for k in tl.static_range(ROWS):
            y = first + k
            tl.store(padded + (y * W + cell), total[k], mask=_below(place, G, y < Y))
    tl.debug_barrier()
    for begin in range(0, 2 * RADIUS_X, LANES):
        place = begin + lane
        beyond = tl.where(place < RADIUS_X, place, place + X)
        x, _ = _sample(_begin(beyond, RADIUS_X, X, PERIODIC), X, PERIODIC)
        values = ()
        for k in tl.static_range(ROWS):
            values = values + (tl.load(padded + (tl.minimum(first + k, Y - 1) * W + x)),)
        for k in tl.static_range(ROWS):
            y = first + k
            mask = _below(place, 2 * RADIUS_X, y < Y)
            tl.store(padded + (y * W + beyond - RADIUS_X), values[k], mask=mask)
    tl.debug_barrier()
    shift = 0.0
    if ADD != "nothing":
        shift = tl.load(numbers + shape)
    if ADD == "field":
        base += (shape * Z + z) * Y * X
    out += shape * apart_out * WIDTH + z * Y * X
    for begin in range(0, G, LANES):
        cell = _wide(tl.minimum(begin + lane, G - 1) * WIDTH, WIDTH)
        place = _lift(begin + lane, WIDTH)
        values = ()
        for k in tl.static_range(ROWS):
            y = tl.minimum(first + k, Y - 1)
            parts = (tl.zeros((LANES,), tl.float32),) * WIDTH
            for q in tl.static_range(-((RADIUS_X + WIDTH - 1) // WIDTH), (RADIUS_X + WIDTH - 1) // WIDTH + 1):
                samples = _unpacked(tl.load(padded + (y * W + q * WIDTH + cell)), LANES, WIDTH)
                for e in tl.static_range(WIDTH):
                    parts = _spread(parts, samples[e], TAPS_X, RADIUS_X, q * WIDTH + e + RADIUS_X, WIDTH)
            value = _packed(parts, LANES, WIDTH) + shift
            if ADD == "field":
                value += tl.load(base + (y * X + cell))
            values = values + (value,)
        for k in tl.static_range(ROWS):
            y = first + k
            tl.store(out + (y * X + cell), values[k], mask=_below(place, G, y < Y))


@triton.jit(do_not_specialize=["u", "parts", "energies", "weights", "mask", "Z", "Y", "X", "apart", "planes"])
def density(
    u, parts, energies, weights, mask, Z, Y, X, apart, planes, eps,
    fz, fy, fx, fzz, fyy, fxx, fzy, fzx, fyx, Qzz, Qyy, Qxx, Qzy, Qzx, Qyx,
    PERIODIC: tl.constexpr, ENERGY: tl.constexpr, ORIENTED: tl.constexpr, VARIES: tl.constexpr, MASKED: tl.constexpr,
    LANES: tl.constexpr,
):  # fmt: skip
    """Compute the `VOLUMES` partial derivatives of F_ε's density, with the sums of transposed stencils along z.

    A program takes `planes` planes of a column of cells, and those on either side once more. `weights` are the
    density's six, a shape or (VARIES) a voxel, the latter with ε; Q is the orientation, times the voxel's volume. What
    comes of a voxel is multiplied by its `mask` (MASKED).
    """
    plane = Y * X
    chunks = tl.cdiv(Z, planes)
    first = tl.program_id(0) % chunks * planes
    last = tl.minimum(first + planes, Z)
    place, cell, y, x = _cells(tl.program_id(0) // chunks, Y, X, LANES)
    shape = tl.program_id(1).to(tl.int64)
    volume = Z * plane
    u += shape * volume
    parts += shape * apart
    stay, y_after, y_before = parts + _STAY * volume, parts + _Y_AFTER * volume, parts + _Y_BEFORE * volume
    x_after, x_before, diagonal = parts + _X_AFTER * volume, parts + _X_BEFORE * volume, parts + _DIAGONAL * volume
    yb, ya, xb, xa = _before(y, Y, PERIODIC), _after(y, Y, PERIODIC), _before(x, X, PERIODIC), _after(x, X, PERIODIC)
    rows, columns = (yb * X, y * X, ya * X), (xb, x, xa)
    weights += shape * (7 * volume if VARIES else 6)
    mask += shape * volume
    if not VARIES:
        wP, wT2, wTS = tl.load(weights), tl.load(weights + 1), tl.load(weights + 2)
        wGT, wGS, ws = tl.load(weights + 3), tl.load(weights + 4), tl.load(weights + 5)
    _, b_yb, _, b_xb, b_c, b_xa, _, b_ya, _ = _nine(u, _reflect(first - 2, Z, PERIODIC) * plane, rows, columns)
    bb, yb_, ba, xb_, c, xa_, ab, ya_, aa = _nine(u, _reflect(first - 1, Z, PERIODIC) * plane, rows, columns)
    zero = tl.zeros((LANES,), tl.float32)
    # Of the plane before: what waits for this plane's share, and what it hands on.
    p_stay, p_ya, p_yb, p_xa, p_xb = zero, zero, zero, zero, zero
    p_zp, p_zy, p_zx = zero, zero, zero
    energy = zero
    for z in tl.range(first - 1, last + 1, loop_unroll_factor=2):
        n_bb, n_yb, n_ba, n_xb, n_c, n_xa, n_ab, n_ya, n_aa = _nine(
            u, _reflect(z + 1, Z, PERIODIC) * plane, rows, columns
        )
        if VARIES:
            here = _reflect(z, Z, PERIODIC) * plane + cell
            wP, wT2 = tl.load(weights + here), tl.load(weights + volume + here)
            wTS, wGT = tl.load(weights + 2 * volume + here), tl.load(weights + 3 * volume + here)
            wGS, ws = tl.load(weights + 4 * volume + here), tl.load(weights + 5 * volume + here)
            ε = tl.load(weights + 6 * volume + here)
        else:
            ε = eps
        kept = 1.0
        if MASKED:
            kept = tl.load(mask + _reflect(z, Z, PERIODIC) * plane + cell)
        # Differences.
        gz, gy, gx = fz * (n_c - b_c), fy * (ya_ - yb_), fx * (xa_ - xb_)
        twice = c + c
        zz, yy, xx = fzz * (n_c + b_c - twice), fyy * (ya_ + yb_ - twice), fxx * (xa_ + xb_ - twice)
        zy = fzy * ((n_ya + b_yb) - (n_yb + b_ya))
        zx = fzx * ((n_xa + b_xb) - (n_xb + b_xa))
        yx = fyx * ((aa + bb) - (ab + ba))
        # The density; names as in `cpu`.
        i_ε = 1.0 / ε
        s = gz * gz + gy * gy + gx * gx
        d = s + _XI2
        i_G = tl.rsqrt(d)
        G, i_d = d * i_G, i_G * i_G
        r = s * i_d
        u2 = c * c
        w = c * (u2 - 1.0)
        N = zz * zz + yy * yy + xx * xx + 2.0 * (zy * zy + zx * zx + yx * yx)
        hz = gz * zz + gy * zy + gx * zx
        hy = gz * zy + gy * yy + gx * yx
        hx = gz * zx + gy * yx + gx * xx
        q = (gz * hz + gy * hy + gx * hx) * i_d
        wr = w * r * i_ε
        T = wr - ε * (zz + yy + xx)
        bend2, well2 = ε * ε * N, wr * wr
        P = bend2 - 2.0 * w * q + well2
        square = 2.0 * P - T * T
        resolved = square > tl.maximum(_ROUNDING * (bend2 + well2), _FLOOR)  # as `curvature.positive_root`
        square = tl.where(square > _FLOOR, square, _FLOOR)
        i_S = tl.rsqrt(square)
        S = square * i_S
        # Its derivatives, from the outside in.
        κ = tl.where(resolved, 0.5 * (wTS * T + wGS * G) * i_S, 0.0)
        e_P = wP + κ + κ
        e_T = 2.0 * T * (wT2 - κ) + wTS * S + wGT * G
        e_G = wGT * T + wGS * S
        e_L = -ε * e_T
        e_N = 2.0 * ε * ε * e_P
        e_Q = -2.0 * w * e_P * i_d
        e_wr = (e_T + 2.0 * e_P * wr) * i_ε
        e_w = r * e_wr - 2.0 * e_P * q
        e_s = 2.0 * ws + e_G * i_G - 2.0 * e_Q * q + 2.0 * w * e_wr * _XI2 * i_d * i_d
        e_q, e_n = e_Q + e_Q, e_N + e_N
        dz, dy, dx = e_s * gz + e_q * hz, e_s * gy + e_q * hy, e_s * gx + e_q * hx
        if ORIENTED:
            turn = ε  # across z, beyond a mirror: what reaches into the box is the image of what is inside
            if not PERIODIC:
                turn = tl.where((z < 0) | (z >= Z), -ε, ε)
            qz = ε * Qzz * gz + turn * (Qzy * gy + Qzx * gx)
            qy = turn * Qzy * gz + ε * (Qyy * gy + Qyx * gx)
            qx = turn * Qzx * gz + ε * (Qyx * gy + Qxx * gx)
            dz, dy, dx = dz + 2.0 * qz, dy + 2.0 * qy, dx + 2.0 * qx
        if ENERGY:
            e = wP * P + wT2 * T * T + wTS * T * S + G * (wGT * T + wGS * S) + ws * s
            if ORIENTED:
                e += qz * gz + qy * gy + qx * gx
            energy += tl.where(_below(place, plane, (z >= first) & (z < last)), kept * e, 0.0)
        if MASKED:
            dz, dy, dx, e_L, e_N, e_Q = kept * dz, kept * dy, kept * dx, kept * e_L, kept * e_N, kept * e_Q
            e_n, e_q, e_w = kept * e_n, kept * e_q, kept * e_w
        dz, dy, dx = fz * dz, fy * dy, fx * dx
        dzz = fzz * (e_L + e_N * zz + e_Q * gz * gz)
        dyy = fyy * (e_L + e_N * yy + e_Q * gy * gy)
        dxx = fxx * (e_L + e_N * xx + e_Q * gx * gx)
        dzy, dzx = fzy * (e_n * zy + e_q * gz * gy), fzx * (e_n * zx + e_q * gz * gx)
        # The plane before is complete; this one begins.
        done = (z - 1) * plane + cell
        ready = _below(place, plane, z > first)
        tl.store(stay + done, p_stay + dzz - dz, mask=ready)
        tl.store(y_after + done, p_ya + dzy, mask=ready)
        tl.store(y_before + done, p_yb - dzy, mask=ready)
        tl.store(x_after + done, p_xa + dzx, mask=ready)
        tl.store(x_before + done, p_xb - dzx, mask=ready)
        dyx = fyx * (e_n * yx + e_q * gy * gx)
        tl.store(diagonal + z * plane + cell, dyx, mask=_below(place, plane, (z >= first) & (z < last)))
        p_stay = e_w * (3.0 * u2 - 1.0) - 2.0 * (dzz + dyy + dxx) + p_zp
        p_ya, p_yb = dyy - dy - p_zy, dyy + dy + p_zy
        p_xa, p_xb = dxx - dx - p_zx, dxx + dx + p_zx
        p_zp, p_zy, p_zx = dzz + dz, dzy, dzx
        b_yb, b_xb, b_c, b_xa, b_ya = yb_, xb_, c, xa_, ya_
        bb, yb_, ba, xb_, c, xa_, ab, ya_, aa = n_bb, n_yb, n_ba, n_xb, n_c, n_xa, n_ab, n_ya, n_aa
    if ENERGY:
        tl.store(energies + shape * tl.num_programs(0) + tl.program_id(0), tl.sum(energy, 0))


@triton.jit(do_not_specialize=["parts", "out", "taken", "Z", "Y", "X", "apart"])
def gather(
    parts, out, taken, Z, Y, X, apart,
    PERIODIC: tl.constexpr, ROWS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Apply the transposed stencils within planes to `density`'s sums for F_ε's gradient; count the step in `taken`."""
    if (tl.program_id(0) == 0) & (tl.program_id(1) == 0):
        tl.store(taken, tl.load(taken) + 1)
    plane = Y * X
    first, place, cell, y, x = _columns(Z, Y, X, ROWS, LANES, 1)
    shape = tl.program_id(1).to(tl.int64)
    volume = Z * plane
    parts += shape * apart
    out += shape * volume
    yb, ya, xb, xa = _before(y, Y, PERIODIC), _after(y, Y, PERIODIC), _before(x, X, PERIODIC), _after(x, X, PERIODIC)
    from_ya, from_yb = _Y_AFTER * volume + ya * X + x, _Y_BEFORE * volume + yb * X + x
    from_xa, from_xb = _X_AFTER * volume + y * X + xa, _X_BEFORE * volume + y * X + xb
    aa, ab, ba, bb = ya * X + xa, ya * X + xb, yb * X + xa, yb * X + xb
    waa, wab, wba, wbb = 1.0, 1.0, 1.0, 1.0
    if not PERIODIC:  # in a mirror the shares of the two neighbours change places, and cross differences are odd
        from_ya = tl.where(y == Y - 1, _Y_BEFORE * volume + cell, from_ya)
        from_yb = tl.where(y == 0, _Y_AFTER * volume + cell, from_yb)
        from_xa = tl.where(x == X - 1, _X_BEFORE * volume + cell, from_xa)
        from_xb = tl.where(x == 0, _X_AFTER * volume + cell, from_xb)
        wa, wb = tl.where(y == Y - 1, -1.0, 1.0), tl.where(y == 0, -1.0, 1.0)
        va, vb = tl.where(x == X - 1, -1.0, 1.0), tl.where(x == 0, -1.0, 1.0)
        waa, wab, wba, wbb = wa * va, wa * vb, wb * va, wb * vb
    values = ()
    for k in tl.static_range(ROWS):
        row = tl.minimum(first + k, Z - 1) * plane
        source, diagonal = parts + row, parts + (_DIAGONAL * volume + row)
        value = tl.load(source + (_STAY * volume + cell))
        value += tl.load(source + from_ya) + tl.load(source + from_yb)
        value += tl.load(source + from_xa) + tl.load(source + from_xb)
        value += waa * tl.load(diagonal + aa) - wab * tl.load(diagonal + ab)
        value += wbb * tl.load(diagonal + bb) - wba * tl.load(diagonal + ba)
        values = values + (value,)
    for k in tl.static_range(ROWS):
        z = first + k
        tl.store(out + (z * plane + cell), values[k], mask=_below(place, plane, z < Z))


@triton.jit(do_not_specialize=["keep", "table", "taken", "highest", "sums", "Z", "Y", "G", "apart"])
def blur_z_adam(
    g, A, m, v, keep, table, taken, highest, sums, Z, Y, G, apart,
    half_y, half_x, β1c, β2, β2c, adam_eps,
    TAPS: tl.constexpr, SLOPES: tl.constexpr, RADIUS: tl.constexpr, PERIODIC: tl.constexpr,
    HELD: tl.constexpr, MOVE: tl.constexpr, OBSERVE: tl.constexpr,
    ROWS: tl.constexpr, LANES: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Blur a gradient along z that is blurred in planes, apply -∇ (the transpose of `divergence_blur_z`), and step by
    Adam with the row of `table` that `taken` names: step length and factor of the root, bias corrections included.

    MOVE: take the step. OBSERVE: leave maximum and sum of the slopes' moduli. The shapes of g stand `apart` groups
    apart.
    """
    X = G * WIDTH
    plane = Y * X
    first, place, group, y, x = _columns(Z, Y, G, ROWS, LANES, WIDTH)
    shape = tl.program_id(1).to(tl.int64)
    volume = Z * plane
    g += shape * apart * WIDTH
    cell = _wide(group * WIDTH, WIDTH)
    yb, ya = _wide(_before(y, Y, PERIODIC) * X + x, WIDTH), _wide(_after(y, Y, PERIODIC) * X + x, WIDTH)
    xb, xa = y * X + _before(x, X, PERIODIC), y * X + _after(x + WIDTH - 1, X, PERIODIC)
    zero = _zero(LANES, WIDTH)
    slope_z, slope_y, slope_x = (zero,) * ROWS, (zero,) * ROWS, (zero,) * ROWS
    walk = _begin(first, RADIUS, Z, PERIODIC)
    for j in tl.static_range(2 * RADIUS + ROWS):
        z, _ = _sample(walk, Z, PERIODIC)
        row = z * plane
        slope_z = _spread(slope_z, -tl.load(g + (row + cell)), SLOPES, RADIUS, j, ROWS)
        if (j > 0) and (j < 2 * RADIUS + ROWS - 1):
            slope_y = _spread(slope_y, tl.load(g + (row + yb)) - tl.load(g + (row + ya)), TAPS, RADIUS, j, ROWS)
            along_x = -_difference_x(g + row, cell, xb, xa, 1.0, 1.0, 1.0, WIDTH)
            slope_x = _spread(slope_x, along_x, TAPS, RADIUS, j, ROWS)
        walk = _next(walk, Z, PERIODIC)
    if MOVE:
        entry = table + 2 * (tl.load(taken) - 1)
        length, spread = tl.load(entry), tl.load(entry + 1)
    offset = shape * 3 * volume
    A += offset
    m += offset
    v += offset
    top, total = zero, zero
    place = _lift(place, WIDTH)
    for k in tl.static_range(ROWS):
        here = (first + k) * plane + cell
        free = _below(place, Y * G, first + k < Z)
        if HELD:
            free = free & (tl.load(keep + here, mask=free, other=0) != 0)
        slopes = (slope_z[k], half_y * slope_y[k], half_x * slope_x[k])
        if OBSERVE:
            for i in tl.static_range(3):
                size = tl.where(free, tl.abs(slopes[i]), 0.0)
                top = tl.maximum(top, size)
                total += size
        if MOVE:
            one, two, at = (), (), ()
            for i in tl.static_range(3):
                one = one + (tl.load(m + (i * volume + here), mask=free, other=0.0),)
                two = two + (tl.load(v + (i * volume + here), mask=free, other=0.0),)
                at = at + (tl.load(A + (i * volume + here), mask=free, other=0.0),)
            for i in tl.static_range(3):
                first_moment = one[i] + β1c * (slopes[i] - one[i])
                second_moment = β2 * two[i] + β2c * slopes[i] * slopes[i]
                step = length * first_moment / (spread * tl.sqrt(second_moment) + adam_eps)
                tl.store(m + (i * volume + here), first_moment, mask=free)
                tl.store(v + (i * volume + here), second_moment, mask=free)
                tl.store(A + (i * volume + here), at[i] - step, mask=free)
    if OBSERVE:
        place = shape * tl.num_programs(0) + tl.program_id(0)
        tl.store(highest + place, tl.max(top))
        tl.store(sums + place, tl.sum(total))


@triton.jit
def _columns(Z, Y, G, ROWS: tl.constexpr, LANES: tl.constexpr, WIDTH: tl.constexpr):
    """A program's first plane of ROWS, and its groups of cells as `_cells` gives them, with x at the end. Programs that
    follow one another stand above one another."""
    blocks = tl.cdiv(Z, ROWS)
    place, group, y, i = _cells(tl.program_id(0) // blocks, Y, G, LANES)
    return tl.program_id(0) % blocks * ROWS, place, group, y, i * WIDTH


@triton.jit
def _cells(block, Y, G, LANES: tl.constexpr):
    """A block of groups of cells in a plane with G a row: number, number of the last where that is beyond it, row, and
    number in the row."""
    place = block * LANES + tl.arange(0, LANES)
    group = tl.minimum(place, Y * G - 1)
    y = group // G
    return place, group, y, group - y * G


@triton.jit
def _below(place, count, valid):
    """Whether a place is one of so many, and a number for all of them is in range."""
    return place < tl.where(valid, count, 0)


@triton.jit
def _wide(place, WIDTH: tl.constexpr):
    """The places of a group's cells, from the first one's."""
    if WIDTH > 1:
        place = place[:, None] + tl.arange(0, WIDTH)[None, :]
    return place


@triton.jit
def _lift(value, WIDTH: tl.constexpr):
    """A group's value for each of its cells."""
    if WIDTH > 1:
        value = value[:, None]
    return value


@triton.jit
def _zero(LANES: tl.constexpr, WIDTH: tl.constexpr):
    if WIDTH > 1:
        zero = tl.zeros((LANES, WIDTH), tl.float32)
    else:
        zero = tl.zeros((LANES,), tl.float32)
    return zero


@triton.jit
def _unpacked(values, LANES: tl.constexpr, WIDTH: tl.constexpr):
    """Groups' values as WIDTH (1, 2 or 4) tensors, a cell of the group each; all in a thread's own registers."""
    if WIDTH == 1:
        cells = (values,)
    elif WIDTH == 2:
        cells = tl.split(values)
    else:
        even, odd = tl.split(tl.reshape(values, (LANES, 2, 2)))
        zeroth, second = tl.split(even)
        first, third = tl.split(odd)
        cells = (zeroth, first, second, third)
    return cells


@triton.jit
def _packed(cells, LANES: tl.constexpr, WIDTH: tl.constexpr):
    """The reverse."""
    if WIDTH == 1:
        values = cells[0]
    elif WIDTH == 2:
        values = tl.join(cells[0], cells[1])
    else:
        pairs = tl.join(tl.join(cells[0], cells[2]), tl.join(cells[1], cells[3]))
        values = tl.reshape(pairs, (LANES, WIDTH))
    return values


@triton.jit
def _difference_x(row, cell, before, after, wb, w, wa, WIDTH: tl.constexpr):
    """Sample after less sample before, along x, of each cell: weighted by w, but wb and wa at the two that lie outside
    the group."""
    left, right = wb * tl.load(row + before), wa * tl.load(row + after)
    if WIDTH == 1:
        difference = right - left
    else:
        LANES: tl.constexpr = cell.shape[0]
        cells = _unpacked(w * tl.load(row + cell), LANES, WIDTH)
        if WIDTH == 2:
            difference = _packed((cells[1] - left, right - cells[0]), LANES, WIDTH)
        else:
            within = (cells[2] - cells[0], cells[3] - cells[1])
            difference = _packed((cells[1] - left, within[0], within[1], right - cells[2]), LANES, WIDTH)
    return difference


@triton.jit
def _before(i, n, PERIODIC: tl.constexpr):
    return tl.where(i == 0, n - 1 if PERIODIC else 0, i - 1)


@triton.jit
def _after(i, n, PERIODIC: tl.constexpr):
    return tl.where(i == n - 1, 0 if PERIODIC else n - 1, i + 1)


@triton.jit
def _reflect(i, n, PERIODIC: tl.constexpr):
    """An index at most two beyond either end, brought back."""
    if PERIODIC:
        i = tl.where(i < 0, i + n, tl.where(i >= n, i - n, i))
    else:
        i = tl.where(i < 0, -1 - i, tl.where(i >= n, 2 * n - 1 - i, i))
    return i


@triton.jit
def _begin(i, RADIUS: tl.constexpr, n, PERIODIC: tl.constexpr):
    """Start of a walk at i - RADIUS, any distance beyond the ends."""
    period = n if PERIODIC else 2 * n
    return (i - RADIUS + period * (RADIUS + 1)) % period


@triton.jit
def _next(walk, n, PERIODIC: tl.constexpr):
    walk += 1
    return tl.where(walk == (n if PERIODIC else 2 * n), 0, walk)


@triton.jit
def _sample(walk, n, PERIODIC: tl.constexpr):
    """Which sample stands there, and whether as a mirror image."""
    mirrored = walk >= n
    if not PERIODIC:
        walk = tl.where(mirrored, 2 * n - 1 - walk, walk)
    return walk, mirrored


@triton.jit
def _spread(total, row, TAPS: tl.constexpr, RADIUS: tl.constexpr, j: tl.constexpr, ROWS: tl.constexpr):
    """Add row j of a walk to each of the ROWS sums that it belongs to."""
    new = ()
    for k in tl.static_range(ROWS):
        if (j >= k) and (j - k <= 2 * RADIUS):
            new = new + (total[k] + TAPS[j - k] * row,)
        else:
            new = new + (total[k],)
    return new


@triton.jit
def _nine(u, row, rows, columns):
    """The nine values about each cell in the plane that begins at `row`, by rows."""
    before, here, after = u + (row + rows[0]), u + (row + rows[1]), u + (row + rows[2])
    b, c, a = columns
    return (
        tl.load(before + b), tl.load(before + c), tl.load(before + a),
        tl.load(here + b), tl.load(here + c), tl.load(here + a),
        tl.load(after + b), tl.load(after + c), tl.load(after + a),
    )  # fmt: skip
