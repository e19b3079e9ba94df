"""What a 3D convolutional network reads in masks that their descriptors leave unread: R² of the six parameters.

    python -m benchmarks.network STORE… --table TABLE.npz [--cache FOLDER] [--held-out 0,1] [--epochs 50]

STORE… are stores of cubes, as `curvafit atlas build` makes them, and TABLE is what `curvafit atlas describe` makes of
them. The shapes are the table's, seen as masks; those of the named folds (`benchmarks.closure` has the same five, so R²
compare) are held out, and a tenth of the others says which epoch is best. The cache has the masks and the state after
each epoch, so that a stopped run goes on; give it the cache of `benchmarks.closure` and its posteriors are used again.

Rows, all by one kind of perceptron with one plan, so that only what they read differs:

- masks: the network alone. It sees each mask under one of the cube's 48 symmetries, shifted at random in its periodic
  box, anew in each epoch. All convolutions are circular, so that no texture ends; of the levels' channels the mean and
  the deviation over the box are kept.
- descriptors: the table's columns alone, standardised (lengths and densities as logarithms).
- both: what the network keeps, beside the columns. The network learns from this row and the first.
- ridge, posterior (`--beside`, also process, match, refined): the methods of `benchmarks.closure`, on the same shapes.

Columns: R² of each parameter on the held-out shapes, their mean, and how much more that is than the mean of the last
row, with its standard deviation over draws of the held-out shapes (bootstrap, both rows on the same draw).

Folds are best learnt side by side, each by a process of its own (OMP_NUM_THREADS=1); a last command that names them all
reads their answers from the cache. The network computes in bfloat16, twice as fast where the processor has it (AVX-512
BF16, AMX). With glibc, memory that is not given back to the system saves a fourth of the time:
MALLOC_MMAP_THRESHOLD_=4000000000 MALLOC_TRIM_THRESHOLD_=8000000000 in the environment.
"""

from __future__ import annotations

import argparse
import copy
import math
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.closure import fold_of, key_of, methods, r_squared
from curvafit.core.files import write_atomically
from curvafit.data_synth import open_store
from curvafit.data_synth.sets.moves import any_crop
from curvafit.geometry.descriptors import BLOCKS
from curvafit.inference.compression import FURTHEST, columns_of
from curvafit.inference.learning import STEEPEST
from curvafit.inference.table import PARAMETERS, Table, load_table

FOLDS = 5
#: What the three perceptrons read.
ROWS = ("masks", "descriptors", "both")
#: Edge in voxels of the blocks that the first convolution reads as channels; channels and stride of each convolution;
#: and the first of those whose means and deviations are kept: before it, a map has more voxels than it tells.
BLOCK, LEVELS, FIRST = 2, ((16, 1), (32, 2), (32, 1), (64, 2), (128, 1)), 1
#: The shift in voxels under which what the network keeps of a periodic box stays the same.
PERIOD = BLOCK * math.prod(stride for _, stride in LEVELS)
#: Width of a perceptron's hidden layer, and part of it that training leaves out at random.
HIDDEN, DROPOUT = 128, 0.2
#: Shapes of a step, greatest step length, part of the steps in which it grows, and weight decay.
BATCH, RATE, WARM, DECAY = 16, 2e-3, 0.1, 0.02
#: Part of the shapes of the other folds that say which epoch is best.
VALIDATION = 0.1
#: Moved copies of a held-out shape, of whose answers the mean is taken.
COPIES = 8


class Level(nn.Module):
    """A circular convolution, batch normalisation, rectification."""

    def __init__(self, inputs: int, channels: int, stride: int) -> None:
        super().__init__()
        self.convolution = nn.Conv3d(inputs, channels, 3, stride, 1, bias=False, padding_mode="circular")
        self.norm = nn.BatchNorm3d(channels)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(self.norm(self.convolution(x)), inplace=True)


class Reader(nn.Module):
    """What the three rows answer of masks `(N, E, E, E)` in {0, 1} and descriptors `(N, columns)`: `(N, 6)` each."""

    def __init__(self, columns: int, half: bool = True) -> None:
        super().__init__()
        self.half_precision = half
        inputs = [BLOCK**3, *(channels for channels, _ in LEVELS)]
        self.levels = nn.ModuleList(Level(n, *level) for n, level in zip(inputs, LEVELS, strict=False))
        features = 2 * sum(inputs[1 + FIRST :])
        widths = {"masks": features, "descriptors": columns, "both": features + columns}
        self.rows = nn.ModuleDict({row: _perceptron(widths[row]) for row in ROWS})

    def forward(self, masks: Tensor, descriptors: Tensor) -> dict[str, Tensor]:
        features = self.features(masks, descriptors.dtype)
        seen = {"masks": features, "descriptors": descriptors, "both": torch.cat([features, descriptors], 1)}
        return {row: perceptron(seen[row]) for row, perceptron in self.rows.items()}

    def features(self, masks: Tensor, dtype: torch.dtype) -> Tensor:
        """Mean and deviation of each channel of each level over the box, `(N, 2 x channels)`."""
        statistics = []
        with torch.autocast("cpu", torch.bfloat16, enabled=self.half_precision):
            x = 2 * _blocks(masks).to(torch.bfloat16 if self.half_precision else dtype) - 1
            for number, level in enumerate(self.levels):
                x = level(x)
                if number < FIRST:
                    continue
                values = x.flatten(2).to(dtype)
                mean = values.mean(2)
                statistics += [mean, ((values - mean[..., None]).square().mean(2) + 1e-5).sqrt()]
        return torch.cat(statistics, 1)


def _perceptron(inputs: int) -> nn.Sequential:
    first = nn.BatchNorm1d(inputs), nn.Linear(inputs, HIDDEN), nn.GELU(), nn.Dropout(DROPOUT)
    return nn.Sequential(*first, nn.Linear(HIDDEN, HIDDEN), nn.GELU(), nn.Linear(HIDDEN, len(PARAMETERS)))


def _blocks(masks: Tensor) -> Tensor:
    """Each block of voxels as channels, `(N, BLOCK³, E / BLOCK, …)`."""
    n, *edges = masks.shape
    split = masks.reshape(n, *(size for edge in edges for size in (edge // BLOCK, BLOCK)))
    return split.permute(0, 2, 4, 6, 1, 3, 5).reshape(n, BLOCK**3, *(edge // BLOCK for edge in edges))


# ---- shapes ----------------------------------------------------------------------------------------------------------


class Shapes(NamedTuple):
    """Masks, packed `(N, E³ / 8)`, and their edge E; descriptors and parameters `(N, …)`, standardised."""

    packed: np.ndarray
    edge: int
    descriptors: np.ndarray
    parameters: np.ndarray

    def rows(self, chosen: np.ndarray) -> Shapes:
        return Shapes(self.packed[chosen], self.edge, self.descriptors[chosen], self.parameters[chosen])

    def batch(self, chosen: Sequence[int] | np.ndarray, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Some masks, each moved anew, with their descriptors and parameters."""
        cube = (self.edge,) * 3
        masks = [np.unpackbits(self.packed[k]).reshape(cube) for k in chosen]
        copies = np.stack([any_crop(mask, cube, rng)[0] for mask in masks])
        descriptors, parameters = (torch.from_numpy(each[chosen]) for each in (self.descriptors, self.parameters))
        return torch.from_numpy(copies), descriptors.float(), parameters.float()


class Standard(NamedTuple):
    """Means and deviations of the descriptors' columns and of the parameters of what is learnt from."""

    columns: tuple[np.ndarray, np.ndarray]
    parameters: tuple[np.ndarray, np.ndarray]

    def shapes(self, packed: np.ndarray, table: Table) -> Shapes:
        mean, deviation = self.columns
        columns = (columns_of(table.descriptors, tuple(BLOCKS)) - mean) / deviation
        centre, spread = self.parameters
        edge = round((8 * packed.shape[1]) ** (1 / 3))
        return Shapes(packed, edge, np.clip(columns, -FURTHEST, FURTHEST), (table.parameters - centre) / spread)


def standard_of(table: Table) -> Standard:
    columns = columns_of(table.descriptors, tuple(BLOCKS))
    return Standard(
        (columns.mean(0), columns.std(0) + 1e-9),
        (table.parameters.mean(0), table.parameters.std(0)),
    )


def packed_masks(stores: Sequence[Path], table: Table, cache: Path) -> np.ndarray:
    """The masks {u > 0} of a table's rows, packed; read once from their stores.

    Raises
    ------
    ValueError
        If a row's store is not among them, or their shapes are no cubes of one size that the network divides.
    """
    path = cache / f"{key_of(table)}-masks.npz"
    if not path.exists():
        sources = {each.resolve().name.removesuffix(".zarr"): open_store(each) for each in stores}
        names = sorted({shape.partition("/")[0] for shape in table.shapes.tolist()})
        if missing := [name for name in names if name not in sources]:
            raise ValueError(f"expected the stores of the table, got none of {', '.join(missing)}")
        extents = {sources[name].settings.shape for name in names}
        if len(extents) > 1 or any(len({*each}) > 1 or each[0] % PERIOD for each in extents):
            raise ValueError(f"expected stores of cubes of one edge, a multiple of {PERIOD}, got {sorted(extents)}")
        places = (shape.partition("/") for shape in table.shapes.tolist())
        masks = np.stack([np.packbits(sources[name].field(int(draw)) > 0) for name, _, draw in places])
        cache.mkdir(parents=True, exist_ok=True)
        _save(path, masks=masks)
    return np.load(path)["masks"]


def _save(path: Path, **arrays: np.ndarray) -> None:
    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    write_atomically(path, write)


# ---- training --------------------------------------------------------------------------------------------------------


class Training:
    """A reader in training: epochs done, and for each row the least cost of the validation and the reader that had it.

    An epoch depends on the state and its number alone, so a run that was stopped ends as one that was not.
    """

    def __init__(self, shapes: Shapes, validation: np.ndarray, epochs: int, seed: int = 0, half: bool = True) -> None:
        torch.manual_seed(seed)
        self.shapes, self.validation = shapes.rows(~validation), shapes.rows(validation)
        self.epochs, self.seed, self.epoch = epochs, seed, 0
        self.reader = Reader(shapes.descriptors.shape[1], half)
        self.optimiser = torch.optim.AdamW(self.reader.parameters(), RATE, weight_decay=DECAY)
        self.best = {row: (math.inf, copy.deepcopy(self.reader.state_dict())) for row in ROWS}

    def run(self) -> Iterator[dict[str, float]]:
        """Learn the epochs that remain; after each, the validation's cost by row."""
        while self.epoch < self.epochs:
            self._learn()
            self.epoch += 1
            values = answers(self.reader, self.validation)
            costs = {row: float(np.square(values[row] - self.validation.parameters).mean()) for row in ROWS}
            for row, cost in costs.items():
                if cost < self.best[row][0]:
                    self.best[row] = cost, copy.deepcopy(self.reader.state_dict())
            yield costs

    def _learn(self) -> None:
        rng = np.random.default_rng([self.seed, self.epoch])
        torch.manual_seed(int(rng.integers(2**31)))
        order = rng.permutation(len(self.shapes.packed))
        steps = len(order) // BATCH or 1
        self.reader.train()
        for step, chosen in enumerate(np.array_split(order, steps)):
            self.optimiser.param_groups[0]["lr"] = _rate((self.epoch + step / steps) / self.epochs)
            masks, descriptors, parameters = self.shapes.batch(chosen, rng)
            self.optimiser.zero_grad()
            values = self.reader(masks, descriptors)
            torch.stack([functional.mse_loss(values[row], parameters) for row in ROWS]).sum().backward()
            nn.utils.clip_grad_norm_(self.reader.parameters(), STEEPEST)
            self.optimiser.step()

    def results(self, queries: Shapes) -> dict[str, np.ndarray]:
        """What each row's best reader answers of shapes, the mean over moved copies."""
        return {row: answers(self._reader(row), queries, COPIES)[row] for row in ROWS}

    def _reader(self, row: str) -> Reader:
        reader = copy.deepcopy(self.reader)
        reader.load_state_dict(self.best[row][1])
        return reader

    def save(self, path: Path) -> None:
        state = {"reader": self.reader.state_dict(), "optimiser": self.optimiser.state_dict()}
        state |= {"epoch": self.epoch, "best": self.best}
        write_atomically(path, lambda temporary: torch.save(state, temporary))

    def load(self, path: Path) -> None:
        state = torch.load(path)
        self.reader.load_state_dict(state["reader"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.epoch, self.best = state["epoch"], state["best"]


def _rate(part: float) -> float:
    """The step length after a part of all steps: it grows evenly, then follows half a cosine to zero."""
    return RATE * min(part / WARM, (1 + math.cos(math.pi * max(0.0, part - WARM) / (1 - WARM))) / 2)


def answers(reader: Reader, shapes: Shapes, copies: int = 1) -> dict[str, np.ndarray]:
    """The rows' standardised answers `(N, 6)`, the mean over moved copies."""
    reader.eval()
    rng, parts = np.random.default_rng(0), []
    with torch.no_grad():
        for chosen in np.array_split(np.arange(len(shapes.packed)), len(shapes.packed) // BATCH or 1):
            values = [reader(*shapes.batch(chosen, rng)[:2]) for _ in range(copies)]
            parts.append({row: torch.stack([each[row] for each in values]).mean(0).double().numpy() for row in ROWS})
    return {row: np.concatenate([part[row] for part in parts]) for row in ROWS}


# ---- runs ------------------------------------------------------------------------------------------------------------


def fold_answers(packed: np.ndarray, table: Table, fold: int, epochs: int, cache: Path) -> dict[str, np.ndarray]:
    """What each row answers of the shapes of a fold, after training on the others."""
    path = cache / f"{key_of(table)}-network-{epochs}epochs-{fold}of{FOLDS}.pt"
    if (record := path.with_suffix(".npz")).exists():
        return dict(np.load(record))
    held, standard = fold_of(table, FOLDS) == fold, standard_of(table.rows(fold_of(table, FOLDS) != fold))
    shapes = standard.shapes(packed, table)
    validation = np.random.default_rng(fold).random((~held).sum()) < VALIDATION
    training = Training(shapes.rows(~held), validation, epochs, seed=fold)
    if path.exists():
        training.load(path)
    began = time.perf_counter()
    for costs in training.run():
        training.save(path)
        seconds, began = time.perf_counter() - began, time.perf_counter()
        step = seconds / max(1, len(training.shapes.packed) // BATCH)
        values = ", ".join(f"{row} {cost:.3f}" for row, cost in costs.items())
        left = f"{1e3 * step:.0f} ms a step, {seconds * (epochs - training.epoch) / 60:.0f} min left"
        print(f"  fold {fold}, epoch {training.epoch} of {epochs}: validation {values}; {left}", flush=True)
    centre, spread = standard.parameters
    results = {row: values * spread + centre for row, values in training.results(shapes.rows(held)).items()}
    _save(record, **results)
    return results


def show(results: dict[str, np.ndarray], truth: np.ndarray) -> None:
    """Print R² by row; gains are over the last."""
    draws = np.random.default_rng(0).integers(len(truth), size=(1000, len(truth)))
    reference = list(results)[-1]

    def means(row: str) -> np.ndarray:
        """The mean R² of a row, by draws of the held-out shapes."""
        return np.array([r_squared(truth[i], results[row][i]).mean() for i in draws])

    print(f"  {'R²':12}" + "".join(f"{name:>9}" for name in (*PARAMETERS, "mean")) + f"   over {reference}")
    for row, mean in results.items():
        values = r_squared(truth, mean)
        gain = values.mean() - r_squared(truth, results[reference]).mean()
        width = (means(row) - means(reference)).std()
        figures = "".join(f"{value:9.3f}" for value in (*values, values.mean()))
        print(f"  {row:12}{figures}" + (f"   {gain:+.3f} ± {width:.3f}" if row != reference else ""), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stores", type=Path, nargs="+", metavar="STORE")
    parser.add_argument("--table", type=Path, required=True)
    parser.add_argument("--cache", type=Path, default=Path("closure_cache"))
    parser.add_argument("--held-out", default="0", help="folds, 0 to 4")
    parser.add_argument("--epochs", type=int, default=50)
    parser.add_argument("--beside", default="ridge,posterior", help="methods of benchmarks.closure")
    options = parser.parse_args()
    warnings.filterwarnings("ignore", module="sklearn")
    whole = load_table(options.table).visible
    table, folds = whole.of(["mask"]), [int(fold) for fold in options.held_out.split(",")]
    packed = packed_masks(options.stores, table, options.cache)
    held = np.isin(fold_of(table, FOLDS), folds)
    print(f"{len(table)} shapes, {held.sum()} of them held out; {torch.get_num_threads()} threads", flush=True)
    results = {row: np.empty((len(table), len(PARAMETERS))) for row in (*ROWS, *options.beside.split(","))}
    for fold in folds:
        mine = fold_of(table, FOLDS) == fold
        for row, mean in fold_answers(packed, table, fold, options.epochs, options.cache).items():
            results[row][mine] = mean
        training = whole.rows(fold_of(whole, FOLDS) != fold)
        for name in options.beside.split(","):
            results[name][mine] = methods(options.cache)[name](training, table.rows(mine)).mean
    show({row: mean[held] for row, mean in results.items()}, table.parameters[held])


if __name__ == "__main__":
    main()
