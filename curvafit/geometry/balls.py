"""Exact Euclidean distances in a mask, and the balls that fit into it: which is the largest that covers a voxel.

`_paint` visits balls in descending size, so that each voxel is painted once; bits of the voxels that are still free
show at once that most balls paint nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from skimage.measure import block_reduce

#: Columns whose distances are computed together.
_COLUMNS = 16
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


def square_distances(
    mask: np.ndarray, steps: Sequence[float] | np.ndarray, reach: float, *, offset: float = 0.0, both: bool = False
) -> np.ndarray:
    """Return the squared distance of each voxel's centre in a mask to the nearest voxel outside; float32 (Z, Y, X).

    `steps` are a voxel's edges along z, y and x; squares are at most `reach`², in the same unit. Distances end `offset`
    voxels before the outer voxel's centre: 0.5 is at its face. Outside the mask squares are 0, or with `both` minus the
    squared distances to the mask.
    """
    squares = np.empty(mask.shape, dtype=np.float32)
    scratch = np.empty((max(mask.shape), _COLUMNS), dtype=np.float32)
    edges = np.asarray(steps, dtype=np.float32)
    _square_distances(np.ascontiguousarray(mask), edges, np.float32(reach), np.float32(offset), both, squares, scratch)
    return squares


@njit(cache=True)
def _square_distances(mask, steps, reach, offset, both, squares, scratch):  # pragma: no cover
    """Fill `squares` with the squared distances along x, then lower them along y and z; see `square_distances`."""
    nz, ny, nx = mask.shape
    hz, hy, hx = steps
    for z in range(nz):
        for y in range(ny):
            _fill_row(mask[z, y], hx, reach, offset, both, squares[z, y])
    for z in range(nz):
        for first in range(0, nx, _COLUMNS):
            _lower_columns(squares[z, :, first : first + _COLUMNS], hy, offset, scratch)
    for y in range(ny):
        for first in range(0, nx, _COLUMNS):
            _lower_columns(squares[:, y, first : first + _COLUMNS], hz, offset, scratch)


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


@njit(cache=True)
def _lower_columns(squares, step, offset, scratch):  # pragma: no cover
    """Lower squares (n, columns) of distances, negative outside, to the least of ((k - offset) step)² plus the square k
    voxels away in the column; `offset` is the border's distance from a voxel's centre."""
    n, width = squares.shape
    zero, one = np.float32(0), np.float32(1)
    scratch[:n, :width] = squares
    for row in range(n):
        for i in range(width):
            sign = -one if scratch[row, i] < 0 else one
            best, k, cost = sign * scratch[row, i], 1, ((one - offset) * step) ** 2
            while cost < best and (row - k >= 0 or row + k < n):
                if row - k >= 0:  # a voxel of the other side is at distance 0
                    best = min(best, cost + max(sign * scratch[row - k, i], zero))
                if row + k < n:
                    best = min(best, cost + max(sign * scratch[row + k, i], zero))
                k += 1
                cost = ((np.float32(k) - offset) * step) ** 2
            squares[row, i] = sign * best


# ---- balls -----------------------------------------------------------------------------------------------------------


def ball_radii(mask: np.ndarray, spacing: tuple[float, float, float], limit: float = math.inf) -> np.ndarray:
    """Return the distance of each voxel of a mask to the nearest voxel outside, at most `limit`; float32 (Z, Y, X).

    Distances are exact, from centre to centre, in spacing's unit.
    """
    edge = float(min(spacing))
    steps = np.array(spacing, dtype=np.float32) / np.float32(edge)
    reach = min(limit / edge, 2.0 * math.hypot(*(n * h for n, h in zip(mask.shape, steps.tolist(), strict=True))))
    squares = square_distances(mask, steps, reach)
    np.sqrt(squares, out=squares)
    squares *= np.float32(edge)
    return squares


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
    dtype = np.int32 if radius.size < 2**31 else np.int64
    order = np.flatnonzero(radius if core is None else _find_reaching(radius, spacing, core)).astype(dtype)
    order = order[np.argsort(-radius.ravel()[order], kind="stable")]
    painted, owner = np.zeros(radius.size, dtype=np.float32), np.full(radius.size, -1, dtype=dtype)
    # A bit for each voxel that is free, in words for 64 voxels of a row; and the words of 4 x 4 rows joined by "or".
    rows = np.pad(radius > 0, ((0, 0), (0, 0), (0, -radius.shape[2] % 64)))
    free = blocks = np.packbits(rows, axis=2, bitorder="little").view("<u8").astype(np.uint64)
    for axis in (0, 1):
        blocks = np.bitwise_or.reduceat(blocks, np.arange(0, radius.shape[axis], 4), axis)
    runs = np.empty([int((float(radius.max(initial=0)) + edge) / h) + 2 for h in steps[:2]], dtype=np.int64)
    balls = (radius.ravel(), painted, owner, free.ravel(), blocks.ravel())
    _paint(order, balls, runs, np.array(radius.shape), steps, rim, periodic)
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


@njit(cache=True)
def _gap(index, low, high):  # pragma: no cover
    """Return how many voxels an index lies outside the interval low..high - 1."""
    return low - index if index < low else index - high + 1 if index >= high else 0


@njit(cache=True)
def _paint(order, balls, runs, shape, spacing, edge, periodic):  # pragma: no cover
    """Paint balls in descending size; a voxel keeps the radius and centre of the first ball that covers it."""
    radius, _, owner, _, _ = balls
    nz, ny, nx = shape
    hz, hy, hx = spacing
    copies = 1 if periodic else 0  # of a ball, a period before and after it along each axis
    last = np.float32(0)
    for centre in order:
        r = radius[centre]
        if owner[centre] >= 0 and _is_nearly_inside(centre, owner[centre], radius, shape, spacing, edge, periodic):
            continue
        reach = r + 0.5 * edge
        if r != last:
            last = r
            _fill_runs(reach, spacing, runs)
        z, y, x = centre // (ny * nx), centre // nx % ny, centre % nx
        kz, ky, kx = int(reach / hz), int(reach / hy), int(reach / hx)
        for k in range(z - copies * nz, z + copies * nz + 1, nz):
            for j in range(y - copies * ny, y + copies * ny + 1, ny):
                for i in range(x - copies * nx, x + copies * nx + 1, nx):
                    if _gap(k, 0, nz) <= kz and _gap(j, 0, ny) <= ky and _gap(i, 0, nx) <= kx:
                        _paint_ball(centre, balls, runs, (k, j, i), shape, (kz, ky))


@njit(cache=True)
def _is_nearly_inside(centre, o, radius, shape, spacing, edge, periodic):  # pragma: no cover
    """Return whether a ball sticks out of the ball around the voxel `o` so little that it need not be painted."""
    nz, ny, nx = shape
    hz, hy, hx = spacing
    dz, dy = abs(centre // (ny * nx) - o // (ny * nx)), abs(centre // nx % ny - o // nx % ny)
    dx = abs(centre % nx - o % nx)
    if periodic:
        dz, dy, dx = min(dz, nz - dz), min(dy, ny - dy), min(dx, nx - dx)
    excess = np.sqrt((dz * hz) ** 2 + (dy * hy) ** 2 + (dx * hx) ** 2) + radius[centre] - radius[o]
    return excess <= max(0.5 * edge, 0.05 * radius[o])


@njit(cache=True)
def _fill_runs(reach, spacing, runs):  # pragma: no cover
    """Fill `runs` with how many voxels a ball reaches along x, at each distance in voxels along z and y; -1: none."""
    hz, hy, hx = spacing
    for k in range(int(reach / hz) + 1):
        for j in range(int(reach / hy) + 1):
            rest = reach * reach - (k * hz) ** 2 - (j * hy) ** 2
            runs[k, j] = int(np.sqrt(rest) / hx) if rest >= 0 else -1


@njit(cache=True)
def _paint_ball(centre, balls, runs, position, shape, reach):  # pragma: no cover
    """Paint the free voxels of a ball at `position`, which may lie beyond the box; `centre` its index. `runs[dz, dy]`
    is half the length of the ball's row along x, negative where it has none. Most blocks of 4 x 4 rows have none free.
    """
    blocks = balls[4]
    nz, ny, nx = shape
    z, y, x = position
    lowest, highest = max(0, z - reach[0]), min(nz, z + reach[0] + 1)
    front, back = max(0, y - reach[1]), min(ny, y + reach[1] + 1)
    words, blocks_y = (nx + 63) // 64, (ny + 3) // 4
    for bz in range(lowest // 4, (highest + 3) // 4):
        dz = _gap(z, 4 * bz, 4 * bz + 4)
        for by in range(front // 4, (back + 3) // 4):
            kx = runs[dz, _gap(y, 4 * by, 4 * by + 4)]
            row = (bz * blocks_y + by) * words
            if kx < 0 or not _any_free(blocks, row, max(0, x - kx), min(nx, x + kx + 1)):
                continue
            painted = 0
            for k in range(max(lowest, 4 * bz), min(highest, 4 * bz + 4)):
                for j in range(max(front, 4 * by), min(back, 4 * by + 4)):
                    kx = runs[abs(k - z), abs(j - y)]
                    if kx >= 0:
                        painted += _paint_run(centre, balls, k * ny + j, max(0, x - kx), min(nx, x + kx + 1), nx)
            if painted:
                _update_block(balls, bz, by, shape)


@njit(cache=True)
def _update_block(balls, bz, by, shape):  # pragma: no cover
    """Join the bits of the free voxels of 4 x 4 rows again, after some were painted."""
    free, blocks = balls[3], balls[4]
    nz, ny, nx = shape
    words, blocks_y = (nx + 63) // 64, (ny + 3) // 4
    row = (bz * blocks_y + by) * words
    for word in range(words):
        blocks[row + word] = 0
        for k in range(4 * bz, min(nz, 4 * bz + 4)):
            for j in range(4 * by, min(ny, 4 * by + 4)):
                blocks[row + word] |= free[(k * ny + j) * words + word]


@njit(cache=True)
def _any_free(bits, row, start, stop):  # pragma: no cover
    """Return whether any bit from `start` to `stop` of a row of words is set."""
    for word in range(start // 64, (stop + 63) // 64):
        if bits[row + word] & _between(start - 64 * word, stop - 64 * word):
            return True
    return False


@njit(cache=True)
def _between(start, stop):  # pragma: no cover
    """Return a word whose bits from `start` to `stop` are set."""
    ones = np.uint64(0xFFFFFFFFFFFFFFFF)
    return (ones << np.uint64(max(start, 0))) & (ones >> np.uint64(64 - min(stop, 64)))


@njit(cache=True)
def _paint_run(centre, balls, row, start, stop, nx):  # pragma: no cover
    """Paint the free voxels from `start` to `stop` of a row; return how many there were."""
    radius, painted, owner, free, _ = balls
    words, count = (nx + 63) // 64, 0
    for word in range(start // 64, (stop + 63) // 64):
        bits = free[row * words + word] & _between(start - 64 * word, stop - 64 * word)
        if bits:
            free[row * words + word] ^= bits  # no longer free
            for k in range(max(start - 64 * word, 0), min(stop - 64 * word, 64)):
                if bits & (np.uint64(1) << np.uint64(k)):
                    painted[row * nx + 64 * word + k] = radius[centre]
                    owner[row * nx + 64 * word + k] = centre
                    count += 1
    return count
