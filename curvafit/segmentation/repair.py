"""A small network that repairs the masks of other networks, taught by the generator's shapes.

It reads log-odds and the signed distance of the mask that they make, on cubes of a size that makes structures a few
voxels thick, and says by how much the log-odds change: it closes breaks, opens false bridges, fills holes, drops specks
and smooths staircases where the surroundings show it. It sees `REACH` voxels at most.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from curvafit.core.checks import check_float, check_int
from curvafit.core.files import open_packaged
from curvafit.core.records import Format
from curvafit.core.runtime import Progress, silent
from curvafit.scan.grids import centre_distance, resample
from curvafit.segmentation.filler import plane_thickness
from curvafit.segmentation.uncertainty import best_log_odds
from curvafit.volumes.formats.part import Box, cut_boxes, grow, within

REPAIRER_FILE = Format("curvafit repairer", 1, "weights of a repairer", "teach them again with `atlas teach --repair`")
#: Log-odds are cut here: what a network is surer of does not matter.
SUREST = 8.0
#: Signed distances are cut here, in voxels. As far from the surface, log-odds of this size or more stay as they are.
FAR, SURE = 8.0, 4.0
#: Voxels beyond which nothing is seen, a multiple of 4.
REACH = 28
#: Interval of the mean thickness of structures, in voxels of the grid on which they are repaired.
THICKNESS = (3.0, 14.0)
#: Longest side of a tile that is repaired at once, in voxels, without its surroundings; a multiple of 4.
TILE = 128
#: About so many planes across each axis say how thick a structure is.
PLANES = 16
#: Most voxels of the grid on which a volume is repaired: beyond, they are larger.
MOST = 512**3


class Block3(nn.Module):
    """Two convolutions in 3D with a shortcut; features are normalised over channels, voxel by voxel."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Conv3d(inputs, outputs, 3, padding=1)
        self.second = nn.Conv3d(outputs, outputs, 3, padding=1)
        self.shortcut = nn.Conv3d(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return features (B, outputs, Z, Y, X) of x (B, inputs, Z, Y, X)."""
        y = self.first(x)
        y = y * torch.rsqrt(y.square().mean(1, keepdim=True) + 1e-3)
        return self.shortcut(x) + self.second(F.silu(y))


class RepairNet(nn.Module):
    """The network: blocks at a half and a quarter of the voxels, and a last pass at all of them.

    Eight voxels are one at the half, with eight times the channels, which is what makes it quick.
    """

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        c = check_int(width, "a width of the repairer", 1, 256)
        self.width = c
        self.fine, self.coarse, self.deep = Block3(8 * 3, c), Block3(c, 2 * c), Block3(2 * c, 2 * c)
        self.up, self.out = Block3(3 * c, c), nn.Conv3d(c, 8, 1)
        self.last = nn.Sequential(nn.Conv3d(4, 8, 3, padding=1), nn.SiLU(), nn.Conv3d(8, 1, 3, padding=1))
        self.trust = nn.Parameter(torch.tensor(1.0))
        for end in (self.out, self.last[-1]):
            nn.init.zeros_(end.weight)  # type: ignore[arg-type]
            nn.init.zeros_(end.bias)  # type: ignore[arg-type]
        self.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]

    def forward(self, odds: Tensor, distances: Tensor) -> Tensor:
        """Return the log-odds of the inside (B, Z, Y, X), of log-odds and signed distances (B, Z, Y, X).

        The distances are those of the mask in voxels, positive inside; Z, Y and X are multiples of 4.
        """
        odds = odds.clamp(-SUREST, SUREST)
        given = torch.stack([torch.tanh(odds / 2), odds / SUREST, distances / FAR], dim=1)
        fine = self.fine(_fold(given).contiguous(memory_format=torch.channels_last_3d))
        deep = self.deep(self.coarse(F.avg_pool3d(fine, 2)))
        up = F.interpolate(deep, scale_factor=2, mode="trilinear", align_corners=False)
        change = _unfold(self.out(self.up(torch.cat([fine, up], dim=1))))
        change = change + self.last(torch.cat([change / SUREST, given], dim=1))
        return self.trust * odds + change[:, 0]


def _fold(x: Tensor) -> Tensor:
    """Return volumes (B, c, Z, Y, X) with eight voxels as channels of one, (B, 8 c, Z / 2, Y / 2, X / 2)."""
    for axis in (2, 3, 4):
        x = torch.cat([x[(slice(None),) * axis + (slice(k, None, 2),)] for k in (0, 1)], dim=1)
    return x


def _unfold(x: Tensor) -> Tensor:
    """Return volumes (B, 8, Z, Y, X), each voxel as eight, (B, 1, 2 Z, 2 Y, 2 X)."""
    for axis in (4, 3, 2):
        x = torch.stack(x.chunk(2, dim=1), dim=axis + 1).flatten(axis, axis + 1)
    return x


# ---- volumes ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Repairer:
    """A network that repairs masks, with its card: what taught it, and how well it does on shapes held out.

    Attributes
    ----------
    temperature
        By what log-odds are divided to be true probabilities.
    card
        Stores, seeds, steps, versions and held-out figures, of JSON's types.
    error
        The calibration error near surfaces, on shapes held out or on an example.
    helps
        Whether masks are repaired: on an example, p > 1/2 may be as good.
    status
        What is done, as the beginning of a sentence.
    """

    network: RepairNet
    temperature: float
    card: dict[str, Any]
    error: float
    helps: bool = True
    status: str = "repaired by the network"

    def save(self, path: str | Path) -> None:
        """Write weights and card as one `.npz`; nothing in it runs when it is read."""
        header = {"width": self.network.width, "temperature": self.temperature, "card": self.card, "error": self.error}
        header |= {"helps": self.helps, "status": self.status}
        REPAIRER_FILE.write(path, header, {name: value.numpy() for name, value in self.network.state_dict().items()})

    @classmethod
    def load(cls, path: str | Path | None = None) -> Repairer:
        """Read a repairer, by default the packaged one.

        Raises FileNotFoundError if there is no such file, and ValueError if it is something else or is damaged.
        """
        if path is None:
            packaged = open_packaged("segmentation", "repairer.npz")
            return REPAIRER_FILE.read(packaged, cls._of, place="the packaged repairer")
        return REPAIRER_FILE.read(path, cls._of)

    @classmethod
    def _of(cls, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Repairer:
        if not all(np.isfinite(each).all() for each in arrays.values()):
            raise ValueError("numbers that are not finite")
        with torch.random.fork_rng():  # first weights are drawn, and then replaced
            network = RepairNet(header["width"]).eval()
        network.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})
        temperature = check_float(header["temperature"], "a temperature", 1e-3, 1e3)
        error = check_float(header["error"], "an error", 0.0, 1.0)
        status = str(header.get("status", cls.status))
        return cls(network, temperature, dict(header["card"]), error, bool(header.get("helps", True)), status)

    def repair(self, odds: np.ndarray, spacing: Sequence[float], progress: Progress = silent) -> np.ndarray:
        """Return the log-odds of the inside (Z, Y, X), float32, of the log-odds of another network.

        What is far inside or far outside, and sure, stays. Where the mask has no surface, all stays as it is.
        """
        inside = odds > 0
        if not self.helps or inside.all() or not inside.any():
            return odds.astype(np.float32)
        pixel = choose_pixel(inside, spacing)
        pixel *= max(1.0, math.prod(odds.shape) * math.prod(spacing) / pixel**3 / MOST) ** (1 / 3)
        scale = [pixel / h for h in spacing]
        cut = odds.clip(-SUREST, SUREST).astype(np.float32)
        if all(abs(s - 1) < 1e-6 for s in scale):
            return self._repair_cubes(cut, progress) / np.float32(self.temperature)
        shape = [math.ceil(n / s) for n, s in zip(odds.shape, scale, strict=True)]
        cubes = resample(cut, scale, (0, 0, 0), shape)
        change = self._repair_cubes(cubes, progress) - cubes
        back = resample(change, [1 / s for s in scale], (0, 0, 0), odds.shape)
        return (cut + back) / np.float32(self.temperature)

    def threshold(self, odds: np.ndarray) -> float:
        """Return the log-odds above which repaired voxels are inside: those of the mask with the best expected Dice; 0
        where nothing is repaired."""
        inside = odds > 0
        return best_log_odds(odds) if self.helps and inside.any() and not inside.all() else 0.0

    @torch.inference_mode()
    def _repair_cubes(self, odds: np.ndarray, progress: Progress) -> np.ndarray:
        """Return log-odds on the grid on which structures are `THICKNESS` thick, tile by tile."""
        inner = tuple(slice(n) for n in odds.shape)
        odds = np.ascontiguousarray(np.pad(odds, [(0, -n % 4) for n in odds.shape], mode="edge"), dtype=np.float32)
        found = odds.copy()
        tiles = cut_boxes(odds.shape, TILE)
        for number, core in enumerate(tiles):
            progress("repairing", number / len(tiles))
            seen = grow(core, REACH, odds.shape)
            distances, own = _measure_distances(odds, seen), within(core, seen)
            stays = (np.abs(distances[own]) >= FAR) & (np.abs(odds[core]) >= SURE)
            if stays.all():
                continue
            given = (torch.from_numpy(np.ascontiguousarray(each))[None] for each in (odds[seen], distances))
            found[core] = np.where(stays, odds[core], self.network(*given)[0].numpy()[own])
        progress("repairing", 1.0)
        return found[inner]


def _measure_distances(odds: np.ndarray, box: Box) -> np.ndarray:
    """Return the signed distances in a box of the mask of log-odds, cut at `FAR`."""
    wider = grow(box, math.ceil(FAR) + 1, odds.shape)
    return centre_distance(odds[wider] > 0, (1.0, 1.0, 1.0), FAR)[within(box, wider)]


def choose_pixel(inside: np.ndarray, spacing: Sequence[float]) -> float:
    """Return the edge of the cubes on which a structure is repaired: voxels of the finest axis, unless it is then
    thinner or thicker than `THICKNESS`."""
    finest, thick = min(spacing), []
    if not inside.any():
        return finest
    for axis in range(3):
        planes = np.moveaxis(inside, axis, 0)
        planes = planes[planes.any((1, 2))]
        edges = [h for k, h in enumerate(spacing) if k != axis]
        thick.append(plane_thickness(planes[:: max(len(planes) // PLANES, 1)], edges))
    thickness = float(np.min(thick)) / finest
    if not math.isfinite(thickness):
        return finest
    return finest * thickness / float(np.clip(thickness, *THICKNESS))
