"""Parameters of a mask or an image from the fixed point of a short flow: the right ones leave the scan where it is.

A mask's profile is made up, so that stationarity, which reads the profile's deviation from tanh, says nothing of it.
A short flow started at the scan mends the profile first and then moves the interface, the less the better the
parameters are. A weak energy moves nothing either, so all flows get the same budget of force: a is scaled until the
norm of (a_α × the force of term α alone) is that of the first start, and only its direction counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from curvafit.core.runtime import Progress, silent
from curvafit.generation.flow import relax
from curvafit.generation.schedule import Schedule
from curvafit.inference.refinement import Refinement, called, double_precision_on_cpu, import_jax, named
from curvafit.inference.stationarity import energy_gradients
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.priors.shapes import Float
from curvafit.priors.stencils import gaussian_blur, gradient
from curvafit.scan.regrid import rich_boxes, surface_voxels

#: The short flow: Adam steps of 1e-3 as published.
SHORT_FLOW = Schedule("short", 150, 1e-3, 1e-3, "constant")
#: Longest edge of the box that is flowed, and the width of the halo that is held at the sides of a crop, in voxels.
LARGEST_BOX, HALO = 64, 8
#: Standard deviation in voxels of the low-pass on the displacement, and every how many voxels it is read.
LOW_PASS, STRIDE = 2.0, 2
#: Levenberg-Marquardt steps from each start, and more from the best end.
FIRST_STEPS, LAST_STEPS = 3, 7
#: Displacement in voxels that the solver is told is 1: its damping starts at 1.
_UNIT = 0.1
#: Step of the Jacobian's finite differences, in scaled parameters.
DIFFERENCE = 0.05
#: Voxels whose share of interface is under this part of the largest are not read.
_FAINT = 0.02
#: Residual of a flow that diverged, in voxels.
_LOST = 10.0
#: Sizes of (a11, log a02, a10, a01, a00) in working units that make a change of one a similar change of the flow.
_SIZES = np.array([2.0, 1.0, 50.0, 50.0, 800.0])
#: Flows that leave at most this many times the least residual are as good: the truth itself may leave that.
_AS_GOOD = 1.2
#: A coefficient whose deviation is above this part of its size is weakly held.
_WEAK = 0.5


def fixed_point(
    phase: Float[Tensor, "z y x"],
    grid: Grid,
    epsilon: float,
    *,
    starts: Sequence[Coefficients],
    progress: Progress = silent,
) -> Refinement:
    """Find the coefficients (a20 = 1, a02 > 0) under which a short flow started at `phase` moves its interface least.

    Least squares in the low-passed displacement of the interface, by optimistix (Levenberg-Marquardt, float64): some
    steps from each start, then more from the best end. The mass is the phase field's mean, which the flow keeps.

    Deviations add up two parts: the residual's covariance, with one independent sample for each patch 4π (low-pass)² of
    the interface, and the reach of the valley: how far from the best the fit met parameters that are nearly as good.

    Parameters
    ----------
    phase
        Phase field of the mask, about ±1, working units. Of a larger box the part richest in surface is used.
    starts
        Where to begin: the nearest matches.
    progress
        Called with a sentence and the share done.

    Returns
    -------
    Refinement
        `residual` is the root mean square displacement in voxels.

    Raises
    ------
    ValueError
        If there is no start, or the field is not finite or too small to have an inside apart from its borders.
    """
    if not starts:
        raise ValueError("expected at least one start for the fixed-point fit, got none")
    if not bool(torch.isfinite(phase).all()):
        raise ValueError("expected a finite phase field, got NaN or infinity in it")
    if not grid.periodic and min(grid.shape) <= 2 * HALO + STRIDE:
        voxels = " x ".join(map(str, grid.shape))
        raise ValueError(
            f"expected a structure that spans more than {2 * HALO + STRIDE} working voxels along each axis, got "
            f"{voxels}: the scan is too small to refine parameters on"
        )
    flow = ShortFlow(phase, grid, epsilon, starts[0])
    total = (1 + len(_SIZES)) * (len(starts) * (FIRST_STEPS + 1) + LAST_STEPS)
    flow.after = lambda count: progress("flowing from the scan", min(1.0, count / total))
    minimise = _minimiser(flow)
    ends = [minimise(_parameters(start), FIRST_STEPS) for start in starts]
    order = np.argsort([end.residual for end in ends])
    best = minimise(ends[order[0]].free, LAST_STEPS)
    deviations = np.hypot(_deviations(best, flow.patches), _valley(flow, best))
    singular = np.linalg.svd(best.jacobian, compute_uv=False)
    return Refinement(
        method="fixed point",
        coefficients=_coefficients(best.free),
        mass=float(phase.double().mean()),
        uncertainty=named(deviations),
        singular_values=tuple(float(value) for value in singular),
        residual=best.residual,
        starts=tuple((starts[k].scaled(1 / float(starts[k].a20)), ends[k].residual) for k in order),
        status=_status(best, deviations),
        evaluations=flow.evaluations,
    )


def drift(phase: Float[Tensor, "z y x"], grid: Grid, epsilon: float, coefficients: Coefficients) -> float | None:
    """Return how far, in voxels, a short flow of a law moves the surface of `phase`: root mean square, low-passed.

    None where the box is too small to have an inside apart from its borders.
    """
    if not grid.periodic and min(grid.shape) <= 2 * HALO + STRIDE:
        return None
    residual = ShortFlow(phase, grid, epsilon, coefficients).residual(_parameters(coefficients))
    return float(np.linalg.norm(residual))


class ShortFlow:
    """The residual as a function of the five free parameters, with its Jacobian; the last values are remembered."""

    def __init__(self, phase: Tensor, grid: Grid, epsilon: float, reference: Coefficients) -> None:
        values, self.grid = _box(phase.detach().to("cpu", torch.float32), grid)
        self.epsilon, self.evaluations, self._known = epsilon, 0, {}
        self.after: Callable[[int], object] = lambda count: None
        self._voxel = grid.spacing[0]
        self.start = sharpened(values, self.grid, epsilon)
        self._before = gaussian_blur(self.start, self.grid, epsilon)
        halo = 0 if self.grid.periodic else HALO
        inside = tuple(slice(halo, n - halo) for n in self.grid.shape)
        self._frozen = None
        if halo:
            self._frozen = torch.ones(self.grid.shape, dtype=torch.bool)
            self._frozen[inside] = False
        slope = gradient(self._before.double(), self.grid).square().sum(-4).sqrt()
        self._read = tuple(slice(s.start, s.stop, STRIDE) for s in inside)
        share = gaussian_blur(slope, self.grid, LOW_PASS * self._voxel)[self._read]
        self._kept = share > _FAINT * share.max()
        self._norm = (share * share[self._kept].sum()).sqrt()[self._kept]
        self._forces = self._force_of_each_term()
        self._budget = self._force(reference.scaled(1 / float(reference.a20)))
        area = float(slope[inside].sum()) * self.grid.voxel_volume / 2
        self.patches = area / (4 * np.pi * (LOW_PASS * self._voxel) ** 2)

    @property
    def size(self) -> int:
        return int(self._kept.sum())

    def residual(self, free: np.ndarray) -> np.ndarray:
        """Return the displacement in voxels, low-passed, weighted by interface so that its square sums to the mean
        square."""
        key = free.tobytes()
        if key not in self._known:
            self._known[key] = self._flowed(free)
        return self._known[key]

    def nearly(self, residual: float) -> np.ndarray:
        """Return the parameters `(n, 5)` of the flows made so far that left at most this residual."""
        good = [np.frombuffer(key) for key, left in self._known.items() if np.linalg.norm(left) <= residual]
        return np.array(good).reshape(-1, len(_SIZES))

    def jacobian(self, free: np.ndarray) -> np.ndarray:
        """Return one-sided differences, `(size, 5)`."""
        here = self.residual(free)
        ahead = [self.residual(free + DIFFERENCE * unit) for unit in np.eye(len(free))]
        return (np.stack(ahead, 1) - here[:, None]) / DIFFERENCE

    def _force_of_each_term(self) -> np.ndarray:
        """Return the root mean square of the six low-passed ∂F_α/∂u where the residual is read."""
        terms = energy_gradients(self._before.double(), self.grid, self.epsilon)
        low = gaussian_blur(terms, self.grid, LOW_PASS * self._voxel)[(slice(None), *self._read)][:, self._kept]
        return low.square().mean(1).sqrt().numpy()

    def _force(self, coefficients: Coefficients) -> float:
        return float(np.linalg.norm(self._forces * coefficients.tensor().numpy()))

    def _flowed(self, free: np.ndarray) -> np.ndarray:
        a = _coefficients(free)
        scaled = a.scaled(self._budget / self._force(a))
        flow = relax(self.start, scaled, self.grid, schedule=SHORT_FLOW, epsilon=self.epsilon, frozen=self._frozen)
        self.evaluations += 1
        self.after(self.evaluations)
        moved = (flow.field - self._before).double()
        if not bool(torch.isfinite(moved).all()):
            return np.full(self.size, _LOST / np.sqrt(self.size))
        low = gaussian_blur(moved, self.grid, LOW_PASS * self._voxel)[self._read][self._kept]
        return (low / self._norm / self._voxel).numpy()


def sharpened(phase: Tensor, grid: Grid, width: float) -> Tensor:
    """Return v₀ with k ∗ v₀ close to `phase`, by two Van Cittert steps."""
    v = phase
    for _ in range(2):
        v = v + phase - gaussian_blur(v, grid, width)
    return v


class _End(NamedTuple):
    free: np.ndarray
    residual: float
    jacobian: np.ndarray


def _box(phase: Tensor, grid: Grid) -> tuple[Tensor, Grid]:
    """Return the whole, or the part of at most `LARGEST_BOX` voxels a side that is richest in surface."""
    if max(grid.shape) <= LARGEST_BOX:
        return phase, grid
    windows = rich_boxes(surface_voxels((phase > 0).numpy()), LARGEST_BOX)
    part = phase[windows[0]].contiguous()
    return part, Grid(tuple(part.shape), grid.spacing, "replicate")  # type: ignore[arg-type]


def _coefficients(free: np.ndarray) -> Coefficients:
    a11, log_a02, a10, a01, a00 = (float(value) for value in free * _SIZES)
    return Coefficients(1.0, a11, float(np.exp(np.clip(log_a02, -6, 6))), a10, a01, a00)


def _parameters(start: Coefficients) -> np.ndarray:
    _, a11, a02, a10, a01, a00 = (float(value) / float(start.a20) for value in start)
    return np.array([a11, np.log(a02), a10, a01, a00]) / _SIZES


def _minimiser(flow: ShortFlow) -> Callable[[np.ndarray, int], _End]:
    """Return what runs Levenberg-Marquardt from a start for some steps and gives the best of the points it visits.

    One residual serves all starts, so that optimistix compiles its solver for each number of steps and not each start.
    """
    import_jax()
    import jax
    import jax.numpy as jnp
    import optimistix

    visited: list[np.ndarray] = []
    failures: list[BaseException] = []

    def value(free: np.ndarray) -> np.ndarray:
        visited.append(free)
        return flow.residual(free) / _UNIT

    def jacobian(free: np.ndarray) -> np.ndarray:
        return flow.jacobian(free) / _UNIT

    @jax.custom_jvp
    def residual(free):
        return called(value, (flow.size,), free, failures)

    @residual.defjvp
    def residual_jvp(primals, tangents):
        (free,), (change,) = primals, tangents
        slope = called(jacobian, (flow.size, len(_SIZES)), free, failures)
        return residual(free), slope @ change

    def misfit(free, args):
        return residual(free)

    def minimise(begin: np.ndarray, steps: int) -> _End:
        visited[:] = [np.array(begin, dtype=np.float64)]
        with double_precision_on_cpu():
            solver = optimistix.LevenbergMarquardt(rtol=1e-3, atol=1e-3)
            try:
                optimistix.least_squares(misfit, solver, jnp.asarray(begin), max_steps=steps, throw=False)
            finally:
                if failures:
                    raise failures.pop() from None
        best = min(visited, key=lambda free: float(np.linalg.norm(flow.residual(free))))
        return _End(best, float(np.linalg.norm(flow.residual(best))), flow.jacobian(best))

    return minimise


def _deviations(end: _End, patches: float) -> np.ndarray:
    """Return the standard deviations of the six coefficients from the residual's covariance."""
    variance = end.residual**2 / max(patches - len(_SIZES), 1.0)
    covariance = variance * np.linalg.pinv(end.jacobian.T @ end.jacobian)
    free = np.sqrt(np.diag(covariance)) * _SIZES
    a02 = _coefficients(end.free).a02
    return np.array([0.0, free[0], a02 * free[1], *free[2:]])


def _valley(flow: ShortFlow, best: _End) -> np.ndarray:
    """Return how far `(6,)` the coefficients of a nearly as good flow lie from the best, at most."""
    centre = _coefficients(best.free).tensor().numpy()
    near = [_coefficients(free).tensor().numpy() for free in flow.nearly(_AS_GOOD * best.residual)]
    return np.abs(np.array(near) - centre).max(0)


def _status(end: _End, deviations: np.ndarray) -> str:
    weak = [
        name for name, size, deviation in zip(("a11", "a02", "a10", "a01", "a00"), _SIZES, deviations[1:], strict=True)
        if deviation > _WEAK * size
    ]  # fmt: skip
    support = f"weakly held: {', '.join(weak)}" if weak else "all coefficients held"
    return f"A short flow from the scan moves its surface by {end.residual:.2f} voxels; {support}."
