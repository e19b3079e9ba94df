"""The network that repairs masks: what it sees, its files, the damage that teaches it, teaching, tuning, commands."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from calling import call, refused
from scipy import ndimage
from scipy.special import expit, logit

import curvafit.segmentation.repair as room
import curvafit.segmentation.teach_repair as school
from curvafit.geometry.topology import betti_numbers
from curvafit.segmentation import refine, repair_classes
from curvafit.segmentation.damage import Damage, damage
from curvafit.segmentation.refine import Refine
from curvafit.segmentation.repair import REACH, SUREST, Repairer, RepairNet, choose_pixel
from curvafit.segmentation.teach import Texture, learn
from curvafit.segmentation.teach_repair import MIX, MapLessons, pose, teach_repair, tune_repair
from curvafit.segmentation.trials import dice
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.read import load
from curvafit.volumes.write import save

#: A shape without any defect.
SOUND = Damage(image=0, waver=(1e-3, 2e-3), share=0, stairs=0, sharpness=(1, 1.001), hard=0)


def rods(n: int = 48) -> np.ndarray:
    """Rods along all three axes that repeat, five voxels thick."""
    wave = np.cos(2 * np.pi * np.arange(n) / 16)
    z, y, x = wave[:, None, None], wave[:, None], wave
    return np.maximum(np.maximum(z + y, z + x), y + x) > 1.1


def drawn(seed: int = 0, width: int = 8) -> Repairer:
    """A repairer with weights drawn at random, all of which count."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = RepairNet(width).eval()
        for parameter in network.parameters():
            torch.nn.init.normal_(parameter, std=0.15)
    return Repairer(network, 1.0, {}, 0.02)


# ---- the network -----------------------------------------------------------------------------------------------------


def test_what_has_learnt_nothing_changes_nothing() -> None:
    odds = np.random.default_rng(0).normal(0, 3, (21, 30, 26)).astype(np.float32)
    plain = Repairer(RepairNet(4).eval(), 1.0, {}, 0.0)
    np.testing.assert_allclose(plain.repair(odds, (1, 1, 1)), odds.clip(-SUREST, SUREST), atol=1e-5)
    np.testing.assert_allclose(plain.repair(odds, (3, 1, 1)), odds.clip(-SUREST, SUREST), atol=1e-4)


def test_tiles_find_what_the_whole_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    odds = damage(rods(64)[:50, :61], np.random.default_rng(1), Damage())
    whole = drawn().repair(odds, (1, 1, 1))
    monkeypatch.setattr(room, "TILE", 20)
    np.testing.assert_allclose(drawn().repair(odds, (1, 1, 1)), whole, atol=1e-4)


def test_what_is_far_and_sure_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rod in a large empty volume: no probability is made of background, wherever tiles are cut."""
    odds = np.full((96, 64, 64), -SUREST, np.float32)
    odds[:, 20:26, 20:26] = SUREST
    odds[70, 50, 50] = -0.1  # nearly inside, far from all else
    found = drawn().repair(odds, (1, 1, 1))
    assert (found[:, 40:, 40:][odds[:, 40:, 40:] == -SUREST] == -SUREST).all()
    monkeypatch.setattr(room, "TILE", 32)
    np.testing.assert_allclose(drawn().repair(odds, (1, 1, 1)), found, atol=1e-4)


def test_nothing_is_seen_beyond_the_reach() -> None:
    odds = torch.from_numpy(damage(rods(96)[:64, :8, :8], np.random.default_rng(0), Damage()))[None]
    other = odds.clone()
    other[:, 60:] = -1
    network, same = drawn().network, torch.zeros_like(odds)
    with torch.inference_mode():
        change = (network(odds, same) - network(other, same)).abs().amax((0, 2, 3))
    assert change[60:].min() > 0 and change[: 60 - REACH].max() == 0


def test_a_structure_is_repaired_on_voxels_of_its_size() -> None:
    mask = rods()
    assert choose_pixel(mask, (2.0, 2.0, 2.0)) == 2.0
    assert choose_pixel(np.repeat(np.repeat(np.repeat(mask, 4, 0), 4, 1), 4, 2), (1, 1, 1)) > 1.2
    thin = np.zeros((20, 20, 20), bool)
    thin[10] = True
    assert choose_pixel(thin, (1, 1, 1)) < 1
    assert choose_pixel(np.zeros((5, 5, 5), bool), (3, 2, 1)) == 1


def test_what_has_no_surface_stays() -> None:
    for value in (-2.0, 3.0):
        odds = np.full((9, 10, 11), value, np.float32)
        np.testing.assert_array_equal(drawn().repair(odds, (1, 1, 1)), odds)


# ---- files -----------------------------------------------------------------------------------------------------------


def test_weights_come_back_from_their_file(tmp_path: Path) -> None:
    one = replace(drawn(), temperature=1.7, error=0.03, card={"seed": 4}, helps=False, status="p > 1/2 is as good")
    one.save(tmp_path / "repairer.npz")
    other = Repairer.load(tmp_path / "repairer.npz")
    assert (other.temperature, other.error, other.card) == (1.7, 0.03, {"seed": 4})
    assert (other.helps, other.status) == (False, "p > 1/2 is as good")
    one, other = (replace(each, helps=True) for each in (one, other))
    odds = damage(rods(24), np.random.default_rng(0), Damage())
    np.testing.assert_array_equal(other.repair(odds, (1, 1, 1)), one.repair(odds, (1, 1, 1)))
    content = dict(np.load(tmp_path / "repairer.npz"))
    content["out.weight"][0] = np.nan
    np.savez(tmp_path / "broken.npz", **content)
    with pytest.raises(ValueError, match="not finite"):
        Repairer.load(tmp_path / "broken.npz")
    with pytest.raises(FileNotFoundError):
        Repairer.load(tmp_path / "none.npz")


def test_the_packaged_repairer_is_small_and_says_what_taught_it() -> None:
    packaged = Repairer.load()
    size = (Path(room.__file__).parent / "data" / "repairer.npz").stat().st_size
    assert size < 3e6 and packaged.card["shapes"] >= 200 and packaged.card["sources"][0]["design"]
    assert packaged.card["held_out_loss"] < 0.75 * packaged.card["held_out_damaged"]
    assert json.loads(json.dumps(packaged.card)) == packaged.card


# ---- damage ----------------------------------------------------------------------------------------------------------


def test_damage_depends_on_its_seed_alone_and_is_cut() -> None:
    one, other = (damage(rods(), np.random.default_rng(5), Damage()) for _ in range(2))
    np.testing.assert_array_equal(one, other)
    assert one.dtype == np.float32 and np.abs(one).max() <= SUREST


def test_a_sound_mask_stays_as_it_is() -> None:
    np.testing.assert_array_equal(damage(rods(), np.random.default_rng(0), SOUND) > 0, rods())


@pytest.mark.parametrize("field", [each.name for each in fields(Damage) if each.name in ("image", "share", "stairs")])
def test_each_kind_of_damage_makes_errors(field: str) -> None:
    found = [damage(rods(), np.random.default_rng(seed), replace(SOUND, **{field: 1.0})) > 0 for seed in range(5)]
    assert all(0 < np.count_nonzero(mask != rods()) < 0.3 * mask.size for mask in found)


def test_defects_break_and_join() -> None:
    """Over seeds, what defects do to Betti numbers goes both ways: parts are cut off and joined."""
    tall = np.zeros((40, 40, 40), bool)
    tall[:, 8:13, 8:13] = tall[:, 20:25, 20:25] = True
    parts = [betti_numbers(damage(tall, np.random.default_rng(k), replace(SOUND, share=1.0)) > 0)[0] for k in range(8)]
    assert max(parts) > 3 and betti_numbers(tall)[0] == 2


# ---- teaching --------------------------------------------------------------------------------------------------------


def lessons(length: int = 6, edge: int = 24) -> MapLessons:
    wave = np.where(rods(32), 1.0, -1.0).astype(np.float32)
    return MapLessons([[Texture(wave)]], replace(MIX, pairs=0), Damage(), 0, length, 2, edge)


def test_a_lesson_depends_on_its_number_alone() -> None:
    for number in (4, 0):
        for a, b in zip(lessons()[number], lessons(99)[number], strict=True):
            assert a.shape == (2, 24, 24, 24) and a.dtype == np.float32
            np.testing.assert_array_equal(a, b)


def test_learning_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("curvafit.segmentation.teach.SAVED", 2)

    def stop(_: str, share: float) -> None:
        if share > 0.6:
            raise KeyboardInterrupt

    whole, stopped, parts = (drawn(3, 4).network for _ in range(3))
    losses = learn(whole, lessons(), 1e-3, workers=0)
    with pytest.raises(KeyboardInterrupt):
        learn(stopped, lessons(), 1e-3, checkpoint=tmp_path / "steps", workers=0, progress=stop)
    with pytest.raises(ValueError, match="another teaching"):
        learn(drawn(0, 6).network, lessons(), 1e-3, checkpoint=tmp_path / "steps", workers=0)
    assert learn(parts, lessons(), 1e-3, checkpoint=tmp_path / "steps", workers=0) == losses
    assert all(torch.equal(a, b) for a, b in zip(whole.parameters(), parts.parameters(), strict=True))


@pytest.mark.slow
def test_teaching_lowers_the_loss_of_shapes_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(school, "JUDGED", 8)
    monkeypatch.setattr(school, "MapLessons", partial(MapLessons, edge=24))
    wave = np.where(rods(32), 1.0, -1.0).astype(np.float32)
    sources = [[Texture(np.roll(wave, k, 0)) for k in range(3)]]
    found = teach_repair(sources, {"sources": []}, steps=80, workers=0)
    card = json.loads(json.dumps(found.card))
    assert card["held_out_loss"] < card["held_out_damaged"] and 0 <= found.error < 0.3
    assert (card["shapes"], card["held_out"], card["steps"]) == (2, 1, 80)


def test_an_example_says_whether_a_repair_helps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(school, "TUNING", 1)
    odds, truth = np.where(rods(), 4, -4).astype(np.float32), rods()
    left = tune_repair(drawn(), odds, truth, (1, 1, 1))
    assert not left.helps and "p > 1/2" in left.status and "1.000" in left.status
    np.testing.assert_array_equal(left.repair(odds, (1, 1, 1)), odds)
    with pytest.raises(ValueError, match="both its parts"):
        tune_repair(drawn(), odds, np.zeros_like(truth), (1, 1, 1))
    with pytest.raises(ValueError, match="12 or more"):
        tune_repair(drawn(), odds[:3], truth[:3], (1, 1, 1))


def test_tuning_learns_a_network_s_habit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network that makes everything two voxels too thick: on the example's rest the tuned one undoes it."""
    monkeypatch.setattr(school, "TUNING", 40)
    truth = rods()
    level = pose(truth, np.where(truth, 1.0, -1.0))[1]
    found = tune_repair(Repairer.load(), np.asarray(level + 1.5, np.float32), truth, (1, 1, 1))
    assert found.helps and "tuned" in found.status
    assert dice(found.repair(level + 1.5, (1, 1, 1)) > 0, truth) > dice(level + 1.5 > 0, truth) + 0.1


# ---- maps ------------------------------------------------------------------------------------------------------------


def broken(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rods, and the probabilities of a network that breaks them, joins them and puts specks around them."""
    truth, random = rods(), np.random.default_rng(seed)
    noise = ndimage.gaussian_filter(random.standard_normal(truth.shape), 1.2)
    odds = damage(truth, random, replace(SOUND, share=1.0, number=10)) + 3 * noise / noise.std() * 0.5
    return truth, expit(odds).astype(np.float32)


def test_a_broken_mask_is_repaired() -> None:
    truth, p = broken()
    found = refine(p, repair=True)
    before, after = p > 0.5, found.mask.values
    assert dice(after, truth) > dice(before, truth) - 0.01
    errors = [
        sum(abs(a - b) for a, b in zip(betti_numbers(m), betti_numbers(truth), strict=True)) for m in (before, after)
    ]
    assert errors[1] < 0.3 * errors[0]
    likely = found.probability.values  # type: ignore[union-attr]
    assert after[likely > 0.5].all() and (likely[after] > 0.35 - 1e-6).all()  # what has the best expected Dice
    assert found.uncertainty.calibration_error < 0.2 and "repaired by the network" in found.status  # type: ignore[union-attr]


def test_a_repair_takes_an_example_or_nothing() -> None:
    truth, p = broken()
    for more in ({"weight": 1.0}, {"prior": "tubes"}):
        with pytest.raises(ScanError, match="repair"):
            refine(p, repair=True, **more)  # type: ignore[arg-type]
    with pytest.raises(ScanError, match="voxel"):
        refine(p, repair=True, example=(Field(p, (2, 2, 2), "um"), Field(truth, (2, 2, 2), "um")))


def test_the_command_repairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(school, "TUNING", 2)
    truth, p = broken()
    scan, other, mask, out = (tmp_path / f"{name}.nii.gz" for name in ("p", "p2", "mask2", "mask"))
    for path, values in ((scan, p), (other, broken(1)[1]), (mask, truth.astype(np.uint8))):
        save(Field(values, (0.5, 0.5, 0.5), "um"), path)
    result = call("refine", scan, "--repair", "-o", out)
    assert result.exit_code == 0, (result.output, result.exception)
    np.testing.assert_array_equal(
        load(out).values > 0, refine(Field(p, (0.5, 0.5, 0.5), "um"), repair=True).mask.values
    )
    record = json.loads((tmp_path / "mask.json").read_text())
    assert record["repair"] is True and record["calibration_error"] > 0 and "changed" in record["status"]
    assert load(tmp_path / "mask_probability.nii.gz").unit == "um" and (tmp_path / "mask.png").exists()
    pair = ("--example", mask, "--example-probabilities", other)
    result = call("refine", scan, "--repair", *pair, "-o", out)
    assert result.exit_code == 0 and "on a part of the example" in result.output
    refused(call("refine", scan, "--repair", "--weight", 3, "-o", tmp_path / "no.nii.gz"), "repair")
    refused(call("refine", scan, "--repair", "--tile", 64, "-o", tmp_path / "no.nii.gz"), "--tile")
    refused(call("refine", scan, "--repair", "--steps", 9, "-o", tmp_path / "no.nii.gz"), "--steps")
    refused(call("refine", scan, "--repairer", scan, "-o", tmp_path / "no.nii.gz"), "--repair")
    refused(call("refine", scan, "--repair", "--repairer", scan, "-o", tmp_path / "no.nii.gz"), "repairer")
    assert not (tmp_path / "no.nii.gz").exists()


def test_log_odds_are_read_as_their_probabilities() -> None:
    _, p = broken()
    odds = logit(p.astype(np.float64).clip(1e-4, 1 - 1e-4)).astype(np.float32)
    found = refine(odds, repair=True, logits=True)
    np.testing.assert_allclose(found.phase.values, refine(p, repair=True).phase.values, atol=2e-3)
    with pytest.raises(ScanError, match="probabilities"):
        refine(odds, repair=True)


def test_classes_become_labels(tmp_path: Path) -> None:
    """Two structures that exclude each other, and a class that nobody asked for."""
    _, p = broken()
    other = np.roll(p, 8, (0, 1, 2)) * (1 - p)
    left = np.clip(1 - p - other, 0, 1)
    np.savez_compressed(tmp_path / "case.npz", probabilities=np.stack([left, p, left, other]).astype(np.float16))
    found = repair_classes(tmp_path / "case.npz", [3, 1])
    alone = refine(tmp_path / "case.npz", repair=True, channel=1)
    assert found.labels is not None and set(np.unique(found.labels.values)) == {0, 1, 3}
    assert not (found.labels.values[~alone.mask.values] == 1).any()
    np.testing.assert_array_equal(found.mask.values, found.labels.values > 0)
    likely = found.probability.values  # type: ignore[union-attr]
    assert likely.min() >= 0.35 - 1e-6 and "class 3" in found.status and set(found.uncertainty.dice_of_labels) == {1, 3}  # type: ignore[union-attr]
    for wrong in ([], [0, 1], [1, 1], [1.5]):
        with pytest.raises(ValueError, match="classes"):
            repair_classes(tmp_path / "case.npz", wrong)  # type: ignore[arg-type]
    out = tmp_path / "labels.nii.gz"
    result = call("refine", tmp_path / "case.npz", "--repair", "--classes", "3,1", "-o", out)
    assert result.exit_code == 0, (result.output, result.exception)
    np.testing.assert_array_equal(load(out).values, found.labels.values)
    refused(call("refine", tmp_path / "case.npz", "--classes", "3,1", "-o", tmp_path / "no.tif"), "repair")
    refused(call("refine", tmp_path / "case.npz", "--repair", "--classes", "1,9", "-o", tmp_path / "no.tif"), "channel")
    assert not (tmp_path / "no.tif").exists()


def test_the_command_teaches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(school, "JUDGED", 2)
    save(Field(rods(32).astype(np.uint8)), tmp_path / "mask.npy")
    result = call("atlas", "teach", tmp_path / "mask.npy", "--repair", "--steps", 1, "-o", tmp_path / "repairer.npz")
    assert result.exit_code == 0, (result.output, result.exception)
    assert Repairer.load(tmp_path / "repairer.npz").card["steps"] == 1 and "damaged masks" in result.stderr
    assert not list(tmp_path.glob(".*"))
    refused(call("atlas", "teach", tmp_path / "mask.npy", "--repair", "--images", 2, "-o", tmp_path / "n.npz"), "both")


def test_a_chain_of_transforms_repairs() -> None:
    _, p = broken()
    found = Refine(repair=True, channel=0)(torch.from_numpy(p)[None])
    np.testing.assert_array_equal(found[0].numpy() > 0, refine(p, repair=True).mask.values)
    assert np.isfinite(logit(p.astype(float))).all()
