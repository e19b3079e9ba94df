"""What a program that calls curvafit may have set, and which call changes any of it.

This file, run as a program, makes every public call in a process that has done nothing yet, and prints what each of them
changed, by name. What a first call alone can change (threads, libraries that it imports) shows only there.
"""

from __future__ import annotations

import decimal
import faulthandler
import gc
import hashlib
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

#: Numbers of threads that are nobody's default.
TORCH_THREADS, NUMBA_THREADS = 2, 3


def snapshot() -> dict[str, str]:
    """Everything of the process that a library has no business with, as text."""
    parts = {"torch": _torch(), "numpy": _numpy(), "python": _python(), "process": _process(), "optional": _optional()}
    return {f"{part} {name}": repr(value) for part, found in parts.items() for name, value in found.items()}


def changes(before: dict[str, str], after: dict[str, str]) -> dict[str, list[str]]:
    """What differs, before and after; what a library that was not imported before brings with it is no difference."""
    return {name: [old, after[name]] for name, old in before.items() if after[name] != old and old != repr(_ABSENT)}


_ABSENT = "not imported"


def _torch() -> dict[str, Any]:
    with ThreadPoolExecutor(1) as elsewhere:
        in_a_new_thread = elsewhere.submit(torch.get_num_threads).result()
    return {
        "threads": torch.get_num_threads(),
        "threads in a new thread": in_a_new_thread,
        "threads between operations": torch.get_num_interop_threads(),
        "default type": torch.get_default_dtype(),
        "default device": torch.get_default_device(),
        "gradients": torch.is_grad_enabled(),
        "inference mode": torch.is_inference_mode_enabled(),
        "anomaly detection": torch.is_anomaly_enabled(),
        "autocast": torch.is_autocast_enabled(),
        "deterministic": torch.are_deterministic_algorithms_enabled(),
        "deterministic, warnings only": torch.is_deterministic_algorithms_warn_only_enabled(),
        "cudnn": (torch.backends.cudnn.enabled, torch.backends.cudnn.benchmark, torch.backends.cudnn.deterministic),
        "precision of products": torch.get_float32_matmul_precision(),
        "denormal numbers": float(torch.tensor(1e-40) / 2),
        "random": _digest(torch.get_rng_state().numpy().tobytes()),
    }


def _numpy() -> dict[str, Any]:
    return {
        "errors": (np.geterr(), np.geterrcall()),
        "printing": sorted(np.get_printoptions().items(), key=lambda item: item[0]),
        "random": _digest(repr(np.random.get_state())),  # noqa: NPY002
        "denormal numbers": float(np.float32(1e-40) / np.float32(2)),
    }


def _python() -> dict[str, Any]:
    root = logging.getLogger()
    return {
        "random": _digest(repr(random.getstate())),
        "warning filters": warnings.filters,
        "showing of warnings": warnings.showwarning,
        "logging": (root.level, root.handlers, root.filters, root.disabled, logging.root.manager.disable),
        "class of loggers": (logging.getLoggerClass(), logging.raiseExceptions, logging.getLogRecordFactory()),
        "search path": sys.path,
        "importers": (sys.meta_path[-3:], len(sys.path_hooks)),
        "streams": (sys.stdin, sys.stdout, sys.stderr),
        "hooks": (sys.excepthook, sys.displayhook, threading.excepthook, sys.unraisablehook, sys.gettrace()),
        "recursion": sys.getrecursionlimit(),
        "switch interval": sys.getswitchinterval(),
        "garbage": (gc.isenabled(), gc.get_threshold(), gc.get_debug()),
        "decimals": decimal.getcontext(),
        "temporary folder": tempfile.tempdir,
        "starting of processes": multiprocessing.get_start_method(allow_none=True),
        "fault handler": faulthandler.is_enabled(),
    }


def _process() -> dict[str, Any]:
    mask = os.umask(0)
    os.umask(mask)
    return {
        "environment": sorted(os.environ.items()),
        "folder": os.getcwd(),
        "file mode": mask,
        "locale": locale.setlocale(locale.LC_ALL),
        "signals": [signal.getsignal(number) for number in sorted(signal.valid_signals())],
        "Python threads": sorted(thread.name for thread in threading.enumerate()),
        "children": len(multiprocessing.active_children()),
    }


def _optional() -> dict[str, Any]:
    """Of libraries that the host may use too."""
    numba, jax, matplotlib = (sys.modules.get(name) for name in ("numba", "jax", "matplotlib"))
    return {
        "numba's threads": _ABSENT if numba is None else numba.get_num_threads(),
        "JAX's precision": _ABSENT if jax is None else jax.config.jax_enable_x64,
        "JAX's device": _ABSENT if jax is None else jax.config.jax_default_device,
        "matplotlib": _ABSENT if matplotlib is None else _digest(repr(sorted(matplotlib.rcParams.items()))),
        "pyplot": "matplotlib.pyplot" in sys.modules,
    }


def _digest(value: str | bytes) -> str:
    return hashlib.sha256(value.encode() if isinstance(value, str) else value).hexdigest()[:12]


def calls(folder: Path) -> dict[str, Callable[[], object]]:
    """Every public name at work, by name; small."""
    import curvafit
    from curvafit import priors

    shape = (24, 24, 24)
    noise = torch.rand((1, 1, *shape), generator=torch.Generator().manual_seed(0))
    memory: dict[str, Any] = {}

    def grid():
        return priors.Grid(shape)

    def ball():
        z, y, x = np.mgrid[:24, :24, :24] - 11.5
        return z**2 + y**2 + x**2 < 49

    def trained(loss) -> None:
        value = noise.clone().requires_grad_()
        loss(value, noise.round()).backward()

    def generated() -> None:
        memory["flow"] = curvafit.generate("tubes", grid=shape, seed=1)

    def drawn() -> None:
        memory["diagram"] = curvafit.diagram(memory["flow"].field, memory["flow"].grid, 0.02)

    def descended() -> None:
        a = curvafit.preset("tubes").coefficients
        for flow, optimiser in (("l2", "lbfgs"), ("h-1", "adam")):
            curvafit.descend(memory["flow"].field, a, memory["flow"].grid, flow=flow, optimiser=optimiser, steps=2)

    def saved() -> None:
        for name in ("a.nii.gz", "a.tif", "a.npy", "a.mha", "a.zarr", "a.nrrd"):
            curvafit.save(curvafit.Field(ball().astype(np.uint8), (2.0, 1.0, 1.0), "um"), folder / name)

    def inferred() -> None:
        values = memory["flow"].field.numpy()
        found = curvafit.infer(curvafit.Field(values), kind="field", periodic=True)
        (folder / "fit.json").write_text(found.fit.to_json())

    def pictured() -> None:
        from curvafit import plot

        plot.png(plot.diagram_figure(memory["diagram"]))
        plot.png(plot.surface_figure(memory["flow"].field.numpy(), width=32))

    names: dict[str, Callable[[], object]] = {
        "Coefficients": lambda: curvafit.Coefficients(1, 2, 6).in_unit(2.0),
        "Grid": lambda: curvafit.Grid(8).volume,
        "__version__": lambda: curvafit.__version__,
        "preset": lambda: curvafit.preset("tubes"),
        "energy": lambda: priors.energy(noise[0], curvafit.preset("tubes").coefficients, grid(), 0.02),
        "energy_terms": lambda: priors.energy_terms(priors.jet(noise[0, 0], grid()), 0.02),
        "jet": lambda: priors.jet(noise[0, 0], grid()),
        "diffuse_curvatures": lambda: priors.diffuse_curvatures(priors.jet(noise[0, 0], grid()), 0.02),
        "geometric_curvatures": lambda: priors.geometric_curvatures(priors.jet(noise[0, 0], grid())),
        "cahn_hilliard_area": lambda: priors.cahn_hilliard_area(noise[0, 0], grid(), 0.02),
        "discrepancy_ratio": lambda: priors.discrepancy_ratio(noise[0, 0], grid(), 0.02),
        "orientation": lambda: priors.orientation((1, 0, 0), 2.0),
        "optimal_profile": lambda: priors.optimal_profile(noise, 0.02),
        "profile_distance": lambda: priors.profile_distance(noise, 0.02),
        "signed_distance": lambda: priors.signed_distance(torch.from_numpy(ball()), grid()),
        "phase_field": lambda: priors.phase_field(torch.from_numpy(ball()), grid(), 0.02),
        "curvature_prior": lambda: priors.curvature_prior(noise[0], priors.Coefficients(1, 1, 1), (1.0,) * 3, 2.0),
        "CurvaturePrior": lambda: trained(priors.CurvaturePrior("tubes", blur=1.0, normalize="area")),
        "CombinedLoss": lambda: trained(
            priors.CombinedLoss(torch.nn.functional.mse_loss, priors.CurvaturePrior("tubes"), 0.1, warmup=2)
        ),
        "generate": generated,
        "generate_batch": lambda: list(
            curvafit.generate_batch(curvafit.preset("tubes").coefficients, -0.4, curvafit.Grid(12), seeds=[1, 2])
        ),
        "descend": descended,
        "diagram": drawn,
        "Diagram": lambda: curvafit.Diagram(np.zeros((1, 2)), np.ones(1)),
        "wasserstein": lambda: curvafit.wasserstein(memory["diagram"], memory["diagram"]),
        "Field": lambda: curvafit.Field(ball()),
        "save": saved,
        "load": lambda: [curvafit.load(path) for path in sorted(folder.glob("a.*"))],
        "segment": lambda: curvafit.segment(curvafit.Field(200 * ball() + 1.0), "tubes", threshold=100.0, steps=2),
        "reconstruct": lambda: curvafit.reconstruct(curvafit.Field(ball().astype(np.uint8)), "tubes", every=4, steps=2),
        "infer": inferred,
        "read_fit": lambda: priors.read_fit(folder / "fit.json"),
        "plot": pictured,
    }
    return names


def main() -> None:
    """What each call changed, or how it failed, as JSON."""
    torch.set_num_threads(TORCH_THREADS)
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
