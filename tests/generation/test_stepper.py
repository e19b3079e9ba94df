"""The step in plain torch, for any device: nothing is read from the device, and a compiler may fail."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from kernel_cases import BLUR, EPSILON, TUBES

from curvafit.generation.flow import generate
from curvafit.generation.forms import DivergenceForm
from curvafit.generation.schedule import Schedule
from curvafit.generation.stepper import TorchStepper
from curvafit.priors.grid import Grid

ROOT = Path(__file__).resolve().parents[2]
PLAN = Schedule("test", 30, 1e-2, 1e-3, "cosine")


def test_the_step_and_its_run_read_nothing_from_the_device() -> None:
    """On the device "meta" nothing can be read: a step that waits for a number fails there."""
    grid = Grid((8, 9, 10))
    stepper = TorchStepper(
        torch.zeros(2, 3, *grid.shape), DivergenceForm(grid, BLUR, -0.6), TUBES, EPSILON, (0.9, 0.999), None, "meta",
        count=2,
    )  # fmt: skip
    stepper.run([1e-3, 2e-3])
    assert stepper.state()["parameters"].shape == (2, 3, *grid.shape)


def test_a_compiler_that_fails_warns_once(monkeypatch) -> None:
    def no_compiler(function):
        raise RuntimeError("no compiler is found")

    monkeypatch.setattr(torch, "compile", no_compiler)
    grid = Grid((8, 9, 10))
    with pytest.warns(UserWarning, match="compile") as caught:
        flow = generate(TUBES, -0.6, grid, schedule=PLAN, backend="compiled")
    assert len(caught) == 1
    plain = generate(TUBES, -0.6, grid, schedule=PLAN, backend="torch")
    torch.testing.assert_close(flow.field, plain.field, rtol=1e-4, atol=1e-4)


#: Two steps, plain and traced as `torch.compile` does but without a C++ compiler's minute, in an interpreter without
#: the tests' checks of shapes, which cannot be traced.
COMPILED = """
import functools
import torch
torch.compile = functools.partial(torch.compile, backend="aot_eager")
from curvafit.generation import Schedule, generate
plan, ends = Schedule("test", 2, 1e-3, 1e-3, "constant"), []
for backend in ("torch", "compiled"):
    ends.append(generate("tubes", grid=(8, 9, 10), schedule=plan, backend=backend).field)
torch.testing.assert_close(ends[1], ends[0], rtol=1e-4, atol=1e-4)
print("alike")
"""


@pytest.mark.slow
def test_the_compiled_step_is_the_plain_one() -> None:
    command = [sys.executable, "-W", "error:torch.compile failed", "-c", COMPILED]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.stdout.strip() == "alike", found.stderr
