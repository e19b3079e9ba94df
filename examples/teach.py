"""Teach the network that `curvafit reconstruct` fills volumes with, from generated shapes and masks.

python examples/teach.py mixed -o filler.npz                               # two hours; a stopped run goes on
python examples/teach.py mixed mine.nii.gz --filler filler.npz -o mine.npz # with masks of your own, from there
python examples/teach.py mixed store --images 160 -o image.npz             # for `reconstruct --image`

Sources are stores made by `curvafit atlas build`, masks, or `mixed`: textures of no law. Windows of a shape are cut at
any rotation, scale and stretch: a shape that repeats has no border. Faults of slices that a person draws are added:
outlines that tremble, slices that are shifted, specks, structures of two calibres, slices that are known in part.
"""

from __future__ import annotations

import argparse
import copy
import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
import typer
from mixed import KINDS
from scipy import ndimage
from torch.nn import functional as F
from torch.utils.data import DataLoader

from curvafit.cli.console import plain_errors, resumable, say_notes, show_stages
from curvafit.core.checks import check_int, check_seed
from curvafit.core.files import remove
from curvafit.core.records import can_write
from curvafit.core.runtime import Progress, listen, silent, sub_progress
from curvafit.data_synth.imaging.modality import MODALITIES, field_shape, image, regrid
from curvafit.data_synth.store import HEADER, find_well_formed
from curvafit.scan.grids import centre_distance
from curvafit.segmentation.filler import (
    FAR,
    FILLER_FILE,
    REACH,
    SLOPE,
    Filler,
    Gaps,
    Raster,
    Taught,
    interpolate,
    plane_thickness,
)
from curvafit.segmentation.image import read_image
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.teach import HALO, Batches, Lesson, Whole, WholeLessons, learn, near_error
from curvafit.segmentation.uncertainty import fit_temperature
from curvafit.volumes.read import load
from curvafit.volumes.run import open_run

#: Steps of teaching, with images too, and the greatest rate.
STEPS, IMAGE_STEPS, RATE = 4500, 1500, 2e-3
#: Shares of a volume between which a shape teaches, and the number of shapes below which they teach little.
FILLED, FEW = (0.02, 0.75), 200
#: The source that is no file: `TEXTURES` of each of `textures.KINDS`.
MIXED, TEXTURES = "mixed", 90
#: Voxels of an imaged shape along a slice, at most but for the thinnest structures, and shares as `FILLED` of it.
FINEST, IMAGED = 160, (0.01, 0.9)
#: The largest gap, in thicknesses of a structure, that can be learnt.
SLIMMEST = 4.0
#: One of so many shapes is held out.
HELD_OUT = 10
#: Batches of shapes held out, and temperatures that are fitted to them.
JUDGED, TEMPERATURES = 80, 5


# ---- lessons ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Texture:
    """A shape that teaches: a field (Z, Y, X), positive inside, that repeats or ends; and its thickness in voxels."""

    values: np.ndarray
    periodic: bool = True
    thickness: float = field(init=False)

    def __post_init__(self) -> None:
        stacks = [np.moveaxis(self.values, axis, 0)[::4] > 0 for axis in range(3)]  # some planes are enough
        thicknesses = [plane_thickness(masks, (1.0, 1.0)) for masks in stacks]
        object.__setattr__(self, "thickness", float(np.mean(thicknesses)))

    def read(self, points: np.ndarray) -> np.ndarray:
        """Interpolate the field at points (3, ...), in voxels."""
        mode = "grid-wrap" if self.periodic else "mirror"
        return ndimage.map_coordinates(self.values, points, np.float32, order=1, mode=mode, prefilter=False)

    def cut(self, rng: np.random.Generator, axes: Sequence[np.ndarray], thickness: float, mix: Mix) -> np.ndarray:
        """Cut a window, bool (Z, Y, X), anywhere in the shape, turned and stretched at random. `axes` are the positions
        of its voxels along three axes; its structures get the `thickness`, in the same unit. A shape that ends is
        turned by right angles alone: beyond its ends it is a mirror image."""
        voxels_per_unit = self.thickness / thickness
        if rng.random() < mix.upright or not self.periodic:
            rotation = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)[:, None]
        else:
            rotation, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        matrix = rotation * (voxels_per_unit * np.exp(mix.stretch * rng.standard_normal(3)))
        grid = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(3, -1)
        corner = rng.uniform(0, self.values.shape)[:, None]
        return self.read(matrix @ grid + corner).reshape([len(axis) for axis in axes]) > 0


@dataclass(frozen=True)
class Mix:
    """How windows are drawn at random; lengths in pixels. Intervals of the structures' `thickness` (uniform in the
    logarithm) and of the `gap`, the `most` slices to fill, and the deviation of the logarithm of each axis' `stretch`.
    The others are probabilities of a window: to lie along the axes of the shape (`upright`); to have slices not one
    pixel apart (`coarse`), no known slice beyond an end of the gap (`ends`), structures of two shapes (`pairs`), inside
    and outside swapped (`holes`), outlines as a person draws them (`trembling`), voxels known between (`partial`)."""

    thickness: tuple[float, float] = (3.0, 24.0)
    gap: tuple[float, float] = (2.0, 20.0)
    most: int = 15
    upright: float = 0.6
    stretch: float = 0.2
    coarse: float = 0.3
    ends: float = 0.2
    pairs: float = 0.1
    holes: float = 0.05
    trembling: float = 0.15
    partial: float = 0.15


@dataclass(frozen=True, eq=False)
class Lessons(Batches):
    """Batches of `size` gaps in windows of shapes; batch k depends on (seed, k) alone. Each of the `sources` of shapes
    is drawn as often as the others; `edge` pixels of a window's side count for the loss."""

    sources: Sequence[Sequence[Texture]]
    mix: Mix
    seed: int
    length: int
    size: int = 8
    edge: int = 80
    halo: int = HALO

    def __getitem__(self, number: int) -> Lesson:
        rng = np.random.default_rng([self.seed, number])
        count = int(rng.integers(1, self.mix.most + 1))
        gaps: list[tuple[np.ndarray, float, np.ndarray, np.ndarray]] = []
        while len(gaps) < self.size:
            step = self._draw_step(rng, count)
            window = self._draw_window(rng, count, step)
            answer = window[2:-2][self.inner]
            if answer.any() and not answer.all():  # else there is nothing to learn
                gaps.append(self._pose(rng, window, step))
        distances, steps, marks, truth = zip(*gaps, strict=True)
        return np.stack(distances), np.array(steps, np.float32), np.stack(marks), None, np.stack(truth)

    def _draw_step(self, rng: np.random.Generator, count: int) -> float:
        """Draw the distance between slices, of which so many lie in a gap."""
        step = 1.0
        if rng.random() < self.mix.coarse:
            step = float(np.exp(rng.uniform(math.log(0.5), math.log(6))))
        low, high = self.mix.gap
        return step if low <= step * (count + 1) <= high else float(rng.uniform(low, high)) / (count + 1)

    def _draw_window(self, rng: np.random.Generator, count: int, step: float) -> np.ndarray:
        """Draw slices of a structure, bool (count + 4, Y, X): two known ones, those to fill, two known ones. Three gaps
        of the same length lie between the known ones."""
        plane = np.arange(self.edge + 2 * self.halo, dtype=np.float64)
        heights = step * np.array([-count - 1, *range(count + 2), 2 * count + 2], dtype=np.float64)
        mix, (low, high) = self.mix, self.mix.thickness
        low = min(max(low, step * (count + 1) / SLIMMEST), high)  # thinner structures cannot be predicted in this gap

        def cut() -> np.ndarray:
            textures = self.sources[int(rng.integers(len(self.sources)))]
            texture = textures[int(rng.integers(len(textures)))]
            thickness = float(np.exp(rng.uniform(math.log(low), math.log(high))))
            return texture.cut(rng, (heights, plane, plane), thickness, mix)

        inside = cut()
        if rng.random() < mix.pairs:
            inside |= cut()
        return ~inside if rng.random() < mix.holes else inside

    def _pose(
        self, rng: np.random.Generator, window: np.ndarray, step: float
    ) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
        """Return a window as a gap: distances in known slices (4, Y, X), the step, marks and truth (n, Y, X)."""
        known, truth = window[[0, 1, -2, -1]], window[2:-2]
        if rng.random() < self.mix.trembling:
            known = np.stack([tremble(mask, rng) for mask in known])
        distances = np.stack([centre_distance(mask, (1.0, 1.0), FAR) for mask in known])
        if rng.random() < self.mix.ends:
            distances[0] = distances[1]
        if rng.random() < self.mix.ends:
            distances[3] = distances[2]
        marks = np.zeros(truth.shape, np.float32)
        if rng.random() < self.mix.partial:
            marks = np.where(_draw_known(truth.shape, rng), 2 * truth.astype(np.float32) - 1, 0).astype(np.float32)
        return distances, step, marks, truth.astype(np.float32)


def tremble(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a mask as a person draws it: shifted by about a pixel, with a wavy outline and a few specks."""
    wave = ndimage.gaussian_filter(rng.standard_normal(mask.shape, dtype=np.float32), 2.0)
    level = centre_distance(mask, (1.0, 1.0), FAR) + rng.uniform(0, 1.0) * wave / wave.std()
    level = ndimage.shift(level, rng.normal(0, 0.7, 2), order=1, mode="nearest")
    specks = ndimage.gaussian_filter((rng.random(mask.shape) < 5e-4).astype(np.float32), 1.0) > 0.06
    return (level > 0) ^ specks


def _draw_known(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Draw which voxels of the slices to fill are known, bool (n, Y, X): planes across y or x, or part of one slice."""
    known = np.zeros(shape, bool)
    count, ys, xs = shape
    choice = rng.random()
    if choice < 0.35:
        known[:, int(rng.integers(ys)) :: max(ys // 2, 8)] = True
    elif choice < 0.7:
        known[:, :, int(rng.integers(xs)) :: max(xs // 2, 8)] = True
    else:
        y, x = int(rng.integers(ys // 2)), int(rng.integers(xs // 2))
        known[int(rng.integers(count)), y : y + ys // 2, x : x + xs // 2] = True
    return known


def load_textures(
    sources: Sequence[str | Path], progress: Progress = silent
) -> tuple[list[list[Texture]], dict[str, Any]]:
    """Load the shapes of stores and mask files that can teach, one list for each source, and a card that describes
    them; `MIXED` is a source for each of `KINDS`. All well-formed shapes of a store are periodic, a mask is not; those
    that fill between `FILLED` are taken. Raises ValueError and FileNotFoundError as `open_store` and `load`."""
    textures, origins = [], []
    named = [each for source in map(str, sources) for each in (KINDS if source == MIXED else (source,))]
    for number, source in enumerate(map(Path, named)):
        if (kind := str(source)) in KINDS:
            shapes = [Texture(KINDS[kind](np.random.default_rng([*kind.encode(), k]))) for k in range(TEXTURES)]
            origin = {"seeds": TEXTURES}
        elif (source / HEADER).is_file():
            draws = find_well_formed((source,))
            shapes = [Texture(store.field(index)) for store, index in draws]
            settings = draws[0][0].settings
            origin = {"design": settings.design, "seed": settings.seed, "shape": list(settings.shape)}
        else:
            mask = load(source)
            shapes = [Texture(2 * (mask.values > 0).astype(np.float32) - 1, periodic=False)]
            origin = {"shape": list(mask.shape)}
        shapes = [texture for texture in shapes if FILLED[0] < (texture.values > 0).mean() < FILLED[1]]
        if not shapes:
            raise ValueError(f"{source} has no shape that can teach")
        textures.append(shapes)
        origins.append({"source": source.name, "shapes": len(shapes), **origin})
        progress(f"reading {source.name}", (number + 1) / len(named))
    return textures, {"sources": origins, "curvafit": version("curvafit"), "torch": version("torch")}


# ---- imaged shapes ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ImageMix:
    """How imaged shapes are drawn at random; lengths in pixels. Intervals of the structures' `thickness` (uniform in
    the logarithm; thick where a slice would have too many voxels) and of the `gap`, the slices from a known one to the
    next, which are at most `longest` pixels apart; the `edge` of a slice, and the number of `gaps` of a volume. The
    probability that an image is `noisy` beyond its modality, and the interval of the `noise`, in contrasts."""

    thickness: tuple[float, float] = (3.0, 24.0)
    gap: tuple[int, int] = (2, 15)
    longest: float = 20.0
    edge: int = 80
    gaps: int = 3
    noisy: float = 0.5
    noise: tuple[float, float] = (0.3, 2.5)


def image_shape(textures: Sequence[Sequence[Texture]], mix: ImageMix, seed: Sequence[int]) -> Whole:
    """Draw a shape, a modality that images it, an axis across its slices and a gap; return the shape with the evidence
    of the image where every `gap`-th slice is known, in pixels."""
    rng = np.random.default_rng(seed)
    while True:
        source = textures[int(rng.integers(len(textures)))]
        texture = source[int(rng.integers(len(source)))]
        names = list(MODALITIES)
        modality = MODALITIES[names[int(rng.integers(len(names)))]].draw(int(rng.integers(2**31)))
        order = rng.permutation(3)  # the modality's axes in the order of the result
        edges = np.array(modality.spacing)[order]
        finest = float(edges[1:].min())  # about a pixel
        longest = min(mix.gap[1], int(mix.longest * finest / edges[0]))
        gap = int(rng.integers(mix.gap[0], max(mix.gap[0], longest) + 1))
        sides = np.ceil(mix.edge * finest / edges[1:]).astype(int)
        shape = np.empty(3, dtype=int)
        shape[order] = [mix.gaps * gap + 1, *sides]
        low, high = mix.thickness
        low = min(max(low, mix.edge * texture.thickness / FINEST), high)  # at most `FINEST` voxels a slice
        voxel = math.exp(rng.uniform(math.log(low), math.log(high))) * finest / texture.thickness
        size = field_shape(shape.tolist(), voxel, modality)
        corner = rng.integers(0, texture.values.shape)
        indices = [(a + np.arange(n)) % m for a, n, m in zip(corner, size, texture.values.shape, strict=True)]
        phase = torch.from_numpy(np.ascontiguousarray(texture.values[np.ix_(*indices)], dtype=np.float32))
        grey = image(phase, voxel, modality, int(rng.integers(2**31))).numpy()
        inside = regrid(phase, voxel, modality).numpy() > 0
        box = tuple(slice(n) for n in shape)
        grey, inside = (np.ascontiguousarray(values[box].transpose(order)) for values in (grey, inside))
        known = inside[::gap]
        if IMAGED[0] < inside.mean() < IMAGED[1] and not known.all() and known.any():
            break
    if rng.random() < mix.noisy:
        contrast = abs(float(grey[inside].mean()) - float(grey[~inside].mean()))
        deviation = math.exp(rng.uniform(*np.log(mix.noise))) * contrast
        grey = grey + deviation * rng.standard_normal(grey.shape, dtype=np.float32)
    slices = Slices(known, tuple(range(0, len(inside), gap)), len(inside), tuple(edges.tolist()))
    raster, margin = Raster.of(slices), slice(REACH - HALO, HALO - REACH)
    distances = np.stack([raster.distances(mask)[margin, margin] for mask in inside])
    evidence = np.stack([raster.spread(plane)[margin, margin] for plane in read_image(grey, slices)[0]])
    return Whole(distances, gap, slices.spacing[0] / raster.pixel, evidence)


# ---- teaching --------------------------------------------------------------------------------------------------------


def teach(
    sources: Sequence[Sequence[Texture]],
    card: dict[str, Any],
    *,
    first: Taught | None = None,
    volumes: int = 0,
    steps: int | None = None,
    seed: int = 0,
    mix: Mix | None = None,
    checkpoint: Path | None = None,
    workers: int = 1,
    progress: Progress = silent,
) -> Taught:
    """Teach a filler by shapes, every tenth of which is held out to judge it; with `volumes`, to weigh images of them.

    Parameters
    ----------
    sources
        Shapes by where they come from, each source at least one; with fewer than 200 in all the filler knows little.
    card
        Where they come from, kept beside the weights.
    first
        A filler that learns on, by default a new one.
    volumes
        If any, the filler learns to weigh the evidence of images, of so many shapes; a tenth as many judge.
    steps
        By default 4500, or 1500 with images.
    checkpoint
        A file by which a run that was stopped goes on, beside the `image_folder`; the caller deletes both.
    workers
        Processes that cut windows: 1, or 0 for this one.

    Raises ValueError if a source is empty, or an argument is out of range.
    """
    default = IMAGE_STEPS if volumes else STEPS
    steps = check_int(default if steps is None else steps, "a number of steps from 1", 1, 10**7)
    seed, volumes = check_seed(seed), check_int(volumes, "a number of volumes from 0", 0, 10**5)
    if not sources or not all(sources):
        raise ValueError("expected sources with one shape or more to teach with")
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        filler = Filler() if first is None else copy.deepcopy(first.filler)
        filler = see_images(filler) if volumes and not filler.image else filler
    settings = {"steps": steps, "seed": seed} | ({} if first is None else {"first": first.card})
    if not volumes:
        held_out = [texture for source in sources for texture in source[HELD_OUT - 1 :: HELD_OUT]] or [sources[-1][-1]]
        training = [[texture for texture in source if texture not in held_out] or list(source) for source in sources]
        mix = mix or Mix()
        lessons = Lessons(training, mix, seed, steps)
        tests = Lessons([held_out], replace(mix, partial=0.0), seed + 1, JUDGED)
        settings |= {"shapes": sum(map(len, training)), "held_out": len(held_out), "mix": asdict(mix)}
    else:
        store = None if checkpoint is None else image_folder(checkpoint)
        step = sub_progress(progress, 0.0, 0.3)
        wholes = _image_shapes(sources, volumes, seed, store, {"sources": card.get("sources")}, step)
        lessons, tests = WholeLessons(wholes[:volumes], steps, seed), WholeLessons(wholes[volumes:], JUDGED, seed + 1)
        settings |= {"volumes": volumes, "mix": asdict(ImageMix())}
        progress = sub_progress(progress, 0.3, 1.0)
    step = sub_progress(progress, 0.0, 0.97)
    losses = learn(filler, lessons, RATE, checkpoint=checkpoint, workers=workers, progress=step)
    temperatures, figures, error = judge(filler, tests)
    progress("judging on shapes held out", 1.0)
    return Taught(filler, temperatures, {**card, **settings, "losses": losses, **figures}, error)


def see_images(plain: Filler) -> Filler:
    """Return a filler that also takes the evidence of an image, with the weights of a plain one, and weights of 0 for
    the channels that a plain one lacks."""
    filler, plain_state = Filler(plain.width, image=True), plain.state_dict()
    state = filler.state_dict()
    for name, values in plain_state.items():
        added = [n - m for n, m in zip(state[name].shape, values.shape, strict=True)]
        # torch pads the last axis first, before and after each
        state[name] = F.pad(values, [width for n in reversed(added) for width in (0, n)])
    filler.load_state_dict(state)
    return filler


def image_folder(checkpoint: Path) -> Path:
    """Return the folder in which `teach` keeps imaged shapes, beside a checkpoint."""
    return checkpoint.with_name(f"{checkpoint.name}-images")


def _image_shapes(
    sources: Sequence[Sequence[Texture]], volumes: int, seed: int, store: Path | None, same: dict[str, Any],
    progress: Progress,
) -> list[Whole]:  # fmt: skip
    """Return so many imaged shapes that teach, and a tenth as many, of shapes held out, that judge. They are kept in a
    folder, for a run that is stopped; `same` is what such runs have in common."""
    held_out = [source[HELD_OUT - 1 :: HELD_OUT] or source for source in sources]
    training = [[texture for k, texture in enumerate(source) if (k + 1) % HELD_OUT] for source in sources]

    def image_number(number: int) -> dict[str, Any]:
        return vars(image_shape(training if number < volumes else held_out, ImageMix(), (seed, number)))

    same = {**same, "volumes": volumes, "seed": seed}
    with open_run(None, store, same, progress, {"imaging shapes": 1.0}) as run:
        records = run("imaging shapes", image_number, volumes + max(volumes // 10, 1))
    return [Whole(row["distances"], int(row["gap"]), float(row["step"]), row["evidence"]) for row in records]


@torch.inference_mode()
def judge(filler: Filler, lessons: Batches) -> tuple[np.ndarray, dict[str, float], float]:
    """Return temperatures (2, k) by gap; the cross entropy of held-out lessons, by the filler and by the cubic alone;
    and the calibration error near surfaces."""
    gaps, logits, cubics, truths = [], [], [], []  # one entry a gap
    for *inputs, truth in DataLoader(lessons, batch_size=None):
        batch = Gaps(*inputs)
        filled, cubic = filler(batch), SLOPE * interpolate(batch.distances, batch.heights)[1]
        gaps += (batch.step * (truth.shape[1] + 1)).tolist()
        for windows, values in ((logits, filled), (cubics, cubic), (truths, truth)):
            windows += [window[lessons.inner].flatten() for window in values]
    table, errors = [], []
    for group in np.array_split(np.argsort(gaps), TEMPERATURES):
        # Cross-validation: each half of a group of similar gaps is judged at the temperature of the other.
        halves = (group[::2], group[1::2])
        pairs = [[torch.cat([windows[k] for k in half]) for windows in (logits, truths)] for half in halves]
        temperatures = [fit_temperature(z.numpy(), y.numpy()) for z, y in pairs]
        errors += [near_error(z / t, y) for (z, y), t in zip(pairs, temperatures[::-1], strict=True)]
        table.append((float(np.mean([gaps[k] for k in group])), float(np.sqrt(np.prod(temperatures)))))
    cross_entropy = F.binary_cross_entropy_with_logits
    predictions = {"held_out_loss": torch.cat(logits), "held_out_cubic": torch.cat(cubics)}
    losses = {name: float(cross_entropy(values, torch.cat(truths))) for name, values in predictions.items()}
    return np.array(table).T, losses, float(np.mean(errors))


def main() -> None:
    listen()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", help="stores, masks, or `mixed`")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the weights (.npz) to write")
    parser.add_argument("--images", type=int, default=0, help="teach for `reconstruct --image`, from so many shapes")
    parser.add_argument("--filler", help="filler to begin with; else a new one; with --images the packaged")
    parser.add_argument("--steps", type=int, help=f"by default {STEPS}; {IMAGE_STEPS} with --images")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--overwrite", action="store_true", help="replace a file of another origin")
    options = parser.parse_args()
    try:
        with plain_errors(), resumable(checkpoint_of(options.output)), show_stages() as progress:
            run(options, progress)
    except typer.Exit as end:
        sys.exit(end.exit_code)


def checkpoint_of(out: Path) -> Path:
    """Return the file beside the weights in which steps are kept until they are written."""
    return out.with_name(f".{out.name}.curvafit-steps")


def run(options: argparse.Namespace, progress: Progress) -> None:
    """Teach what the command asks for, and write it."""
    out = options.output
    if out.suffix != ".npz":
        raise ValueError(f"the output's name must end in .npz, got {out.name}")
    inputs = [*options.sources, *([options.filler] if options.filler else [])]
    can_write(out, FILLER_FILE, inputs=inputs, overwrite=options.overwrite)
    checkpoint = checkpoint_of(out)
    # With images, a filler that was taught on masks alone learns to use them.
    first = Taught.load(options.filler) if options.images or options.filler else None
    sources, card = load_textures(options.sources, progress)
    if (count := sum(map(len, sources))) < FEW:
        say_notes([f"{count} shapes teach little: {FEW} or more are better"])
    settings = {"first": first, "volumes": options.images, "steps": options.steps, "seed": options.seed}
    card["command"] = shlex.join(["python", *sys.argv])
    taught = teach(sources, card, **settings, checkpoint=checkpoint, progress=progress)
    can_write(out, FILLER_FILE, overwrite=options.overwrite)  # hours later, the place may be taken
    taught.save(out)
    for path in (checkpoint, image_folder(checkpoint)):
        remove(path)
    loss, cubic = taught.card["held_out_loss"], taught.card["held_out_cubic"]
    print(f"cross entropy of shapes held out {loss:.4f}, of the cubic interpolation {cubic:.4f}")
    print(out)


if __name__ == "__main__":
    main()
