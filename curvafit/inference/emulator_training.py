"""Training an emulator on a table of descriptors."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from curvafit.inference.compression import Compression
from curvafit.inference.emulator import FAINTEST, Emulator, Layer, misfits
from curvafit.inference.table import PARAMETERS, Table
from curvafit.progress import Progress, silent

#: Networks of the mean, of which each leaves out another part of the shapes, and of the deviations.
FOLDS = 5
#: Widths of the hidden layers.
HIDDEN = (96, 96)
#: Least and most rows of a step, and steps that an epoch has between the two.
BATCH, PACE = (64, 512), 100
#: First step length, weight decay, most epochs, and epochs without a better validation.
RATE, DECAY, EPOCHS, PATIENCE = 3e-3, 1e-2, 200, 15
#: Most rows of a view whose misfits are kept.
REFERENCE = 400


class Trained(NamedTuple):
    """An emulator, and by view what it leaves unexplained of shapes that its networks did not learn from: sums of
    squares, of `REFERENCE` rows at most, as `emulator.misfits` has them."""

    emulator: Emulator
    misfits: dict[str, np.ndarray]


def train_emulator(
    table: Table, compression: Compression, box: np.ndarray, *, seed: int = 0, progress: Progress = silent
) -> Trained:
    """Fit networks to the compressed descriptors of a table's rows, given their parameters, and others to the
    deviations of what the first miss of shapes that they did not learn from.

    Of 424 shapes left out in fifths, seen as masks, a quarter of the components' variance is missed; of cubic
    polynomials .37, of Gaussian processes .39.
    """
    views = tuple(sorted(set(table.views.tolist())))
    target = compression(table.descriptors)
    shapes, number = np.unique(table.shapes, return_inverse=True)
    part = np.random.default_rng(seed).permutation(len(shapes))[number] % FOLDS
    none = (Layer(np.zeros((1, 1, 1)), np.zeros((1, 1))),)
    blank = Emulator(compression, views, box, none, none, np.eye(target.shape[1]), 1.0)
    inputs = np.empty((len(table), 6 + len(views)))
    for view in views:
        mine = table.views == view
        inputs[mine] = blank.inputs(table.parameters[mine], view)
    x, y = torch.from_numpy(inputs).float(), torch.from_numpy(target).float()

    def told(first: float) -> Callable[[int], Progress]:
        return lambda k: lambda text, share: progress(f"emulator, {text}", first + (k + share) / FOLDS / 2)

    means = _ensemble(x, y, part, _squares, seed, told(0.0))
    missed = y - _apart(means, x, part)
    values, vectors = np.linalg.eigh(np.cov(missed.double().numpy().T))
    basis = (vectors / np.sqrt(np.maximum(values, 1e-9 * values.max()))).T[::-1].astype(np.float32)
    whitened = missed @ torch.from_numpy(basis).T
    spreads = _ensemble(x, whitened, part, _nats, seed, told(0.5))
    deviation = torch.exp(_apart(spreads, x, part)).clamp(min=FAINTEST)
    emulator = Emulator(compression, views, box, _layers(means), _layers(spreads), basis, 1.0)
    left = (whitened / deviation).double().numpy()
    emulator = dataclasses.replace(emulator, inflation=_inflation(emulator, table, left))
    rows = [[np.flatnonzero((table.views == view) & (part == k)) for k in range(FOLDS)] for view in views]
    least = min(REFERENCE // FOLDS, *(len(each) for parts in rows for each in parts))
    if not least:
        raise ValueError(f"expected many shapes in each of the views {', '.join(views)}, got few in one")
    left = [[_misfits(emulator, k, table.rows(parts[k][:least])) for k in range(FOLDS)] for parts in rows]
    return Trained(emulator, {view: np.sort(np.concatenate(each)) for view, each in zip(views, left, strict=True)})


def _misfits(emulator: Emulator, number: int, rows: Table) -> np.ndarray:
    """Return what one network, which did not learn from them, leaves unexplained of rows of one view."""
    mean, spread = (
        tuple(Layer(*(each[number : number + 1] for each in layer)) for layer in layers)
        for layers in (emulator.mean, emulator.spread)
    )
    apart = dataclasses.replace(emulator, mean=mean, spread=spread)
    return misfits(apart, rows.descriptors, str(rows.views[0]), rows.parameters[:, None])


def _inflation(emulator: Emulator, table: Table, left: np.ndarray) -> float:
    """Return the mean square of what is left along the directions of the parameters, each as firm as it is with a prior
    of deviation 1, over what it would be if all that is left were uncorrelated."""
    squared, expected = 0.0, 0.0
    for view in emulator.views:
        mine = table.views == view
        slopes = emulator.slopes(table.parameters[mine], view)
        pulls = np.einsum("nkd,nk->nd", slopes, left[mine])
        firmness = np.einsum("nkd,nke->nde", slopes, slopes)
        covariance = np.linalg.inv(firmness + np.eye(len(PARAMETERS)))
        squared += np.einsum("nd,nde,ne->", pulls, covariance, pulls)
        expected += np.einsum("nde,ned->", covariance, firmness)
    return float(squared / expected)


def batch_of(rows: int) -> int:
    """Return how many rows of a table a step sees."""
    return min(max(rows // PACE, BATCH[0]), BATCH[1])


def _squares(output: Tensor, target: Tensor) -> Tensor:
    return (output - target).square().mean()


def _nats(output: Tensor, target: Tensor) -> Tensor:
    output = output.clamp(min=float(np.log(FAINTEST)))
    return (0.5 * (target * torch.exp(-output)).square() + output).mean()


def _ensemble(
    x: Tensor,
    y: Tensor,
    part: np.ndarray,
    cost: Callable[[Tensor, Tensor], Tensor],
    seed: int,
    progress: Callable[[int], Progress],
) -> list[nn.Sequential]:
    """Return networks; each learns until its own part of the rows, which it does not learn from, is fit best."""
    networks = []
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for k in range(FOLDS):
            networks.append(
                _trained(_network(x.shape[1], y.shape[1]), (x, y), torch.from_numpy(part == k), cost, progress(k))
            )
    return networks


def _network(inputs: int, outputs: int) -> nn.Sequential:
    sizes = (inputs, *HIDDEN)
    layers = [layer for n, m in zip(sizes, HIDDEN, strict=False) for layer in (nn.Linear(n, m), nn.SiLU())]
    return nn.Sequential(*layers, nn.Linear(HIDDEN[-1], outputs))


def _trained(
    network: nn.Sequential,
    rows: tuple[Tensor, Tensor],
    held: Tensor,
    cost: Callable[[Tensor, Tensor], Tensor],
    progress: Progress,
) -> nn.Sequential:
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    slower = torch.optim.lr_scheduler.ReduceLROnPlateau(optimiser, factor=0.5, patience=PATIENCE // 3)
    (x, y), (x_held, y_held) = [each[~held] for each in rows], [each[held] for each in rows]
    best, state, waited = np.inf, copy.deepcopy(network.state_dict()), 0
    for epoch in range(EPOCHS):
        for chosen in torch.randperm(len(x)).split(batch_of(len(x))):
            optimiser.zero_grad()
            cost(network(x[chosen]), y[chosen]).backward()
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
        with torch.no_grad():
            value = float(cost(network(x_held), y_held))
        slower.step(value)
        waited = 0 if value < best else waited + 1
        if value < best:
            best, state = value, copy.deepcopy(network.state_dict())
        progress(f"epoch {epoch + 1}", (epoch + 1) / EPOCHS)
        if waited > PATIENCE:
            break
    network.load_state_dict(state)
    return network


def _apart(networks: list[nn.Sequential], x: Tensor, part: np.ndarray) -> Tensor:
    """Return each row's outputs by the network that did not learn from it."""
    with torch.no_grad():
        outputs = torch.stack([network(x) for network in networks])
    return outputs[torch.from_numpy(part), torch.arange(len(x))]


def _layers(networks: list[nn.Sequential]) -> tuple[Layer, ...]:
    linear = [[layer for layer in network if isinstance(layer, nn.Linear)] for network in networks]
    return tuple(
        Layer(
            np.stack([layer.weight.detach().numpy() for layer in level]),
            np.stack([layer.bias.detach().numpy() for layer in level]),
        )
        for level in zip(*linear, strict=True)
    )
