"""Teach a filler what an image is worth: by shapes that all modalities see, each read from some of its slices."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curvafit.core.checks import check_int, check_seed
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.data_synth.imaging.image import field_shape, image, regrid
from curvafit.data_synth.imaging.modality import MODALITIES
from curvafit.segmentation.filler import REACH, Filler, Raster, Taught
from curvafit.segmentation.image import read_image
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.teach import HALO, HELD_OUT, JUDGED, Texture, Whole, WholeLessons, learn_and_judge

#: Steps of teaching, and volumes that teach.
STEPS, VOLUMES = 1500, 160
#: Voxels of a shape along a slice, at most but for the thinnest structures.
FINEST = 160
#: Shares of a volume between which it teaches.
FILLED = (0.01, 0.9)


@dataclass(frozen=True)
class ImageMix:
    """How imaged shapes are drawn; lengths in pixels, shares from 0 to 1.

    Intervals of the structures' `thickness` (uniform in the logarithm; thick where a slice would be too many voxels)
    and of the slices from a known one to the next, `gap`, at most `longest` pixels; a slice's side and gaps of a
    volume; the share of images with noise besides the modality's, and the interval of its deviation, in contrasts.
    """

    thickness: tuple[float, float] = (3.0, 14.0)
    gap: tuple[int, int] = (2, 15)
    longest: float = 20.0
    edge: int = 80
    gaps: int = 3
    noisy: float = 0.5
    noise: tuple[float, float] = (0.3, 2.5)


def image_shape(textures: Sequence[Sequence[Texture]], mix: ImageMix, seed: Sequence[int]) -> Whole:
    """Return a shape and what an image of it says where every `gap`-th slice is known, in pixels; any axis is first."""
    rng = np.random.default_rng(seed)
    while True:
        source = textures[int(rng.integers(len(textures)))]
        texture = source[int(rng.integers(len(source)))]
        names = list(MODALITIES)
        how = MODALITIES[names[int(rng.integers(len(names)))]].draw(int(rng.integers(2**31)))
        turn = rng.permutation(3)
        edges = np.array(how.spacing)[turn]
        finest = float(edges[1:].min())
        gap = int(rng.integers(mix.gap[0], max(mix.gap[0], min(mix.gap[1], int(mix.longest * finest / edges[0]))) + 1))
        sides = np.ceil(mix.edge * finest / edges[1:]).astype(int)
        shape = np.empty(3, dtype=int)
        shape[turn] = [mix.gaps * gap + 1, *sides]
        low, high = mix.thickness
        low = min(max(low, mix.edge * texture.thickness / FINEST), high)
        edge = math.exp(rng.uniform(math.log(low), math.log(high))) * finest / texture.thickness
        size = field_shape(shape.tolist(), edge, how)
        start = rng.integers(0, texture.values.shape)
        rows = [(a + np.arange(n)) % m for a, n, m in zip(start, size, texture.values.shape, strict=True)]
        field = torch.from_numpy(np.ascontiguousarray(texture.values[np.ix_(*rows)], dtype=np.float32))
        seen = image(field, edge, how, int(rng.integers(2**31))).numpy()
        inside = regrid(field, edge, how).numpy() > 0
        box = tuple(slice(n) for n in shape)
        seen, inside = (np.ascontiguousarray(each[box].transpose(turn)) for each in (seen, inside))
        known = inside[::gap]
        if FILLED[0] < inside.mean() < FILLED[1] and not known.all() and known.any():
            break
    if rng.random() < mix.noisy:
        contrast = abs(float(seen[inside].mean()) - float(seen[~inside].mean()))
        deviation = math.exp(rng.uniform(*np.log(mix.noise))) * contrast
        seen = seen + deviation * rng.standard_normal(seen.shape, dtype=np.float32)
    slices = Slices(known, tuple(range(0, len(inside), gap)), len(inside), tuple(edges.tolist()))
    raster, margin = Raster.of(slices), slice(REACH - HALO, HALO - REACH)
    distances = np.stack([raster.distances(mask)[margin, margin] for mask in inside])
    evidence = np.stack([raster.spread(plane)[margin, margin] for plane in read_image(seen, slices)[0]])
    return Whole(distances, gap, slices.spacing[0] / raster.pixel, evidence)


def teach_image(
    sources: Sequence[Sequence[Texture]],
    plain: Taught,
    card: dict[str, Any],
    *,
    steps: int = STEPS,
    volumes: int = VOLUMES,
    seed: int = 0,
    checkpoint: Path | None = None,
    workers: int = 1,
    progress: Progress = silent,
) -> Taught:
    """Teach a plain filler to weigh the evidence of images; of each source every tenth shape is held out to judge it.

    Parameters
    ----------
    volumes
        Imaged shapes that teach; a tenth as many judge.

    The other parameters are those of `teach`.
    """
    steps, seed = check_int(steps, "a number of steps from 1", 1, 10**7), check_seed(seed)
    volumes = check_int(volumes, "a number of volumes from 1", 1, 10**5)
    mix = ImageMix()
    held = [source[HELD_OUT - 1 :: HELD_OUT] or source for source in sources]
    taught = [[each for k, each in enumerate(source) if (k + 1) % HELD_OUT] for source in sources]
    count = volumes + max(volumes // 10, 1)
    wholes = []
    for number in range(count):
        progress(f"imaging shape {number + 1} of {count}", 0.3 * number / count)
        wholes.append(image_shape(taught if number < volumes else held, mix, (seed, number)))
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        filler = Filler.with_image(plain.filler)
    lessons, exam = WholeLessons(wholes[:volumes], steps, seed), WholeLessons(wholes[volumes:], JUDGED, seed + 1)
    said = {"plain": plain.card, "volumes": volumes, "steps": steps, "seed": seed, "mix": asdict(mix)}
    tools = {"checkpoint": checkpoint, "workers": workers, "progress": sub_progress(progress, 0.3, 1.0)}
    return learn_and_judge(filler, lessons, exam, {**card, **said}, **tools)  # type: ignore[arg-type]
