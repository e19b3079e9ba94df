"""The vessel benchmark on a made-up volume: masked losses, its four trainings, its scores and its table."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("monai")

from benchmarks.vessel_data import UNKNOWN, Part, annotated, sparse
from benchmarks.vessel_report import stacked, table, verdict
from benchmarks.vessel_scores import COUNTS, SCORES, block_counts, bootstrap, scores
from benchmarks.vessel_training import LOSSES, Plan, Setting, Training, dice_ce, network, predict


@pytest.fixture(scope="module")
def tubes() -> Part:
    z, y, x = np.indices((13, 100, 130))
    label = (np.hypot(y - 30 - 2 * z, x - 40) < 6) | (np.hypot(z - 6, (y - 70) / 2) < 2.5)
    image = label + np.random.default_rng(0).normal(0, 0.2, label.shape)
    return Part(image.astype(np.float32), label)


def test_three_slices_carry_labels(tubes):
    assert annotated(25) == [4, 12, 20]
    target = sparse(tubes.label)
    known = np.flatnonzero((target != UNKNOWN).any((1, 2)))
    assert known.tolist() == annotated(13) and (target[known] == tubes.label[known]).all()


def test_dice_ce_sees_labelled_voxels_only(tubes):
    logits = torch.randn(1, 1, *tubes.label.shape, requires_grad=True)
    target = torch.from_numpy(sparse(tubes.label))[None, None].float()
    (slope,) = torch.autograd.grad(dice_ce(logits, target), logits)
    assert (slope[target == UNKNOWN] == 0).all() and (slope[target != UNKNOWN] != 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("loss", LOSSES)
def test_a_training_resumes_to_the_same_network(tubes, loss, tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.vessel_training.BATCHES", 1)
    plan, setting = Plan(2, 1, 1e-3), Setting(loss, 0.5, 4.0, "tubes")
    whole, again = Training(tubes, plan, 7), Training(tubes, plan, 8)
    whole.run(dice_ce, plan.alone)
    whole.save(tmp_path / "begun.pt")
    again.load(tmp_path / "begun.pt")
    again.seed = 7
    assert whole.finish(setting) == again.finish(setting)
    pairs = zip(whole.model.state_dict().values(), again.model.state_dict().values(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)


def test_a_prediction_covers_the_volume(tubes):
    probability = predict(network(), tubes.image)
    assert probability.shape == tubes.label.shape and 0 < probability.min() < probability.max() < 1


def test_scores_of_a_perfect_and_of_a_broken_prediction(tubes):
    perfect = scores(block_counts(tubes.label, tubes.label))
    assert perfect.tolist() == [1, 1, 0, 0]
    broken = tubes.label.copy()
    broken[:, :, 90:93] = False
    broken[3, 5, 5] = True
    dice, cldice, error, with_specks = scores(block_counts(broken, tubes.label))
    assert dice < 1 and cldice < 1 and with_specks > error > 0


def test_bootstrap_pairs_losses_and_finds_a_difference():
    random = np.random.default_rng(0)
    counts = {name: random.integers(50, 100, (3, 2, 32)) for name in COUNTS}
    counts |= {name: random.integers(1, 9, (3, 2, 32)) for name in ("true_components", "true_components_all")}
    counts |= {"components": counts["true_components"] + 1, "components_all": counts["true_components_all"] + 1}
    better = counts | {"components": counts["true_components"], "both": counts["both"] + 20}
    found = bootstrap({"dice+ce": counts, "better": better, "same": counts}, "dice+ce", draws=50)
    difference = found["better"][1]
    assert found["same"].shape == (2, 3, len(SCORES)) and not found["same"][1].any()
    assert (difference[:, 2] == -1).all() and difference[1, 0] > 0 and not difference[:, 1].any()
    assert "clDice undecided, Betti-0 error better: the bar is not met" in verdict("better", difference)
    assert "clDice better, Betti-0 error better: the bar is met" in verdict(
        "better", difference + np.array([0, 0.1, 0, 0])
    )


def test_the_table_has_a_row_for_each_loss(tubes, monkeypatch):
    monkeypatch.setattr("benchmarks.vessel_report.part", lambda stack, name: tubes)
    counts = block_counts(tubes.image > 0.6, tubes.label)
    run = {"test": counts, "validation": counts, "rate": 1e-3, "steps": 3, "commit": "c", "torch": "t", "monai": "m"}
    runs = {loss: [[run | {"setting": Setting(loss, 0.5, 2.0)._asdict()}] * 2] * 2 for loss in LOSSES}
    assert stacked(runs["cldice"])["both"].shape[:2] == (2, 2)
    text = table(runs, [(1.5, runs["cldice"][0])])
    assert text.count("not met") == 3 and "+0.0000 [+0.0000, +0.0000]" in text and "curvature 0.5, ε 2 µm" in text
