"""Training an emulator on a table of descriptors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from curvafit.core.runtime import Progress, silent
from curvafit.inference.compression import Compression
from curvafit.inference.emulator import FAINTEST, Emulator, Layer, misfits
from curvafit.inference.learning import Plan, learn
from curvafit.inference.table import PARAMETERS, Table

#: Networks of the mean, of which each leaves out another part of the shapes, and of the deviations.
FOLDS = 5
#: Widths of the hidden layers.
HIDDEN = (96, 96)
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


def _squares(network: nn.Module, x: Tensor, target: Tensor) -> Tensor:
    """Return the mean square of what a network's outputs miss."""
    return (network(x) - target).square().mean()


def _nats(network: nn.Module, x: Tensor, target: Tensor) -> Tensor:
    """Return the mean negative logarithm of normal densities whose deviations' logarithms are a network's outputs."""
    output = network(x).clamp(min=float(np.log(FAINTEST)))
    return (0.5 * (target * torch.exp(-output)).square() + output).mean()


def _ensemble(
    x: Tensor,
    y: Tensor,
    part: np.ndarray,
    cost: Callable[[nn.Module, Tensor, Tensor], Tensor],
    seed: int,
    progress: Callable[[int], Progress],
) -> list[nn.Sequential]:
    """Return networks; each learns until its own part of the rows, which it does not learn from, is fit best."""
    networks, plan = [], Plan(RATE, DECAY, EPOCHS, PATIENCE)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for k in range(FOLDS):
            network, own = _network(x.shape[1], y.shape[1]), torch.from_numpy(part == k)
            networks.append(learn(network, (x, y), own, cost, plan, _epochs(progress(k))))
    return networks


def _epochs(progress: Progress) -> Callable[[int, float], None]:
    """Return what reports epochs as progress."""
    return lambda epoch, _: progress(f"epoch {epoch}", epoch / EPOCHS)


def _network(inputs: int, outputs: int) -> nn.Sequential:
    """Return a network as it is before it learns."""
    sizes = (inputs, *HIDDEN)
    layers = [layer for n, m in zip(sizes, HIDDEN, strict=False) for layer in (nn.Linear(n, m), nn.SiLU())]
    return nn.Sequential(*layers, nn.Linear(HIDDEN[-1], outputs))


def _apart(networks: list[nn.Sequential], x: Tensor, part: np.ndarray) -> Tensor:
    """Return each row's outputs by the network that did not learn from it."""
    with torch.no_grad():
        outputs = torch.stack([network(x) for network in networks])
    return outputs[torch.from_numpy(part), torch.arange(len(x))]


def _layers(networks: list[nn.Sequential]) -> tuple[Layer, ...]:
    """Return the weights of networks, stacked."""
    linear = [[layer for layer in network if isinstance(layer, nn.Linear)] for network in networks]
    return tuple(
        Layer(
            np.stack([layer.weight.detach().numpy() for layer in level]),
            np.stack([layer.bias.detach().numpy() for layer in level]),
        )
        for level in zip(*linear, strict=True)
    )
