"""A small network that fills the gap between two known slices, taught by the generator's shapes.

For each gap it reads the signed distances of the four nearest known slices, in square pixels, and for each slice in the
gap it returns the log-odds of the inside. Convolutions see `REACH` pixels at most and nothing is normalised over a
slice, so that the background around a structure, or a cut into tiles, changes nothing.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional as F

from curvafit.core.checks import check_float, check_int
from curvafit.core.records import Format
from curvafit.core.runtime import Progress, silent
from curvafit.scan.grids import centre_distance
from curvafit.segmentation.slices import WHOLE, Slices, plane_distances
from curvafit.volumes.volume import Box

FILLER_FILE = Format("curvafit filler", 1, "weights of a filler", "teach them again with `examples/teach.py`")
#: Signed distances are cut here, in pixels: what is further away does not matter for a gap of 24 pixels at most.
FAR = 16.0
#: Radius, in pixels, of what the network sees around a pixel, by convolutions and distances; a multiple of 4.
REACH = 40
#: Pixels beyond the border that the last convolutions at half and at full size need.
RIM = 8
#: Lengths in pixels by which distances and gaps are divided before the network reads them.
_DISTANCE, _GAP = 8.0, 16.0
#: Log-odds of the inside for a pixel of the cubic interpolation, before anything is learnt.
SLOPE = 0.6
#: Log-odds of the inside in known slices, beyond what the network gives: their probability is 1 in float32.
CERTAIN = 100.0
#: The weight of an image's log-odds before anything is learnt, and where they are cut.
TRUST, SUREST = 0.7, 8.0
#: Numbers that describe a slice to fill: height in the gap, distance to the nearer end, the gap, and the step in it.
CONDITIONS = 4


class Block(nn.Module):
    """Two convolutions with a shortcut; features are normalised over channels, pixel by pixel. A vector of `conditions`
    numbers scales and shifts each channel. A skip connection of `skips` channels, the same for all slices of a gap, is
    convolved once and added."""

    def __init__(self, inputs: int, outputs: int, conditions: int = 0, skips: int = 0) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.shortcut = nn.Conv2d(inputs, outputs, 1)
        self.condition = nn.Linear(conditions, 2 * outputs) if conditions else None
        self.skip = nn.Conv2d(skips, outputs, 3, padding=1) if skips else None

    def forward(self, x: Tensor, condition: Tensor | None = None, skip: Tensor | None = None) -> Tensor:
        """Return features (N, outputs, Y, X) of x (N, inputs, Y, X), a condition (N, c) and a skip (B, s, Y, X)."""
        y = self.first(x)
        if self.skip is not None and skip is not None:
            y = (y.unflatten(0, (len(skip), -1)) + self.skip(skip)[:, None]).flatten(0, 1)
        # The root mean square is over channels: one over pixels too would depend on the background around a structure.
        y = y * torch.rsqrt(y.square().mean(1, keepdim=True) + 1e-3)
        if self.condition is not None and condition is not None:
            scale, shift = self.condition(condition)[..., None, None].chunk(2, dim=1)
            y = torch.addcmul(shift, y, 1 + scale)
        return self.shortcut(x) + self.second(F.silu(y))


@dataclass(frozen=True)
class Gaps:
    """Gaps between known slices, B at a time, all with n slices to fill, `step` (B,) pixels apart. `distances` are
    signed ones in the four nearest known slices (B, 4, Y, X), in pixels, positive inside, cut at `FAR`; the gap is
    between the second and the third, Y and X are multiples of 4. Of the slices to fill (B, n, Y, X), `marks` say what
    is known, 1 inside, -1 outside, 0 unknown, and `evidence` what an image says, as log-odds."""

    distances: Tensor
    step: Tensor
    marks: Tensor
    evidence: Tensor | None = None

    @property
    def heights(self) -> Tensor:
        """The heights of the slices to fill, (n,), strictly between 0 and 1."""
        return heights_between(self.marks.shape[1]).to(self.marks.device)

    @property
    def conditions(self) -> Tensor:
        """The numbers that describe each slice to fill to the network, (B * n, CONDITIONS)."""
        t, (batch, n) = self.heights, self.marks.shape[:2]
        gap = self.step * (n + 1) / _GAP
        # A gap read from its other end is as likely: the distance to the nearer end, which is then the same, makes this
        # easy to learn. The height tells the ends apart, and the step a gap of few thick slices from one of many.
        height = torch.stack([t, torch.minimum(t, 1 - t)], dim=1).repeat(batch, 1)
        size = torch.stack([gap, self.step / 4], dim=1).repeat_interleave(n, 0)
        return torch.cat([height, size], dim=1)


def heights_between(count: int) -> Tensor:
    """Return the heights of `count` slices in a gap, evenly spaced and strictly between 0 and 1."""
    return torch.arange(1, count + 1) / (count + 1)


def interpolate(distances: Tensor, heights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the linear and the cubic (Catmull-Rom) interpolation (B, n, Y, X) of distances (B, 4, Y, X) at heights."""
    t = heights
    zero = torch.zeros_like(t)
    linear = torch.stack([zero, 1 - t, t, zero], dim=1)
    first = -0.5 * t**3 + t**2 - 0.5 * t
    second = 1.5 * t**3 - 2.5 * t**2 + 1
    third = -1.5 * t**3 + 2 * t**2 + 0.5 * t
    fourth = 0.5 * t**3 - 0.5 * t**2
    cubic = torch.stack([first, second, third, fourth], dim=1)
    return torch.einsum("nk,bkyx->bnyx", linear, distances), torch.einsum("nk,bkyx->bnyx", cubic, distances)


class Filler(nn.Module):
    """The network: an encoder of the four slices, run once a gap; a decoder, run for each slice to fill; and a
    convolution in 3D through the gap. The cubic interpolation, times `SLOPE`, is added at the end, and the evidence of
    an image, times `TRUST`: the network learns only how the log-odds differ from that."""

    def __init__(self, width: int = 16, *, image: bool = False) -> None:
        super().__init__()
        self.width = c = check_int(width, "a width of the filler", 1, 256)
        self.image, hidden = image, 32
        self.fine, self.middle, self.coarse = Block(4, c), Block(c, 2 * c), Block(2 * c, 4 * c)
        self.condition = nn.Sequential(nn.Linear(CONDITIONS, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU())
        self.deep = Block(4 * c, 4 * c, hidden)
        self.to_middle, self.up_middle = nn.Conv2d(4 * c, 2 * c, 1), Block(2 * c, 2 * c, hidden, skips=2 * c)
        self.to_fine, self.up_fine = nn.Conv2d(2 * c, c, 1), Block(c + 4 + image, c, hidden, skips=c)
        self.out = nn.Conv2d(c, 1, 1)
        self.slope = nn.Parameter(torch.tensor(SLOPE))
        self.trust = nn.Parameter(torch.tensor(TRUST)) if image else None
        self.through = nn.Sequential(
            nn.Conv3d(2 + image, 8, 3, padding=1),
            nn.SiLU(),
            nn.Conv3d(8, 8, 3, padding=1),
            nn.SiLU(),
            nn.Conv3d(8, 1, 1),
        )
        for last in (self.out, self.through[-1]):  # a new network is the interpolation itself
            nn.init.zeros_(last.weight)  # type: ignore[arg-type]
            nn.init.zeros_(last.bias)  # type: ignore[arg-type]
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, gaps: Gaps, drop: int = 0) -> Tensor:
        """Return the log-odds of the inside (B, n, Y - 2 drop, X - 2 drop) in the slices to fill. `drop` pixels at each
        border are read but not filled: 0, or a multiple of 4 from 16 on."""
        # Each stage drops the border pixels that no later one needs; the last convolutions need `rim`.
        n, rim = gaps.marks.shape[1], min(drop, RIM)
        fine = self.fine(gaps.distances / _DISTANCE)
        middle = self.middle(F.avg_pool2d(fine, 2))
        coarse = self.coarse(F.avg_pool2d(middle, 2))
        condition = self.condition(gaps.conditions)
        x = _trim(self.deep(coarse.repeat_interleave(n, 0), condition), (drop - 2 * rim) // 4)
        x = self.up_middle(_double(self.to_middle(x)), condition, _trim(middle, (drop - 2 * rim) // 2))
        x = _trim(x, rim // 2)
        distances, marks = _trim(gaps.distances, drop - rim), _trim(gaps.marks, drop - rim)
        linear, cubic = interpolate(distances, gaps.heights)
        inputs = [linear / _DISTANCE, cubic / _DISTANCE, marks, marks.abs()]
        evidence = None if gaps.evidence is None else _trim(gaps.evidence, drop - rim).clamp(-SUREST, SUREST)
        if evidence is not None:
            inputs.append(evidence / _DISTANCE)
        x = torch.cat([_double(self.to_fine(x)), torch.stack(inputs, dim=2).flatten(0, 1)], dim=1)
        x = self.up_fine(x, condition, _trim(fine, drop - rim))
        logits = self.out(x).unflatten(0, (-1, n))[:, :, 0] + self.slope * cubic
        if evidence is not None and self.trust is not None:
            logits = logits + self.trust * evidence
        # Each slice was decoded on its own: this pass sees all slices of a gap, between the two known ones.
        ends = self.slope * distances[:, 1:3]
        stack = torch.cat([ends[:, :1], logits, ends[:, 1:]], dim=1) / _DISTANCE
        known = torch.ones_like(stack)
        known[:, 1:-1] = marks.abs()
        channels = [stack, known]
        if evidence is not None:
            channels.append(F.pad(evidence / _DISTANCE, (0, 0, 0, 0, 1, 1)))
        x = torch.stack(channels, dim=1)
        for layer in self.through:
            x = _convolve(layer, x) if isinstance(layer, nn.Conv3d) else layer(x)
        return _trim(logits + x[:, 0, 1:-1], rim)


def _trim(x: Tensor, pixels: int) -> Tensor:
    """Drop pixels at the borders of the last two axes."""
    return x[..., pixels : x.shape[-2] - pixels, pixels : x.shape[-1] - pixels]


def _convolve(layer: nn.Conv3d, x: Tensor) -> Tensor:
    """Convolve x (B, c, Z, Y, X) in 3D by a convolution in 2D, to which each slice's neighbours are more channels: five
    times as fast on a processor with few channels and slices."""
    size, count = layer.kernel_size[0], x.shape[2]
    margin = size // 2
    padded = F.pad(x, (0, 0, 0, 0, margin, margin))
    neighbours = torch.cat([padded[:, :, k : k + count] for k in range(size)], dim=1)
    planes = neighbours.transpose(1, 2).flatten(0, 1).contiguous(memory_format=torch.channels_last)
    weight = layer.weight.transpose(1, 2).flatten(1, 2).contiguous(memory_format=torch.channels_last)
    return F.conv2d(planes, weight, layer.bias, padding=margin).unflatten(0, (-1, count)).transpose(1, 2)


def _double(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


# ---- volumes ---------------------------------------------------------------------------------------------------------

#: Thinner structures get smaller pixels; thicker ones get larger pixels where gaps are longer than `LONG` pixels.
THICKNESS, LONG = (3.0, 16.0), 12.0
#: Longest edge of a tile of slices that is filled at once, in pixels.
TILE = 256


def fill(
    slices: Slices,
    taught: Taught,
    box: Box = WHOLE,
    *,
    raster: Raster | None = None,
    evidence: np.ndarray | None = None,
    progress: Progress = silent,
) -> np.ndarray:
    """Return calibrated log-odds of the inside in a box of a volume between known slices, float32 (Z, Y, X).

    In known slices they are `CERTAIN` or minus that. Before the first and beyond the last they are `SLOPE` times the
    signed distance in pixels from the outline in the nearest known slice, but at most 0 in slices that are not filled
    (`Slices.unfilled`). `evidence` holds an image's log-odds (length, Y, X), which are then those of the slices before
    the first and beyond the last. `raster` has the network's pixels, by default those of the slices.
    """
    rows, *core = (slice(*edge.indices(n)[:2]) for edge, n in zip(box, slices.shape, strict=True))
    raster = replace(raster or Raster.of(slices), core=tuple(core))  # type: ignore[arg-type]
    logits = np.empty([edge.stop - edge.start for edge in (rows, *core)], dtype=np.float32)
    before, beyond = slice(0, slices.places[0]), slice(slices.places[-1] + 1, slices.length)
    for known_row, outer in ((0, before), (-1, beyond)):
        start, stop = max(outer.start, rows.start), min(outer.stop, rows.stop)
        if start < stop:
            part = logits[start - rows.start : stop - rows.start]  # a view
            if evidence is not None:
                part[:] = evidence[(slice(start, stop), *core)]
                continue
            mask, gap = slices.inside[[known_row]], slices.gap * slices.spacing[0]
            distances = plane_distances(mask, slices.spacing[1:], gap)[0]
            part[:] = (SLOPE / raster.pixel) * distances[tuple(core)].astype(np.float32)
            unfilled = slices.unfilled[start:stop]
            part[unfilled] = np.minimum(part[unfilled], 0)
    for indices, values in _fill_gaps(slices, taught, raster, rows, evidence, progress):
        in_box = (indices >= rows.start) & (indices < rows.stop)
        logits[indices[in_box] - rows.start] = values[in_box]
    positions, inside = slices.known((rows, *core))  # type: ignore[arg-type]
    logits[positions] = np.where(inside, CERTAIN, -CERTAIN)
    return logits


def _fill_gaps(
    slices: Slices, taught: Taught, raster: Raster, rows: slice, evidence: np.ndarray | None, progress: Progress
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Fill each gap that overlaps `rows` of the volume: yield the indices of the slices in it, and their log-odds as
    `fill` returns them, float32 (n, Y, X), on the core of a raster."""
    places, last = list(slices.places), len(slices.places) - 1
    start, stop, _ = rows.indices(slices.length)
    lengths = enumerate(np.diff(places).tolist())
    gaps = [(k, gap) for k, gap in lengths if gap > 1 and places[k] + 1 < stop and places[k] + gap > start]
    window, step, distances = raster.support, slices.spacing[0] / raster.pixel, dict[int, np.ndarray]()
    for done, (k, gap) in enumerate(gaps):
        progress("filling the gaps", done / len(gaps))
        # The slices at both ends of the gap and the next beyond each; beyond the last known slice, that one again.
        four = [max(k - 1, 0), k, k + 1, min(k + 2, last)]
        for row in four:
            if row not in distances:
                distances[row] = raster.distances(slices.inside[(row, *window)])
        indices = np.arange(places[k] + 1, places[k] + gap)
        known = np.stack([distances[row] for row in four])
        marks = None if slices.marks is None else raster.marks(slices.marks[(indices, *window)])
        planes = None if evidence is None else np.stack([raster.spread(p) for p in evidence[(indices, *window)]])
        logits = _fill_gap(taught.filler, known, marks, planes, gap - 1, step) / taught.temperature(gap * step)
        yield indices, raster.to_slices(logits)
    progress("filling the gaps", 1.0)


@dataclass(frozen=True)
class Raster:
    """Square pixels for slices of a `shape` with voxel `edges` (y, x): `pixel` wide, in the unit of the edges, so that
    structures are some pixels thick. They cover the part `core` (y, x) of the slices, on the grid of the whole."""

    shape: tuple[int, int]
    edges: tuple[float, float]
    pixel: float
    core: tuple[slice, slice]

    @classmethod
    def of(cls, slices: Slices) -> Raster:
        """Return pixels for whole slices."""
        edges, shape = slices.spacing[1:], slices.shape[1:]
        thickness = plane_thickness((slices.inside[k] for k in range(len(slices.places))), edges)
        pixel = choose_pixel(thickness, edges, slices.gap * slices.spacing[0])
        return cls(shape, edges, pixel, (slice(0, shape[0]), slice(0, shape[1])))

    @property
    def scale(self) -> tuple[float, float]:
        """Pixels for each voxel along both axes."""
        return (self.edges[0] / self.pixel, self.edges[1] / self.pixel)

    @property
    def size(self) -> tuple[int, int]:
        """Pixels of the core, a multiple of 4 that covers it."""
        return tuple(edge.stop - edge.start for edge in self._pixels)  # type: ignore[return-value]

    @property
    def support(self) -> tuple[slice, slice]:
        """The voxels that the core's pixels depend on, (y, x)."""
        ends = zip(self._window, self.shape, strict=True)
        return tuple(slice(max(edge.start, 0), min(edge.stop, n)) for edge, n in ends)  # type: ignore[return-value]

    def distances(self, mask: np.ndarray) -> np.ndarray:
        """Return the signed distances in a mask of `support`, in pixels, cut at `FAR`, float32. They reach `REACH`
        pixels beyond the core on each side, where the slice's border is repeated: the shape is `size` + 2 `REACH`."""
        padded = np.pad(mask, self._padding, mode="edge")
        return self._resample(centre_distance(padded, self.edges, FAR * self.pixel) / self.pixel)

    def spread(self, plane: np.ndarray) -> np.ndarray:
        """Return values on `support` in pixels, float32, of the same shape as `distances`."""
        return self._resample(np.pad(plane, self._padding, mode="edge"))

    def marks(self, marks: np.ndarray) -> np.ndarray:
        """Return marks (n, Y, X) of `support` in pixels, of the shape of `distances`, float32, 0 beyond slices. Each
        pixel has the mark of the voxel at its centre, since marks cannot be interpolated."""
        resampled = np.zeros((len(marks), *(m + 2 * REACH for m in self.size)), dtype=np.float32)
        targets, sources = [np.arange(len(marks))], [np.arange(len(marks))]
        for edge, n, pixels_per_voxel, window in zip(self._pixels, self.shape, self.scale, self.support, strict=True):
            centres = np.arange(edge.start - REACH, edge.stop + REACH) + 0.5
            voxels = np.floor(centres / pixels_per_voxel).astype(int)
            pixels = np.flatnonzero((voxels >= 0) & (voxels < n))
            targets.append(pixels)
            sources.append(voxels[pixels] - window.start)
        resampled[np.ix_(*targets)] = marks[np.ix_(*sources)]
        return resampled

    def to_slices(self, values: np.ndarray) -> np.ndarray:
        """Interpolate values in pixels (n, *size) on the voxels of the core, (n, Y, X)."""
        shape = [edge.stop - edge.start for edge in self.core]
        axes = zip(self.core, self.scale, self._pixels, strict=True)
        # The position of the core's first voxel, in pixels from the first one of `values`.
        first = [core.start * pixels_per_voxel - window.start for core, pixels_per_voxel, window in axes]
        return np.stack([_sample(plane, shape, self.scale, first) for plane in values])

    @property
    def _pixels(self) -> list[slice]:
        """The pixels from which the core's voxels are interpolated, counted in the whole slice, along both axes."""
        ranges = []
        for core, n, h in zip(self.core, self.shape, self.scale, strict=True):
            most = 4 * math.ceil(n * h / 4)
            first = 0 if core.start == 0 else max(math.floor((core.start + 0.5) * h - 0.5), 0)
            stop = most if core.stop == n else min(math.ceil((core.stop - 0.5) * h - 0.5) + 1, most)
            # The network halves pixels twice: edges at multiples of 4 pool the same pixels in any core.
            ranges.append(slice(first // 4 * 4, 4 * math.ceil(stop / 4)))
        return ranges

    @property
    def _window(self) -> list[slice]:
        """The voxels that the core's pixels depend on, along both axes, with those beyond the slices' borders."""
        ranges = []
        for edge, n, h in zip(self._pixels, self.shape, self.scale, strict=True):
            most = math.ceil((4 * math.ceil(n * h / 4) + REACH) / h)
            # Distances are cut at `FAR`: outlines further away do not matter. Two voxels more are for interpolation.
            first = math.floor((edge.start - REACH - FAR) / h) - 2
            stop = math.ceil((edge.stop + REACH + FAR) / h) + 2
            ranges.append(slice(max(first, -math.ceil(REACH / h)), min(stop, most)))
        return ranges

    @property
    def _padding(self) -> list[tuple[int, int]]:
        """Voxels of the window before and beyond the slices, along both axes."""
        return [(max(-edge.start, 0), max(edge.stop - n, 0)) for edge, n in zip(self._window, self.shape, strict=True)]

    def _resample(self, plane: np.ndarray) -> np.ndarray:
        """Interpolate values on the voxels of `_window` in pixels, `size` + 2 `REACH` of them."""
        shape = [m + 2 * REACH for m in self.size]
        axes = zip(self._pixels, self.scale, self._window, strict=True)
        start = [(edge.start - REACH) / h - window.start for edge, h, window in axes]
        return _sample(plane, shape, [1 / h for h in self.scale], start)


def _sample(plane: np.ndarray, shape: Sequence[int], step: Sequence[float], start: Sequence[float]) -> np.ndarray:
    """Interpolate a plane linearly at the centres of pixels `step` wide, the first of which has its corner at `start`,
    both in the plane's own pixels."""
    if tuple(step) == (1.0, 1.0):
        y, x = map(int, start)
        return plane[y : y + shape[0], x : x + shape[1]]
    offset = [a + 0.5 * h - 0.5 for a, h in zip(start, step, strict=True)]
    return ndimage.affine_transform(plane, np.diag(step), offset, shape, np.float32, order=1, mode="nearest")  # type: ignore[arg-type]


def plane_thickness(masks: Iterable[np.ndarray], edges: Sequence[float]) -> float:
    """Return the mean thickness of a structure in masks (Y, X) with voxel edges (y, x), in their unit: four times the
    mean distance of inside voxels from the outline, as in a strip of this width; infinite without an outline."""
    total, count = 0.0, 0
    for mask in masks:
        if mask.any() and not mask.all():
            distances = centre_distance(mask, edges)[mask]
            total += float(distances.sum(dtype=np.float64))
            count += len(distances)
    return 4 * total / count if count else math.inf


def choose_pixel(thickness: float, edges: Sequence[float], gap: float) -> float:
    """Return the edge of a pixel for a structure's mean thickness, voxel edges (y, x) and the largest gap, in the unit
    of them all: the finest voxel edge, but smaller for thin structures, and larger for thick ones with long gaps."""
    finest = min(edges)
    thick, long = thickness / finest, gap / finest  # in voxels
    coarser = float(np.clip(long / LONG, 1.0, max(thick / THICKNESS[1], 1.0)))
    return finest * min(thick / THICKNESS[0], coarser)


@torch.inference_mode()
def _fill_gap(
    filler: Filler, known: np.ndarray, marks: np.ndarray | None, evidence: np.ndarray | None, count: int, step: float
) -> np.ndarray:
    """Return the log-odds (count, Y, X) in the slices of a gap, given the distances (4, Y', X') of four known slices;
    the inputs extend `REACH` pixels beyond Y and X on all sides. The network runs tile by tile, and only where pixels
    are not far inside or far outside in all four slices, unless marks or evidence may change those too."""
    distances = torch.from_numpy(np.ascontiguousarray(known))
    uncertain = _trim(~((distances == FAR).all(0) | (distances == -FAR).all(0)), REACH)
    if marks is not None or evidence is not None:
        uncertain = torch.ones_like(uncertain)
    all_marks = torch.zeros(1, count, *known.shape[1:]) if marks is None else torch.from_numpy(marks)[None]
    planes = None if evidence is None else torch.from_numpy(np.ascontiguousarray(evidence))[None]
    logits = SLOPE * interpolate(_trim(distances, REACH)[None], heights_between(count))[0][0]
    for y, x in product(*(range(0, n, TILE) for n in uncertain.shape)):
        core = (slice(y, y + TILE), slice(x, x + TILE))
        if uncertain[core].any():
            window = (..., slice(y, y + TILE + 2 * REACH), slice(x, x + TILE + 2 * REACH))
            tile_planes = None if planes is None else planes[window]
            gaps = Gaps(distances[window][None], torch.tensor([step]), all_marks[window], tile_planes)
            logits[:, *core] = torch.where(uncertain[core], filler(gaps, REACH)[0], logits[:, *core])
    return logits.numpy()


# ---- files -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Taught:
    """A trained filler with its calibration. `temperatures` (2, k) are gaps in pixels, ascending, and the numbers that
    divide log-odds there; `error` is the calibration error near surfaces on held-out shapes, or an example. The `card`,
    of JSON's types, says what taught it and how well it does on held-out shapes; `status` begins a sentence on it."""

    filler: Filler
    temperatures: np.ndarray
    card: dict[str, Any]
    error: float
    status: str = "filled by the network"

    def temperature(self, gap: float) -> float:
        """Return the number by which log-odds are divided in a gap of so many pixels."""
        return float(np.interp(gap, *self.temperatures))

    @property
    def digest(self) -> str:
        """A text that changes with weights and temperatures."""
        content = hashlib.sha256(self.temperatures.tobytes())
        for value in self.filler.state_dict().values():
            content.update(value.numpy().tobytes())
        return content.hexdigest()[:16]

    def save(self, path: str | Path) -> None:
        """Write weights and card as one `.npz`; nothing in it runs when it is read."""
        arrays = {name: value.numpy() for name, value in self.filler.state_dict().items()}
        header = {"width": self.filler.width, "image": self.filler.image, "card": self.card, "error": self.error}
        FILLER_FILE.write(path, header, {"temperatures": self.temperatures, **arrays})

    @classmethod
    def load(cls, path: str | Path | None = None, *, image: bool = False) -> Taught:
        """Read a filler, by default a packaged one: without images, or for the evidence of an image. Raises
        FileNotFoundError if there is no such file, and ValueError if it is something else, damaged, of another version,
        or taught otherwise with regard to images."""
        if path is None:
            return FILLER_FILE.read_packaged("segmentation", "image.npz" if image else "filler.npz", cls._of)
        taught = FILLER_FILE.read(path, cls._of)
        if taught.filler.image != image:
            ways = ("with", "without") if image else ("without", "with")
            raise ValueError(f"{path} must be a filler taught {ways[0]} images, but was taught {ways[1]} them")
        return taught

    @classmethod
    def _of(cls, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Taught:
        temperatures = arrays.pop("temperatures")
        if not all(np.isfinite(array).all() for array in (temperatures, *arrays.values())):
            raise ValueError("numbers that are not finite")
        if temperatures.ndim != 2 or len(temperatures) != 2 or not (temperatures > 0).all():
            raise ValueError("temperatures that are not positive")
        with torch.random.fork_rng():  # first weights are drawn, and then replaced
            filler = Filler(header["width"], image=header.get("image", False)).eval()
        filler.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})
        error = check_float(header["error"], "an error", 0.0, 1.0)
        taught = cls(filler, temperatures, dict(header["card"]), error)
        return replace(taught, status=f"{cls.status}, which also read the image") if filler.image else taught
