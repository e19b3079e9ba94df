"""Exact Euclidean distances in a mask, and the balls that fit into it: which is the largest that covers a voxel.

`_paint` visits balls in descending size, so that each voxel is painted once. Whoever paints a voxel decides whether the
ball around it will be painted, too; bits of the voxels that are still free show at once that most balls paint nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from skimage.measure import block_reduce

#: Columns whose distances are computed together.
_COLUMNS = 16
#: Balls are sorted in stages, each down to this part of the radius where the one before ended.
_STAGE = 0.7
#: Rows along y that are looked up together.
_LANES = 8
#: The longest radius, in voxels along x, of a ball whose rows fit into words.
_WIDEST = 31
#: An index that is not negative, so that numba need not count from the end.
_at = np.uint64
#: A power of two times this number has its exponent's own six bits on top, which give the exponent.
_DE_BRUIJN = np.uint64(0x03F79D71B4CB0A89)
_INDEX = np.zeros(64, dtype=np.int64)
_INDEX[[(int(_DE_BRUIJN) << k & (1 << 64) - 1) >> 58 for k in range(64)]] = range(64)
#: A ball may keep a smaller one, which it nearly contains, from being painted: balls that end this many voxels, of the
#: finest axis, before a core count there.
NEAR = 8


# ---- distances -------------------------------------------------------------------------------------------------------
#
# The least of hz²(z - z')² + hy²(y - y')² + hx²(x - x')² over the voxels of the other side is a minimum over x' within
# each row, then over y' of what the rows have, then over z': three passes along one axis each. A pass searches outwards
# from each voxel, and ends where the way alone, (k h)², costs more than the best so far. That is after as many voxels
# as the distance itself is long: few in structures, where the lower envelope of parabolas, whose cost does not depend
# on the distance, would be slower. Signs of the squares hold both sides in one array.


def border_distance(
    mask: np.ndarray,
    spacing: Sequence[float],
    limit: float = math.inf,
    *,
    offset: float = 0.0,
    both: bool = False,
) -> np.ndarray:
    """Return the distance of each voxel of a mask to the nearest voxel outside, at most `limit`; float32 (Z, Y, X).

    Distances are exact, from centre to centre, in spacing's unit. They end `offset` voxels before the outer voxel's
    centre: 0.5 is at its face. Outside the mask they are 0, or with `both` minus the distances to the mask.
    """
    edge = float(min(spacing))
    steps = np.array(spacing, dtype=np.float32) / np.float32(edge)
    reach = min(limit / edge, 2.0 * math.hypot(*(n * h for n, h in zip(mask.shape, steps.tolist(), strict=True))))
    distance = np.empty(mask.shape, dtype=np.float32)
    scratch = np.zeros((max(mask.shape) + 2, _COLUMNS), dtype=np.float32)
    lengths = np.float32(reach), np.float32(offset), np.float32(edge)
    _measure_distances(np.ascontiguousarray(mask), steps, lengths, both, distance, scratch)
    return distance


@njit(cache=True, nogil=True)
def _measure_distances(mask, steps, lengths, both, squares, scratch):  # pragma: no cover
    """Fill `squares` with squared distances along x, lower them along y and z, and take their roots times an edge."""
    (nz, ny, nx), (hz, hy, hx), (reach, offset, edge) = mask.shape, steps, lengths
    for z in range(nz):
        for y in range(ny):
            _fill_row(mask[z, y], hx, reach, offset, both, squares[z, y])
    for z in range(nz):
        for first in range(0, nx, _COLUMNS):
            _lower_columns(squares[z, :, first : first + _COLUMNS], hy, offset, scratch)
    for y in range(ny):
        for first in range(0, nx, _COLUMNS):
            _lower_columns(squares[:, y, first : first + _COLUMNS], hz, offset, scratch)
    for z in range(nz):
        for y in range(ny):
            _take_roots(squares[z, y], edge)


@njit(cache=True)
def _fill_row(mask, step, reach, offset, both, squares):  # pragma: no cover
    """Fill the squared distances to borders within a row; outside the mask they are negative, or 0 without `both`."""
    n, largest, one = len(mask), reach * reach, np.float32(1)
    distance = reach / step + one  # in voxels; there is no border before the first voxel
    for x in range(n):
        distance = one - offset if x > 0 and mask[x] != mask[x - 1] else distance + one
        squares[x] = min((distance * step) ** 2, largest)
    distance = reach / step + one
    for x in range(n - 1, -1, -1):
        distance = one - offset if x < n - 1 and mask[x] != mask[x + 1] else distance + one
        square = min((distance * step) ** 2, squares[x])
        squares[x] = square if mask[x] else -square if both else np.float32(0)


@njit(cache=True, fastmath=True)
def _lower_columns(squares, step, offset, scratch):  # pragma: no cover
    """Lower squares (n, columns) of distances, negative outside, to the least of ((k - offset) step)² plus the square k
    voxels away in the column; `offset` is the border's distance from a voxel's centre."""
    n, width = squares.shape
    zero, one, columns = np.float32(0), np.float32(1), scratch.shape[1]
    scratch[:n, :width] = squares
    best, sign = scratch[n], scratch[n + 1]
    for row in range(n):
        largest, k, cost = zero, 1, ((one - offset) * step) ** 2
        for i in range(columns):
            sign[i] = -one if scratch[row, i] < zero else one
            best[i] = sign[i] * scratch[row, i]
            largest = max(largest, best[i])
        while cost < largest and (row - k >= 0 or row + k < n):
            before, after = scratch[max(row - k, 0)], scratch[min(row + k, n - 1)]  # an end is nearer than it counts
            for i in range(columns):  # a voxel of the other side is at distance 0
                other = cost + max(min(sign[i] * before[i], sign[i] * after[i]), zero)
                best[i] = min(best[i], other)
            k += 1
            cost = ((np.float32(k) - offset) * step) ** 2
            if k % 4 == 0:
                largest = best.max()
        for i in range(width):
            squares[row, i] = sign[i] * best[i]


@njit(cache=True)
def _take_roots(squares, edge):  # pragma: no cover
    """Replace squares by their roots times an edge, with the same signs."""
    for x in range(len(squares)):
        squares[x] = math.copysign(math.sqrt(abs(squares[x])), squares[x]) * edge


# ---- balls -----------------------------------------------------------------------------------------------------------


def paint_coarse_balls(radius: np.ndarray, spacing: tuple[float, float, float], factor: int) -> np.ndarray:
    """Return what `paint_balls` does, from balls painted on a grid whose voxels are longer by a whole factor."""
    coarse = block_reduce(radius, factor, np.max)
    painted = paint_balls(coarse, [h * factor for h in spacing], edge=float(min(spacing)))
    fine = painted.repeat(factor, 0).repeat(factor, 1).repeat(factor, 2)[tuple(slice(n) for n in radius.shape)]
    return np.where(radius > 0, np.maximum(fine, radius), np.float32(0))


def paint_balls(
    radius: np.ndarray,
    spacing: Sequence[float],
    *,
    edge: float | None = None,
    periodic: bool = False,
    core: tuple[slice, ...] | None = None,
) -> np.ndarray:
    """Return the radius of the largest ball that covers each voxel, of balls of `radius` (Z, Y, X) around the voxels.

    A ball covers voxels up to half an `edge`, by default the finest, beyond its rim. With a `core`, only the result
    there counts: balls are left out that neither reach the core nor keep a ball that does from being painted.
    """
    edge = float(min(spacing)) if edge is None else edge
    steps, rim = np.asarray(spacing, dtype=np.float32), np.float32(edge)
    radius = np.ascontiguousarray(radius)
    largest = float(radius.max(initial=0))
    alive = radius > 0 if core is None else _find_reaching(radius, spacing, core)
    reach = [int((largest + edge) / h) + 1 for h in steps]
    if (largest + 0.5 * edge) / steps[2] >= _WIDEST + 1:
        raise ValueError(f"expected balls of a radius of {_WIDEST} voxels along x at most, got {largest / steps[2]:g}")
    # A bit for each voxel that is free and counts, in words for 64 voxels along x, which lie side by side along y. A
    # ball, or its copy a period away, reaches into the margin.
    margin = reach[1] * (2 if periodic else 1)
    padded = np.pad(alive, ((0, 0), (margin, margin + _LANES), (0, -radius.shape[2] % 64)))
    free = np.packbits(padded, axis=2, bitorder="little").view("<u8").astype(np.uint64).transpose(0, 2, 1).copy()
    del padded
    rows = np.empty((reach[0] + 1, 2 * reach[1] + 1 + _LANES), dtype=np.uint64)
    painted = np.zeros(radius.size, dtype=np.float32)
    balls = (radius.ravel(), painted, alive.ravel(), free)
    slack = 0.51 * edge + math.hypot(*steps)  # a ball's rim, and how far two voxels are from their cells' centres
    while largest > 0:  # in stages, each of which leaves few of the smaller balls to the next ones
        least, limit = _STAGE * largest if largest > edge else 0.0, 0.0 if periodic else largest + 2 * slack
        distance = _measure_free(free[:, :, margin : -margin - _LANES], steps, limit)
        order = _find_useful(radius, alive, distance, np.float32(slack), np.float32(least))
        order = order[np.argsort(-balls[0][order], kind="stable")]
        _paint(order, balls, rows, np.array(radius.shape), steps, rim, periodic)
        largest = least
    return painted.reshape(radius.shape)


def reaching_radius(radius: np.ndarray, spacing: Sequence[float], core: tuple[slice, ...]) -> float:
    """Return the largest `radius` (Z, Y, X) of the balls around voxels that count in a core (see `NEAR`)."""
    return float(radius[_find_reaching(radius, spacing, core)].max(initial=0))


def _find_reaching(radius: np.ndarray, spacing: Sequence[float], core: tuple[slice, ...]) -> np.ndarray:
    """Return the voxels whose ball ends in a core or at most `NEAR` voxels before it, bool (Z, Y, X)."""
    distances = []  # of the voxels to the core, along each axis
    for n, edge, h in zip(radius.shape, core, np.asarray(spacing, dtype=np.float32), strict=True):
        index = np.arange(n)
        distances.append(np.maximum(index - edge.stop + 1, edge.start - index).clip(0) * h)
    z, y, x = distances
    in_plane, reaching = y[:, None] ** 2 + x**2, radius > 0
    for dz, radii, plane in zip(z, radius, reaching, strict=True):
        plane &= dz**2 + in_plane <= (radii + NEAR * float(min(spacing))) ** 2  # fills `reaching`, plane by plane
    return reaching


@njit(cache=True, forceinline=True)
def _gap(index, low, high):  # pragma: no cover
    """Return how many voxels an index lies outside the interval low..high - 1."""
    return low - index if index < low else index - high + 1 if index >= high else 0


def _measure_free(free: np.ndarray, steps: np.ndarray, reach: float) -> np.ndarray:
    """Return the distance of each cell of 2³ voxels to the nearest one with a free voxel; at most `reach`."""
    cells = free.transpose(0, 2, 1)
    for axis in (0, 1):
        cells = np.bitwise_or.reduceat(cells, np.arange(0, cells.shape[axis], 2), axis)
    bits = np.unpackbits(cells.view(np.uint8), axis=2, bitorder="little")
    return border_distance((bits[:, :, ::2] | bits[:, :, 1::2]) == 0, (2 * steps).tolist(), reach)


@njit(cache=True, nogil=True)
def _find_useful(radius, alive, distance, slack, least):  # pragma: no cover
    """Return the indices of balls that are alive, of more than the least radius and near a free voxel; those that are
    not near are alive no longer. The `distance` is that of `_measure_free`."""
    nz, ny, nx = radius.shape
    found = np.empty(np.count_nonzero(alive), dtype=np.int64)
    count = 0
    for z in range(nz):
        for y in range(ny):
            for x in range(nx):
                if alive[z, y, x] and radius[z, y, x] > least:
                    if distance[z // 2, y // 2, x // 2] <= radius[z, y, x] + slack:
                        found[count] = (z * ny + y) * nx + x
                        count += 1
                    else:
                        alive[z, y, x] = False
    return found[:count]


@njit(cache=True, nogil=True)
def _paint(order, balls, rows, shape, spacing, edge, periodic):  # pragma: no cover
    """Paint balls in descending size, and none that is no longer alive: a voxel keeps the radius of the first ball that
    covers it."""
    radius, _, alive, _ = balls
    nz, ny, nx = shape
    hz, hy, hx = spacing
    copies = 1 if periodic else 0  # of a ball, a period before and after it along each axis
    last = np.float32(0)
    for centre in order:
        if not alive[centre]:
            continue
        alive[centre] = False
        r = radius[centre]
        reach = r + 0.5 * edge
        if r != last:
            last = r
            _fill_rows(reach, spacing, rows)
        z, y, x = centre // (ny * nx), centre // nx % ny, centre % nx
        kz, ky, kx = int(reach / hz), int(reach / hy), int(reach / hx)
        ball = (r, max(0.5 * edge, 0.05 * r))
        for k in range(z - copies * nz, z + copies * nz + 1, nz):
            for j in range(y - copies * ny, y + copies * ny + 1, ny):
                for i in range(x - copies * nx, x + copies * nx + 1, nx):
                    if _gap(k, 0, nz) <= kz and _gap(j, 0, ny) <= ky and _gap(i, 0, nx) <= kx:
                        _paint_ball(ball, balls, rows, (k, j, i), shape, (kz, ky), spacing)


@njit(cache=True)
def _fill_rows(reach, spacing, rows):  # pragma: no cover
    """Fill in the rows of a ball's voxels along x, at each distance in voxels along z and y, as bits around bit 32."""
    hz, hy, hx = spacing
    for k in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            rest = reach * reach - (k * hz) ** 2 - ((j - (rows.shape[1] - _LANES) // 2) * hy) ** 2
            half = np.uint64(min(int(np.sqrt(rest) / hx), _WIDEST)) if rest >= 0 else np.uint64(0)
            ones = ~np.uint64(0) >> np.uint64(63 - 2 * half)
            rows[k, j] = ones << (np.uint64(32) - half) if rest >= 0 else np.uint64(0)


@njit(cache=True, forceinline=True)
def _paint_ball(ball, balls, rows, position, shape, reach, spacing):  # pragma: no cover
    """Paint the free voxels of a ball at `position`, which may lie beyond the box; `rows` are those of `_fill_rows`."""
    radius, painted, alive, free = balls
    (r, slack), (nz, ny, nx), (hz, hy, hx), (z, y, x) = ball, shape, spacing, position
    middle, count = (rows.shape[1] - _LANES) // 2, (2 * reach[1] + _LANES) // _LANES * _LANES
    shift_y = y - middle + (free.shape[2] - ny - _LANES) // 2  # from a ball's rows to those of the words
    for word in range(max(x - 32, 0) // 64, min(x + 31, nx - 1) // 64 + 1):
        # Of a ball's rows, whose centre is bit 32, the word has the part after so many bits, or before.
        shift = x - 32 - 64 * word
        left, right = np.uint64(max(shift, 0)), np.uint64(max(-shift, 0))
        for k in range(max(0, z - reach[0]), min(nz, z + reach[0] + 1)):
            ball_rows, words = rows[abs(k - z)], free[k, word]
            first, covered = middle - reach[1], np.uint64(0)
            for j in range(count):
                covered |= words[_at(first + shift_y + j)] & (ball_rows[_at(first + j)] << left >> right)
            if not covered:
                continue
            for j in range(middle - reach[1], middle + reach[1] + 1):
                covered = words[j + shift_y] & (ball_rows[j] << left >> right)
                if covered:
                    words[j + shift_y] ^= covered
                    square = ((k - z) * hz) ** 2 + ((j - middle) * hy) ** 2
                    start = (k * ny + y + j - middle) * nx + 64 * word
                    while covered:
                        lowest = covered & (~covered + np.uint64(1))
                        covered ^= lowest
                        i = _INDEX[lowest * _DE_BRUIJN >> np.uint64(58)]
                        painted[start + i] = r
                        # A ball that sticks out of this one by no more than the slack is left out.
                        room = slack + (r - radius[start + i])
                        if room >= 0 and square + ((64 * word + i - x) * hx) ** 2 <= room * room:
                            alive[start + i] = False
