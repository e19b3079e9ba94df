"""What a program that calls curvafit may have set, and which call changes any of it.

This file, run as a program, makes the calls in a process that has done nothing yet, and prints what each one changed,
by name. What a first call alone can change, as numbers of threads, shows only there.
"""

import contextlib
import decimal
import gc
import hashlib
import importlib
import json
import locale
import logging
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch

import curvafit
from curvafit import priors
from curvafit.generation.schedule import schedule
from curvafit.inference import Growth
from curvafit.segmentation import Working

#: Numbers of threads that are nobody's default.
TORCH_THREADS, NUMBA_THREADS = 2, 3
_ABSENT = "not imported"
#: Libraries that set warning filters and names in the environment where they are imported: a program has them already.
#: Not JAX, whose import is known to draw random numbers; the names that it sets are these. Zarr's threads stay its own.
_LIBRARIES = ("numba", "scipy.sparse", "scipy.special", "zarr", "nibabel", "torch._dynamo")
_OF_ZARR = "zarr_io", "asyncio_"
_OF_JAX = ("TF_CPP_MIN_LOG_LEVEL", "TPU_SKIP_MDS_QUERY")


def snapshot() -> dict[str, str]:
    """Everything of the process that a library has no business with, as text."""
    with ThreadPoolExecutor(1) as elsewhere:
        in_a_new_thread = elsewhere.submit(torch.get_num_threads).result()
    backend, root, mask = torch.backends.cudnn, logging.getLogger(), os.umask(0)
    os.umask(mask)
    names = sorted(each.name for each in threading.enumerate())
    numba, jax, matplotlib = (sys.modules.get(name) for name in ("numba", "jax", "matplotlib"))
    started = getattr(sys.modules.get("numba.np.ufunc.parallel"), "_is_initialized", False)  # asking would start them
    found = {
        "torch threads": (torch.get_num_threads(), in_a_new_thread, torch.get_num_interop_threads()),
        "torch defaults": (torch.get_default_dtype(), torch.get_default_device(), torch.get_float32_matmul_precision()),
        "torch gradients": torch.is_grad_enabled(),
        "torch modes": (torch.is_inference_mode_enabled(), torch.is_anomaly_enabled(), torch.is_autocast_enabled()),
        "torch deterministic": torch.get_deterministic_debug_mode(),
        "torch cudnn": (backend.enabled, backend.benchmark, backend.deterministic),
        "torch denormal numbers": float(torch.tensor(1e-40) / 2),
        "torch random": _digest(torch.get_rng_state().numpy().tobytes()),
        "numpy errors": (np.geterr(), np.geterrcall()),
        "numpy printing": sorted(np.get_printoptions().items(), key=lambda item: item[0]),
        "numpy random": _digest(repr(np.random.get_state())),  # noqa: NPY002
        "numpy denormal numbers": float(np.float32(1e-40) / np.float32(2)),
        "python random": _digest(repr(random.getstate())),
        "python warnings": (warnings.filters, warnings.showwarning),
        "python logging": (root.level, root.handlers, root.filters, root.disabled, logging.root.manager.disable),
        "python loggers": (logging.getLoggerClass(), logging.raiseExceptions, logging.getLogRecordFactory()),
        "python imports": (sys.path, sys.meta_path[-3:], len(sys.path_hooks)),
        "python streams": (sys.stdin, sys.stdout, sys.stderr),
        "python hooks": (sys.excepthook, sys.displayhook, threading.excepthook, sys.unraisablehook, sys.gettrace()),
        "python limits": (sys.getrecursionlimit(), sys.getswitchinterval(), decimal.getcontext()),
        "python garbage": (gc.isenabled(), gc.get_threshold(), gc.get_debug()),
        "python temporary folder": tempfile.tempdir,
        "python starting of processes": multiprocessing.get_start_method(allow_none=True),
        "process environment": {name: value for name, value in sorted(os.environ.items()) if name not in _OF_JAX},
        "process folder": os.getcwd(),
        "process file mode": mask,
        "process locale": locale.setlocale(locale.LC_ALL),
        "process signals": [signal.getsignal(number) for number in sorted(signal.valid_signals())],
        "process Python threads": [name for name in names if not name.startswith(_OF_ZARR)],
        "process children": len(multiprocessing.active_children()),
        # of libraries that the host may use too
        "optional numba's threads": _ABSENT if numba is None or not started else numba.get_num_threads(),
        "optional JAX": _ABSENT if jax is None else (jax.config.jax_enable_x64, jax.config.jax_default_device),
        "optional matplotlib": (matplotlib and _digest(repr(sorted(dict.items(matplotlib.rcParams))))) or _ABSENT,
        "optional pyplot": "matplotlib.pyplot" in sys.modules,
    }
    return {name: repr(value) for name, value in found.items()}


def changes(before: dict[str, str], after: dict[str, str]) -> dict[str, list[str]]:
    """What differs, before and after; what a library that was not imported before brings with it is no difference."""
    return {name: [old, after[name]] for name, old in before.items() if after[name] != old and old != repr(_ABSENT)}


def _digest(value: str | bytes) -> str:
    return hashlib.sha256(value.encode() if isinstance(value, str) else value).hexdigest()[:12]


def calls(folder: Path) -> dict[str, Callable[[], object]]:
    """The public calls that start threads, draw or write, by name, in the order to make them; some take what earlier
    ones left in `kept`."""
    grid, law, brief = priors.Grid((24, 24, 24)), priors.preset("tubes").coefficients, schedule("fast", 50)
    noise = torch.rand((1, 1, 24, 24, 24), generator=torch.Generator().manual_seed(0))
    mse = torch.nn.functional.mse_loss
    z, y, x = np.mgrid[:24, :24, :24] - 11.5
    ball = (z**2 + y**2 + x**2 < 49).astype(np.uint8)
    kept = {}

    def keep(name: str, value: Any) -> None:
        kept[name] = value

    def train(loss: Any) -> None:
        value = noise.clone().requires_grad_()
        loss(value, noise.round()).backward()

    def descend(method: Any) -> object:
        return curvafit.descend(kept["flow"].field, law, grid, method=method, steps=2)

    def plot() -> None:
        from curvafit.drawing import plot

        plot.png(plot.diagram_figure(curvafit.diagram(kept["flow"].field, grid, 0.02)))
        plot.png(plot.surface_figure(kept["flow"].field.numpy(), width=32))

    def infer() -> None:
        few = Growth(twins=1, schedule=brief)
        found = curvafit.infer(curvafit.Volume(kept["flow"].field.numpy()), kind="field", periodic=True, growth=few)
        (folder / "fit.json").write_text(found.fit.to_json())

    scan, slices, files = curvafit.Volume(200.0 * ball + 1), curvafit.Volume(ball), ("a.nii.gz", "a.tif", "a.ome.tif")
    sized = curvafit.Volume(ball, (2.0, 1.0, 1.0), "um")
    return {
        "CurvaturePrior": lambda: train(priors.CurvaturePrior("tubes")),
        "CombinedLoss": lambda: train(priors.CombinedLoss(mse, priors.CurvaturePrior("tubes"), 0.1, 2)),
        "curvature_prior": lambda: priors.curvature_prior(noise[0], law, (0.01, 0.01, 0.01), 0.02),
        "generate": lambda: keep("flow", curvafit.generate("tubes", grid=grid, seed=1)),
        "descend": lambda: (descend("lbfgs"), descend("adam")),
        "plot": plot,
        "save": lambda: [curvafit.save(sized, folder / name) for name in (*files, "a.npy", "a.mrc", "a.zarr")],
        "load": lambda: [curvafit.load(path) for path in sorted(folder.glob("a.*"))],
        "segment": lambda: curvafit.segment(scan, "tubes", threshold=100.0, working=Working(steps=2)),
        "reconstruct": lambda: curvafit.reconstruct(slices, "tubes", every=4, working=Working(steps=2)),
        "infer": infer,
        "measure": lambda: (curvafit.measure(ball), curvafit.measure_instances(ball)),
        "compare": lambda: curvafit.compare(*[[np.roll(ball, k, 0) for k in (0, 1)]] * 2),
    }


def main() -> None:
    """What each call changed, or how it failed, as JSON."""
    torch.set_num_threads(TORCH_THREADS)
    for name in _LIBRARIES:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, call in calls(Path(folder)).items():
            before = snapshot()
            try:
                call()
            except Exception:
                found[name] = {"failed": traceback.format_exc()}
            else:
                found[name] = changes(before, snapshot())
    print(json.dumps(found))


if __name__ == "__main__":
    main()
