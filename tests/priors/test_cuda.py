"""The device's kernels: in Triton's interpreter against the definition, compiled for a device that need not be there,
and, where there is one, against the processor and themselves."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import device
import pytest
import torch
from device import ADAM_EPS, BETAS, CHECKS, EPSILON, NUMBERS, close, noise
from torch import Tensor

from curvafit.priors.grid import Grid
from curvafit.priors.kernels import cuda

ROOT = Path(__file__).resolve().parents[2]
needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="needs triton, which comes with torch's CUDA wheels"
)
needs_device = pytest.mark.skipif(not cuda.available("cuda"), reason="needs triton and an NVIDIA device")


# ---- against the definition ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def interpreted() -> dict[str, str]:
    """What went wrong in each check, in a process whose Triton interprets."""
    variables = {"TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error", device.__file__]
    done = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@needs_triton
@pytest.mark.parametrize("name", CHECKS)
@pytest.mark.slow
def test_interpreted_kernels_are_the_definition(name: str, interpreted: dict[str, str]) -> None:
    if "only 0-dimensional arrays can be converted" in interpreted[name]:
        pytest.skip("needs a triton whose interpreter knows this NumPy")
    assert interpreted[name] == ""


# ---- compiled, without a device --------------------------------------------------------------------------------------


@needs_triton
@pytest.mark.slow
@pytest.mark.parametrize(
    ("boundary", "observe", "held", "width"), [("periodic", False, False, 4), ("replicate", True, True, 1)]
)
def test_kernels_compile_without_spilling(boundary, observe, held, width, tmp_path, monkeypatch) -> None:
    """For compute capability 9.0; a narrow blur and few outputs a thread, so as to be quick."""
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    grid = Grid((8, 8, 8), boundary=boundary)
    frozen = torch.zeros(grid.shape, dtype=torch.bool) if held else None
    for usage in compiled(grid, 0.0025, cuda.Tuning(1, 1, width=width), observe, frozen):
        assert usage["STACK"] == usage["LOCAL"] == 0, usage


@needs_triton
@pytest.mark.slow
@pytest.mark.long
def test_kernels_compile_without_spilling_as_they_run(tmp_path, monkeypatch) -> None:
    """The published blur, and the outputs a thread that 100 cells a row get."""
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    for usage in compiled(Grid((4, 4, 100)), 0.02, cuda.Tuning(), False, None):
        assert usage["STACK"] == usage["LOCAL"] == 0, usage


def compiled(grid: Grid, width: float, tuning: cuda.Tuning, observe: bool, frozen) -> list[dict]:
    """What each kernel of a step uses: registers, stack, shared and local bytes."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from curvafit.priors.kernels import passes

    tools = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"
    dump = shutil.which("cuobjdump") or str(tools / "cuobjdump")
    if not (tools / "ptxas").exists() or not Path(dump).exists():
        pytest.skip("needs ptxas and cuobjdump, which come with triton on Linux")
    flow = cuda.CudaFlow(
        torch.zeros(3, *grid.shape), -0.6, NUMBERS[0], grid, EPSILON, width, frozen,
        betas=BETAS, adam_eps=ADAM_EPS, device="cpu", tuning=tuning,
    )  # fmt: skip
    found = []
    for launch in {launch.kernel: launch for launch in flow.launches(True, observe)}.values():
        kernel = getattr(passes, launch.kernel)
        types = {name: kind(value) for name, value in launch.arguments.items()} | dict.fromkeys(
            launch.constants, "constexpr"
        )
        aligned = [k for k, name in enumerate(kernel.arg_names) if types[name].startswith("*")]
        source = ASTSource(
            kernel,
            {name: types[name] for name in kernel.arg_names},
            constexprs=dict(launch.constants),
            attrs={(k,): [["tt.divisibility", 16]] for k in aligned},
        )
        options = {"num_warps": launch.lanes // 32, "num_stages": 1, "enable_fp_fusion": True}
        binary = triton.compile(source, target=GPUTarget("cuda", 90, 32), options=options).asm["cubin"]
        with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
            file.write(binary)
            file.flush()
            text = subprocess.run([dump, "-res-usage", file.name], capture_output=True, text=True, check=True).stdout
        numbers = {key: int(value) for key, value in re.findall(r"(REG|STACK|SHARED|LOCAL):(\d+)", text)}
        found.append({"kernel": launch.kernel, **numbers})
    return found


def kind(value) -> str:
    """An argument's type, as Triton names it."""
    if isinstance(value, Tensor):
        return {torch.float32: "*fp32", torch.int32: "*i32", torch.int8: "*i8"}[value.dtype]
    return "fp32" if isinstance(value, float) else "i32"


# ---- without Triton --------------------------------------------------------------------------------------------------


def test_there_is_no_device_on_the_processor() -> None:
    assert not cuda.available("cpu")


def test_the_module_needs_no_triton() -> None:
    script = "import sys; sys.modules['triton'] = None; from curvafit.priors.kernels import cuda; print('ok')"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "ok", done.stderr


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": torch.zeros(2, 8, 8, 8)}, "expected a start of shape (3, 8, 8, 8)"),
        ({"base": torch.zeros(3)}, "expected a mass of shape (1,)"),
        ({"base": torch.zeros(8, 8, 9)}, "expected a base of shape (1, 8, 8, 8)"),
        ({"frozen": torch.zeros(8, 8)[None, :, 1:]}, "expected a frozen mask of shape (8, 8, 8)"),
        ({"orientation": torch.ones(3, 3).triu()}, "expected a symmetric orientation"),
        ({"width": 0.2}, "expected a blur of at most 16 voxels"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict, message: str) -> None:
    arguments = {"start": torch.zeros(3, 8, 8, 8), "base": -0.6, "a": NUMBERS[0], "grid": Grid((8, 8, 8))}
    arguments |= {"epsilon": EPSILON, "width": 0.02, "betas": BETAS, "adam_eps": ADAM_EPS, "device": "cpu"}
    with pytest.raises(ValueError, match=re.escape(message)):
        cuda.CudaFlow(**(arguments | change))


# ---- on a device -----------------------------------------------------------------------------------------------------


@needs_device
@pytest.mark.parametrize("name", CHECKS)
def test_kernels_on_a_device_are_the_definition(name: str) -> None:
    check, tuning = CHECKS[name]
    check("cuda", tuning)


def device_flow(size: int, batch: int, boundary="periodic") -> cuda.CudaFlow:
    grid = Grid((size - 2, size + 1, size), boundary=boundary)
    start = 0.01 * noise(batch, 3, *grid.shape)
    return cuda.CudaFlow(start, -0.6, NUMBERS[0], grid, EPSILON, 0.02, betas=BETAS, adam_eps=ADAM_EPS)


@needs_device
@pytest.mark.parametrize("size", [37, 64, 100])
def test_a_run_repeats_bit_for_bit(size: int) -> None:
    """In graphs of ten steps, step by step, and from a saved state."""
    rates = [1e-3 * (1 + 0.1 * k) for k in range(35)]
    recorded, single = device_flow(size, 1), device_flow(size, 1)
    for flow in (recorded, single):
        flow.shift(0, 0.01)
    recorded.run(rates[:12])
    saved = recorded.state()
    recorded.run(rates[12:], observe=True)
    for rate in rates:
        single.run([rate])
    assert torch.equal(recorded.vector, single.vector)
    again = recorded.vector.clone()
    recorded.restore(saved)
    recorded.run(rates[12:], observe=True)
    assert torch.equal(recorded.vector, again)


@needs_device
def test_shapes_of_a_batch_do_not_meet() -> None:
    many = device_flow(40, 3)
    starts = many.vector.clone()
    many.run([1e-3] * 20)
    for start, end in zip(starts, many.vector, strict=True):
        one = device_flow(40, 1)
        one.vector.copy_(start[None])
        one.run([1e-3] * 20)
        assert torch.equal(one.vector[0], end)


@needs_device
@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
def test_the_device_follows_the_processor(boundary: str) -> None:
    cpu = pytest.importorskip("curvafit.priors.kernels.cpu")
    flow = device_flow(48, 1, boundary)
    start, a = flow.vector[0].cpu().numpy(), [float(v) for v in NUMBERS[0]]
    processor = cpu.FusedFlow(start, -0.6, a, flow.grid, EPSILON, 0.02, betas=BETAS, adam_eps=ADAM_EPS)
    for _ in range(20):
        processor.evaluate()
        processor.update(2e-3)
    value = processor.evaluate()
    flow.run([2e-3] * 20)
    assert float(flow.observe().energy) == pytest.approx(value, rel=1e-3)
    close(flow.field[0], torch.from_numpy(processor.field.copy()).double(), 1e-4, 2e-2)
