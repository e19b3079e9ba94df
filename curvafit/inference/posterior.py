"""What the descriptors of a texture say about its parameters: an ensemble of conditional normalising flows."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zuko
from torch import Tensor, nn

from curvafit.files import write_content
from curvafit.geometry.descriptors import BLOCKS, Descriptors
from curvafit.inference.table import PARAMETERS, column_names
from curvafit.priors.bounds import quoted, real, whole
from curvafit.priors.json_text import parse_json
from curvafit.volumes.formats import read_archive

FORMAT = "curvafit posterior"
VERSION = 1
#: Blocks of lengths and parts, whose logarithm is taken; and least value of which it is.
LOGARITHMIC = ("fraction", "chords", "gaps", "depths", "clearances")
LEAST = 1e-3
#: Densities of ∫H and χ are sinh of what is compressed, in these units; that of area is its exponential.
BENDS, EULERS = 50.0, 100.0
#: Furthest that a column may lie from its mean, in its deviations.
FURTHEST = 6.0
#: Largest size of a flow, and most flows of an ensemble.
WIDEST, MOST = 2048, 64
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
            whole(size, "sizes of a flow that are whole numbers", 1, WIDEST)
        real(self.dropout, "a dropout", 0.0, 0.9)
        if not self.blocks or not set(self.blocks) <= set(BLOCKS):
            raise ValueError(f"expected blocks among {', '.join(BLOCKS)}, got {quoted(list(self.blocks))}")


@dataclass(frozen=True, eq=False)
class Compression:
    """From descriptors to their principal components: means and scales by column `(c,)`, basis `(k, c)`."""

    blocks: tuple[str, ...]
    mean: np.ndarray
    scale: np.ndarray
    basis: np.ndarray

    def __call__(self, descriptors: np.ndarray) -> np.ndarray:
        """Return the components `(N, k)`, their mean square 1, of descriptors `(N, 351)`."""
        columns = straightened(descriptors, self.blocks)
        return np.clip((columns - self.mean) / self.scale, -FURTHEST, FURTHEST) @ self.basis.T


class Member(nn.Module):
    """One flow of an ensemble: a conditional distribution of the six parameters, in coordinates without bounds."""

    def __init__(self, architecture: Architecture, views: int) -> None:
        super().__init__()
        context = architecture.components + views
        sizes, splines = architecture.hidden, architecture.transforms
        self.flow = zuko.flows.NSF(
            len(PARAMETERS), context, bins=architecture.bins, transforms=splines, hidden_features=sizes
        )
        self.dropout = nn.Dropout(architecture.dropout)

    def forward(self, context: Tensor) -> torch.distributions.Distribution:
        return self.flow(self.dropout(context))


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
    """

    architecture: Architecture
    members: tuple[Member, ...]
    compression: Compression
    views: tuple[str, ...]
    box: np.ndarray
    centre: np.ndarray
    spread: np.ndarray
    provenance: dict[str, Any]

    def sample(self, descriptors: Descriptors | np.ndarray, view: str, count: int = 1000, seed: int = 0) -> np.ndarray:
        """Draw parameters `(N, count, 6)` given descriptors `(N, 351)`; `(count, 6)` given one.

        Raises
        ------
        ValueError
            If it was not trained on the view.
        """
        rows, single = _rows(descriptors)
        context = self.context(rows, np.full(len(rows), view))
        parts = [len(part) for part in np.array_split(np.arange(count), len(self.members))]
        with torch.random.fork_rng(), torch.no_grad():
            torch.manual_seed(seed)
            draws = [member(context).sample(torch.Size((n,))) for member, n in zip(self.members, parts, strict=True)]
        free = torch.cat(draws).movedim(0, 1).double().numpy()
        parameters = self.bounded(free * self.spread + self.centre)
        return parameters[0] if single else parameters

    def log_density(self, parameters: np.ndarray, descriptors: Descriptors | np.ndarray, view: str) -> np.ndarray:
        """Return the logarithm of the density of parameters `(N, 6)` given descriptors `(N, 351)`, in nats."""
        rows, _ = _rows(descriptors)
        context = self.context(rows, np.full(len(rows), view))
        free = (self.unbounded(np.atleast_2d(parameters)) - self.centre) / self.spread
        with torch.no_grad():
            parts = torch.stack([member(context).log_prob(torch.from_numpy(free).float()) for member in self.members])
        density = torch.logsumexp(parts, 0).double().numpy() - np.log(len(self.members))
        return density - np.log(self.spread).sum() + self._log_slope(np.atleast_2d(parameters))

    def context(self, descriptors: np.ndarray, views: np.ndarray) -> Tensor:
        """Return what the flows see: components of the descriptors and the kind of each view."""
        unknown = sorted(set(views.tolist()) - set(self.views))
        if unknown:
            raise ValueError(f"expected views among {', '.join(self.views)}, got {', '.join(unknown)}")
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

    def _share(self, parameters: np.ndarray) -> np.ndarray:
        low, wide = self._edges
        return (parameters - low) / wide

    @property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.box.T
        return low - RIM * (high - low), (1 + 2 * RIM) * (high - low)

    def _log_slope(self, parameters: np.ndarray) -> np.ndarray:
        share = np.clip(self._share(parameters), 1e-6, 1 - 1e-6)
        return -np.log(share * (1 - share) * self._edges[1]).sum(1)


def straightened(descriptors: np.ndarray, blocks: Sequence[str]) -> np.ndarray:
    """Return the columns of some blocks, lengths and densities as logarithms."""
    names = np.array(column_names())
    columns = np.array(descriptors, dtype=np.float64)
    chosen = np.isin(names, LOGARITHMIC)
    columns[:, chosen] = np.log(np.maximum(columns[:, chosen], LEAST))
    area, bend, euler = np.flatnonzero(names == "densities")
    columns[:, area] = np.log(np.maximum(columns[:, area], LEAST))
    columns[:, bend] = np.arcsinh(columns[:, bend] / BENDS)
    columns[:, euler] = np.arcsinh(columns[:, euler] / EULERS)
    return columns[:, np.isin(names, list(blocks))]


def save_posterior(posterior: Posterior, path: str | Path) -> None:
    """Write a posterior as one compressed `.npz`: arrays and a JSON header, nothing that runs when it is read."""
    header = {
        "format": FORMAT,
        "version": VERSION,
        "architecture": asdict(posterior.architecture),
        "members": len(posterior.members),
        "views": posterior.views,
        "blocks": BLOCKS,
        "provenance": posterior.provenance,
    }
    arrays = {name: getattr(posterior, name) for name in ("box", "centre", "spread")}
    arrays |= {name: getattr(posterior.compression, name) for name in ("mean", "scale", "basis")}
    for number, member in enumerate(posterior.members):
        arrays |= {f"{number}.{name}": value.numpy() for name, value in member.state_dict().items()}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, header=np.frombuffer(json.dumps(header).encode(), dtype=np.uint8), **arrays)
    write_content(Path(path), buffer.getvalue())


def load_posterior(path: str | Path) -> Posterior:
    """Read a posterior.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is not a posterior, is damaged, or has another format version or other blocks.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"expected a posterior, got {path}, where there is none")
    try:
        arrays = read_archive(path)
        header = parse_json(arrays.pop("header").tobytes(), "a posterior's header", path)
        known = header["format"] == FORMAT
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"expected a posterior, got {path}, which is damaged or something else") from error
    if not known:
        raise ValueError(f"expected a posterior, got {path}, which is something else")
    if (version := header.get("version")) != VERSION or header.get("blocks") != BLOCKS:
        raise ValueError(
            f"expected a posterior of version {VERSION} with the blocks of this program, got version {quoted(version)} "
            f"or other blocks in {path}: train it again"
        )
    try:
        return _assembled(header, arrays)
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        raise ValueError(f"expected a whole posterior, got {path} ({str(error)[:200]})") from error


def is_posterior(path: Path) -> bool:
    """Return whether a file bears a posterior's format; all else of it may be wrong."""
    try:
        header = read_archive(path)["header"].tobytes() if path.is_file() else b""
        return parse_json(header, "a posterior's header", path)["format"] == FORMAT
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _assembled(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Posterior:
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
    for number in range(whole(header["members"], "a number of flows", 1, MOST)):
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
        header["provenance"],
    )


def _rows(descriptors: Descriptors | np.ndarray) -> tuple[np.ndarray, bool]:
    row = descriptors.vector() if isinstance(descriptors, Descriptors) else np.asarray(descriptors)
    return np.atleast_2d(row), row.ndim == 1
