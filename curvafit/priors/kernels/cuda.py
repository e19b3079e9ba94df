"""F_ε with its gradient, and whole runs of the H⁻¹ flow, on an NVIDIA device (Triton, float32), many shapes at once.

A step is six launches (`passes`), each over all shapes; bytes a voxel are those that must move where nothing stays in
a cache, a number four bytes:

    div A, blurred along z                        reads A (3), writes 1                     16
    blur along y and x, base added                reads 1, writes 1 between and u           12
    partial derivatives, summed along z           reads u, writes 6                         28
    transposed stencils within planes             reads 6, writes 1                         28
    blur along y and x                            reads 1, writes 1 between and 1           12
    blur along z, -∇ and Adam                     reads 1 and A, m, v (9), writes A, m, v   76

172 in all (`BYTES`), of a floor of 100; 68 a voxel are held (A, m, v, u, and seven volumes of scratch).

Steps are recorded into CUDA graphs and replayed: a table of step lengths and a counter stand on the device, so that
nothing passes between host and device within a run. Statistics are computed only where they are asked for, by variants
of two kernels. No sum depends on the order in which threads run: a run repeats bit for bit on one device.
"""

from __future__ import annotations

import functools
import importlib.util
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from curvafit.priors.grid import Grid
from curvafit.priors.stencils import gaussian_taps

#: Bytes a voxel that each launch of a step moves, where no cache helps.
BYTES = {
    "div A, blur along z": 16,
    "blur along y and x, base": 12,
    "partial derivatives": 28,
    "transposed stencils": 28,
    "blur along y and x": 12,
    "blur along z, -∇, Adam": 76,
}
#: Steps of one graph, and rows of the table of step lengths.
_UNROLLED, _TABLE = 10, 4096
#: Radius of the widest blur (taps are unrolled), and voxels of the largest shape (places in it are 32-bit numbers).
_WIDEST, _LARGEST = 64, (2**31 - 1) // 8
#: Planes that a program of `density` takes at most; fewer where that leaves the device idle.
_PLANES = 32


class Tuning(NamedTuple):
    """Sizes of one program.

    `rows` and `last_rows` are a thread's outputs along the blurred axis, and in `gather` and `blur_z_adam`; `planes`
    are those of `density`, `width` is the cells of a thread in the blurs (None: by size), `lanes` the threads.
    """

    rows: int = 8
    last_rows: int = 4
    planes: int | None = None
    width: int | None = None
    lanes: int = 128


class Statistics(NamedTuple):
    """F_ε, and max and mean of |∂F_ε/∂A| over free voxels: `(B,)` each, float64."""

    energy: Tensor
    gradient_max: Tensor
    gradient_mean: Tensor


class State(NamedTuple):
    """The state from which a run can go on: A and Adam's moments, each `(B, 3, Z, Y, X)`, the sums of the shifts of u,
    `(B,)` in float64, and the number of steps."""

    vector: Tensor
    first: Tensor
    second: Tensor
    shifts: Tensor
    taken: int


class Launch(NamedTuple):
    """A kernel's name in `passes`, the number of programs (shapes last), the arguments, constants and threads."""

    kernel: str
    programs: tuple[int, int]
    arguments: dict[str, Any]
    constants: dict[str, Any]
    lanes: int

    def __call__(self) -> None:
        from curvafit.priors.kernels import passes

        options = {"num_warps": self.lanes // 32, "num_stages": 1, "enable_fp_fusion": True}
        getattr(passes, self.kernel)[self.programs](**self.arguments, **self.constants, **options)


def available(device: torch.device | str) -> bool:
    """Return whether kernels can be built for a device and run there."""
    if torch.device(device).type != "cuda" or importlib.util.find_spec("triton") is None:
        return False
    return torch.cuda.is_available() and torch.cuda.get_device_capability(device) >= (8, 0)


def energy_gradient(
    u: Tensor,
    a,
    grid: Grid,
    epsilon: float | Tensor,
    orientation: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    tuning: Tuning | None = None,
) -> tuple[Tensor, Tensor]:
    """Return F_ε of fields and its gradient with respect to every voxel, in which the voxel's volume is a factor.

    Parameters
    ----------
    u
        `(Z, Y, X)` or `(B, Z, Y, X)`, float32, on the device.
    a, epsilon, orientation
        As for `CudaFlow`.
    mask
        Weights of the energy's density, `(Z, Y, X)` or `(B, Z, Y, X)`, or None.

    Returns
    -------
    tuple
        F_ε, float64, `()` or `(B,)`, and the gradient, like `u`.

    Raises
    ------
    ValueError
        If a shape or type does not fit.
    """
    if tuple(u.shape[-3:]) != grid.shape or u.dim() not in (3, 4) or u.dtype != torch.float32:
        raise ValueError(f"expected a float32 field of shape {grid.shape} or a batch of them, got {u.dtype}, {u.shape}")
    fields = u.detach().reshape(-1, *grid.shape).contiguous()
    layout = _Layout(grid, len(fields), u.device, tuning or Tuning())
    scratch = _Scratch(layout, 0)
    cost = _Density(layout, a, epsilon, orientation, mask)
    gradient = torch.empty_like(fields)
    with layout.selected():
        cost.launch(fields, scratch, True)()
        layout.gather(scratch, gradient, torch.zeros(1, dtype=torch.int32, device=u.device))()
    return cost.energy().reshape(u.shape[:-3]), gradient.reshape(u.shape)


class CudaFlow:
    """The flow u = k ∗ (div A + base) under Adam on A, for a batch of shapes on one grid, on the device.

    Parameters
    ----------
    start
        A at the first step, `(3, Z, Y, X)` or `(B, 3, Z, Y, X)`, components z, y, x.
    base
        k ∗ base: the mass m₀, a number or `(B,)`; or a blurred field, `(Z, Y, X)` or `(B, Z, Y, X)`.
    a
        The six numbers (a20, a11, a02, a10, a01, a00), `(6,)` or `(B, 6)`; or six numbers for every voxel,
        `(6, Z, Y, X)` or `(B, 6, Z, Y, X)`.
    grid, epsilon, width
        The sampling (either boundary); ε, a number or a field; the blur's standard deviation in spacing's unit.
    frozen
        Voxels `(Z, Y, X)` whose A is constant in all shapes, or None.
    orientation
        Q of a further term ε ∇uᵀQ∇u, `(3, 3)`, symmetric, axes z, y, x; or None.
    betas, adam_eps
        Adam's decay rates and the number added to its root (`torch.optim.Adam`'s betas and eps).

    Raises
    ------
    ValueError
        If a shape does not fit, or the blur or the grid is too wide for the kernels (plain torch has no such limit).
    """

    def __init__(
        self,
        start,
        base,
        a,
        grid: Grid,
        epsilon: float | Tensor,
        width: float,
        frozen=None,
        *,
        orientation: Tensor | None = None,
        betas: tuple[float, float],
        adam_eps: float,
        device: torch.device | str = "cuda",
        tuning: Tuning | None = None,
    ) -> None:
        start = torch.as_tensor(start)
        if start.dim() not in (4, 5) or tuple(start.shape[-4:]) != (3, *grid.shape):
            raise ValueError(f"expected a start of shape {(3, *grid.shape)} or a batch of them, got {start.shape}")
        batch = len(start) if start.dim() == 5 else 1
        self.grid, self.taken = grid, 0
        self._layout = layout = _Layout(grid, batch, torch.device(device), tuning or Tuning())
        self._adam_eps, self._taps = adam_eps, _Taps(grid, width)
        #: Adam's decay rates, which may change between steps; a graph holds those that it was recorded with.
        self.betas = betas
        self._vector = layout.empty(3)
        self._vector.copy_(start.detach().reshape(-1, 3, *grid.shape))
        self._first, self._second = torch.zeros_like(self._vector), torch.zeros_like(self._vector)
        self._mass, self._base = _base(base, layout)
        self._shifts = torch.zeros_like(self._mass)
        self._numbers = torch.empty(batch, dtype=torch.float32, device=device)
        self._set_numbers()
        self._keep, self._free = None, 3 * math.prod(grid.shape)
        if frozen is not None:
            self._keep = _fitting(~torch.as_tensor(frozen, dtype=torch.bool), grid.shape, "frozen mask", layout)
            self._keep = self._keep.to(torch.int8).contiguous()
            self._free = 3 * int(self._keep.count_nonzero())
        self._density = _Density(layout, a, epsilon, orientation)
        self._scratch = _Scratch(layout, self._taps.radius[2])
        self._field, self._between = layout.empty(), layout.empty()
        self._table = torch.ones((_TABLE, 2), dtype=torch.float32, device=device)
        self._row = torch.zeros(1, dtype=torch.int32, device=device)
        columns, _ = layout.columns(layout.width, layout.tuning.last_rows)
        self._highest, self._sums = (layout.figures(columns) for _ in range(2))
        self._graphs: dict[tuple[int, bool, bool, tuple[float, float]], Callable[[], None]] = {}

    @property
    def field(self) -> Tensor:
        """The last u, `(B, Z, Y, X)` on the device, which later steps overwrite."""
        return self._field

    @property
    def vector(self) -> Tensor:
        """A, `(B, 3, Z, Y, X)` on the device, which later steps overwrite."""
        return self._vector

    def run(self, rates: Sequence[float], observe: bool = False) -> None:
        """Make steps of lengths `rates`; with `observe`, the last one leaves statistics from before its move."""
        rates = [float(rate) for rate in rates]
        for begin in range(0, len(rates), _TABLE):
            part = rates[begin : begin + _TABLE]
            self._table[: len(part)].copy_(_lengths(part, self.taken, self.betas))
            self._row.zero_()
            done = 0
            while done < len(part):
                count = min(_UNROLLED, len(part) - done)
                done += count
                self._replay(count, True, observe and begin + done == len(rates))
            self.taken += len(part)

    def observe(self) -> Statistics:
        """Compute u and its statistics, and leave A as it is."""
        self._replay(1, False, True)
        return self.statistics()

    def statistics(self) -> Statistics:
        """Return statistics of the field that was observed last."""
        mean = self._sums.double().sum(-1) / max(1, self._free)
        return Statistics(self._density.energy(), self._highest.double().amax(-1), mean)

    def state(self) -> State:
        """Copy the state on which later steps depend."""
        vector, first, second, shifts = (mine.clone() for mine in self._state())
        return State(vector, first, second, shifts, self.taken)

    def restore(self, state: State) -> None:
        """Continue from a state; `field` stays as it was until the next step."""
        for mine, saved in zip(self._state(), state[:-1], strict=True):
            mine.copy_(saved)
        self.taken = int(state.taken)
        self._set_numbers()

    def shift(self, shape: int, amount: float) -> None:
        """Add a number to u of one shape from the next step on."""
        self._shifts[shape] += amount
        self._set_numbers()

    def launches(self, move: bool = True, observe: bool = False) -> tuple[Launch, ...]:
        """Return the launches of one step, in order."""
        layout, taps, scratch = self._layout, self._taps, self._scratch
        return (
            self._divergence(),
            layout.blur_plane(taps, self._between, scratch, self._field, self._numbers, self._base),
            self._density.launch(self._field, scratch, observe),
            layout.gather(scratch, self._between, self._row),
            layout.blur_plane(taps, self._between, scratch, scratch.smooth),
            self._update(move, observe),
        )

    def _state(self) -> tuple[Tensor, ...]:
        return self._vector, self._first, self._second, self._shifts

    def _set_numbers(self) -> None:
        """What is added to each shape's u from the next step on."""
        self._numbers.copy_(self._mass + self._shifts)

    def _divergence(self) -> Launch:
        layout = self._layout
        arguments = {"A": self._vector, "out": self._between, **layout.grouped, **self._halves()}
        constants = {**self._along_z(), "ROWS": layout.tuning.rows}
        return Launch(
            "divergence_blur_z", layout.columns(layout.width, layout.tuning.rows), arguments, constants, layout.lanes
        )

    def _update(self, move: bool, observe: bool) -> Launch:
        layout, (β1, β2) = self._layout, self.betas
        arguments = {
            "g": self._scratch.smooth,
            "A": self._vector,
            "m": self._first,
            "v": self._second,
            "keep": self._row if self._keep is None else self._keep,
            "table": self._table,
            "taken": self._row,
            "highest": self._highest,
            "sums": self._sums,
            **layout.grouped,
            "apart": self._scratch.apart // layout.width,
            **self._halves(),
            "β1c": 1 - β1,
            "β2": β2,
            "β2c": 1 - β2,
            "adam_eps": self._adam_eps,
        }
        flags = {"HELD": self._keep is not None, "MOVE": move, "OBSERVE": observe}
        constants = {**self._along_z(), **flags, "ROWS": layout.tuning.last_rows}
        columns = layout.columns(layout.width, layout.tuning.last_rows)
        return Launch("blur_z_adam", columns, arguments, constants, layout.lanes)

    def _halves(self) -> dict[str, float]:
        _, hy, hx = self.grid.spacing
        return {"half_y": 0.5 / hy, "half_x": 0.5 / hx}

    def _along_z(self) -> dict[str, Any]:
        constants = {"TAPS": self._taps.inner, "SLOPES": self._taps.slopes, "RADIUS": self._taps.radius[0] + 1}
        return {**constants, **self._layout.constants, "WIDTH": self._layout.width}

    def _replay(self, count: int, move: bool, observe: bool) -> None:
        """Make `count` steps, of which the last observes: recorded once, and the first time launched one by one."""
        key = (count, move, observe, self.betas)
        with self._layout.selected():
            if key in self._graphs:
                self._graphs[key]()
                return
            steps = functools.partial(self._eagerly, count, move, observe)
            steps()
            if self._layout.device.type == "cuda":
                self._graphs[key] = _recorded(steps)

    def _eagerly(self, count: int, move: bool, observe: bool) -> None:
        for step in range(count):
            for launch in self.launches(move, observe and step == count - 1):
                launch()


class _Layout:
    """Sizes, programs, and the launches that a single evaluation shares with a flow."""

    def __init__(self, grid: Grid, batch: int, device: torch.device, tuning: Tuning) -> None:
        Z, Y, X = grid.shape
        if math.prod(grid.shape) > _LARGEST:
            raise ValueError(
                f"expected at most {_LARGEST} voxels a shape (more with backend 'torch'), got {grid.shape}"
            )
        self.grid, self.batch, self.device, self.tuning = grid, batch, device, tuning
        self.lanes, self.width = tuning.lanes, tuning.width or _width(X)
        if X % self.width:
            raise ValueError(f"expected a width that divides {X}, got {self.width}")
        self.sizes, self.grouped = {"Z": Z, "Y": Y, "X": X}, {"Z": Z, "Y": Y, "G": X // self.width}
        self.constants = {"PERIODIC": grid.periodic, "LANES": self.lanes}
        across = -(-Y * X // self.lanes)
        self.planes = tuning.planes or _planes(Z, across * batch, device)
        self.chunks = across * -(-Z // self.planes)

    def columns(self, width: int, rows: int) -> tuple[int, int]:
        """Programs that take `rows` planes of a column each, a thread `width` cells of a plane."""
        Z, Y, X = self.grid.shape
        return -(-Y * X // (width * self.lanes)) * -(-Z // rows), self.batch

    def selected(self) -> AbstractContextManager:
        """Within it, launches go to the device."""
        return torch.cuda.device(self.device) if self.device.type == "cuda" else nullcontext()

    def empty(self, *components: int) -> Tensor:
        """A volume a shape, or so many."""
        return torch.empty((self.batch, *components, *self.grid.shape), dtype=torch.float32, device=self.device)

    def figures(self, programs: int) -> Tensor:
        """A number a program."""
        return torch.zeros((self.batch, programs), dtype=torch.float32, device=self.device)

    def gather(self, scratch: _Scratch, out: Tensor, taken: Tensor) -> Launch:
        arguments = {"parts": scratch.parts, "out": out, "taken": taken, **self.sizes, "apart": scratch.apart}
        rows = self.tuning.last_rows
        return Launch("gather", self.columns(1, rows), arguments, {**self.constants, "ROWS": rows}, self.lanes)

    def blur_plane(
        self,
        taps: _Taps,
        source: Tensor,
        scratch: _Scratch,
        out: Tensor,
        numbers: Tensor | None = None,
        base: Tensor | None = None,
    ) -> Launch:
        """`out` is a whole tensor or a view into the scratch; a number a shape may be added to it, and then a field."""
        Z, Y, X = self.grid.shape
        add = "nothing" if numbers is None else "number" if base is None else "field"
        arguments = {
            "source": source,
            "padded": scratch.parts,
            "out": out,
            "base": source if base is None else base,
            "numbers": source if numbers is None else numbers,
            **self.grouped,
            "apart_padded": scratch.apart // self.width,
            "apart_out": out.stride(0) // self.width,
        }
        lanes = min(self.lanes, max(32, 1 << (X // self.width).bit_length() - 1))
        constants = {
            "TAPS_Y": taps.taps[1],
            "RADIUS_Y": taps.radius[1],
            "TAPS_X": taps.taps[2],
            "RADIUS_X": taps.radius[2],
            "PAD": _rounded(taps.radius[2]),
            "PERIODIC": self.grid.periodic,
            "ADD": add,
            "ROWS": self.tuning.rows,
            "LANES": lanes,
            "WIDTH": self.width,
        }
        programs = (Z * -(-Y // self.tuning.rows), self.batch)
        return Launch("blur_plane", programs, arguments, constants, lanes)


class _Scratch:
    """Volumes that a step hands from launch to launch: partial derivatives; in the same place, rows that hold their
    continuation (at the front) and the gradient blurred in planes (at the back)."""

    def __init__(self, layout: _Layout, radius: int) -> None:
        Z, Y, X = layout.grid.shape
        volume, padded = _rounded(Z * Y * X), Z * Y * (X + 2 * _rounded(radius))
        self.apart = _rounded(max(6 * volume, padded + volume))
        self.parts = torch.empty((layout.batch, self.apart), dtype=torch.float32, device=layout.device)
        self.smooth = self.parts[:, self.apart - volume :]


class _Density:
    """F_ε's numbers on the device."""

    def __init__(
        self, layout: _Layout, a, epsilon: float | Tensor, orientation: Tensor | None, mask: Tensor | None = None
    ) -> None:
        hz, hy, hx = layout.grid.spacing
        self._layout = layout
        self._weights, self._varies = _weights(a, epsilon, layout)
        self._numbers = {
            "eps": 0.0 if self._varies else float(epsilon),
            **dict(zip(("fz", "fy", "fx"), (0.5 / hz, 0.5 / hy, 0.5 / hx), strict=True)),
            **dict(zip(("fzz", "fyy", "fxx"), (1 / hz**2, 1 / hy**2, 1 / hx**2), strict=True)),
            **dict(zip(("fzy", "fzx", "fyx"), (0.25 / (hz * hy), 0.25 / (hz * hx), 0.25 / (hy * hx)), strict=True)),
            **_orientation(orientation, layout.grid),
        }
        self._oriented, self._mask = orientation is not None, None
        if mask is not None:
            self._mask = _fitting(mask.float(), (layout.batch, *layout.grid.shape), "mask", layout).contiguous()
        self._energies = layout.figures(layout.chunks)

    def launch(self, u: Tensor, scratch: _Scratch, energy: bool) -> Launch:
        layout = self._layout
        arguments = {
            "u": u,
            "parts": scratch.parts,
            "energies": self._energies,
            "weights": self._weights,
            "mask": self._weights if self._mask is None else self._mask,
            **layout.sizes,
            "apart": scratch.apart,
            "planes": layout.planes,
            **self._numbers,
        }
        constants = {"ENERGY": energy, "ORIENTED": self._oriented, "VARIES": self._varies}
        constants |= {"MASKED": self._mask is not None, **layout.constants}
        return Launch("density", (layout.chunks, layout.batch), arguments, constants, layout.lanes)

    def energy(self) -> Tensor:
        """F_ε of the field last evaluated with its energy, `(B,)`, float64."""
        return self._energies.double().sum(-1)


class _Taps:
    """Weights of the blur along each axis, and for z those padded by a zero and those after a central difference."""

    def __init__(self, grid: Grid, width: float) -> None:
        self.taps = tuple(gaussian_taps(width / h) if width > 0 else (1.0,) for h in grid.spacing)
        self.radius = tuple(len(taps) // 2 for taps in self.taps)
        if max(self.radius) > _WIDEST:
            most = f"{_WIDEST // 4} voxels (more with backend 'torch')"
            raise ValueError(f"expected a blur of at most {most}, got {width} at {grid.spacing}")
        self.inner = (0.0, *self.taps[0], 0.0)
        half, wide = 0.5 / grid.spacing[0], (0.0, 0.0, *self.taps[0], 0.0, 0.0)
        self.slopes = tuple(half * (before - after) for before, after in zip(wide, wide[2:], strict=False))


def _rounded(n: int) -> int:
    """Up to a multiple of four floats, so that groups of cells stand at multiples of 16 bytes."""
    return -(-n // 4) * 4


def _width(X: int) -> int:
    """Cells of a thread: as many as leave a warp's threads work in a row."""
    return next(width for width in (4, 2, 1) if X % width == 0 and (width == 1 or X // width >= 24))


def _planes(Z: int, columns: int, device: torch.device) -> int:
    """So many that about five programs stand on each processor; at least four, for those on either side cost twice."""
    processors = torch.cuda.get_device_properties(device).multi_processor_count if device.type == "cuda" else 1
    chunks = max(1, 5 * processors // columns)
    return max(4, min(_PLANES, -(-Z // chunks)))


def _lengths(rates: Sequence[float], taken: int, betas: tuple[float, float]) -> Tensor:
    """Adam's step length and factor of the root, with bias corrections, for steps after `taken`: `(N, 2)`, float32."""
    step = taken + 1 + np.arange(len(rates))
    length, spread = np.asarray(rates) / (1 - betas[0] ** step), 1 / np.sqrt(1 - betas[1] ** step)
    return torch.from_numpy(np.stack((length, spread), -1).astype(np.float32))


def _base(base, layout: _Layout) -> tuple[Tensor, Tensor | None]:
    """What is added to k ∗ div A: a number a shape, `(B,)` in float64, and, where it is one, a field."""
    base = torch.as_tensor(base).detach()
    if base.dim() < 3:
        return _fitting(base.double(), (layout.batch,), "mass", layout).contiguous(), None
    field = _fitting(base.float(), (layout.batch, *layout.grid.shape), "base", layout).contiguous()
    return torch.zeros(layout.batch, dtype=torch.float64, device=layout.device), field


def _fitting(values: Tensor, shape: tuple[int, ...], name: str, layout: _Layout) -> Tensor:
    """Broadcast to a shape, on the device."""
    try:
        return values.detach().to(layout.device).expand(shape)
    except RuntimeError as error:
        raise ValueError(f"expected a {name} of shape {shape} or one that broadcasts, got {values.shape}") from error


def _weights(a, epsilon: float | Tensor, layout: _Layout) -> tuple[Tensor, bool]:
    """The density's six weights, times the voxel's volume, `(B, 6)`; or where anything varies over voxels those and ε,
    `(B, 7, Z, Y, X)`. And which of the two."""
    a = torch.as_tensor(a, dtype=torch.float64).detach().to(layout.device)
    ε = torch.as_tensor(epsilon, dtype=torch.float64).detach().to(layout.device)
    varies = a.dim() >= 4 or ε.dim() > 0
    numbers = (*a.shape[:-1], 6, 1, 1, 1) if a.dim() < 4 else a.shape
    a = _fitting(a.reshape(numbers), (layout.batch, 6, *(layout.grid.shape if varies else (1, 1, 1))), "a", layout)
    a20, a11, a02, a10, a01, a00 = (a * layout.grid.voxel_volume).unbind(1)
    quadratic = ((a20 + a02 - a11) / (2 * ε), a11 / (2 * ε), (a20 - a02) / (2 * ε))
    weights = (*quadratic, (a10 + a01) / 2, (a10 - a01) / 2, a00 * ε)
    if varies:
        weights = (*weights, _fitting(ε, (layout.batch, *layout.grid.shape), "epsilon", layout))
    return torch.stack(weights, 1).to(torch.float32).contiguous(), varies


def _orientation(orientation: Tensor | None, grid: Grid) -> dict[str, float]:
    """The six entries of Q, times the voxel's volume."""
    Q = torch.zeros((3, 3)) if orientation is None else torch.as_tensor(orientation, dtype=torch.float64)
    if tuple(Q.shape) != (3, 3) or not torch.equal(Q, Q.T):
        raise ValueError(f"expected a symmetric orientation of shape (3, 3) (z, y, x), got {Q.tolist()}")
    pairs = {"Qzz": (0, 0), "Qyy": (1, 1), "Qxx": (2, 2), "Qzy": (0, 1), "Qzx": (0, 2), "Qyx": (1, 2)}
    return {name: float(Q[pair]) * grid.voxel_volume for name, pair in pairs.items()}


def _recorded(action: Callable[[], None]) -> Callable[[], None]:
    """The launches of an action that has run once already, as a graph."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        action()
    return graph.replay
