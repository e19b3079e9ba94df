"""What the descriptors of a texture say about its parameters: an ensemble of conditional normalising flows."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from curvafit.core.checks import check_float, check_int, quoted
from curvafit.core.extras import require
from curvafit.core.records import Format
from curvafit.geometry.descriptors import BLOCKS, Descriptors
from curvafit.inference.emulator import Emulator, Layer
from curvafit.inference.table import PARAMETERS, Compression, column_names, packaged

POSTERIOR_FILE = Format("curvafit posterior", 3, "a posterior", "train it again", {"blocks": BLOCKS})
#: Largest size of a flow, and most flows of an ensemble.
WIDEST, MOST = 2048, 64
#: Which of the parameters is the mass.
MASS = PARAMETERS.index("m0")
#: Part by which the box of the parameters is wider, on each side, than what was drawn.
RIM = 0.02


@dataclass(frozen=True)
class Architecture:
    """Sizes of a flow of splines: principal components of the descriptors that it sees, widths of its hidden layers,
    transforms, bins of a spline, part of the components that training leaves out at random, and blocks of descriptors.

    Raises
    ------
    ValueError
        If a size is not a whole number from 1 to `WIDEST`, or a block has another name.
    """

    components: int = 32
    hidden: tuple[int, ...] = (64, 64)
    transforms: int = 2
    bins: int = 8
    dropout: float = 0.1
    blocks: tuple[str, ...] = tuple(BLOCKS)

    def __post_init__(self) -> None:
        for size in (self.components, *self.hidden, self.transforms, self.bins):
            check_int(size, "sizes of a flow that are whole numbers", 1, WIDEST)
        check_float(self.dropout, "a dropout", 0.0, 0.9)
        if not self.blocks or not set(self.blocks) <= set(BLOCKS):
            raise ValueError(f"expected blocks among {', '.join(BLOCKS)}, got {quoted(list(self.blocks))}")


class Member(nn.Module):
    """One flow of an ensemble: a conditional distribution of the six parameters, in coordinates without bounds.

    Of the mass it is that of what a straight line of the context leaves, by view, in the deviations `width` `(views,)`:
    the volume fraction tells the mass, and dropout would hide it.
    """

    slope: Tensor
    width: Tensor

    def __init__(self, architecture: Architecture, views: int) -> None:
        super().__init__()
        context = architecture.components + views
        sizes, splines = architecture.hidden, architecture.transforms
        zuko = require("zuko", "infer", "reading a posterior")
        self.flow = zuko.flows.NSF(
            len(PARAMETERS), context, bins=architecture.bins, transforms=splines, hidden_features=sizes
        )
        self.dropout = nn.Dropout(architecture.dropout)
        self.register_buffer("slope", torch.zeros(views, context))
        self.register_buffer("width", torch.ones(views))

    def forward(self, context: Tensor) -> torch.distributions.Distribution:
        view = context[:, -len(self.width) :]
        mean = torch.zeros(len(context), len(PARAMETERS))
        width = torch.ones_like(mean)
        mean[:, MASS], width[:, MASS] = (view @ self.slope * context).sum(1), view @ self.width
        line = torch.distributions.AffineTransform(mean, width, event_dim=1)
        return torch.distributions.TransformedDistribution(self.flow(self.dropout(context)), [line])


@dataclass(frozen=True, eq=False)
class Posterior:
    """The posterior of (a11, log a02, a10, a01, a00, m₀), with a20 = 1, given descriptors: all in working units.

    Attributes
    ----------
    members
        Flows whose equal mixture it is.
    compression
        What the flows see of descriptors.
    views
        Kinds of views that it was trained on.
    box
        `(6, 2)`: the parameters' least and greatest values.
    centre, spread
        `(6,)`: mean and deviation of the parameters without bounds.
    emulator
        What parameters make of the descriptors.
    misfits
        By view, what the emulator's best parameters leave unexplained of shapes that it did not learn from, increasing.
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
    provenance: dict[str, Any]

    def sample(self, descriptors: Descriptors | np.ndarray, view: str, count: int = 1000, seed: int = 0) -> np.ndarray:
        """Draw parameters `(N, count, 6)` given descriptors `(N, 351)`; `(count, 6)` given one.

        Raises
        ------
        ValueError
            If it was not trained on the view, or descriptors are not finite.
        """
        rows, single = _rows(descriptors)
        context = self.context(rows, np.full(len(rows), view))
        parts = [len(part) for part in np.array_split(np.arange(count), len(self.members))]
        with torch.random.fork_rng(), torch.no_grad():
            torch.manual_seed(seed)
            draws = [member(context).sample(torch.Size((n,))) for member, n in zip(self.members, parts, strict=True)]
        free = torch.cat(draws).movedim(0, 1).double().numpy()
        parameters = self.of_standard(free)
        return parameters[0] if single else parameters

    def log_density(self, parameters: np.ndarray, descriptors: Descriptors | np.ndarray, view: str) -> np.ndarray:
        """Return the logarithm of the density of parameters `(N, 6)` given descriptors `(N, 351)`, in nats.

        It is -inf outside the box, which is wider by 1/50 on each side than what was drawn.

        Raises
        ------
        ValueError
            As `sample`.
        """
        rows, _ = _rows(descriptors)
        context = self.context(rows, np.full(len(rows), view))
        free = self.standard(np.atleast_2d(parameters))
        with torch.no_grad():
            parts = torch.stack([member(context).log_prob(torch.from_numpy(free).float()) for member in self.members])
        density = torch.logsumexp(parts, 0).double().numpy() - np.log(len(self.members))
        share = self._share(np.atleast_2d(parameters))
        within = ((share > 0) & (share < 1)).all(1)
        return np.where(within, density - np.log(self.spread).sum() + self._log_slope(share), -np.inf)

    def context(self, descriptors: np.ndarray, views: np.ndarray) -> Tensor:
        """Return what the flows see: components of the descriptors and the kind of each view.

        Raises
        ------
        ValueError
            If a view is of another kind, or descriptors are not finite.
        """
        unknown = sorted(set(views.tolist()) - set(self.views))
        if unknown:
            raise ValueError(f"expected views among {', '.join(self.views)}, got {', '.join(unknown)}")
        if bad := int((~np.isfinite(descriptors)).any(1).sum()):
            raise ValueError(f"expected descriptors that are finite, got {bad} of {len(descriptors)} rows with others")
        kinds = views[:, None] == np.array(self.views)
        return torch.from_numpy(np.concatenate([self.compression(descriptors), kinds], axis=1)).float()

    def unbounded(self, parameters: np.ndarray) -> np.ndarray:
        """Return the logits of the parameters' places in the box."""
        share = np.clip(self._share(parameters), 1e-6, 1 - 1e-6)
        return np.log(share / (1 - share))

    def bounded(self, free: np.ndarray) -> np.ndarray:
        """Return the parameters of logits."""
        low, wide = self._edges
        return low + wide / (1 + np.exp(-free))

    def standard(self, parameters: np.ndarray) -> np.ndarray:
        """Return the parameters without bounds, in deviations of the shapes that it was trained on."""
        return (self.unbounded(parameters) - self.centre) / self.spread

    def of_standard(self, standard: np.ndarray) -> np.ndarray:
        """Return the parameters whose `standard` it is."""
        return self.bounded(standard * self.spread + self.centre)

    def _share(self, parameters: np.ndarray) -> np.ndarray:
        """Return the parameters' places in the box, widened by its rim: 0 to 1 within."""
        low, wide = self._edges
        return (parameters - low) / wide

    @property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the least parameters of the box, widened by its rim, and its lengths."""
        low, high = self.box.T
        return low - RIM * (high - low), (1 + 2 * RIM) * (high - low)

    def _log_slope(self, share: np.ndarray) -> np.ndarray:
        """Return the logarithm of the volume of logits to one of parameters, at shares of the box `(N, 6)`."""
        share = np.clip(share, 1e-6, 1 - 1e-6)
        return -np.log(share * (1 - share) * self._edges[1]).sum(1)


def save_posterior(posterior: Posterior, path: str | Path) -> None:
    """Write a posterior as one compressed `.npz`: arrays and a JSON header, nothing that runs when it is read."""
    arrays = {name: getattr(posterior, name) for name in ("box", "centre", "spread")}
    arrays |= {name: getattr(posterior.compression, name) for name in ("mean", "scale", "basis")}
    for number, member in enumerate(posterior.members):
        arrays |= {f"{number}.{name}": value.numpy() for name, value in member.state_dict().items()}
    for name, layers in (("mean", posterior.emulator.mean), ("spread", posterior.emulator.spread)):
        for level, layer in enumerate(layers):
            arrays |= {f"emulator.{name}.{level}.{part}": value for part, value in layer._asdict().items()}
    arrays["emulator.basis"] = posterior.emulator.basis.astype(np.float32)
    arrays |= {f"misfits.{view}": values.astype(np.float32) for view, values in posterior.misfits.items()}
    header = {
        "architecture": asdict(posterior.architecture),
        "members": len(posterior.members),
        "inflation": posterior.emulator.inflation,
        "views": posterior.views,
        "provenance": posterior.provenance,
    }
    POSTERIOR_FILE.write(path, header, arrays)


def load_posterior(path: str | Path | None = None) -> Posterior:
    """Read a posterior; by default the packaged one.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is not a posterior, is damaged, or has another format version or other blocks.
    """
    if path is None:
        return POSTERIOR_FILE.read(packaged("posterior.npz"), _posterior, place="the packaged posterior")
    return POSTERIOR_FILE.read(path, _posterior)


def _posterior(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Posterior:
    """Return the posterior of a file's header and arrays."""
    if not all(np.isfinite(each).all() for each in arrays.values() if each.dtype.kind == "f"):
        raise ValueError("numbers that are not finite")
    sizes = header["architecture"]
    architecture = Architecture(**sizes | {name: tuple(sizes[name]) for name in ("hidden", "blocks")})
    columns = int(np.isin(column_names(), architecture.blocks).sum())
    expected = {"mean": (columns,), "scale": (columns,), "basis": (architecture.components, columns)}
    expected |= {"box": (len(PARAMETERS), 2), "centre": (len(PARAMETERS),), "spread": (len(PARAMETERS),)}
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} of shape {arrays[name].shape}, not {shape}")
    views = tuple(str(view) for view in header["views"])
    members = []
    for number in range(check_int(header["members"], "a number of flows", 1, MOST)):
        with torch.random.fork_rng():  # its first weights are drawn, and then replaced
            member = Member(architecture, len(views)).eval()
        prefix = f"{number}."
        state = {k.removeprefix(prefix): torch.from_numpy(v) for k, v in arrays.items() if k.startswith(prefix)}
        member.load_state_dict(state)
        members.append(member)
    compression = Compression(architecture.blocks, arrays["mean"], arrays["scale"], arrays["basis"])
    return Posterior(
        architecture,
        tuple(members),
        compression,
        views,
        arrays["box"],
        arrays["centre"],
        arrays["spread"],
        _emulator(compression, views, arrays, header["inflation"]),
        {view: _column(arrays[f"misfits.{view}"]) for view in views},
        header["provenance"],
    )


def _emulator(
    compression: Compression, views: tuple[str, ...], arrays: dict[str, np.ndarray], inflation: float
) -> Emulator:
    components = len(compression.basis)
    layers = {
        name: _read_layers(arrays, f"emulator.{name}", len(PARAMETERS) + len(views)) for name in ("mean", "spread")
    }
    for name, each in layers.items():
        if each[-1].weight.shape[1] != components:
            raise ValueError(f"networks of the emulator's {name} with {each[-1].weight.shape[1]} outputs")
    if (basis := arrays["emulator.basis"]).shape != (components, components):
        raise ValueError(f"emulator.basis of shape {basis.shape}, not {(components, components)}")
    inflation = check_float(inflation, "an emulator's inflation", 1e-3, 1e3)
    return Emulator(compression, views, arrays["box"], layers["mean"], layers["spread"], basis, inflation)


def _read_layers(arrays: dict[str, np.ndarray], name: str, inputs: int) -> tuple[Layer, ...]:
    """Return the layers (member, out, in) of an ensemble; raise ValueError where their shapes do not chain."""
    count = sum(key.startswith(f"{name}.") for key in arrays) // 2
    layers = [Layer(arrays[f"{name}.{k}.weight"], arrays[f"{name}.{k}.bias"]) for k in range(count)]
    for weight, bias in layers:
        if weight.ndim != 3 or weight.shape[2] != inputs or bias.shape != weight.shape[:2]:
            raise ValueError(f"{name} with layers of shapes {weight.shape} and {bias.shape} for {inputs} inputs")
        inputs = weight.shape[1]
    return tuple(layers)


def _column(values: np.ndarray) -> np.ndarray:
    if values.ndim != 1 or not len(values):
        raise ValueError(f"misfits of shape {values.shape}")
    return np.sort(values)


def _rows(descriptors: Descriptors | np.ndarray) -> tuple[np.ndarray, bool]:
    """Return descriptors as rows, and whether there was one without a leading axis."""
    row = descriptors.vector() if isinstance(descriptors, Descriptors) else np.asarray(descriptors)
    return np.atleast_2d(row), row.ndim == 1
