"""Cases that were wrong once: small doors."""

import csv
import logging
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import curvafit
from curvafit.core.runtime import log_stages
from curvafit.scan.measure import COLUMNS
from curvafit.studies.tables import format_csv


def refuse_inputs_before_libraries(folder: Path) -> None:
    """The command ends before torch is imported."""
    code = "import sys\nfrom curvafit.cli.app import app\ntry:\n    app(sys.argv[1:])\n"
    code += "except SystemExit as end:\n    print(end.code, 'torch' in sys.modules)"
    for words, sentence in (
        ("measure typo.tif", "no such file: typo.tif"),
        ("reconstruct typo.h5::a -o a.tif", "no such file: typo.h5"),
        ("generate --preset tubez -o a.tif", "takes a preset among"),
        ("synth --presets tubes,spunge --modality confocal -o set", "got 'spunge'"),
    ):
        run = subprocess.run([sys.executable, "-c", code, *words.split()], cwd=folder, capture_output=True, text=True)
        assert run.stdout.split() == ["2", "False"] and sentence in run.stderr, run


def keep_formulas_out_of_a_spreadsheet(folder: Path) -> None:
    odd = {"=1+1": "@SUM(A1)", "b": "-x", "c": "+1.5", "d": "-0.5 0.1 -1e-05", "e": -2.5, "f": "-1+cmd|' /C calc'!A0"}
    head, row = csv.reader(format_csv([odd]).splitlines())
    assert head[:2] == ["'=1+1", "b"]
    assert row == ["'@SUM(A1)", "'-x", "+1.5", "-0.5 0.1 -1e-05", "-2.5", "'-1+cmd|' /C calc'!A0"]


def show_measures_in_a_notebook(folder: Path) -> None:
    """A table of all numbers, of each compartment; a data frame with the columns of a file; a figure."""
    phase = np.indices((32, 32, 32)).sum(0) % 16 < 8
    halves = np.ones(phase.shape, np.uint8)
    halves[16:] = 2
    whole, parted = curvafit.measure(phase), curvafit.measure(phase, roi=halves)
    for found, columns in ((whole, 1), (parted, 2)):
        table = found._repr_html_()
        assert all(each.symbol in table for each in found.quantities)
        assert table.count("<td>") == (len(found.quantities) + 1) * (3 + columns)
        assert len(found.plot().axes) >= columns
        frame = found.to_frame()
        assert tuple(frame)[: len(COLUMNS)] == COLUMNS and len(frame) == columns * len(found.quantities)


def log_the_stages_of_an_inference(folder: Path) -> None:
    records: list[logging.LogRecord] = []
    logger, handler = logging.getLogger("curvafit"), logging.Handler(logging.INFO)
    handler.emit = records.append  # type: ignore[method-assign, assignment]
    logger.addHandler(handler)
    level = logger.level
    logger.setLevel(logging.INFO)
    try:
        curvafit.infer(np.indices((48, 48, 48)).sum(0) % 16 < 5, fast=True)  # layers are told that they have no law
        log = log_stages()
        for share in (0.5, 0.6):
            log(f"shape {share}", share)
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
    said = [record.getMessage() for record in records]
    assert said == ["reading the scan (0 % done)", "measuring curvature (5 % done)", "shape 0.5 (50 % done)"]


CASES: dict[str, Callable[[Path], None]] = {
    "eng-12-missing-inputs": refuse_inputs_before_libraries,
    "eng-12-formulas": keep_formulas_out_of_a_spreadsheet,
    "eng-12-measures": show_measures_in_a_notebook,
    "infer-is-silent": log_the_stages_of_an_inference,
}


@pytest.mark.parametrize("case", CASES)
def test_handed(case, tmp_path):
    CASES[case](tmp_path)
