"""Cases of the training loss that users handed in, by name: each was wrong once."""

from __future__ import annotations

import copy
import io
import math
import pickle

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from curvafit.priors import Coefficients, CombinedLoss, CurvaturePrior

pytestmark = pytest.mark.filterwarnings("ignore:ε = .* interpolating")


def noise(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(0))


def ignored_neighbours() -> None:
    """Voxels from column 8 on are ignored: neither they nor a NaN in them is felt."""
    prior = CurvaturePrior("tubes", softmax=True, include_background=False, to_onehot_y=True, ignore_index=255)
    logits, target = noise(1, 3, 12, 11, 16), torch.zeros(1, 1, 12, 11, 16, dtype=torch.int64)
    target[..., 8:] = 255
    spoiled = logits.clone()
    spoiled[..., 8] = 9.0
    spoiled[..., 9:] = float("nan")
    leaves = [x.requires_grad_() for x in (logits, spoiled)]
    values = [prior(x, target) for x in leaves]
    torch.testing.assert_close(*values)
    sum(values).backward()  # type: ignore[union-attr]
    for x in leaves:
        assert x.grad is not None and not bool(x.grad[..., 8:].any()) and bool(x.grad[..., 7].any())
    torch.testing.assert_close(leaves[0].grad, leaves[1].grad)


def weight_of_a_resumed_training() -> None:
    base, prior = nn.BCEWithLogitsLoss(), CurvaturePrior("tubes", sigmoid=True)
    loss, x = CombinedLoss(base, prior, 0.0, warmup=2), noise(1, 1, 8, 8, 8)
    loss.weight = 7.5e-5
    loss(x, torch.zeros_like(x))
    again, whole = CombinedLoss(base, prior, 0.0), nn.ModuleDict({"loss": CombinedLoss(base, prior, 0.0)})
    file = io.BytesIO()
    torch.save(nn.ModuleDict({"loss": loss}).state_dict(), file)
    file.seek(0)
    again.load_state_dict(loss.state_dict())
    whole.load_state_dict(torch.load(file, weights_only=True))
    for other in (again, whole["loss"], copy.deepcopy(loss), pickle.loads(pickle.dumps(loss))):
        assert (float(other.weight), other.warmup, int(other.calls)) == (7.5e-5, 2, 1)
    older = CombinedLoss(base, prior, 0.5, warmup=3)
    older.load_state_dict({"calls": torch.tensor(4)})
    assert (older.weight, older.warmup, int(older.calls)) == (0.5, 3, 4)


def compiled_second_prior() -> None:
    torch.compiler.reset()
    try:
        x = noise(1, 1, 8, 9, 10)
        for spacing in (1.0, 0.5, 0.4):
            prior = CurvaturePrior("tubes", sigmoid=True, spacing=spacing)
            compiled = torch.compile(prior, backend="eager", fullgraph=True)
            torch.testing.assert_close(compiled(x), prior(x))
    finally:
        torch.compiler.reset()


def thick_slices() -> None:
    """One exact sphere, ε = 2, in slices of 1 and of 2: a sixth-order spline at two samples an ε."""

    def total(thickness: int) -> float:
        axes = (h * (torch.arange(48 // h).double() - (48 // h - 1) / 2) for h in (thickness, 1, 1))
        z, y, x = torch.meshgrid(*axes, indexing="ij")
        u = torch.tanh((14 - (z**2 + y**2 + x**2).sqrt()) / (math.sqrt(2) * 2))
        law = Coefficients(1, 2, 6, -0.4, -0.4, 0.04)
        prior = CurvaturePrior(law, spacing=(float(thickness), 1.0, 1.0), epsilon=2.0, reduction="sum")
        return float(prior((u + 1)[None, None] / 2))

    assert total(2) == pytest.approx(total(1), rel=0.03)


def small_api() -> None:
    x = noise(1, 1, 8, 8, 8)
    shown = repr(CurvaturePrior("tubes", softmax=True, reduction="sum", ignore_index=255))
    assert all(word in shown for word in ("preset tubes", "softmax=True", "reduction='sum'", "ignore_index=255"))
    with pytest.raises(TypeError, match="tensor"):
        CurvaturePrior("tubes")(np.zeros((1, 1, 8, 8, 8), np.float32))  # type: ignore[arg-type]
    for law in ((1, 2, 1, 0, 0, 0), {"a20": 1, "a11": 2, "a02": 1}):
        assert CurvaturePrior(law).coefficients == (Coefficients.willmore(),)  # type: ignore[arg-type]
    with pytest.warns(UserWarning, match="unit"):
        CurvaturePrior("tubes", unit="nm")
    for spacing in (1.0, (2.0, 1.0, 1.0)):
        prior = CurvaturePrior("tubes", sigmoid=True, spacing=spacing)
        torch.testing.assert_close(torch.export.export(prior, (x,)).module()(x), prior(x))


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(ignored_neighbours, id="19-small-things, part 4"),
        pytest.param(compiled_second_prior, id="eng-02-compile-second-prior", marks=pytest.mark.slow),
        pytest.param(weight_of_a_resumed_training, id="eng-05-weight-lost-on-resume"),
        pytest.param(thick_slices, id="eng-09-thick-slices-inflate"),
        pytest.param(small_api, id="eng-12-small-api", marks=pytest.mark.slow),
    ],
)
def test_handed_cases(case) -> None:
    """eng-01 and eng-11 are in `priors/test_workers.py`: each needs processes of its own."""
    case()
