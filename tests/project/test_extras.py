"""Without the extras: what the core installs works, and what needs more says which line to type."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.golden import FOLDER
from tests.golden.rows import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
EXTRAS = "jax jaxlib optimistix equinox zuko geomloss dask distributed sklearn plotly pandas nrrd aiohttp"

SCRIPT = f"""
import json, os, shutil, sys
from importlib.machinery import PathFinder
HIDDEN = set("{EXTRAS}".split())
class Without(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in HIDDEN else super().find_spec(name, path, target)
sys.meta_path[:] = [finder for finder in sys.meta_path if finder is not PathFinder] + [Without]
import curvafit
from typer.testing import CliRunner
from curvafit.cli.app import app

answers = {{}}
for name, line in json.loads(sys.stdin.read()).items():
    shutil.copytree({str(FOLDER)!r}, name)
    os.chdir(name)
    before = set(os.listdir())
    result = CliRunner().invoke(app, line.split())
    answers[name] = [result.exit_code, result.output, sorted(set(os.listdir()) - before)]
    os.chdir("..")
try:
    curvafit.infer("mask/mask.nii.gz", growth=None)
except ImportError as error:
    answers["python"] = [2, str(error), []]
print(json.dumps(answers))
"""
#: The extra that a command asks for; the others need none.
NEEDED = dict.fromkeys(("infer-fast", "infer-match", "python", "demo"), "infer") | {"workers": "synth", "map": "atlas"}
NEEDED |= {"remote": "remote"}
NEEDED |= dict.fromkeys(("reconstruct-image", "reconstruct-cells"), "image")
#: A command of each room that needs none.
PLAIN = ("measure-mask", "compare", "generate-mesh", "segment", "reconstruct", "synth", "atlas-info")
MORE = {
    "mask": "measure mask.nii.gz",
    "workers": "synth -o out --preset tubes --modality micro-ct --count 1 --shape 16",
    "map": "atlas map store -o out",
    "demo": "demo -o out",
    "remote": "measure https://example.org/scan.zarr",
}


@pytest.mark.slow
def test_a_command_works_without_extras_or_names_the_one_to_install(tmp_path: Path) -> None:
    command, env = [sys.executable, "-W", "ignore", "-c", SCRIPT], os.environ | {"PYTHONPATH": str(ROOT)}
    lines = json.dumps({name: COMMANDS[name] for name in (*NEEDED, *PLAIN) if name in COMMANDS} | MORE)
    done = subprocess.run(command, cwd=tmp_path, env=env, input=lines, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for name, (code, said, new) in json.loads(done.stdout.splitlines()[-1]).items():
        asked = f'pip install "curvafit[{NEEDED.get(name)}]"' in said
        assert (code == 2 and asked and not new) if name in NEEDED else code == 0, (name, said)
