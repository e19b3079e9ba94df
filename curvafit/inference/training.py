"""Train a posterior, with the emulator and the combinations that it holds, on a table of descriptors."""

from __future__ import annotations

import copy
import dataclasses
import itertools
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from scipy import linalg
from torch import Tensor, nn

from curvafit.core.checks import check_int, check_seed
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.geometry.description import LEVELS
from curvafit.inference.emulator import FAINTEST, Emulator, Layer, misfits
from curvafit.inference.posterior import MASS, MOST, Architecture, Combinations, Member, Posterior
from curvafit.inference.table import LEAST, PARAMETERS, TARGETS, Compression, Table, column_names, compression_of

#: Fraction of the laws that a member does not learn from: their likelihood says when to stop.
VALIDATION = 0.1
#: Ridge penalty of the straight lines that fit the mass, in rows.
RIDGE = 3.0
#: Most steps of a flow, which bound the time that a large table takes.
STEPS = 12_000
#: Fraction of the progress that the emulator takes.
EMULATOR_PART = 0.2
#: Folds of the laws; the emulator has as many networks of the mean, and of the deviations: each leaves out one fold.
FOLDS = 5
#: One law of so many teaches no network of the emulator: misfits are ranked among those of its shapes.
KEPT = 10
#: Widths of the hidden layers.
HIDDEN = (96, 96)
#: Least and most rows of a step, and steps that an epoch has between the two.
BATCH, PACE = (64, 512), 100
#: Draws of a flow whose mean is compared with the truth.
DRAWS = 200
#: Features by which shapes differ, with words for low and high values; and how many features describe an end.
LOOKS = {
    "filled": ("sparse", "full"),
    "roundness": ("flat", "round"),
    "bend": ("hollow", "bulging"),
    "bodies": ("joined by tunnels", "in separate bodies"),
    "thickness": ("even in thickness", "uneven in thickness"),
    "gaps": ("even in spacing", "uneven in spacing"),
}
NAMED = 2
#: Least correlation with a combination of a feature that describes its ends.
FAINT = 0.18

Network = TypeVar("Network", bound=nn.Module)
Cost = Callable[[nn.Module, Tensor, Tensor], Tensor]


class Plan(NamedTuple):
    """First learning rate, weight decay, most epochs, and most epochs in a row without a better validation."""

    rate: float
    decay: float
    epochs: int
    patience: int


#: How the flows of a posterior learn, and how the networks of its emulator do.
PLANS = (Plan(1e-3, 1e-3, 300, 20), Plan(3e-3, 1e-2, 200, 15))


def train_posterior(
    table: Table,
    architecture: Architecture | None = None,
    *,
    members: int = 8,
    seed: int = 0,
    plans: tuple[Plan, Plan] | None = None,
    progress: Progress = silent,
) -> Posterior:
    """Fit an ensemble of flows to the parameters of a table's rows, and an emulator to the descriptors.

    Each member starts from other weights, and stops where the likelihood of a tenth of the laws, from none of whose
    shapes it learns, is highest. Raises ValueError if the table has too few shapes, or a parameter that does not vary,
    or an argument is out of range.

    Parameters
    ----------
    table
        Rows without a surface are left out.
    architecture
        Sizes of the flows.
    members
        Number of flows.
    plans
        How the flows and the emulator's networks learn; by default `PLANS`.
    progress
        Called after each epoch with a sentence and the share of the epochs that are done at most.
    """
    members, seed = check_int(members, "a number of flows", 1, MOST), check_seed(seed)
    architecture, table = architecture or Architecture(), table.visible.pooled
    law_of_row, laws = table.laws, len(np.unique(table.laws))
    if laws < 2 * architecture.components:
        raise ValueError(f"expected shapes of {2 * architecture.components} laws or more to train on, got {laws}")
    views = tuple(sorted(set(table.views.tolist())))
    box = np.stack([table.targets.min(0), table.targets.max(0)], axis=1)
    if fixed := [name for name, (low, high) in zip(TARGETS, box, strict=True) if low == high]:
        raise ValueError(f"expected shapes whose parameters all vary, got {', '.join(fixed)} the same in all")
    compression = compression_of(table.descriptors, architecture.components)
    flow_plan, emulator_plan = plans or PLANS
    options = {"seed": seed, "plan": emulator_plan, "progress": sub_progress(progress, 0.0, EMULATOR_PART)}
    emulator, misfits_by_view = train_emulator(table, compression, box[: len(PARAMETERS)], **options)
    counts = {"shapes": len(np.unique(table.shapes)), "laws": laws, "rows": len(table), "members": members}
    provenance = {"table": table.provenance, **counts, "seed": seed}
    # Members, the scaling of the parameters and combinations are replaced below.
    posterior = Posterior(
        architecture, (), compression, views, box, np.zeros(len(TARGETS)), np.ones(len(TARGETS)), emulator,
        misfits_by_view, Combinations(np.eye(6), np.zeros(6), ()), provenance, {},
    )  # fmt: skip
    logits = posterior.to_logits(table.targets)
    posterior = dataclasses.replace(posterior, centre=logits.mean(0), spread=logits.std(0))
    target = torch.from_numpy(posterior.standardise(table.targets)).float()
    context = posterior.context(table.descriptors, table.views, table.amount)
    flows, held_out, errors = [], [], []
    for k in range(members):
        rng = np.random.default_rng([seed, k])
        holdout = rng.permutation(laws)[: max(1, round(VALIDATION * laws))]
        validation = torch.from_numpy(np.isin(law_of_row, holdout))
        stage = sub_progress(progress, *(EMULATOR_PART + (1 - EMULATOR_PART) * end / members for end in (k, k + 1)))
        with torch.random.fork_rng():
            torch.manual_seed(int(rng.integers(2**31)))
            flow = Member(architecture, len(views))
            flows.append(_fit(flow, context, target, validation, flow_plan, f"member {k + 1} of {members}", stage))
        # Combinations are found from the flow's errors on rows that it has not learnt from.
        held_out.append(np.flatnonzero(validation.numpy()))
        single, rows = dataclasses.replace(posterior, members=(flow,)), table.rows(held_out[-1])
        draws = single.sample(rows.descriptors, rows.views, rows.amount, DRAWS)
        errors.append(draws[..., : len(PARAMETERS)].mean(1) - rows.parameters)
    rows = table.rows(np.concatenate(held_out))
    combinations = find_combinations(np.concatenate(errors), rows.parameters, rows.descriptors)
    return dataclasses.replace(posterior, members=tuple(flows), combinations=combinations)


def _fit(
    member: Member, context: Tensor, target: Tensor, validation: Tensor, plan: Plan, name: str, progress: Progress
) -> Member:
    """Fit a flow to the rows outside `validation`, and return it as it was when those within were likeliest."""
    _fit_lines(member, context[~validation], target[~validation, MASS])
    rows = int((~validation).sum())
    epochs = min(plan.epochs, STEPS * batch_size(rows) // rows + 1)

    def nats(member: Member, context: Tensor, target: Tensor) -> Tensor:
        return -member(context).log_prob(target).mean()

    def report(epoch: int, best: float) -> None:
        progress(f"{name}: epoch {epoch}, {best:.3f} nats", epoch / epochs)

    return learn(member, (context, target), validation, nats, plan._replace(epochs=epochs), report)


def _fit_lines(member: Member, context: Tensor, mass: Tensor) -> None:
    """Fit the mass as a straight line of the context by ridge regression, for each view, and store it in a flow."""
    for view in range(len(member.width)):
        in_view = context[:, view - len(member.width)] == 1  # the last columns are 1 for the row's view
        x, y = context[in_view].double(), mass[in_view].double()
        slope = torch.linalg.solve(x.T @ x + RIDGE * torch.eye(x.shape[1]), x.T @ y)
        member.slope[view], member.width[view] = slope, (y - x @ slope).std()


def train_emulator(
    table: Table,
    compression: Compression,
    box: np.ndarray,
    *,
    seed: int = 0,
    plan: Plan = PLANS[1],
    progress: Progress = silent,
) -> tuple[Emulator, dict[str, np.ndarray]]:
    """Fit networks to the compressed descriptors of a table's rows, given their parameters.

    One ensemble of networks learns the mean. A second one learns the deviations of the first one's errors on shapes
    held out. Returns the emulator and, by view, the misfits (`emulator.misfits`) of laws that no network has learnt
    from (`keep_laws`), with which the misfit of a scan is compared.
    """
    views = tuple(sorted(set(table.views.tolist())))
    kept = keep_laws(table, seed)
    if few := [view for view in views if not (kept & (table.views == view)).any()]:
        raise ValueError(f"expected many shapes in each of the views {', '.join(views)}, got few in {', '.join(few)}")
    references, table = table.rows(kept), table.rows(~kept)
    target = compression(table.descriptors)
    law_of_row = table.laws
    fold = np.random.default_rng(seed).permutation(law_of_row.max() + 1)[law_of_row] % FOLDS
    untrained = Emulator(compression, views, box, (), (), np.eye(target.shape[1]), 1.0)
    inputs = untrained.inputs(table.parameters, table.views, table.amount)
    x, y = torch.from_numpy(inputs).float(), torch.from_numpy(target).float()

    first, second = sub_progress(progress, 0.0, 0.5), sub_progress(progress, 0.5, 1.0)
    means = _train_ensemble(x, y, fold, lambda net, x, y: (net(x) - y).square().mean(), plan, seed, first)
    errors = y - _predict_held_out(means, x, fold)
    values, vectors = np.linalg.eigh(np.cov(errors.double().numpy().T))
    # Rows are the principal directions of the errors, greatest variance first, scaled so that theirs along each is 1.
    basis = (vectors / np.sqrt(np.maximum(values, 1e-9 * values.max()))).T[::-1].astype(np.float32)
    whitened = errors @ torch.from_numpy(basis).T
    spreads = _train_ensemble(x, whitened, fold, _normal_nats, plan, seed, second)
    deviation = torch.exp(_predict_held_out(spreads, x, fold)).clamp(min=FAINTEST)
    emulator = Emulator(compression, views, box, _layers(means), _layers(spreads), basis, 1.0)
    residuals = (whitened / deviation).double().numpy()
    emulator = dataclasses.replace(emulator, inflation=_inflation(emulator, table, residuals))
    columns = (references.descriptors, references.views, references.amount)
    unexplained = misfits(emulator, *columns, references.parameters[:, None])
    return emulator, {view: np.sort(unexplained[references.views == view]) for view in views}


def keep_laws(table: Table, seed: int) -> np.ndarray:
    """Return which rows `(N,)` are of the laws from which the emulator does not learn: one of `KEPT`, by the seed."""
    laws = table.laws
    return np.random.default_rng([seed, KEPT]).permutation(laws.max() + 1)[laws] % KEPT == 0


def _inflation(emulator: Emulator, table: Table, residuals: np.ndarray) -> float:
    """Return the mean square by which whitened residuals `(N, k)` move the best parameters, over its expectation if
    they were independent of variance 1."""
    # A Gauss-Newton step moves parameters by covariance · slopesᵀ residuals, here squared in units of that covariance:
    # gradientᵀ covariance gradient. Their prior has deviation 1.
    squared, expected = 0.0, 0.0
    for view in emulator.views:
        in_view = table.views == view
        slopes = emulator.slopes(table.parameters[in_view], table.views[in_view], table.amount[in_view])
        gradients = np.einsum("nkd,nk->nd", slopes, residuals[in_view])
        information = np.einsum("nkd,nke->nde", slopes, slopes)
        covariance = np.linalg.inv(information + np.eye(len(PARAMETERS)))
        squared += np.einsum("nd,nde,ne->", gradients, covariance, gradients)
        expected += np.einsum("nde,ned->", covariance, information)
    return float(squared / expected)


def _normal_nats(network: nn.Module, x: Tensor, target: Tensor) -> Tensor:
    """Return the mean negative logarithm of normal densities whose deviations' logarithms are a network's outputs."""
    output = network(x).clamp(min=float(np.log(FAINTEST)))
    return (0.5 * (target * torch.exp(-output)).square() + output).mean()


def _train_ensemble(
    x: Tensor, y: Tensor, fold: np.ndarray, cost: Cost, plan: Plan, seed: int, progress: Progress
) -> list[nn.Sequential]:
    """Return `FOLDS` networks; each learns from all folds of the rows but one, and stops where that one is fit best."""
    sizes, networks = (x.shape[1], *HIDDEN), []
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for k in range(FOLDS):

            def report(epoch: int, _: float, k: int = k) -> None:
                progress(f"emulator, epoch {epoch}", (k + epoch / plan.epochs) / FOLDS)

            layers = [layer for n, m in itertools.pairwise(sizes) for layer in (nn.Linear(n, m), nn.SiLU())]
            network = nn.Sequential(*layers, nn.Linear(HIDDEN[-1], y.shape[1]))
            networks.append(learn(network, (x, y), torch.from_numpy(fold == k), cost, plan, report))
    return networks


def _predict_held_out(networks: list[nn.Sequential], x: Tensor, fold: np.ndarray) -> Tensor:
    """Return each row's outputs by the network that did not learn from it."""
    with torch.no_grad():
        outputs = torch.stack([network(x) for network in networks])
    return outputs[torch.from_numpy(fold), torch.arange(len(x))]


def _layers(networks: list[nn.Sequential]) -> tuple[Layer, ...]:
    """Return the linear layers of networks of one shape, each stacked over the networks."""
    linear = [[layer for layer in network if isinstance(layer, nn.Linear)] for network in networks]
    return tuple(
        Layer(*(np.stack([getattr(layer, name).detach().numpy() for layer in level]) for name in ("weight", "bias")))
        for level in zip(*linear, strict=True)
    )


def batch_size(rows: int) -> int:
    """Return the number of rows of a step: `PACE` steps to an epoch, within `BATCH`."""
    return min(max(rows // PACE, BATCH[0]), BATCH[1])


def learn(
    network: Network, rows: tuple[Tensor, Tensor], validation: Tensor,
    cost: Callable[[Network, Tensor, Tensor], Tensor], plan: Plan, report: Callable[[int, float], object],
) -> Network:  # fmt: skip
    """Fit a network by AdamW to the rows (inputs, targets) outside `validation`. Return it with its weights after the
    epoch in which the rows of `validation` cost least; `report` is called with the number of each epoch, from 1, and
    the least cost so far."""
    optimiser = torch.optim.AdamW(network.parameters(), lr=plan.rate, weight_decay=plan.decay)
    scheduler = torch.optim.lr_scheduler.ReduceLROnPlateau(optimiser, factor=0.5, patience=plan.patience // 3)
    x, y = (column[~validation] for column in rows)
    held_out = [column[validation] for column in rows]
    best, state, waited = np.inf, copy.deepcopy(network.state_dict()), 0
    for epoch in range(1, plan.epochs + 1):
        network.train()
        for batch in torch.randperm(len(x)).split(batch_size(len(x))):
            optimiser.zero_grad()
            cost(network, x[batch], y[batch]).backward()
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
        network.eval()
        with torch.no_grad():
            value = float(cost(network, *held_out))
        scheduler.step(value)
        waited += 1
        if value < best:
            best, state, waited = value, copy.deepcopy(network.state_dict()), 0
        report(epoch, best)
        if waited > plan.patience:
            break
    network.load_state_dict(state)
    return network.eval()


# ---- combinations ----------------------------------------------------------------------------------------------------


def find_combinations(errors: np.ndarray, parameters: np.ndarray, descriptors: np.ndarray) -> Combinations:
    """Find uncorrelated sums of parameters, by increasing mean square error over variance among laws.

    `errors` `(N, 6)` are those of a posterior's means for laws that it has not learnt from, `parameters` `(N, 6)` and
    `descriptors` `(N, 351)` are the laws' and their shapes'.
    """
    centre = parameters.mean(0)
    deviations = parameters - centre
    # The generalised eigenvectors of both covariances, by increasing eigenvalue.
    weights = linalg.eigh(errors.T @ errors / len(errors), deviations.T @ deviations / len(deviations))[1].T
    sums, features = deviations @ weights.T, _measure_looks(descriptors)
    correlations = sums.T @ ((features - features.mean(0)) / np.maximum(features.std(0), 1e-9)) / len(sums)
    # A sum's sign is free: it is chosen so that the feature that goes with it most increases.
    signs = np.sign(np.take_along_axis(correlations, np.abs(correlations).argmax(1)[:, None], 1))
    words, ends = list(LOOKS.values()), []
    for row in signs * correlations:
        chosen = [k for k in np.argsort(-np.abs(row))[:NAMED] if np.abs(row[k]) >= FAINT]
        ends.append(tuple(", ".join(words[k][int((row[k] > 0) == high)] for k in chosen) for high in (False, True)))
    return Combinations(signs * weights, centre, tuple(ends))


def _measure_looks(descriptors: np.ndarray) -> np.ndarray:
    """Return the features `(N, 6)` of `LOOKS` of descriptors `(N, 351)`."""
    names = np.array(column_names())
    fraction, (area, bend, euler), depths, gaps = (
        np.maximum(descriptors[:, names == name].T, LEAST if name != "densities" else -np.inf)
        for name in ("fraction", "densities", "depths", "clearances")
    )

    def spread(quantiles: np.ndarray) -> np.ndarray:
        return np.log(quantiles[LEVELS.index(0.9)] / quantiles[LEVELS.index(0.5)])

    area = np.maximum(area, LEAST)
    return np.column_stack([
        np.log(fraction[0]), np.log(area / fraction[0]), np.arcsinh(bend / area / 10), np.arcsinh(euler / area),
        spread(depths), spread(gaps),
    ])  # fmt: skip
