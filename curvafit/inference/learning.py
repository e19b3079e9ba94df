"""Training a network until the rows that it does not learn from are fit best."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

Network = TypeVar("Network", bound=nn.Module)

#: Least and most rows of a step, and steps that an epoch has between the two.
BATCH, PACE = (64, 512), 100
#: Largest norm of a step's gradient.
STEEPEST = 5.0


class Plan(NamedTuple):
    """First step length, weight decay, most epochs, and epochs without a better validation."""

    rate: float
    decay: float
    epochs: int
    patience: int


def batch_of(rows: int) -> int:
    """Return how many rows of a table a step sees."""
    return min(max(rows // PACE, BATCH[0]), BATCH[1])


def learn(
    network: Network,
    rows: tuple[Tensor, Tensor],
    validation: Tensor,
    cost: Callable[[Network, Tensor, Tensor], Tensor],
    plan: Plan,
    report: Callable[[int, float], object],
) -> Network:
    """Fit a network to all rows but those of a mask, and return it as it was where those cost least.

    Parameters
    ----------
    rows
        Inputs and targets.
    cost
        Of the network, inputs and targets: the mean over rows.
    report
        Called with the number of each epoch, from 1, and the least cost so far.
    """
    optimiser = torch.optim.AdamW(network.parameters(), lr=plan.rate, weight_decay=plan.decay)
    slower = torch.optim.lr_scheduler.ReduceLROnPlateau(optimiser, factor=0.5, patience=plan.patience // 3)
    (x, y), apart = [each[~validation] for each in rows], [each[validation] for each in rows]
    best, state, waited = np.inf, copy.deepcopy(network.state_dict()), 0
    for epoch in range(plan.epochs):
        network.train()
        for chosen in torch.randperm(len(x)).split(batch_of(len(x))):
            optimiser.zero_grad()
            cost(network, x[chosen], y[chosen]).backward()
            nn.utils.clip_grad_norm_(network.parameters(), STEEPEST)
            optimiser.step()
        network.eval()
        with torch.no_grad():
            value = float(cost(network, *apart))
        slower.step(value)
        waited = 0 if value < best else waited + 1
        if value < best:
            best, state = value, copy.deepcopy(network.state_dict())
        report(epoch + 1, best)
        if waited > plan.patience:
            break
    network.load_state_dict(state)
    return network.eval()
