"""Descriptors of many shapes with the parameters that made them, in one file: what a posterior is trained on."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import ndimage

from curvafit.core.records import Format, encode_json
from curvafit.geometry.description import BLOCKS
from curvafit.priors.coefficients import Coefficients
from curvafit.scan.measures import Reading
from curvafit.scan.preparation import thinner_thickness
from curvafit.scan.quality import sample_mask
from curvafit.volumes.volume import Volume

_REMEDY = "describe the stores into another file, or with --overwrite"
TABLE_FILE = Format("curvafit descriptors", 2, "a table of descriptors", _REMEDY, {"blocks": BLOCKS})
#: Parameters that are inferred, in working units with a20 = 1 as the gauge; and with them the thickness of the law's
#: shapes in their own voxels, from which the length of such a voxel on a scan follows.
PARAMETERS = ("a11", "log a02", "a10", "a01", "a00", "m0")
TARGETS = (*PARAMETERS, "log thickness")
#: The same without logarithms, as columns of draws.
COLUMNS = ("a11", "a02", "a10", "a01", "a00", "mass", "thickness")
#: Range of a shape's thickness in the voxels of a mask's scanner, and range of these in voxels of the field.
SAMPLED, SCALES = (4.0, 16.0), (0.5, 2.0)
#: A degraded scan: deviation of the blur in voxels, contrast over the noise's deviation, and thickness of slices.
BLUR, SNR, SLICE = 1.0, 5.0, 2
#: Blocks whose logarithm is taken, and the least value that goes into it.
LOGARITHMIC = ("fraction", "chords", "gaps", "depths", "clearances")
LEAST = 1e-3
#: Of the densities of ∫H and χ, in these units, the inverse sinh is taken.
BENDS, EULERS = 50.0, 100.0
#: Least deviation by which a column is scaled: what hardly varies, as the least depths do, says little.
LEAST_SCALE = 0.03
#: Most deviations from its mean to which a column is clipped.
FURTHEST = 6.0
#: Typical amount seen of a texture, and the most that training shows, in cubes of a thickness.
USUAL, MOST_SEEN = 500.0, 8000.0
#: Weights of blocks in the compression, 1 where none is named.
WEIGHTS = {"curvature": 3.0}


@dataclass(frozen=True, eq=False)
class Table:
    """Readings of N views of shapes, and what made the shapes.

    `shapes` and `views` name them (str, `(N,)`); `parameters` is `(N, 6)` (`PARAMETERS`), `thickness` `(N,)` that of a
    shape in its own voxels; `descriptors` `(N, 351)` has the blocks of `Descriptors` in their order, NaN where a view
    shows no surface, and `amount` `(N,)` says how much was seen (`Reading`).
    """

    shapes: np.ndarray
    views: np.ndarray
    parameters: np.ndarray
    thickness: np.ndarray
    descriptors: np.ndarray
    amount: np.ndarray
    provenance: dict[str, Any]

    def __post_init__(self) -> None:
        n = len(self.shapes)
        expected: dict[str, tuple[int, ...]] = dict.fromkeys(("views", "thickness", "amount"), (n,))
        expected |= {"parameters": (n, len(PARAMETERS)), "descriptors": (n, sum(BLOCKS.values()))}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"expected {name} of shape {shape}, got {getattr(self, name).shape}")

    def __len__(self) -> int:
        return len(self.shapes)

    def rows(self, chosen: np.ndarray) -> Table:
        """Return some rows, by their indices or a mask."""
        columns = fields(self)[:-1]  # all but the provenance
        return replace(self, **{column.name: getattr(self, column.name)[np.asarray(chosen)] for column in columns})

    def select_views(self, views: Sequence[str]) -> Table:
        """Return the rows of some views, by name; raise ValueError if a view has no row."""
        kinds = set(self.views.tolist())
        if missing := [view for view in views if view not in kinds]:
            raise ValueError(f"expected views among {', '.join(sorted(kinds))}, got {', '.join(missing)}")
        return self.rows(np.isin(self.views, list(views)))

    @property
    def targets(self) -> np.ndarray:
        """Return the numbers to infer `(N, 7)` (`TARGETS`)."""
        return np.column_stack([self.parameters, np.log(self.thickness)])

    @property
    def visible(self) -> Table:
        """Return the rows whose view shows a surface."""
        return self.rows(np.asarray(np.isfinite(self.descriptors).all(1)))

    @property
    def laws(self) -> np.ndarray:
        """Return the index of each row's law, from 0 `(N,)`."""
        return np.unique(np.round(self.parameters, 9), axis=0, return_inverse=True)[1].ravel()

    @property
    def pooled(self) -> Table:
        """Return the rows, and with them a row for each 2, 4, 8, … shapes of one law in one view, as if one scan had
        shown them all: the means of their descriptors, and the sum of their amounts."""
        groups, laws = [[k] for k in range(len(self))], self.laws
        for law, view in product(np.unique(laws), np.unique(self.views)):
            group = np.flatnonzero((laws == law) & (self.views == view)).tolist()
            for size in (2**k for k in range(1, len(group).bit_length())):
                groups += [group[start : start + size] for start in range(0, len(group) - size + 1, size)]
        pooled = self.rows(np.array([rows[0] for rows in groups]))
        descriptors = np.array([self.descriptors[rows].mean(0) for rows in groups])
        thickness = np.array([self.thickness[rows].mean() for rows in groups])
        amount = np.array([self.amount[rows].sum() for rows in groups])
        return replace(pooled, descriptors=descriptors, thickness=thickness, amount=amount)


def parameters_of(law: Coefficients, mass: float) -> np.ndarray:
    """Return the six parameters of a law and a mass m₀, in the gauge a20 = 1 (`PARAMETERS`).

    Raises ValueError if a20 or a02 is not above 0.
    """
    a20, a11, a02, a10, a01, a00 = law
    if not (a20 > 0 and a02 > 0):
        raise ValueError(f"expected a law with a20 and a02 above 0, got a20 = {a20:g} and a02 = {a02:g}")
    return np.array([a11 / a20, np.log(a02 / a20), a10 / a20, a01 / a20, a00 / a20, mass])


def law_of(parameters: Sequence[float] | np.ndarray) -> tuple[Coefficients, float]:
    """Return the law and the mass of six parameters."""
    a11, log_a02, a10, a01, a00, mass = map(float, parameters)
    return Coefficients(1.0, a11, float(np.exp(log_a02)), a10, a01, a00), mass


def to_columns(draws: np.ndarray) -> np.ndarray:
    """Return draws `(n, 7)` of `TARGETS`, or `(n, 6)` of `PARAMETERS`, as columns `COLUMNS`, without logarithms."""
    columns = draws.T.copy()
    for k in {1, 6} & set(range(len(columns))):  # a02, and thickness where there is one
        columns[k] = np.exp(columns[k])
    return columns


def mirror_parameters(parameters: np.ndarray) -> np.ndarray:
    """Return the parameters `(…, 6)` of the same shapes with inside and outside exchanged (`Coefficients.mirror`)."""
    a11, log_a02, a10, a01, a00, mass = np.moveaxis(np.asarray(parameters, dtype=np.float64), -1, 0)
    a02 = np.exp(log_a02)
    return np.stack([a11 / a02, -log_a02, -a01 / a02, -a10 / a02, a00 / a02, -mass], -1)


def encode_seen(kinds: Sequence[str], views: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """Encode how textures were seen as numbers `(N, 1 + kinds)`: the amount's logarithm, and the view one-hot.

    Amounts are clipped to `MOST_SEEN`, as training shows no more. Raises ValueError if a view is not among `kinds`.
    """
    if unknown := sorted(set(views.tolist()) - set(kinds)):
        raise ValueError(f"expected views among {', '.join(kinds)}, got {', '.join(unknown)}")
    log_amount = np.log10(np.minimum(amount, MOST_SEEN) / USUAL)
    return np.concatenate([log_amount[:, None], views[:, None] == np.array(kinds)], axis=1)


def column_names() -> list[str]:
    """Return the name of the block that each column of descriptors belongs to."""
    return [name for name, length in BLOCKS.items() for _ in range(length)]


def to_row(reading: Reading | None) -> np.ndarray:
    """Return the descriptors of a reading; NaN where there is none."""
    return np.full(sum(BLOCKS.values()), np.nan) if reading is None else reading.descriptors


def save_table(table: Table, path: str | Path) -> None:
    """Write a table as one compressed `.npz`: arrays (descriptors in float32) and a JSON header."""
    arrays = {
        "names": encode_json([table.shapes.tolist(), table.views.tolist()]),
        **{name: getattr(table, name) for name in ("parameters", "thickness", "amount")},
        "descriptors": table.descriptors.astype(np.float32),
    }
    TABLE_FILE.write(path, {"provenance": table.provenance}, arrays)


def load_table(path: str | Path) -> Table:
    """Read a table of descriptors.

    Raises FileNotFoundError if there is no such file, and ValueError if it is not a table, is damaged, or has another
    format version or other blocks.
    """
    return TABLE_FILE.read(path, _from_arrays)


def _from_arrays(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Table:
    """Return the table of a file's header and arrays; descriptors may be stored `scaled` to each column's range."""
    shapes, views = (np.array(names, dtype=str) for names in json.loads(arrays["names"].tobytes()))
    if not np.isfinite(arrays["parameters"]).all():
        raise ValueError("parameters that are not finite")
    scaled = "scaled" in arrays
    descriptors = arrays["scaled"] * arrays["span"] + arrays["least"] if scaled else arrays["descriptors"]
    if descriptors.dtype.kind != "f" or not isinstance(header["provenance"], dict):
        raise ValueError("descriptors that are no numbers, or no provenance")
    parameters, thickness, amount = (arrays[name] for name in ("parameters", "thickness", "amount"))
    return Table(shapes, views, parameters, thickness, descriptors, amount, header["provenance"])


# ---- views -----------------------------------------------------------------------------------------------------------


class Scanned(NamedTuple):
    """A simulated scan of a shape, and the options with which it is prepared: its kind, and whether it is periodic."""

    scan: Volume
    kind: Literal["field", "mask", "image"]
    periodic: bool = False


def see_field(u: np.ndarray, rng: np.random.Generator) -> Scanned:
    """Return the phase field itself."""
    return Scanned(Volume(u), "field", periodic=True)


def see_mask(u: np.ndarray, rng: np.random.Generator) -> Scanned:
    """Return {u > 0}, cut open at random, on coarser or finer voxels with which it is 4 to 16 thick."""
    inside = _open(u, rng)
    voxel = float(np.clip(thinner_thickness(inside) / math.exp(rng.uniform(*np.log(SAMPLED))), *SCALES))
    coarse = sample_mask(inside, [voxel] * 3, periodic=False)
    return Scanned(Volume(coarse.astype(np.uint8)), "mask")


def see_scan(
    u: np.ndarray, rng: np.random.Generator, blur: float = BLUR, thick: int = SLICE, snr: float = SNR
) -> Scanned:
    """Return {u > 0}, cut open at random, scanned badly: blurred, slices two voxels thick, noise at SNR 5."""
    grey = ndimage.gaussian_filter(_open(u, rng).astype(np.float32), blur, mode="nearest")
    padded = np.pad(grey, ((0, -len(grey) % thick), (0, 0), (0, 0)), mode="edge")
    grey = padded.reshape(-1, thick, *grey.shape[1:]).mean(1)
    grey += rng.standard_normal(grey.shape, dtype=np.float32) / snr
    return Scanned(Volume(grey, (float(thick), 1.0, 1.0), "voxel"), "image")


#: Views by name.
VIEWS: dict[str, Callable[[np.ndarray, np.random.Generator], Scanned]]
VIEWS = {"field": see_field, "mask": see_mask, "scan": see_scan}


def _open(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return {u > 0} of a periodic box, rolled by a random shift, so that its sides cut the structure anywhere."""
    return np.roll(u > 0, [int(rng.integers(n)) for n in u.shape], (0, 1, 2))


# ---- compression -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Compression:
    """From descriptors to their principal components: means and scales by column `(c,)`, basis `(k, c)`."""

    mean: np.ndarray
    scale: np.ndarray
    basis: np.ndarray

    def __call__(self, descriptors: np.ndarray) -> np.ndarray:
        """Return the components `(N, k)`, their mean square 1, of descriptors `(N, 351)`."""
        columns = columns_of(descriptors)
        return np.clip((columns - self.mean) / self.scale, -FURTHEST, FURTHEST) @ self.basis.T


def compression_of(descriptors: np.ndarray, components: int) -> Compression:
    """Return the compression to the principal components of descriptors `(N, 351)`.

    Columns are scaled to deviation 1 (those of the curvature block by one factor, which keeps distances), and blocks
    weighted by `WEIGHTS`. Components are half whitened: one of deviation σ is divided by √σ, so that the first do not
    drown the others. The components' mean square is 1.
    """
    names, columns = np.array(column_names()), columns_of(descriptors)
    mean, scale = columns.mean(0), np.maximum(columns.std(0), LEAST_SCALE)
    weight = np.ones(len(names))
    for block in BLOCKS:
        in_block = names == block
        weight[in_block] = WEIGHTS.get(block, 1.0) / np.sqrt(in_block.sum())
        if block == "curvature":
            scale[in_block] = np.sqrt((scale[in_block] ** 2).mean())
    uncompressed = Compression(mean, scale, np.diag(weight))
    weighted = uncompressed(descriptors)
    values, vectors = np.linalg.eigh(weighted.T @ weighted / len(weighted))
    order = np.argsort(-values)[:components]
    # An eigenvalue is σ², so its fourth root is √σ.
    basis = (vectors[:, order] / (values[order] + 1e-12) ** (1 / 4)).T * weight
    basis /= np.sqrt(np.mean(np.sqrt(values[order])))
    return Compression(mean, scale, basis)


def columns_of(descriptors: np.ndarray, blocks: Sequence[str] = tuple(BLOCKS)) -> np.ndarray:
    """Return the columns of some blocks, lengths and densities as logarithms."""
    names = np.array(column_names())
    columns = np.array(descriptors, dtype=np.float64)
    logarithmic = np.isin(names, LOGARITHMIC)
    columns[:, logarithmic] = np.log(np.maximum(columns[:, logarithmic], LEAST))
    area, bend, euler = np.flatnonzero(names == "densities")
    columns[:, area] = np.log(np.maximum(columns[:, area], LEAST))
    columns[:, bend] = np.arcsinh(columns[:, bend] / BENDS)
    columns[:, euler] = np.arcsinh(columns[:, euler] / EULERS)
    return columns[:, np.isin(names, list(blocks))]
