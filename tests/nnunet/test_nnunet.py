"""nnU-Net's trainer: the variables by which it is found, and the trainer in the real package where there is one."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "curvafit" / "nnunet"


PROGRAM = """
import copy, json, os, sys
import torch
from nnunetv2.utilities.find_objects import recursive_find_trainer_class_by_name
from nnunetv2.training.loss.deep_supervision import DeepSupervisionWrapper

os.environ.setdefault("CURVAFIT_WEIGHT", "0.01")
kind = recursive_find_trainer_class_by_name("nnUNetTrainerCurvafit")
labels, ignore = {"background": 0, "vessel": 1, "ignore": 2}, 2
dataset = {"channel_names": {"0": "CT"}, "labels": labels, "numTraining": 1, "file_ending": ".nii.gz"}
stages = {"n_stages": 3, "features_per_stage": [4, 8, 8], "conv_op": "torch.nn.modules.conv.Conv3d",
    "kernel_sizes": [[3, 3, 3]] * 3, "strides": [[1, 1, 1], [1, 2, 2], [2, 2, 2]], "n_conv_per_stage": [1, 1, 1],
    "n_conv_per_stage_decoder": [1, 1], "conv_bias": True, "norm_op": "torch.nn.modules.instancenorm.InstanceNorm3d",
    "norm_op_kwargs": {"eps": 1e-5, "affine": True}, "dropout_op": None, "dropout_op_kwargs": None,
    "nonlin": "torch.nn.LeakyReLU", "nonlin_kwargs": {"inplace": True}}
plan = {"data_identifier": "x", "preprocessor_name": "DefaultPreprocessor", "batch_size": 1, "patch_size": [16, 32, 32],
    "spacing": [2.0, 1.0, 1.0], "normalization_schemes": ["ZScoreNormalization"], "use_mask_for_norm": [False],
    "batch_dice": False, "architecture": {
        "network_class_name": "dynamic_network_architectures.architectures.unet.PlainConvUNet",
        "arch_kwargs": stages, "_kw_requires_import": ["conv_op", "norm_op", "dropout_op", "nonlin"]}}
plans = {"dataset_name": "Dataset001_X", "plans_name": "nnUNetPlans", "continue_training": False,
    "configurations": {"3d_fullres": plan}, "foreground_intensity_properties_per_channel": {},
    "transpose_forward": [0, 1, 2], "transpose_backward": [0, 1, 2]}
trainer = kind(copy.deepcopy(plans), "3d_fullres", 0, dataset, device=torch.device("cpu"))
trainer.initialize()
assert isinstance(trainer.loss, DeepSupervisionWrapper)
torch.manual_seed(0)
image = torch.randn(1, 1, 16, 32, 32)
target = [torch.randint(0, 3, (1, 1, *n)).float() for n in ((16, 32, 32), (16, 16, 16))]
trainer.network.train()
outputs = trainer.network(image)
assert [tuple(o.shape[2:]) for o in outputs] == [(16, 32, 32), (16, 16, 16)]
combined, factors = trainer.loss.loss, trainer.loss.weight_factors
with torch.no_grad():
    value = trainer.loss(outputs, target)
    base = sum(f * combined.base(o, t) for f, o, t in zip(factors, outputs, target) if f)
    own = sum(f * combined.prior(o, t) for f, o, t in zip(factors, outputs, target) if f)
weight = float(os.environ["CURVAFIT_WEIGHT"])
warmup = int(float(os.environ["CURVAFIT_WARMUP"]) * 250) * sum(f != 0 for f in factors)
assert combined.warmup == warmup and int(combined.calls) == 0
combined.warmup = 0
with torch.no_grad():
    torch.testing.assert_close(trainer.loss(outputs, target), base + weight * own)
combined.warmup = warmup
before = [p.detach().clone() for p in trainer.network.parameters()]
step = trainer.train_step({"data": image, "target": target})
assert step["loss"] == step["loss"] and any(bool((a != b).any()) for a, b in zip(before, trainer.network.parameters()))
made = int(combined.calls)
with torch.no_grad():
    trainer.validation_step({"data": image, "target": [t.clone() for t in target]})
assert int(combined.calls) == made
trainer.current_epoch = 3
trainer.on_train_epoch_start()
assert int(combined.calls) == 3 * 250 * made
del os.environ["CURVAFIT_WEIGHT"]
shared = kind(copy.deepcopy(plans), "3d_fullres", 0, dataset, device=torch.device("cpu"))
shared.initialize()
shared.dataloader_train = iter([{"data": image, "target": [t.clone() for t in target]}] * 20)
for epoch in (1, 2):
    assert shared.loss.loss.weight == 0
    shared.current_epoch = epoch
    shared.on_train_epoch_start()
combined = shared.loss.loss
leaf = shared.network(image)[0].detach().float().requires_grad_()
slopes = [torch.autograd.grad(part(leaf, target[0]), leaf)[0].norm() for part in (combined.base, combined.prior)]
assert abs(float(combined.weight * slopes[1] / slopes[0]) - 0.1) < 1e-3
assert shared.train_step({"data": image, "target": target})["loss"] < 1e3
print("done")
"""


def variables(*words: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "curvafit.nnunet", *words]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(command, env=env, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_a_shell_takes_the_variables_that_are_printed():
    script = variables("Bilinear_Tubes").stdout + 'echo "$nnUNet_extTrainer|$CURVAFIT_PRIOR"'
    for env, rest in (({}, ""), ({"nnUNet_extTrainer": "/elsewhere"}, ":/elsewhere")):
        said = subprocess.run(["bash", "-c", script], env=env, capture_output=True, text=True, check=True)
        assert said.stdout == f"{FOLDER}{rest}|bilinear-tubes\n"
    for words in ((), ("tubs",), ("none.json",)):
        done = variables(*words)
        assert done.returncode == 2 and done.stderr.count("\n") == done.stderr.count("expected") == 1
        assert "fit.json" in done.stderr and not done.stdout


@pytest.mark.skipif(
    importlib.util.find_spec("nnunetv2") is None, reason="nnunetv2 is not installed: pip install nnunetv2"
)
def test_the_trainer_in_the_real_package(tmp_path):
    env = {"nnUNet_extTrainer": str(FOLDER), "CURVAFIT_PRIOR": "tubes", "nnUNet_compile": "f"}
    env |= {"CURVAFIT_WARMUP": "2", "PYTHONPATH": os.pathsep.join((str(ROOT), os.environ.get("PYTHONPATH", "")))}
    for name in ("raw", "preprocessed", "results"):
        env[f"nnUNet_{name}"] = str(tmp_path / name)
        (tmp_path / name / "Dataset001_X" / "x").mkdir(parents=True)
    (tmp_path / "preprocessed" / "Dataset001_X" / "x" / "case.npz").touch()  # tells how data are stored
    for more, word in (({}, ""), ({"CURVAFIT_WEIGHT": "nan"}, "CURVAFIT_WEIGHT"), ({"CURVAFIT_PRIOR": ""}, "not set")):
        command = [sys.executable, "-c", PROGRAM]
        done = subprocess.run(command, env=os.environ | env | more, capture_output=True, text=True, check=False)
        assert (done.returncode == 0 and done.stdout.endswith("done\n")) if not word else word in done.stderr, (
            done.stderr
        )
