"""The tiles of a volume: boxes of voxels, with the overlap at which a cut is not felt any more."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise, product

from curvafit.core.checks import check_int
from curvafit.priors.grid import MOST
from curvafit.segmentation.engine import HALO
from curvafit.segmentation.working import Ends, WorkingGrid
from curvafit.volumes.field import Field
from curvafit.volumes.formats.part import Box

__all__ = ["EDGE", "OVERLAP", "WHOLE", "Tile", "Tiling"]

#: Working voxels beyond a tile that are lowered with it: at that distance the cut is not felt any more.
OVERLAP = 24
#: Most working voxels that are lowered at once by default, and the edge of a tile where there are more.
WHOLE, EDGE = 256**3, 192
#: Shortest edge of a tile, in working voxels.
SHORTEST = 8


@dataclass(frozen=True)
class Tile:
    """A part of a volume.

    Attributes
    ----------
    number
        Its number, from 0.
    core
        The voxels that it gives.
    box
        The voxels that it is lowered on: with the overlap. In a volume that repeats they may lie around it.
    ends
        Whether the box ends where the volume does, on either side of each axis.
    """

    number: int
    core: Box
    box: Box
    ends: Ends

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape of the box."""
        return tuple(edge.stop - edge.start for edge in self.box)  # type: ignore[return-value]

    @property
    def inner(self) -> Box:
        """The core within the box."""
        pairs = zip(self.core, self.box, strict=True)
        return tuple(slice(c.start - b.start, c.stop - b.start) for c, b in pairs)  # type: ignore[return-value]


@dataclass(frozen=True)
class Tiling:
    """A volume in tiles.

    Attributes
    ----------
    shape
        Voxels of the volume.
    place
        The grid of the whole volume.
    counts
        Number of tiles along each axis, whose sizes differ by a voxel at most.
    """

    shape: tuple[int, int, int]
    place: WorkingGrid
    counts: tuple[int, int, int]

    @classmethod
    def of(cls, frame: Field, epsilon: float | None, edge: int | None = None, *, periodic: bool = False) -> Tiling:
        """Return the tiles of a volume, of at most `edge` working voxels a side without the overlap.

        By default the volume is one tile where it has at most `WHOLE` working voxels, else tiles of `EDGE`.

        Raises
        ------
        ValueError
            If the edge is not a whole number from `SHORTEST`, or as `WorkingGrid.of`.
        """
        place = WorkingGrid.of(frame, epsilon, halo=HALO, periodic=periodic)
        if edge is None:
            edge = max(place.grid.shape) if math.prod(place.grid.shape) <= WHOLE else EDGE
        edge = check_int(edge, f"a tile of {SHORTEST} or more working voxels a side", SHORTEST, MOST)
        pairs = zip(frame.shape, place.times, strict=True)
        return cls(frame.shape, place, tuple(-(-n // max(1, edge // times)) for n, times in pairs))  # type: ignore[arg-type]

    @property
    def count(self) -> int:
        """The number of tiles."""
        return math.prod(self.counts)

    @property
    def tiles(self) -> list[Tile]:
        """The tiles, z slowest."""
        axes = (self._axis(axis) for axis in range(3))
        return [Tile(k, *zip(*edges, strict=True)) for k, edges in enumerate(product(*axes))]  # type: ignore[arg-type]

    def place_of(self, tile: Tile) -> WorkingGrid:
        """Return the grid of a tile's box."""
        return self.place if self.count == 1 else self.place.part(tile.shape, tile.ends)

    @property
    def voxels(self) -> list[int]:
        """The working voxels of each tile's box."""
        return [math.prod(self.place_of(tile).grid.shape) for tile in self.tiles]

    def _axis(self, axis: int) -> list[tuple[slice, slice, tuple[bool, bool]]]:
        """Return core, box and ends of the tiles along an axis."""
        n, times, count = self.shape[axis], self.place.times[axis], self.counts[axis]
        periodic, overlap = self.place.grid.periodic, -(-OVERLAP // times)
        if self.count == 1:
            return [(slice(0, n), slice(0, n), (True, True))]
        edges = [k * n // count for k in range(count + 1)]
        tiles = []
        for start, stop in pairwise(edges):
            first, last = start - overlap, stop + overlap
            ends = (first <= 0 and not periodic, last >= n and not periodic)
            box = slice(0 if ends[0] else first, n if ends[1] else last)
            tiles.append((slice(start, stop), box, ends))
        return tiles
