"""What the descriptors of a texture say about its parameters: an ensemble of conditional normalising flows.

Combinations are sums of parameters: those that a texture determines best come first, with words for what they do to
shapes.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from curvafit.core.checks import check_float, check_int, require
from curvafit.core.records import Format
from curvafit.core.schema import Rule
from curvafit.core.units import format_number
from curvafit.geometry.description import BLOCKS
from curvafit.inference.emulator import Emulator, Layer
from curvafit.inference.table import PARAMETERS, TARGETS, Compression, encode_seen
from curvafit.scan.measures import Reading

POSTERIOR_FILE = Format("curvafit posterior", 5, "a posterior", "train it again", {"blocks": BLOCKS})
#: Largest size of a flow, and most flows of an ensemble.
WIDEST, MOST = 2048, 64
#: Which of the parameters is the mass.
MASS = PARAMETERS.index("m0")
#: Margin on each side of the box of the parameters, as a fraction of the range that was drawn.
RIM = 0.02
#: Deviation of what the flows miss themselves, however much of a structure is seen, in deviations of the parameters'
#: logits: chosen so that 90 % intervals held 86 % of the parameters of shapes of 100³ grown by the paper's protocol.
MISSED = 0.15
#: A combination is known where a scan takes away at least this fraction of its variance among laws.
KNOWN = 0.5


@dataclass(frozen=True)
class Architecture:
    """Sizes of a flow of splines: principal components of the descriptors that it sees, widths of its hidden layers,
    transforms, bins of a spline, and dropout of the components in training. Raises ValueError if a size is not a whole
    number from 1 to `WIDEST`.
    """

    components: int = 64
    hidden: tuple[int, ...] = (64, 64)
    transforms: int = 2
    bins: int = 8
    dropout: float = 0.1

    def __post_init__(self) -> None:
        for size in (self.components, *self.hidden, self.transforms, self.bins):
            check_int(size, "sizes of a flow that are whole numbers", 1, WIDEST)
        check_float(self.dropout, "a dropout", 0.0, 0.9)


class Member(nn.Module):
    """One flow of an ensemble: a conditional distribution of `TARGETS`, in coordinates without bounds.

    The mass is modelled as a straight line of the context, one for each view, plus a remainder of deviation `width`
    `(views,)`: dropout would hide the volume fraction, which determines the mass.
    """

    slope: Tensor
    width: Tensor

    def __init__(self, architecture: Architecture, views: int) -> None:
        super().__init__()
        context = architecture.components + 1 + views
        zuko = require("zuko", "infer", "reading a posterior")
        sizes = {"transforms": architecture.transforms, "hidden_features": architecture.hidden}
        self.flow = zuko.flows.NSF(len(TARGETS), context, bins=architecture.bins, **sizes)
        self.dropout = nn.Dropout(architecture.dropout)
        self.register_buffer("slope", torch.zeros(views, context))
        self.register_buffer("width", torch.ones(views))

    def forward(self, context: Tensor) -> torch.distributions.Distribution:
        view = context[:, -len(self.width) :]
        mean = torch.zeros(len(context), len(TARGETS))
        width = torch.ones_like(mean)
        mean[:, MASS], width[:, MASS] = (view @ self.slope * context).sum(1), view @ self.width
        line = torch.distributions.AffineTransform(mean, width, event_dim=1)
        return torch.distributions.TransformedDistribution(self.flow(self.dropout(context)), [line])


class Discriminant(NamedTuple):
    """Fisher's discriminant of the model's shapes and textures of no law: its weights `(351,)` of the descriptors, and
    its values `(n,)` for shapes of laws that it has not learnt from, increasing."""

    weights: np.ndarray
    reference: np.ndarray


@dataclass(frozen=True, eq=False)
class Posterior:
    """The posterior of (a11, log a02, a10, a01, a00, m₀), with a20 = 1, and of the thickness of their shapes, given
    descriptors in voxels with which the structure is eight thick.

    Attributes
    ----------
    members
        Flows whose equal mixture it is.
    compression
        From descriptors to what the flows see of them.
    views
        Kinds of views that it was trained on.
    box
        `(7, 2)`: least and greatest values of `TARGETS`.
    centre, spread
        `(7,)`: mean and deviation of their logits (`to_logits`) in training.
    emulator
        From parameters to the descriptors of their shapes.
    misfits
        By view, what the emulator's best parameters leave unexplained of shapes that it did not learn from, increasing.
    combinations
        Sums of parameters, ordered by how well textures determine them.
    discriminants
        By view, what tells the model's shapes from textures of no law; a view is missing where that was not learned.
    """

    architecture: Architecture
    members: tuple[Member, ...]
    compression: Compression
    views: tuple[str, ...]
    box: np.ndarray
    centre: np.ndarray
    spread: np.ndarray
    emulator: Emulator
    misfits: dict[str, np.ndarray]
    combinations: Combinations
    provenance: dict[str, Any]
    discriminants: dict[str, Discriminant]

    def sample(
        self, descriptors: np.ndarray, views: np.ndarray, amount: np.ndarray, count: int = 1000, seed: int = 0
    ) -> np.ndarray:
        """Draw `TARGETS` `(N, count, 7)` given what `context` takes."""
        context = self.context(descriptors, views, amount)
        counts = [len(chunk) for chunk in np.array_split(np.arange(count), len(self.members))]
        with torch.random.fork_rng(), torch.no_grad():
            torch.manual_seed(seed)
            draws = [member(context).sample(torch.Size((n,))) for member, n in zip(self.members, counts, strict=True)]
            drawn = torch.cat(draws).movedim(0, 1)
            drawn += MISSED * torch.randn_like(drawn)
        standard = drawn.double().numpy()
        return self.from_logits(standard * self.spread + self.centre)

    def draw(self, reading: Reading, count: int, seed: int = 0) -> np.ndarray:
        """Draw `TARGETS` `(count, 7)` given what was read of a scan."""
        return self.sample(*reading.columns, count, seed)[0]

    def context(self, descriptors: np.ndarray, views: np.ndarray, amount: np.ndarray) -> Tensor:
        """Return the flows' inputs `(N, …)` for descriptors `(N, 351)`, views and amounts `(N,)`.

        Raises ValueError if it was not trained on a view, or descriptors are not finite.
        """
        seen = encode_seen(self.views, views, amount)
        if bad := int((~np.isfinite(descriptors)).any(1).sum()):
            raise ValueError(f"expected descriptors that are finite, got {bad} of {len(descriptors)} rows with others")
        return torch.from_numpy(np.concatenate([self.compression(descriptors), seen], axis=1)).float()

    def discriminate(self, descriptors: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return a discriminant `(N,)` of descriptors `(N, 351)` by its weights: textures of no law have the least."""
        return replace(self.compression, basis=weights[None])(descriptors)[:, 0]

    def to_logits(self, parameters: np.ndarray) -> np.ndarray:
        """Return the logits of the parameters' positions in the box, from 0 to 1: numbers without bounds."""
        low, lengths = self._edges
        position = np.clip((parameters - low) / lengths, 1e-6, 1 - 1e-6)
        return np.log(position / (1 - position))

    def from_logits(self, logits: np.ndarray) -> np.ndarray:
        """Return the parameters of logits."""
        low, lengths = self._edges
        return low + lengths / (1 + np.exp(-logits))

    def standardise(self, parameters: np.ndarray) -> np.ndarray:
        """Return the parameters' logits, in deviations of the shapes that the posterior was trained on."""
        return (self.to_logits(parameters) - self.centre) / self.spread

    @property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the least parameters, and the lengths, of the box with its margin."""
        low, high = self.box.T
        return low - RIM * (high - low), (1 + 2 * RIM) * (high - low)


@dataclass(frozen=True)
class Combination:
    """A weighted sum of parameters, in deviations among laws, and what a scan says of it.

    Attributes
    ----------
    low, high
        Words for how shapes look at its ends; empty where it hardly changes how they look.
    weights
        By name (`table.PARAMETERS`), the weight of each parameter's difference from the laws' mean.
    median, interval
        Median, and central 90 % interval, of the posterior's draws.
    known
        Fraction of its variance among laws that the scan takes away.
    """

    low: str
    high: str
    weights: dict[str, float]
    median: float
    interval: tuple[float, float]
    known: Annotated[float, Rule(least=0, most=1)]

    def __str__(self) -> str:
        low, high = (format_number(end, 2) for end in self.interval)
        value = format_number(self.median, 2) if self.known >= KNOWN else "not known"
        if not self.low:
            return f"A sum that hardly changes how shapes look: {value} ({low} to {high})."
        return f"From {self.low} (-2) to {self.high} (+2): {value} ({low} to {high})."


@dataclass(frozen=True, eq=False)
class Combinations:
    """Six weighted sums of the parameters, uncorrelated among laws, each of deviation 1.

    `weights` `(6, 6)` has a row for each sum, `centre` `(6,)` is the laws' mean. `ends` has words for the low and the
    high end of each, empty where it hardly changes how shapes look.
    """

    weights: np.ndarray
    centre: np.ndarray
    ends: tuple[tuple[str, str], ...]

    def __call__(self, parameters: np.ndarray) -> np.ndarray:
        """Return the sums `(…, 6)` of parameters `(…, 6)`."""
        return (parameters - self.centre) @ self.weights.T

    def read(self, draws: np.ndarray, *, background: bool = False) -> tuple[Combination, ...]:
        """Return what draws `(n, 6)` say of each sum, the best known first; `background`: they are the background's."""
        suffix = " (the background)" if background else ""
        combinations = []
        for ends, weights, sums in zip(self.ends, self.weights, self(draws).T, strict=True):
            low, high = (words and words + suffix for words in ends)
            by_name: dict[str, float] = dict(zip(PARAMETERS, weights.tolist(), strict=True))
            least, median, most = np.quantile(sums, (0.05, 0.5, 0.95)).tolist()
            known = float(np.clip(1 - sums.var(), 0, 1))  # a sum's variance among laws is 1
            combinations.append(Combination(low, high, by_name, median, (least, most), known))
        return tuple(sorted(combinations, key=lambda combination: -combination.known))


def load_posterior(path: str | Path | None = None) -> Posterior:
    """Read a posterior; by default the packaged one.

    Raises FileNotFoundError if there is no such file, and ValueError if it is not a posterior, is damaged, or has
    another format version or other blocks.
    """
    if path is None:
        return POSTERIOR_FILE.read_packaged("inference", "posterior.npz", _from_arrays)
    return POSTERIOR_FILE.read(path, _from_arrays)


def _from_arrays(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Posterior:
    """Return the posterior of a file's header and arrays; raise ValueError where they do not fit together."""
    if not all(np.isfinite(array).all() for array in arrays.values() if array.dtype.kind == "f"):
        raise ValueError("numbers that are not finite")
    sizes: dict[str, Any] = {field.name: header["architecture"][field.name] for field in fields(Architecture)}
    sizes["hidden"] = tuple(sizes["hidden"])
    architecture = Architecture(**sizes)
    views = tuple(str(view) for view in header["views"])
    columns, components = sum(BLOCKS.values()), architecture.components
    asked = [view for view in views if f"weights.{view}" in arrays]
    expected: dict[str, tuple[int | None, ...]] = {"mean": (columns,), "scale": (columns,)}
    expected |= {"basis": (components, columns), "emulator.basis": (components, components)}
    expected |= {"box": (len(TARGETS), 2), "centre": (len(TARGETS),), "spread": (len(TARGETS),)}
    expected |= {"combinations.weights": (len(PARAMETERS), len(PARAMETERS)), "combinations.centre": (len(PARAMETERS),)}
    expected |= {f"misfits.{view}": (None,) for view in views}
    expected |= {f"weights.{view}": (columns,) for view in asked} | {f"reference.{view}": (None,) for view in asked}
    for name, shape in expected.items():
        actual = arrays[name].shape
        if len(actual) != len(shape) or any(n not in (None, m) for n, m in zip(shape, actual, strict=True)):
            raise ValueError(f"{name} of shape {actual}, not {shape}")
    members = []
    for k in range(check_int(header["members"], "a number of flows", 1, MOST)):
        with torch.random.fork_rng():  # its first weights are drawn, and then replaced
            member = Member(architecture, len(views)).eval()
        split = ((key.partition("."), value) for key, value in arrays.items())
        member.load_state_dict({name: torch.from_numpy(value) for (n, _, name), value in split if n == str(k)})
        members.append(member)
    compression = Compression(arrays["mean"], arrays["scale"], arrays["basis"])
    mean, spread = (_read_layers(arrays, f"emulator.{name}", len(views), components) for name in ("mean", "spread"))
    inflation, box = check_float(header["inflation"], "an emulator's inflation", 1e-3, 1e3), arrays["box"]
    emulator = Emulator(compression, views, box[: len(PARAMETERS)], mean, spread, arrays["emulator.basis"], inflation)
    references = {view: arrays[f"misfits.{view}"] for view in views}
    discriminants = {view: Discriminant(arrays[f"weights.{view}"], arrays[f"reference.{view}"]) for view in asked}
    if not all(map(len, (*references.values(), *(each.reference for each in discriminants.values())))):
        raise ValueError("misfits without numbers")
    ends = tuple((str(low), str(high)) for low, high in header["ends"])
    if len(ends) != len(PARAMETERS):
        raise ValueError(f"words for {len(ends)} combinations, not {len(PARAMETERS)}")
    combinations = Combinations(arrays["combinations.weights"], arrays["combinations.centre"], ends)
    return Posterior(
        architecture, tuple(members), compression, views, box, arrays["centre"], arrays["spread"], emulator,
        references, combinations, header["provenance"], discriminants,
    )  # fmt: skip


def _read_layers(arrays: dict[str, np.ndarray], name: str, views: int, outputs: int) -> tuple[Layer, ...]:
    """Return the layers (member, out, in) of an ensemble; raise ValueError where their shapes do not chain."""
    count = sum(key.startswith(f"{name}.") for key in arrays) // 2
    layers = [Layer(arrays[f"{name}.{k}.weight"], arrays[f"{name}.{k}.bias"]) for k in range(count)]
    inputs = len(PARAMETERS) + 1 + views
    for weight, bias in layers:
        if weight.ndim != 3 or weight.shape[2] != inputs or bias.shape != weight.shape[:2]:
            raise ValueError(f"{name} with layers of shapes {weight.shape} and {bias.shape} for {inputs} inputs")
        inputs = weight.shape[1]
    if inputs != outputs:
        raise ValueError(f"{name} with {inputs} outputs, not {outputs}")
    return tuple(layers)
