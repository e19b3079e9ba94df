"""The curvature prior beside the losses and in the loops that people have."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from curvafit.priors import CombinedLoss, CurvaturePrior

ROOT = Path(__file__).resolve().parents[2]


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


class Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.body = nn.Sequential(nn.Conv3d(1, 4, 3, padding=1), nn.ReLU(), nn.Conv3d(4, 1, 3, padding=1))

    def forward(self, image: Tensor) -> Tensor:
        return self.body(image)


def gradients(net: nn.Module, loss: nn.Module, image: Tensor, target: Tensor) -> list[Tensor]:
    net.zero_grad()
    loss(net(image), target).backward()
    return [p.grad.clone() for p in net.parameters() if p.grad is not None]


# ---- CombinedLoss ----------------------------------------------------------------------------------------------------


def test_combined_loss_is_the_weighted_sum():
    base, prior = nn.BCEWithLogitsLoss(), CurvaturePrior("tubes", sigmoid=True)
    logits, target = noise(1, 1, 8, 8, 8), (noise(1, 1, 8, 8, 8, seed=1) > 0).float()
    expected = base(logits, target) + 0.01 * prior(logits)
    torch.testing.assert_close(CombinedLoss(base, prior, 0.01)(logits, target), expected)
    mask = (torch.arange(8) < 5).float().expand(1, 1, 8, 8, 8)
    expected = base(logits, target) + 0.01 * prior(logits, mask=mask)
    torch.testing.assert_close(CombinedLoss(base, prior, 0.01)(logits, target, mask), expected)


def test_the_warm_up_counts_training_steps_and_survives_a_restart():
    base, prior = nn.BCEWithLogitsLoss(), CurvaturePrior("tubes", sigmoid=True)
    logits, target = noise(1, 1, 8, 8, 8), torch.zeros(1, 1, 8, 8, 8)
    loss, alone, ours = CombinedLoss(base, prior, 2.0, warmup=4), base(logits, target), 2 * prior(logits)
    for share in (0.25, 0.5, 0.75):
        torch.testing.assert_close(loss(logits, target), alone + share * ours)
    with torch.no_grad():
        torch.testing.assert_close(loss(logits, target), alone + 0.75 * ours)
    again = CombinedLoss(base, prior, 2.0, warmup=4)
    again.load_state_dict(loss.state_dict())
    for _ in range(3):
        torch.testing.assert_close(again(logits, target), alone + ours)
    again.eval()
    assert int(again.calls) == 6 and again(logits, target) is not None and int(again.calls) == 6


def test_the_parts_of_the_sum_are_there_to_log():
    base, prior = nn.BCEWithLogitsLoss(), CurvaturePrior("tubes", sigmoid=True)
    logits, target = noise(1, 1, 8, 8, 8).requires_grad_(), torch.zeros(1, 1, 8, 8, 8)
    loss = CombinedLoss(base, prior, 2.0, warmup=4)
    assert loss.parts == {}
    value = loss(logits, target)
    parts = loss.parts
    assert set(parts) == {"base", "prior", "weight"} and not any(part.requires_grad for part in parts.values())
    torch.testing.assert_close(parts["base"], base(logits, target).detach())
    torch.testing.assert_close(parts["prior"], prior(logits).detach())
    assert float(parts["weight"]) == 0.5
    torch.testing.assert_close(parts["base"] + parts["weight"] * parts["prior"], value.detach())


def test_combined_loss_refuses_negative_numbers():
    for options in ({"weight": -1.0}, {"weight": None}, {"weight": float("inf")}, {"warmup": -1}, {"warmup": 0.5}):
        with pytest.raises(
            ValueError, match=r"expected a (finite weight|warm-up of a whole number of calls) from 0, got"
        ):
            CombinedLoss(nn.BCEWithLogitsLoss(), CurvaturePrior("tubes"), **options)


# ---- torch -----------------------------------------------------------------------------------------------------------


def test_it_compiles_into_one_graph():
    loss = CombinedLoss(nn.BCEWithLogitsLoss(), CurvaturePrior("tubes", sigmoid=True, ignore_index=2), 1e-3)
    loss.calls.zero_()
    logits, target = noise(2, 1, 8, 8, 8), (noise(2, 1, 8, 8, 8, seed=1) > 0).float()
    compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)
    plain, fast = (logits.clone().requires_grad_() for _ in range(2))
    one, two = loss(plain, target), compiled(fast, target)
    one.backward()
    two.backward()
    torch.testing.assert_close(one, two)
    torch.testing.assert_close(plain.grad, fast.grad)


def test_distributed_training_sees_the_same_gradients(tmp_path):
    import torch.distributed as dist

    image, target = noise(2, 1, 8, 8, 8), torch.zeros(2, 1, 8, 8, 8)
    loss = CombinedLoss(nn.BCEWithLogitsLoss(), CurvaturePrior("tubes", sigmoid=True), 1e-3)
    expected = gradients(Net(), loss, image, target)
    dist.init_process_group("gloo", init_method=f"file://{tmp_path}/store", rank=0, world_size=1)
    try:
        found = gradients(nn.parallel.DistributedDataParallel(Net()), loss, image, target)
    finally:
        dist.destroy_process_group()
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)


# ---- MONAI -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["prior", "dice"])
def test_keywords_mean_what_they_mean_in_monai(name):
    """Every keyword and reduction that MONAI's Dice loss has relates the same values in both."""
    losses = pytest.importorskip("monai.losses", reason="monai is not installed: pip install monai")
    logits = noise(2, 3, 8, 8, 8)
    target = torch.randint(0, 3, (2, 1, 8, 8, 8), generator=torch.Generator().manual_seed(0))
    onehot = nn.functional.one_hot(target[:, 0], 3).movedim(-1, 1)
    p = logits.softmax(1)

    def value(input: Tensor, target: Tensor, **options) -> Tensor:
        loss = CurvaturePrior("tubes", **options) if name == "prior" else losses.DiceLoss(**options)
        return loss(input, target)

    each = value(p, onehot, reduction="none")
    assert each.shape == (2, 3, 1, 1, 1) and len(set(each.flatten().tolist())) == 6
    for include, expected in ((True, each), (False, each[:, 1:])):
        options = {"to_onehot_y": True, "softmax": True, "include_background": include}
        torch.testing.assert_close(value(logits, target, reduction="none", **options), expected)
        torch.testing.assert_close(value(logits, target, **options), expected.mean())
        if name == "prior":  # of the energies themselves: 6³ voxels inside, ε of two voxels
            expected = expected * 6**3 / 2**3
        torch.testing.assert_close(value(logits, target, reduction="sum", **options), expected.sum())
    found = value(logits, onehot, sigmoid=True, reduction="none")
    torch.testing.assert_close(found, value(logits.sigmoid(), onehot, reduction="none"))


def test_tensors_with_metadata_are_tensors():
    data = pytest.importorskip("monai.data", reason="monai is not installed: pip install monai")
    logits, target = noise(1, 1, 8, 8, 8), torch.zeros(1, 1, 8, 8, 8)
    prior = CurvaturePrior("tubes", sigmoid=True, ignore_index=1)
    leaf = data.MetaTensor(logits).requires_grad_()
    value = prior(leaf, data.MetaTensor(target), data.MetaTensor(torch.ones_like(target)))
    value.backward()
    assert type(value) is Tensor and torch.equal(value, prior(logits, target))
    assert leaf.grad is not None and bool(leaf.grad.any())


def test_it_trains_under_monai_s_deep_supervision():
    losses = pytest.importorskip("monai.losses", reason="monai is not installed: pip install monai")
    prior = CurvaturePrior("tubes", softmax=True, include_background=False, shape=(16, 16, 16))
    base = losses.DiceCELoss(to_onehot_y=True, softmax=True)
    loss = losses.DeepSupervisionLoss(CombinedLoss(base, prior, 1e-3), weight_mode="exp")
    outputs = [noise(1, 2, n, n, n, seed=n).requires_grad_() for n in (16, 8)]
    target = (noise(1, 1, 16, 16, 16) > 0.5).float()
    value = loss(outputs, target)
    value.backward()
    plain = losses.DeepSupervisionLoss(base, weight_mode="exp")(outputs, target)
    ours = prior(outputs[0]) + 0.5 * prior(outputs[1])
    torch.testing.assert_close(value, plain + 1e-3 * ours)
    assert all(bool(output.grad.any()) for output in outputs)


@pytest.mark.slow
def test_the_monai_example_runs(tmp_path):
    pytest.importorskip("monai", reason="monai is not installed: pip install monai")
    command = [sys.executable, str(ROOT / "examples" / "monai_training.py"), "--small", "-o", str(tmp_path)]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr
    assert "Dice" in done.stdout and (tmp_path / "monai_training.png").is_file()
