"""Lessons cut from shapes, learning that a stop does not change, and what an example adds."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scripts import example

import curvafit.segmentation.teach as room
from curvafit.data_synth.atlas import build
from curvafit.generation.schedule import schedule
from curvafit.segmentation.filler import FAR, Filler, Taught
from curvafit.segmentation.teach import Whole, WholeLessons, learn
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import save

script = example("teach")
Mix, Texture, Lessons, KINDS = script.Mix, script.Texture, script.Lessons, script.KINDS
#: Windows along the axes of a shape, as it is.
EXACT = Mix(upright=1, stretch=0, coarse=0, ends=0, pairs=0, holes=0, trembling=0, partial=0)


def rods(n: int = 24) -> np.ndarray:
    """Rods along all three axes that repeat, as a phase field."""
    wave = np.cos(2 * np.pi * np.arange(n) / 12)
    z, y, x = wave[:, None, None], wave[:, None], wave
    return np.tanh(3 * np.maximum(np.maximum(z + y, z + x), y + x) - 4).astype(np.float32)


TEXTURE = Texture(rods())


def lessons(mix=EXACT, length: int = 6, **sizes: int):
    return Lessons([[TEXTURE]], mix, 0, length, **{"size": 2, "edge": 16, "halo": 4, **sizes})


def test_a_lesson_depends_on_its_number_alone_and_is_what_the_network_reads() -> None:
    one, other = lessons(Mix()), lessons(Mix(), length=99)
    for number in (5, 0, 3):
        assert all(np.array_equal(a, b) for a, b in zip(one[number], other[number], strict=True))
    assert not np.array_equal(one[0][0], replace(one, seed=1)[0][0])
    for number in range(6):
        distances, steps, marks, evidence, truth = lessons(Mix())[number]
        assert evidence is None
        count = truth.shape[1]
        assert distances.shape == (2, 4, 24, 24) and steps.shape == (2,) and marks.shape == truth.shape
        assert np.abs(distances).max() <= FAR and set(np.unique(truth)) <= {0, 1}
        assert (steps * (count + 1) <= Mix().gap[1] + 1e-5).all() and count <= Mix().most
        assert np.array_equal(marks[marks != 0] > 0, truth[marks != 0] > 0)


def test_a_shape_that_goes_on_unchanged_is_shown_unchanged() -> None:
    """A prism along z, cut across z alone: all known slices and those to fill are one."""
    plane = np.hypot(*(np.mgrid[:24, :24] - 11.5)) < 5
    prism = Texture(np.broadcast_to(np.where(plane, 1.0, -1.0), (24, 24, 24)).astype(np.float32))
    straight = Lessons([[prism]], replace(EXACT, thickness=(7.0, 7.0)), 0, 40, 1, 16, 4)
    found = 0
    for number in range(40):
        distances, _, _, _, truth = straight[number]
        if all(np.array_equal(distances[0, 0], each) for each in distances[0]):
            found += 1
            assert all(np.array_equal(each, distances[0, 0] > 0) for each in truth[0])
    assert found > 5


def test_a_texture_repeats_where_it_is_told_to() -> None:
    points = np.array([[3.2, 27.2, -20.8], [1.0, 1.0, 1.0], [5.5, 5.5, 29.5]])
    values = TEXTURE.read(points)
    assert values[0] == pytest.approx(values[1], abs=1e-5)
    assert values[0] == pytest.approx(float(TEXTURE.read(points[:, 2:] - [[0], [0], [24]])[0]), abs=1e-5)


def test_lessons_of_a_whole_volume_are_its_own_slices_with_their_evidence() -> None:
    z, y, x = np.mgrid[:25, :20, :20]
    distances = (4 - np.hypot(y - 10, x - 5 - z / 4)).astype(np.float32)
    for number in range(5):
        known, steps, marks, evidence, truth = WholeLessons([Whole(distances, 6, 1.5)], 5, size=2)[number]
        assert evidence is None and np.isin(known, distances).all()
        assert known.shape[:2] == (2, 4) and 4 <= truth.shape[1] <= 6 and (steps == 1.5).all() and not marks.any()
        known, _, _, evidence, truth = WholeLessons([Whole(distances, 6, 1.5, distances)], 5)[number]
        assert evidence is not None
        assert truth.shape[1] == 5 and ((evidence > 0) == truth).all() and np.isin(known, distances[::6]).all()


def test_a_run_that_was_stopped_ends_as_one_that_was_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "SAVED", 2)
    checkpoint = tmp_path / "steps"

    def small() -> Filler:
        with torch.random.fork_rng():
            torch.manual_seed(0)
            return Filler(4)

    def stop(text: str, share: float) -> None:
        if share > 0.6:
            raise KeyboardInterrupt

    whole, parts = small(), small()
    losses = learn(whole, lessons(), 1e-3, workers=0)
    with pytest.raises(KeyboardInterrupt):
        learn(small(), lessons(), 1e-3, checkpoint=checkpoint, workers=0, progress=stop)
    assert learn(parts, lessons(), 1e-3, checkpoint=checkpoint, workers=0) == losses
    assert all(torch.equal(a, b) for a, b in zip(whole.parameters(), parts.parameters(), strict=True))


@pytest.mark.slow
def test_teaching_lowers_the_loss_of_shapes_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "JUDGED", 6)
    turned = [Texture(np.roll(rods(), k, 0)) for k in range(4)]
    taught = script.teach([turned], {"sources": []}, steps=35, workers=0, mix=replace(EXACT, gap=(2.0, 8.0), most=6))
    card = json.loads(json.dumps(taught.card))
    assert card["held_out_loss"] < 0.9 * card["held_out_cubic"] and 0 <= taught.error < 0.2
    assert (card["shapes"], card["held_out"], card["steps"]) == (3, 1, 35)
    assert taught.temperatures.shape == (2, script.TEMPERATURES) and (np.diff(taught.temperatures[0]) >= 0).all()


def test_stores_masks_and_textures_teach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "TEXTURES", 2)
    build(tmp_path / "store", 2, (16, 16, 16), 0, schedule("fast", 300))
    save(Volume((rods() > 0).astype(np.uint8)), tmp_path / "mask.npy")
    sources, card = script.load_textures([tmp_path / "store", tmp_path / "mask.npy", "mixed"])
    assert [source[-1].periodic for source in sources] == [True, False, *[True] * len(KINDS)]
    assert [each["source"] for each in card["sources"]] == ["store", "mask.npy", *KINDS]
    assert card["sources"][0]["shapes"] == len(sources[0]) >= 1 and "design" in card["sources"][0]
    nearly = np.zeros((8, 8, 8), np.uint8)
    nearly[4, 4, 4] = 1
    np.save(tmp_path / "nearly.npy", nearly)
    with pytest.raises(ValueError, match="no shape"):
        script.load_textures([tmp_path / "nearly.npy"])


@pytest.mark.slow
def test_the_script_teaches_and_refuses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(script, "JUDGED", 5)
    save(Volume((rods() > 0).astype(np.uint8)), tmp_path / "mask.npy")
    target, new = tmp_path / "filler.npz", tmp_path / "new.npz"

    def run(source: str, out: Path, *options: object) -> None:
        monkeypatch.setattr(sys, "argv", ["teach.py", str(tmp_path / source), "-o", str(out), *map(str, options)])
        script.main()

    run("mask.npy", target, "--steps", 2)
    assert "200" in capsys.readouterr().err and Taught.load(target).card["steps"] == 2
    assert not list(tmp_path.glob(".*"))
    bad = {
        "filler.txt": ("mask.npy", ()),
        "none": ("none", ()),
        "mask.npy": ("mask.npy", ("--filler", tmp_path / "mask.npy")),
    }
    for word, (source, options) in bad.items():
        with pytest.raises(SystemExit, match="2"):
            run(source, tmp_path / word if word.endswith("txt") else new, *options)
        assert word in (said := capsys.readouterr().err) and said.count("error") == 1
    assert not new.exists()
    run("mask.npy", new, "--steps", 2, "--filler", target)
    assert Taught.load(new).card["first"] == Taught.load(target).card
