"""The training loss's derivatives: in float32 those of the definition in reverse mode, in float64 all, or refused."""

import pytest
import torch
from loss_cases import LAW, noise, probabilities, slope_of
from torch import Tensor
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vmap
from torch.testing import assert_close

from curvafit.priors import CurvaturePrior, Grid, curvature_prior, kernels
from curvafit.priors.kernels.differentiable import energies

pytestmark = [
    pytest.mark.filterwarnings("ignore:ε = .* interpolating"),
    pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning"),  # torch's own, of `torch.func.jvp`
]

GRID, EPSILON = Grid((8, 9, 10), (0.012, 0.01, 0.01), "replicate"), 0.02
MASK = torch.rand(1, 8, 9, 10, generator=torch.Generator().manual_seed(1))


@pytest.fixture(params=["fused", "plain"], autouse=True)
def way(request, monkeypatch) -> str:
    """The energy by a fused kernel, and by autograd, as on a device without one."""
    if request.param == "plain":
        monkeypatch.setattr(kernels, "has_kernel", lambda device: False)
    elif not kernels.has_kernel("cpu"):
        pytest.skip("needs numba")
    return request.param


#: Functions of probabilities (2, 8, 9, 10), two numbers each.
FUNCTIONS = {
    "interpolated": lambda p: curvature_prior(p, LAW, (2.0, 1.0, 1.0), 2.0, mask=MASK),
    "module": lambda p: CurvaturePrior(LAW, sigmoid=True, reduction="none")(p[:, None]).flatten(),
    "energies": lambda p: energies(2 * p - 1, LAW, GRID, EPSILON, MASK),
}
functions = pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)


def fields(*batch: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Probabilities and a direction, in float64 but of float32's numbers."""
    p = torch.stack([probabilities(2, 8, 9, 10, seed=seed + k) for k in range(max(1, *batch, 1))])
    p = (p if batch else p[0]).float().double()
    return p, noise(*p.shape, seed=7).float().double()


def close(found: Tensor, exact: Tensor) -> None:
    """Where curvatures are nearly equal float32 has another slope (`positive_root`): about one voxel of 1,440, with its
    neighbours, errs by 2e-3 of the greatest derivative, the others by less than 2e-4."""
    assert found.dtype == torch.float32 and found.shape == exact.shape
    assert float((found.double() - exact).abs().max()) < 3e-3 * float(exact.abs().max())


@functions
def test_reverse_mode_is_float64s_and_forward_mode_its_transpose(function) -> None:
    """And the finite difference; float32 has reverse mode alone."""
    p, direction = fields()
    rows, slope = jacrev(function)(p), jvp(function, (p,), (direction,))[1]
    close(torch.stack([slope_of(lambda p, k=k: function(p)[k], p.float()) for k in range(2)]), rows)
    assert_close((rows * direction).flatten(1).sum(1), slope, rtol=1e-9, atol=1e-9 * float(slope.abs().max()))
    step = 1e-6
    difference = (function(p + step * direction) - function(p - step * direction)) / (2 * step)
    assert_close(slope, difference, rtol=1e-3, atol=1e-3 * float(slope.abs().max()))  # voxels near umbilics
    with pytest.raises((RuntimeError, NotImplementedError)):
        jvp(function, (p.float(),), (direction.float(),))


@functions
@pytest.mark.parametrize("dim", [0, 2, -1])
def test_batches_of_batches_are_one_after_the_other(function, dim) -> None:
    p, direction = fields(3)
    alone = torch.stack([function(each) for each in p])
    assert_close(vmap(function, in_dims=dim)(p.movedim(0, dim)), alone)
    one = grad(lambda p: function(p).sum())
    assert_close(vmap(one)(p), torch.stack([one(each) for each in p]))
    slopes = vmap(lambda p, d: jvp(function, (p,), (d,))[1])(p, direction)
    assert_close(slopes, torch.stack([jvp(function, (q,), (d,))[1] for q, d in zip(p, direction, strict=True)]))


def test_masks_may_be_batched_alone() -> None:
    """What is given once serves every batch; a mask that is wrong is seen where it is not batched."""
    p, prior = fields()[0][:, None], CurvaturePrior(LAW)
    masks = torch.rand(3, 2, 1, 8, 9, 10, generator=torch.Generator().manual_seed(2))
    assert_close(vmap(lambda mask: prior(p, mask=mask))(masks), torch.stack([prior(p, mask=mask) for mask in masks]))


def twice_by_autograd(f):
    """Return the second derivative as a training with a penalty on the gradient takes it."""

    def second(x: Tensor) -> Tensor:
        leaf = x.clone().requires_grad_()
        (slope,) = torch.autograd.grad(f(leaf), leaf, create_graph=True)
        return torch.autograd.grad(slope, leaf)[0]

    return second


@functions
@pytest.mark.parametrize("twice", [hessian, lambda f: jacrev(jacfwd(f)), twice_by_autograd],
                         ids=["forward on reverse", "reverse on forward", "twice"])  # fmt: skip
def test_second_derivatives_are_for_float64(function, twice) -> None:
    p, direction = fields()

    def along(t: Tensor) -> Tensor:
        return function(p.to(t) + t * direction.to(t)).square().sum()

    assert bool(torch.isfinite(twice(along)(torch.tensor(0.1, dtype=torch.float64))).all())
    with pytest.raises(RuntimeError, match="float64" if twice is twice_by_autograd else "functorch|forward|vmap"):
        twice(along)(torch.tensor(0.1))


def test_second_derivatives_are_right() -> None:
    prior, logits, vector = CurvaturePrior("tubes", sigmoid=True), noise(1, 1, 6, 6, 6), noise(1, 1, 6, 6, 6, seed=1)
    found, step = slope_of(lambda x: (grad(prior)(x) * vector).sum(), logits), 1e-5
    ends = [slope_of(prior, logits + sign * step * vector) for sign in (1, -1)]
    assert_close(found, (ends[0] - ends[1]) / (2 * step), rtol=1e-4, atol=1e-4 * float(found.abs().max()))
