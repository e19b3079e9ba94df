"""Textures that no law makes, each drawn in a second: level cuts of random fields, cells, grains, tubes and fibres.

They teach the filler (`teach.py`) how structures go on between slices. Each is a field, float32 (N, N, N),
that repeats along all axes; it is positive inside, and about a distance in voxels near its surface.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

#: Edge of a texture in voxels.
EDGE = 80
#: Deviation of points that are moved at random, as a fraction of the edge, and the waves of the motion along an edge.
MOVED, WAVES = 0.05, 3.0
#: Numbers of cells, grains, trees and fibres in a texture.
CELLS, GRAINS, TREES, FIBRES = (12, 90), (20, 200), (2, 7), (8, 80)
#: Radii of the stem of a tree and of a fibre, and the least of a branch, in voxels; the most pieces of a tree.
STEM, FIBRE, TWIG, PIECES = (3.0, 9.0), (1.8, 4.0), 1.5, 120


def draw_level_cut(rng: np.random.Generator, edge: int = EDGE) -> np.ndarray:
    """Draw a level cut of Gaussian random fields: a sponge of one field's values above a level, sheets where a field is
    near 0, or tubes where two are."""
    waves, octaves = rng.uniform(3, 9), rng.uniform(0.1, 0.7)
    u, v = (_random_field(rng, edge, waves, octaves) for _ in range(2))
    height = (u, -np.abs(u), -np.hypot(u, v))[int(rng.integers(3))]
    height = height - np.quantile(height, 1 - rng.uniform(0.06, 0.5))
    slope = np.sqrt(sum(np.square((np.roll(height, -1, k) - np.roll(height, 1, k)) / 2) for k in range(3)))
    return (height / max(float(slope[np.abs(height) < slope].mean()), 1e-6)).astype(np.float32)


def draw_walls(rng: np.random.Generator, edge: int = EDGE) -> np.ndarray:
    """Draw the walls of a foam, curved at random: faces of a Laguerre tessellation whose cells differ in size. Some
    neighbours are one cell, and have no wall between them."""
    count = int(np.exp(rng.uniform(*np.log(CELLS))))
    centres, moved = rng.uniform(0, edge, (count, 3)), _move_points(rng, edge)
    size = edge / count ** (1 / 3)
    weights = rng.uniform(0, 0.5) * size**2 * rng.random(count)
    owners = np.where(rng.random(count) < 0.1, rng.integers(count, size=count), np.arange(count))
    first, second = _two_least_powers(moved, centres, weights, owners)
    # Half the difference of the power distances over the distance of the centres, about a size, is that from the face.
    depth = (second - first) / (2 * size)
    return (rng.uniform(0.03, 0.13) * size - depth).astype(np.float32)


def draw_grains(rng: np.random.Generator, edge: int = EDGE) -> np.ndarray:
    """Draw grains: balls of many sizes, bent at random, that overlap, or are pressed flat where they meet."""
    count = int(np.exp(rng.uniform(*np.log(GRAINS))))
    size = edge / count ** (1 / 3)
    radii = size * rng.uniform(0.25, 0.45) * np.exp(0.3 * rng.standard_normal(count))
    centres = rng.uniform(0, edge, (count, 3))
    first, second = _two_least_powers(_move_points(rng, edge), centres, radii**2, np.arange(count))
    height = -first / (2 * float(np.mean(radii)))
    if rng.random() < 0.6:
        height = np.minimum(height, (second - first) / (2 * size) - rng.uniform(0.5, 1.5))
    return height.astype(np.float32)


def draw_fibres(rng: np.random.Generator, edge: int = EDGE) -> np.ndarray:
    """Draw long fibres of about one calibre, nearly straight, that cross each other or run along one direction."""
    height = np.full((edge, edge, edge), -4.0, dtype=np.float32)
    radius, along, spread = float(np.exp(rng.uniform(*np.log(FIBRE)))), _direction(rng), rng.uniform(0.1, 3.0)
    for _ in range(int(np.exp(rng.uniform(*np.log(FIBRES))))):
        start, heading = rng.uniform(0, edge, 3), along + spread * _direction(rng)
        for _ in range(int(rng.integers(5, 25))):
            heading = heading / np.linalg.norm(heading) + 0.1 * _direction(rng)
            stop = start + 5 * heading
            _add_capsule(height, start, stop, radius)
            start = stop
    return height


def draw_tubes(rng: np.random.Generator, edge: int = EDGE) -> np.ndarray:
    """Draw trees of tubes of mixed calibre that bend and fork. At a fork the cube of the radius is shared, as Murray's
    law of vessels has it."""
    height = np.full((edge, edge, edge), -4.0, dtype=np.float32)
    for _ in range(int(rng.integers(*TREES))):
        _grow_tree(height, rng, float(np.exp(rng.uniform(*np.log(STEM)))))
    return height


#: The textures that `draw_mixed` draws, by name.
KINDS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "level cuts": draw_level_cut,
    "cell walls": draw_walls,
    "branching tubes": draw_tubes,
    "grains": draw_grains,
    "fibres": draw_fibres,
}


def _random_field(rng: np.random.Generator, edge: int, waves: float, octaves: float) -> np.ndarray:
    """Draw a Gaussian field of variance 1 that repeats, with about so many waves along an edge, in a band this wide."""
    stretch = np.exp(0.25 * rng.standard_normal(3))
    numbers = np.meshgrid(*(np.fft.fftfreq(edge, 1 / edge) * s for s in stretch), indexing="ij")
    length = np.sqrt(sum(np.square(number) for number in numbers))
    amplitude = np.exp(-0.5 * (np.log2(np.maximum(length, 0.1) / waves) / octaves) ** 2) / np.maximum(length, 1)
    field = np.fft.ifftn(np.fft.fftn(rng.standard_normal((edge,) * 3)) * amplitude).real
    return field / field.std()


def _move_points(rng: np.random.Generator, edge: int) -> list[np.ndarray]:
    """Return the coordinates of all voxels, three arrays (N, N, N), moved by smooth random fields."""
    grid = np.meshgrid(*(np.arange(edge, dtype=np.float32),) * 3, indexing="ij")
    shift = MOVED * edge * rng.random()
    return [axis + shift * _random_field(rng, edge, WAVES, 0.5).astype(np.float32) for axis in grid]


def _two_least_powers(
    points: list[np.ndarray], centres: np.ndarray, weights: np.ndarray, owners: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the second power distance of points (N, N, N) from cells. Centres (M, 3) of one owner, whose
    numbers are `owners` (M,), are one cell: the least of their distances counts."""
    edge = len(points[0])
    first, second = np.full((2, edge, edge, edge), np.inf, dtype=np.float32)
    for owner in np.unique(owners):
        members = np.flatnonzero(owners == owner)
        power = np.min([_periodic_square(points, centres[k], edge) - weights[k] for k in members], axis=0)
        second = np.where(power < first, first, np.minimum(second, power))
        first = np.minimum(first, power)
    return first, second


def _periodic_square(points: list[np.ndarray], centre: np.ndarray, edge: int) -> np.ndarray:
    """Return squared distances of points (N, N, N) from a centre in a box that repeats."""
    offsets = (x - c for x, c in zip(points, centre.astype(np.float32), strict=True))
    return np.asarray(sum(np.square(offset - edge * np.round(offset / edge)) for offset in offsets))


def _grow_tree(height: np.ndarray, rng: np.random.Generator, stem: float) -> None:
    """Join a tree of tubes, whose first piece has the radius `stem`, to a field that repeats, in place."""
    tips = [(rng.uniform(0, len(height), 3), _direction(rng), stem)]
    for _ in range(PIECES):
        if not tips:
            return
        start, heading, radius = tips.pop(0)
        heading = heading + rng.uniform(0.2, 0.6) * _direction(rng)
        heading /= np.linalg.norm(heading)
        stop = start + heading * rng.uniform(1.5, 3.0) * max(radius, 2.5)
        _add_capsule(height, start, stop, radius)
        if rng.random() < 0.3:
            share = rng.uniform(0.1, 0.5)
            turn = np.cross(heading, _direction(rng))
            branches = [(share, 1.0), (1 - share, -0.5)]
            tips += [(stop, heading + bend * turn, radius * part ** (1 / 3)) for part, bend in branches]
        else:
            tips.append((stop, heading, radius * rng.uniform(0.93, 1.05)))
        tips = [tip for tip in tips if tip[2] > TWIG]


def _direction(rng: np.random.Generator) -> np.ndarray:
    """Draw a unit vector."""
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def _add_capsule(height: np.ndarray, start: np.ndarray, stop: np.ndarray, radius: float) -> None:
    """Join a tube with round ends to a field that repeats, in place."""
    reach = radius + 3
    low, high = np.floor(np.minimum(start, stop) - reach), np.ceil(np.maximum(start, stop) + reach)
    axes = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
    axes = [axis[:n] for axis, n in zip(axes, height.shape, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) - start
    along = stop - start
    t = np.clip(points @ along / max(float(along @ along), 1e-6), 0, 1)
    box = np.ix_(*(axis.astype(int) % n for axis, n in zip(axes, height.shape, strict=True)))
    depth = radius - np.linalg.norm(points - t[..., None] * along, axis=-1)
    height[box] = np.maximum(height[box], depth.astype(np.float32))
