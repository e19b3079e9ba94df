"""The curvature prior beside the losses and in the loops that people have."""

import copy
import io
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from curvafit.priors import Coefficients, CombinedLoss, CurvaturePrior

ROOT = Path(__file__).resolve().parents[2]
BCE = nn.BCEWithLogitsLoss()


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


PRIOR, LOGITS, TARGET = CurvaturePrior("tubes", sigmoid=True), noise(1, 1, 8, 8, 8), noise(1, 1, 8, 8, 8, seed=1) > 0
TARGET = TARGET.float()


# ---- CombinedLoss ----------------------------------------------------------------------------------------------------


def test_combined_loss_is_the_weighted_sum_and_its_parts_are_there_to_log():
    mask = (torch.arange(8) < 5).float().expand(1, 1, 8, 8, 8)
    assert_close(CombinedLoss(BCE, PRIOR, 0.01)(LOGITS, TARGET), BCE(LOGITS, TARGET) + 0.01 * PRIOR(LOGITS))
    found = CombinedLoss(BCE, PRIOR, 0.01)(LOGITS, TARGET, mask)
    assert_close(found, BCE(LOGITS, TARGET) + 0.01 * PRIOR(LOGITS, mask=mask))
    loss, leaf = CombinedLoss(BCE, PRIOR, 2.0, warmup=4), LOGITS.clone().requires_grad_()
    assert loss.parts == {}
    value, parts = loss(leaf, TARGET), loss.parts
    assert not any(part.requires_grad for part in parts.values())
    assert_close(parts, {"base": BCE(LOGITS, TARGET), "prior": PRIOR(LOGITS), "weight": torch.tensor(0.5)})
    assert_close(parts["base"] + parts["weight"] * parts["prior"], value.detach())
    for wrong in ({"weight": -1.0}, {"weight": None}, {"weight": float("inf")}, {"warmup": -1}, {"warmup": 0.5}):
        with pytest.raises(ValueError, match="from 0, got"):
            CombinedLoss(BCE, PRIOR, **wrong)


def test_the_warm_up_counts_training_steps_and_survives_a_restart():
    """Weight, warm-up and count go with the state, however it is kept."""
    loss, alone, ours = CombinedLoss(BCE, PRIOR, 2.0, warmup=4), BCE(LOGITS, TARGET), 2 * PRIOR(LOGITS)
    for share in (0.25, 0.5, 0.75):
        assert_close(loss(LOGITS, TARGET), alone + share * ours)
    with torch.no_grad():
        assert_close(loss(LOGITS, TARGET), alone + 0.75 * ours)
    file = io.BytesIO()
    torch.save(nn.ModuleDict({"loss": loss}).state_dict(), file)
    file.seek(0)
    again, whole = CombinedLoss(BCE, PRIOR, 0.0), nn.ModuleDict({"loss": CombinedLoss(BCE, PRIOR, 0.0)})
    again.load_state_dict(loss.state_dict())
    whole.load_state_dict(torch.load(file, weights_only=True))
    for other in (again, whole["loss"], copy.deepcopy(loss), pickle.loads(pickle.dumps(loss))):
        assert (float(other.weight), other.warmup, int(other.calls)) == (2.0, 4, 3)
    for _ in range(3):
        assert_close(again(LOGITS, TARGET), alone + ours)
    again.eval()
    assert int(again.calls) == 6 and again(LOGITS, TARGET) is not None and int(again.calls) == 6


def test_it_can_be_copied_and_shown():
    prior = CurvaturePrior("tubes", spacing=(1, 1, 2), epsilon=4.0, softmax=True)
    logits = noise(1, 2, 8, 8, 8)
    assert torch.equal(copy.deepcopy(prior)(logits), prior(logits))
    assert all(word in repr(prior) for word in ("preset tubes", "softmax=True", "epsilon=4"))
    for law in ((1, 2, 1, 0, 0, 0), {"a20": 1, "a11": 2, "a02": 1}):
        assert CurvaturePrior(law).coefficients == Coefficients.willmore()  # type: ignore[arg-type]


# ---- torch and MONAI -------------------------------------------------------------------------------------------------


COMPILES = """
import torch
from torch.testing import assert_close
from curvafit.priors import CombinedLoss, CurvaturePrior

def slope_of(loss, value):
    leaf = value.clone().requires_grad_()
    return torch.autograd.grad(loss(leaf), leaf)[0]

def compiled(loss):
    return torch.compile(loss, backend="aot_eager", fullgraph=True)

logits, target = torch.randn(1, 1, 8, 8, 8), (torch.randn(1, 1, 8, 8, 8) > 0).float()
loss = CombinedLoss(torch.nn.BCEWithLogitsLoss(), CurvaturePrior("tubes", sigmoid=True, ignore_index=2), 1e-3)
slope = slope_of(lambda x: loss(x, target), logits)
found = slope_of(lambda x: compiled(loss)(x, target), logits)
assert_close(found, slope, rtol=1e-3, atol=3e-3 * float(slope.abs().max()))
priors = [CurvaturePrior("tubes", sigmoid=True, spacing=spacing) for spacing in (1.0, 0.5, (2.0, 1.0, 1.0))]
p = logits.sigmoid()
for prior in (*priors, CurvaturePrior("tubes", shape=(16, 16, 16))):
    assert_close(compiled(prior)(p, mask=target), prior(p, mask=target), rtol=1e-4, atol=0)
for prior in (priors[0], priors[2]):
    assert_close(torch.export.export(prior, (logits,)).module()(logits), prior(logits), rtol=1e-4, atol=0)
"""


def test_it_compiles_into_one_graph():
    """With another loss and its warm-up; with other spacings after it; as a level of deep supervision; and exported. In
    a process of its own: compilers do not read the tests' checks of shapes."""
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", COMPILES], capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr


def gradients(net: nn.Module, loss: nn.Module, image: Tensor, target: Tensor) -> list[Tensor]:
    net.zero_grad()
    loss(net(image), target).backward()
    return [p.grad.clone() for p in net.parameters() if p.grad is not None]


def test_distributed_training_sees_the_same_gradients(tmp_path):
    import torch.distributed as dist

    image, target = noise(2, 1, 8, 8, 8), torch.zeros(2, 1, 8, 8, 8)
    net = nn.Sequential(nn.Conv3d(1, 4, 3, padding=1), nn.ReLU(), nn.Conv3d(4, 1, 3, padding=1))
    loss = CombinedLoss(BCE, PRIOR, 1e-3)
    expected = gradients(net, loss, image, target)
    dist.init_process_group("gloo", init_method=f"file://{tmp_path}/store", rank=0, world_size=1)
    try:
        found = gradients(nn.parallel.DistributedDataParallel(net), loss, image, target)
    finally:
        dist.destroy_process_group()
    assert_close(found, expected)


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
        assert_close(value(logits, target, reduction="none", **options), expected)
        assert_close(value(logits, target, **options), expected.mean())
        if name == "prior":  # of the energies themselves: 6³ voxels inside, ε of two voxels
            expected = expected * 6**3 / 2**3
        assert_close(value(logits, target, reduction="sum", **options), expected.sum())
    found = value(logits, onehot, sigmoid=True, reduction="none")
    assert_close(found, value(logits.sigmoid(), onehot, reduction="none"))


def test_tensors_with_metadata_are_tensors():
    data = pytest.importorskip("monai.data", reason="monai is not installed: pip install monai")
    prior, target = CurvaturePrior("tubes", sigmoid=True, ignore_index=1), torch.zeros_like(TARGET)
    leaf = data.MetaTensor(LOGITS).requires_grad_()
    value = prior(leaf, data.MetaTensor(target), data.MetaTensor(torch.ones_like(target)))
    value.backward()
    assert type(value) is Tensor and torch.equal(value, prior(LOGITS, target))
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
    assert_close(value, plain + 1e-3 * (prior(outputs[0]) + 0.5 * prior(outputs[1])))
    assert all(bool(output.grad.any()) for output in outputs)


@pytest.mark.slow
def test_the_monai_example_runs(tmp_path):
    pytest.importorskip("monai", reason="monai is not installed: pip install monai")
    command = [sys.executable, str(ROOT / "examples" / "monai_training.py"), "--small", "-o", str(tmp_path)]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr
    assert "Dice" in done.stdout and (tmp_path / "monai_training.png").is_file()
