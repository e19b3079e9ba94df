"""What the device's kernels are held to: the definition in plain torch and float64, on the device or in Triton's
interpreter.

The interpreter must be chosen before Triton is imported: this file, run as a program with TRITON_INTERPRET=1, makes its
checks there and prints what went wrong, by name.
"""

from __future__ import annotations

import json
import traceback
from typing import NamedTuple

import torch
from torch import Tensor

from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import energy, orientation
from curvafit.priors.grid import Grid
from curvafit.priors.kernels import cuda
from curvafit.priors.profile import optimal_profile
from curvafit.priors.stencils import divergence, gaussian_blur

FLOATS = (torch.float64, torch.float32)
SPACING, EPSILON, BETAS, ADAM_EPS = (0.013, 0.01, 0.008), 0.02, (0.9, 0.95), 1e-2
NUMBERS = torch.tensor([[1, 2, 6, -40, -40, 400], [1.3, -0.7, 4, -60, 35, 500]], dtype=torch.float64)
Q = orientation((1, 2, -1), 300.0) + orientation((0, 1, 1), -40.0)


class Seen(NamedTuple):
    """Of one step: u, F_ε and its gradients with respect to u and to A."""

    u: Tensor
    value: Tensor
    by_u: Tensor
    by_vector: Tensor


def definition(start, base, a, grid, width, rates, *, frozen=None, Q=None) -> tuple[Tensor, list[Seen]]:
    """The flow in plain torch and float64, one field a shape: A at the end, and what every step saw."""
    vector = start.double().clone().requires_grad_()
    adam = torch.optim.Adam([vector], betas=BETAS, eps=ADAM_EPS)
    seen = []
    for rate in rates:
        u = gaussian_blur(divergence(vector, grid), grid, width) + base
        u.retain_grad()
        value = energy(u, a, grid, EPSILON, Q)
        adam.zero_grad()
        value.sum().backward()
        assert vector.grad is not None and u.grad is not None
        if frozen is not None:
            vector.grad *= ~frozen
        seen.append(Seen(u.detach(), value.detach(), u.grad.clone(), vector.grad.clone()))
        adam.param_groups[0]["lr"] = rate
        adam.step()
    return vector.detach(), seen


def a_shape(a: Tensor) -> Coefficients:
    """Six numbers a shape, ready to broadcast with fields."""
    return Coefficients(*a[..., None, None, None].unbind(-4))


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def close(found: Tensor, expected: Tensor, tight: float = 1e-5, loose: float = 1e-2) -> None:
    """Nine places in ten to the tight bound, all to the loose one: where X in √X⁺ crosses zero, 1/√X magnifies what
    float32 rounds off."""
    error = (found.double().cpu() - expected).abs() / expected.abs().max()
    assert float(error.flatten().quantile(0.9)) < tight, float(error.flatten().quantile(0.9))
    assert float(error.max()) < loose, float(error.max())


def compare_flow(flow: cuda.CudaFlow, rates: list[float], expected: Tensor, last: Seen) -> None:
    """Make the steps, the last one observed; then let the last launch look once more without a step."""
    flow.run(rates, observe=True)
    sizes = last.by_vector.abs().flatten(-4).reshape(len(flow.field), -1)
    close(flow.field, last.u.reshape(flow.field.shape), 1e-6, 1e-4)
    close(flow.vector, expected.reshape(flow.vector.shape), 1e-5, 1e-3)
    before = flow.vector.clone()
    for _ in range(2):
        found = flow.statistics()
        torch.testing.assert_close(found.energy.cpu(), last.value.reshape(-1), rtol=1e-4, atol=0)
        torch.testing.assert_close(found.gradient_max.cpu(), sizes.amax(-1), rtol=1e-2, atol=0)
        torch.testing.assert_close(found.gradient_mean.cpu(), sizes.sum(-1) / (sizes > 0).sum(-1), rtol=1e-3, atol=0)
        flow.launches(move=False, observe=True)[-1]()
    assert torch.equal(flow.vector, before)


def check_batch(device: str, tuning: cuda.Tuning) -> None:
    """Two shapes with numbers and masses of their own, periodic, groups of four cells."""
    grid, width = Grid((4, 4, 8), SPACING), 0.006
    start, masses, rates = 0.05 * noise(2, 3, *grid.shape), torch.tensor([-0.6, -0.3]), [5e-3]
    flow = cuda.CudaFlow(
        start, masses, NUMBERS, grid, EPSILON, width, betas=BETAS, adam_eps=ADAM_EPS, device=device, tuning=tuning
    )
    moved, seen = definition(start, masses.double()[:, None, None, None], a_shape(NUMBERS), grid, width, rates)
    compare_flow(flow, rates, moved, seen[-1])


def check_mirrors(device: str, tuning: cuda.Tuning) -> None:
    """Two steps between mirrors from a field, some voxels held, with an orientation; cells one by one."""
    grid, width = Grid((4, 5, 7), SPACING, "replicate"), 0.005
    start, base, rates = 0.05 * noise(3, *grid.shape), 0.5 * noise(*grid.shape, seed=1), [5e-3, 2e-3]
    frozen = noise(*grid.shape, seed=2) > 1
    flow = cuda.CudaFlow(
        start, base, NUMBERS[0], grid, EPSILON, width, frozen,
        orientation=Q, betas=BETAS, adam_eps=ADAM_EPS, device=device, tuning=tuning,
    )  # fmt: skip
    flow.shift(0, 0.125)
    moved, seen = definition(start, base + 0.125, a_shape(NUMBERS[0]), grid, width, rates, frozen=frozen, Q=Q)
    compare_flow(flow, rates, moved, seen[-1])
    assert torch.equal(flow.vector[0][:, frozen].cpu(), start.float()[:, frozen])


def check_wide_blur(device: str, tuning: cuda.Tuning) -> None:
    """A blur that reaches round the box more than once, groups of two cells; both boundaries."""
    for boundary in ("periodic", "replicate"):
        grid, width = Grid((4, 4, 6), (0.01, 0.02, 0.005), boundary), 0.01
        start = noise(3, *grid.shape).float().double()
        flow = cuda.CudaFlow(
            start, 0.25, NUMBERS[0], grid, EPSILON, width, betas=BETAS, adam_eps=ADAM_EPS, device=device, tuning=tuning
        )
        flow.shift(0, 0.5)
        for launch in flow.launches()[:2]:
            launch()
        flux = divergence(start, grid)
        error = flow.field[0].double().cpu() - gaussian_blur(flux, grid, width) - 0.75
        assert error.abs().max() < 2**-22 * flux.abs().max()  # float32 rounds 2⁻²⁴ off what the blur averages away


def check_energy(device: str, tuning: cuda.Tuning) -> None:
    """F_ε and its gradient: numbers a shape; then numbers and ε that vary over voxels, and an orientation; both under a
    mask. No farther from float64 than a few times what the definition itself loses in float32."""
    for boundary in ("periodic", "replicate"):
        grid = Grid((5, 4, 7), SPACING, boundary)
        u = (gaussian_blur(noise(2, *grid.shape), grid, 0.01) - 0.3).float()
        maps = NUMBERS[:, :, None, None, None] * (1 + 0.2 * noise(2, 6, *grid.shape).tanh())
        ε = EPSILON * (1 + 0.2 * noise(*grid.shape, seed=1).tanh())
        mask = (1 + noise(2, *grid.shape, seed=2)).clamp_min(0)
        numbers, varying = a_shape(NUMBERS), Coefficients(*maps.unbind(1))
        cases = (
            (NUMBERS, numbers, EPSILON, None, None),
            (maps, varying, ε, Q, None),
            (NUMBERS, numbers, EPSILON, None, mask),
            (maps, varying, ε, Q, mask),
        )
        for a, coefficients, epsilon, turned, kept in cases:
            exact, rough = (gradient(u.to(kind), coefficients, grid, epsilon, turned, kept) for kind in FLOATS)
            value, slope = cuda.energy_gradient(u.to(device), a, grid, epsilon, turned, kept, tuning=tuning)
            torch.testing.assert_close(value.cpu(), exact[0], rtol=1e-6, atol=0)
            lost, error = (
                (found.double().cpu() - exact[1]).abs() / exact[1].abs().max() for found in (rough[1], slope)
            )
            assert error.flatten().quantile(0.9) < 4 * lost.flatten().quantile(0.9) + 1e-7, error.flatten().quantile(
                0.9
            )
            assert error.max() < 1e-3, error.max()  # where X in √X⁺ crosses zero, 1/√X magnifies what is rounded off


def check_umbilics(device: str, tuning: cuda.Tuning) -> None:
    """A ball whose surface meets voxels on the axes: the root's derivative is taken as 0 there, in any rounding."""
    grid = Grid((7, 7, 7), 0.01, "replicate")
    z, y, x = torch.meshgrid(*[torch.arange(7, dtype=torch.float64) - 3] * 3, indexing="ij")
    r2 = z**2 + y**2 + x**2
    u = optimal_profile(0.01 * (2 - r2.sqrt()), EPSILON).float()[None]
    on_axes = ((r2 == 4) & (z * y == 0) & (y * x == 0) & (z * x == 0))[None]
    exact = gradient(u.double(), a_shape(NUMBERS[1:]), grid, EPSILON, None)[1][on_axes]
    _, slope = cuda.energy_gradient(u.to(device), NUMBERS[1:], grid, EPSILON, tuning=tuning)
    assert len(exact) == 6
    assert (slope.double().cpu()[on_axes] - exact).abs().max() < 1e-3 * exact.abs().max()


def gradient(u: Tensor, a: Coefficients, grid: Grid, epsilon, turned, mask=None) -> tuple[Tensor, Tensor]:
    free = u.detach().requires_grad_()
    value = energy(free, a, grid, epsilon, turned, mask)
    return value.detach(), torch.autograd.grad(value.sum(), free)[0]


CHECKS = {
    "batch": (check_batch, cuda.Tuning(4, 2, 2, width=4, lanes=32)),
    "mirrors": (check_mirrors, cuda.Tuning(5, 4, 4, width=1, lanes=64)),
    "wide blur": (check_wide_blur, cuda.Tuning(4, 4, 4, width=2, lanes=32)),
    "energy": (check_energy, cuda.Tuning(4, 2, 3, lanes=32)),
    "umbilics": (check_umbilics, cuda.Tuning(4, 2, 3, lanes=32)),
}


def main() -> None:
    """Every check in this process, on the processor."""
    wrong = dict.fromkeys(CHECKS, "")
    torch.manual_seed(0)
    for name, (check, tuning) in CHECKS.items():
        try:
            check("cpu", tuning)
        except Exception:
            wrong[name] = traceback.format_exc()
    print(json.dumps(wrong))


if __name__ == "__main__":
    main()
