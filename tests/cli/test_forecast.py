"""What a long command says beforehand of its time and memory."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import numba
import numpy as np
import pytest
from calling import call, refused

from curvafit.cli.workers import Crew
from curvafit.volumes import save

forecast = import_module("curvafit.cli.forecast")


def test_a_forecast_counts_steps_voxels_and_workers(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(forecast, "step_time", lambda device: 1e-8)
    cost = forecast.Cost(0.5e9, 100)
    forecast.say_forecast("infer", (100, 100, 100), 20_000, cost, what="working voxels")
    said = capsys.readouterr().err.strip()
    assert said == "infer: 100 x 100 x 100 working voxels, about 2 to 7 min and 0.60 GB on this machine"
    forecast.say_forecast("synth", (100, 100, 100), 20_000, cost, workers=4)
    assert "about 40 to 100 s and 2.4 GB" in capsys.readouterr().err
    forecast.say_forecast("generate", (10, 10, 10), 1000, cost)
    assert capsys.readouterr().err == ""  # it is done before it could be said


def test_a_step_is_timed_on_this_machine() -> None:
    assert 0 < forecast.step_time() < 1


def test_segment_says_it_before_it_flows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecast, "SHORT", 0)
    monkeypatch.setattr(forecast, "step_time", lambda device: 1e-8)
    scan = np.random.default_rng(0).normal(0, 0.2, (8, 9, 10)).astype(np.float32)
    scan[:4] += 1
    path = save(scan, tmp_path / "scan.npy")
    result = call("segment", path, "--prior", "tubes", "--steps", 3, "-o", tmp_path / "mask.npy")
    assert result.exit_code == 0, (result.output, result.exception)
    line = r"^segment: 8 x 9 x 10 working voxels, about 1 to 2 s and 0\.60 GB on this machine$"
    assert re.search(line, result.stderr, re.MULTILINE)


def test_generate_says_it_once_and_not_where_it_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecast, "SHORT", 0)
    monkeypatch.setattr(forecast, "step_time", lambda device: 1e-8)
    some = ("generate", "--preset", "tubes", "--shape", 12, "--steps", 3, "-o", tmp_path / "out.npy")
    assert call(*some).stderr.count("generate: 12 x 12 x 12 voxels, about") == 1
    assert "about" not in call(*some, "--epsilon", "7").stderr


def test_synth_refuses_a_folder_with_other_things_before_it_forecasts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forecast, "SHORT", 0)
    monkeypatch.setattr(forecast, "step_time", lambda device: 1e-8)
    (tmp_path / "notes.txt").write_text("mine")
    some = ("synth", "--preset", "tubes", "--modality", "confocal", "--shape", 8, "--count", 1, "--workers", 0)
    result = call(*some, "-o", tmp_path)
    refused(result, "expected a new or empty folder, or a set to go on with")
    assert "about" not in result.stderr


def test_workers_on_this_machine_share_the_flows(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """Each has one thread, on which the step is timed; those of a scheduler are unknown."""
    threads = []
    monkeypatch.setattr(forecast, "step_time", lambda device: threads.append(numba.get_num_threads()) or 1e-8)
    before = numba.get_num_threads()
    Crew(4, None, None).say_forecast("synth", (100, 100, 100), 20_000)
    assert "synth: 100 x 100 x 100 voxels a shape, about 40 to 100 s and 1.9 GB" in capsys.readouterr().err
    assert threads == [1] and numba.get_num_threads() == before
    Crew(None, "tcp://there:1", None).say_forecast("synth", (100, 100, 100), 20_000)
    assert capsys.readouterr().err == "" and threads == [1]
