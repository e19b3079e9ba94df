"""Descriptors of many shapes with the parameters that made them, in one file: what a posterior is trained on."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from curvafit.core.records import Format, encode_json
from curvafit.geometry.descriptors import BLOCKS, Descriptors
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.scan.grids import median_thickness, remove_specks
from curvafit.scan.prepare import KEPT_THICKNESS, THINNEST, smallest_piece
from curvafit.scan.structure import split, voxelise
from curvafit.volumes.field import Field, ScanError

TABLE_FILE = Format(
    "curvafit descriptors",
    1,
    "a table of descriptors",
    "describe the stores into another file, or with --overwrite",
    {"blocks": BLOCKS},
)
#: What is inferred, with a20 = 1 as the gauge, in working units.
PARAMETERS = ("a11", "log a02", "a10", "a01", "a00", "m0")
#: Part of each side that a crop keeps.
WINDOW = 0.75
#: Least and greatest voxel of a resampled shape, in voxels of the field.
SCALES = (0.5, 2.0)
#: A degraded scan: deviation of the blur in voxels, contrast over the noise's deviation, and voxels a slice is thick.
BLUR, SNR, SLICE = 1.0, 5.0, 2
#: Blocks whose logarithm is taken, and the least value that goes into it.
LOGARITHMIC = ("fraction", "chords", "gaps", "depths", "clearances")
LEAST = 1e-3
#: Of the densities of ∫H and χ, in these units, the inverse sinh is taken.
BENDS, EULERS = 50.0, 100.0
#: Furthest that a column may lie from its mean, in its deviations.
FURTHEST = 6.0
#: Deviations that blocks have before compression, 1 where none is named.
WEIGHTS = {"curvature": 3.0}


@dataclass(frozen=True, eq=False)
class Table:
    """Descriptors of N views of shapes, and the parameters of the shapes.

    `shapes` and `views` name them (str, `(N,)`); `parameters` is `(N, 6)` (`PARAMETERS`); `descriptors` `(N, 351)` has
    the blocks of `Descriptors` in their order, NaN where a view shows no surface.
    """

    shapes: np.ndarray
    views: np.ndarray
    parameters: np.ndarray
    descriptors: np.ndarray
    provenance: dict[str, Any]

    def __post_init__(self) -> None:
        n = len(self.shapes)
        expected = {"views": (n,), "parameters": (n, len(PARAMETERS)), "descriptors": (n, sum(BLOCKS.values()))}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"expected {name} of shape {shape}, got {getattr(self, name).shape}")

    def __len__(self) -> int:
        return len(self.shapes)

    def rows(self, chosen: np.ndarray) -> Table:
        """Return some rows, by their numbers or a mask."""
        i = np.asarray(chosen)
        return Table(self.shapes[i], self.views[i], self.parameters[i], self.descriptors[i], self.provenance)

    def select_views(self, views: Sequence[str]) -> Table:
        """Return the rows of some kinds of views; raise ValueError if there is none of a kind."""
        kinds = set(self.views.tolist())
        if missing := [view for view in views if view not in kinds]:
            raise ValueError(f"expected views among {', '.join(sorted(kinds))}, got {', '.join(missing)}")
        return self.rows(np.isin(self.views, list(views)))

    @property
    def visible(self) -> Table:
        """Return the rows whose view shows a surface."""
        return self.rows(np.asarray(np.isfinite(self.descriptors).all(1)))


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


def mirror_parameters(parameters: np.ndarray) -> np.ndarray:
    """Return the parameters `(…, 6)` of the same shapes with inside and outside exchanged (`Coefficients.mirrored`)."""
    a11, log_a02, a10, a01, a00, mass = np.moveaxis(np.asarray(parameters, dtype=np.float64), -1, 0)
    a02 = np.exp(log_a02)
    return np.stack([a11 / a02, -log_a02, -a01 / a02, -a10 / a02, a00 / a02, -mass], -1)


def column_names() -> list[str]:
    """Return the name of the block that each column of descriptors belongs to."""
    return [name for name, length in BLOCKS.items() for _ in range(length)]


def to_row(view: Descriptors | None) -> np.ndarray:
    """Return the row of a view's descriptors; NaN where there are none."""
    return np.full(sum(BLOCKS.values()), np.nan) if view is None else view.vector()


def save_table(table: Table, path: str | Path) -> None:
    """Write a table as one compressed `.npz`: arrays (descriptors in float32) and a JSON header."""
    arrays = {
        "names": encode_json([table.shapes.tolist(), table.views.tolist()]),
        "parameters": table.parameters,
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
    """Return the table of a file's header and arrays."""
    shapes, views = (np.array(each, dtype=str) for each in json.loads(arrays["names"].tobytes()))
    if not np.isfinite(arrays["parameters"]).all():
        raise ValueError("parameters that are not finite")
    if arrays["descriptors"].dtype.kind != "f" or not isinstance(header["provenance"], dict):
        raise ValueError("descriptors that are no numbers, or no provenance")
    return Table(shapes, views, arrays["parameters"], arrays["descriptors"], header["provenance"])


class View(NamedTuple):
    """A phase field (float32) or a mask (bool) `(Z, Y, X)`, and its grid: not periodic where it is a part."""

    shape: np.ndarray
    grid: Grid


def see_field(u: np.ndarray, grid: Grid, rng: np.random.Generator) -> View:
    """Return the phase field itself."""
    return View(u, grid)


def see_mask(u: np.ndarray, grid: Grid, rng: np.random.Generator) -> View:
    """Return {u > 0} on the field's own voxels."""
    return View(u > 0, grid)


def see_crop(u: np.ndarray, grid: Grid, rng: np.random.Generator) -> View:
    """Return {u > 0} in a window of three quarters of each side, anywhere in the repeated box."""
    turned = np.roll(u > 0, [int(rng.integers(n)) for n in u.shape], (0, 1, 2))
    nz, ny, nx = (round(WINDOW * n) for n in u.shape)
    part = np.ascontiguousarray(turned[:nz, :ny, :nx])
    if part.all() or not part.any():
        raise ScanError("expected a window with an inside and an outside, got one of them only")
    return View(part, Grid((nz, ny, nx), grid.spacing, "replicate"))


def see_resampled(u: np.ndarray, grid: Grid, rng: np.random.Generator) -> View:
    """Return a crop resampled to other voxels, on which it is 5 to 16 thick, and back, by signed distances.

    A scan's mask is brought to the working grid in the same way.
    """
    part, window = see_crop(u, grid, rng)
    thickness = _measure_thickness(part)
    voxel = float(np.clip(thickness / math.exp(rng.uniform(*np.log(KEPT_THICKNESS))), *SCALES))
    return View(voxelise(part, (1 / voxel,) * 3, smallest_piece(thickness), periodic=False), window)


def see_scan(u: np.ndarray, grid: Grid, rng: np.random.Generator) -> View:
    """Return a crop scanned badly, split by Otsu's threshold: blurred, slices two voxels thick, noise at SNR 5.

    Prepared as `infer` prepares an image: smoothed by a voxel, split, interpolated to cubic voxels, cleared of specks.
    """
    part, window = see_crop(u, grid, rng)
    inside = split(_degrade(part, rng), part.shape)
    return View(remove_specks(inside, smallest_piece(_measure_thickness(inside)), False)[0], window)


def _degrade(part: np.ndarray, rng: np.random.Generator) -> Field:
    """Return a mask as a bad scan shows it: blurred, slices two voxels thick, noise at SNR 5."""
    grey = ndimage.gaussian_filter(part.astype(np.float32), BLUR, mode="nearest")
    whole = np.pad(grey, ((0, -len(grey) % SLICE), (0, 0), (0, 0)), mode="edge")
    grey = whole.reshape(-1, SLICE, *grey.shape[1:]).mean(1)
    grey += rng.standard_normal(grey.shape, dtype=np.float32) / SNR
    return Field(grey, (float(SLICE), 1.0, 1.0), "voxel")


def _measure_thickness(part: np.ndarray) -> float:
    """Return the median thickness in voxels, or raise ScanError where a structure is too thin for `infer`."""
    if not part.any():
        raise ScanError("expected a structure in the window, got none")
    thickness, thick = median_thickness(part, (1.0, 1.0, 1.0), False)
    if thick < THINNEST - 0.5:
        raise ScanError(f"expected a structure {THINNEST:g} voxels thick, got one of {thick:.2g}")
    return thickness


#: Views by name.
VIEWS: dict[str, Callable[[np.ndarray, Grid, np.random.Generator], View]] = {
    "field": see_field,
    "mask": see_mask,
    "crop": see_crop,
    "resampled": see_resampled,
    "scan": see_scan,
}


@dataclass(frozen=True, eq=False)
class Compression:
    """From descriptors to their principal components: means and scales by column `(c,)`, basis `(k, c)`."""

    blocks: tuple[str, ...]
    mean: np.ndarray
    scale: np.ndarray
    basis: np.ndarray

    def __call__(self, descriptors: np.ndarray) -> np.ndarray:
        """Return the components `(N, k)`, their mean square 1, of descriptors `(N, 351)`."""
        columns = columns_of(descriptors, self.blocks)
        return np.clip((columns - self.mean) / self.scale, -FURTHEST, FURTHEST) @ self.basis.T


def compression_of(descriptors: np.ndarray, components: int, blocks: tuple[str, ...] = tuple(BLOCKS)) -> Compression:
    """Return the compression to the principal components of some descriptors.

    Columns are scaled to deviation 1 (those of the curvature block by one factor, so that distances stay), and blocks
    weighed by `WEIGHTS`. Components are half whitened: one of deviation σ is divided by √σ, so that the first do not
    drown the others. The components' mean square is 1.
    """
    names = np.array(column_names())
    names = names[np.isin(names, blocks)]
    columns = columns_of(descriptors, blocks)
    mean, scale = columns.mean(0), columns.std(0) + 1e-9
    weight = np.ones(len(names))
    for block in set(names.tolist()):
        in_block = names == block
        weight[in_block] = WEIGHTS.get(block, 1.0) / np.sqrt(in_block.sum())
        if block == "curvature":
            scale[in_block] = np.sqrt((scale[in_block] ** 2).mean())
    uncompressed = Compression(blocks, mean, scale, np.diag(weight))
    weighed = uncompressed(descriptors)
    values, vectors = np.linalg.eigh(weighed.T @ weighed / len(weighed))
    order = np.argsort(-values)[:components]
    # An eigenvalue is σ², so its fourth root is √σ.
    basis = (vectors[:, order] / (values[order] + 1e-12) ** (1 / 4)).T * weight
    basis /= np.sqrt(np.mean(np.sqrt(values[order])))
    return Compression(blocks, mean, scale, basis)


def columns_of(descriptors: np.ndarray, blocks: Sequence[str]) -> np.ndarray:
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
