"""Without the extras: what the core installs works, and what needs more says which line to type."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXTRAS = "jax jaxlib optimistix equinox zuko geomloss kornia dask distributed networkx sklearn plotly pandas pyarrow"

SCRIPT = f"""
import json, sys
from importlib.machinery import PathFinder
HIDDEN = set("{EXTRAS}".split())
class Without(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in HIDDEN else super().find_spec(name, path, target)
sys.meta_path[:] = [finder for finder in sys.meta_path if finder is not PathFinder] + [Without]
import numpy as np
import curvafit
from typer.testing import CliRunner
from curvafit.cli.app import app

z, y, x = np.indices((32, 24, 24))
tubes = ((y % 12 - 6) ** 2 + (x % 12 - 6) ** 2 < 12) | ((z % 16 - 8) ** 2 + (y % 12 - 6) ** 2 < 12)
curvafit.save(tubes.astype(np.uint8), "mask.nii.gz")
answers = {{"core": {{}}, "missing": {{}}}}
answers["core"]["fraction"] = curvafit.measure("mask.nii.gz")["BV/TV"].value
filled = curvafit.reconstruct("mask.nii.gz", "tubes", every=4, stiffness=1e7, steps=5).mask.values
answers["core"]["reconstruct"] = bool((filled[::4] == tubes[::4]).all())
generate = "generate --preset tubes --shape 24 --steps 30 -o made.nii.gz --no-picture"
for words in ("measure mask.nii.gz", "presets", generate):
    result = CliRunner().invoke(app, words.split())
    answers["core"][words.split()[0]] = [result.exit_code, repr(result.exception)]
synth = "synth -o set --preset tubes --modality micro-ct --count 1 --shape 16"
for words in ("infer mask.nii.gz -o out --fast", synth):
    result = CliRunner().invoke(app, words.split())
    answers["missing"][words.split()[0]] = [result.exit_code, result.stderr]
try:
    curvafit.infer("mask.nii.gz", fast=True)
except ImportError as error:
    answers["missing"]["python"] = [2, str(error)]
print(json.dumps(answers))
"""


@pytest.mark.slow
def test_the_core_works_without_extras_and_names_the_one_to_install(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SCRIPT],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    answers = json.loads(done.stdout.splitlines()[-1])
    core = answers["core"]
    assert 0.1 < core.pop("fraction") < 0.9 and core.pop("reconstruct") is True
    assert core == {name: [0, "None"] for name in ("measure", "presets", "generate")}
    assert set(answers["missing"]) == {"infer", "synth", "python"}
    for name, (code, said) in answers["missing"].items():
        extra = "synth" if name == "synth" else "infer"
        assert code == 2 and f'pip install "curvafit[{extra}]"' in said, (name, said)
    assert not (tmp_path / "out").exists()
