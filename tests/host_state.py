"""What a program that calls curvafit may have set, and which call changes any of it.

This file, run as a program, makes every public call in a process that has done nothing yet, and prints what each call
changed, by name. What a first call alone can change, as numbers of threads, shows only there.
"""

from __future__ import annotations

import contextlib
import decimal
import faulthandler
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
#: Libraries that set warning filters and names in the environment where they are imported: a program has them already.
#: Not JAX, whose import is known to draw random numbers; the names that it sets are these. Zarr's threads stay its own.
_LIBRARIES = ("numba", "scipy.sparse", "scipy.special", "zarr", "nibabel", "torch._dynamo")
_OF_ZARR = "zarr_io", "asyncio_"
_OF_JAX = ("TF_CPP_MIN_LOG_LEVEL", "TPU_SKIP_MDS_QUERY")


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
        "environment": {name: value for name, value in sorted(os.environ.items()) if name not in _OF_JAX},
        "folder": os.getcwd(),
        "file mode": mask,
        "locale": locale.setlocale(locale.LC_ALL),
        "signals": [signal.getsignal(number) for number in sorted(signal.valid_signals())],
        "Python threads": sorted(
            thread.name for thread in threading.enumerate() if not thread.name.startswith(_OF_ZARR)
        ),
        "children": len(multiprocessing.active_children()),
    }


def _optional() -> dict[str, Any]:
    """Of libraries that the host may use too."""
    numba, jax, matplotlib = (sys.modules.get(name) for name in ("numba", "jax", "matplotlib"))
    started = getattr(sys.modules.get("numba.np.ufunc.parallel"), "_is_initialized", False)  # asking would start them
    return {
        "numba's threads": _ABSENT if numba is None or not started else numba.get_num_threads(),
        "JAX's precision": _ABSENT if jax is None else jax.config.jax_enable_x64,
        "JAX's device": _ABSENT if jax is None else jax.config.jax_default_device,
        "matplotlib": _ABSENT if matplotlib is None else _digest(repr(sorted(dict.items(matplotlib.rcParams)))),
        "pyplot": "matplotlib.pyplot" in sys.modules,
    }


def _digest(value: str | bytes) -> str:
    return hashlib.sha256(value.encode() if isinstance(value, str) else value).hexdigest()[:12]


class Calls:
    """Every public name at work, small; later calls take what earlier ones left."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.grid = folder, priors.Grid((24, 24, 24))
        self.noise = torch.rand((1, 1, 24, 24, 24), generator=torch.Generator().manual_seed(0))
        z, y, x = np.mgrid[:24, :24, :24] - 11.5
        self.ball = z**2 + y**2 + x**2 < 49
        self.a = priors.preset("tubes").coefficients

    def of_fields(self) -> dict[str, Callable[[], object]]:
        """The score's functions."""
        u, grid, a, mask = self.noise[0, 0], self.grid, self.a, torch.from_numpy(self.ball)
        return {
            "Coefficients": lambda: curvafit.Coefficients(1, 2, 6).in_unit(2.0),
            "Grid": lambda: curvafit.Grid((8, 8, 8)).volume,
            "__version__": lambda: curvafit.__version__,
            "preset": lambda: curvafit.preset("tubes"),
            "energy": lambda: priors.energy(u, a, grid, 0.02),
            "energy_gradient": lambda: priors.energy_gradient(u, self.a, grid, 0.02),
            "energy_terms": lambda: priors.energy_terms(priors.jet(u, grid), 0.02),
            "jet": lambda: priors.jet(u, grid),
            "diffuse_curvatures": lambda: priors.diffuse_curvatures(priors.jet(u, grid), 0.02),
            "geometric_curvatures": lambda: priors.geometric_curvatures(priors.jet(u, grid)),
            "cahn_hilliard_area": lambda: priors.cahn_hilliard_area(u, grid, 0.02),
            "discrepancy_ratio": lambda: priors.discrepancy_ratio(u, grid, 0.02),
            "orientation": lambda: priors.orientation((1, 0, 0), 2.0),
            "optimal_profile": lambda: priors.optimal_profile(u, 0.02),
            "profile_distance": lambda: priors.profile_distance(u, 0.02),
            "signed_distance": lambda: priors.signed_distance(mask, grid),
            "phase_field": lambda: priors.phase_field(mask, grid, 0.02),
        }

    def of_losses(self) -> dict[str, Callable[[], object]]:
        """The score as a loss: the first fused call."""
        mse = torch.nn.functional.mse_loss
        return {
            "curvature_prior": lambda: priors.curvature_prior(self.noise[0], self.a, (0.01, 0.01, 0.01), 0.02),
            "CurvaturePrior": lambda: self._train(priors.CurvaturePrior("tubes")),
            "CombinedLoss": lambda: self._train(priors.CombinedLoss(mse, priors.CurvaturePrior("tubes"), 0.1, 2)),
        }

    def of_shapes(self) -> dict[str, Callable[[], object]]:
        """Making and measuring."""
        return {
            "generate": self._generate,
            "generate_batch": lambda: list(
                curvafit.generate_batch(self.a, -0.4, priors.Grid((12, 12, 12)), seeds=[1, 2])
            ),
            "descend": self._descend,
            "diagram": self._diagram,
            "Diagram": lambda: curvafit.Diagram(np.zeros((1, 2)), np.ones(1)),
            "wasserstein": lambda: curvafit.wasserstein(self.diagram, self.diagram),
            "plot": self._plot,
        }

    def of_scans(self) -> dict[str, Callable[[], object]]:
        """Volumes, files and what is inferred from them."""
        scan, slices = curvafit.Field(200 * self.ball + 1.0), curvafit.Field(self.ball.astype(np.uint8))
        return {
            "Field": lambda: curvafit.Field(self.ball),
            "save": self._save,
            "load": lambda: [curvafit.load(path) for path in sorted(self.folder.glob("a.*"))],
            "segment": lambda: curvafit.segment(scan, "tubes", threshold=100.0, steps=2),
            "reconstruct": lambda: curvafit.reconstruct(slices, "tubes", every=4, steps=2),
            "refine": lambda: curvafit.refine(0.1 + 0.8 * self.ball, "tubes", weight=1.0, steps=2),
            "infer": self._infer,
            "measure": lambda: curvafit.measure(self.ball.astype(np.uint8)),
            "measure_instances": lambda: curvafit.measure_instances(self.ball.astype(np.uint8)),
            "windows": lambda: curvafit.windows((np.indices((24, 24, 36))[2] % 12 < 6).astype(np.uint8), 24, 12),
            "compare": lambda: curvafit.compare(*[[np.roll(self.ball, k, 0).astype(np.uint8) for k in (0, 1)]] * 2),
            "read_laws": lambda: priors.read_laws(["tubes", self.a, self.folder / "fit.json"]),
        }

    def _train(self, loss) -> None:
        value = self.noise.clone().requires_grad_()
        loss(value, self.noise.round()).backward()

    def _generate(self) -> None:
        self.flow = curvafit.generate("tubes", grid=(24, 24, 24), seed=1)

    def _descend(self) -> None:
        curvafit.descend(self.flow.field, self.a, self.flow.grid, flow="l2", optimiser="lbfgs", steps=2)
        curvafit.descend(self.flow.field, self.a, self.flow.grid, flow="h-1", optimiser="adam", steps=2)

    def _diagram(self) -> None:
        self.diagram = curvafit.diagram(self.flow.field, self.flow.grid, 0.02)

    def _plot(self) -> None:
        from curvafit.drawing import plot

        plot.png(plot.diagram_figure(self.diagram))
        plot.png(plot.surface_figure(self.flow.field.numpy(), width=32))

    def _save(self) -> None:
        for name in ("a.nii.gz", "a.tif", "a.ome.tif", "a.npy", "a.mrc", "a.zarr"):
            curvafit.save(curvafit.Field(self.ball.astype(np.uint8), (2.0, 1.0, 1.0), "um"), self.folder / name)

    def _infer(self) -> None:
        few = {"simulations": 4, "rounds": 1, "twins": 2}
        found = curvafit.infer(curvafit.Field(self.flow.field.numpy()), kind="field", periodic=True, **few)
        (self.folder / "fit.json").write_text(found.fit.to_json())


def calls(folder: Path) -> dict[str, Callable[[], object]]:
    """Every public call by name, in the order to make them."""
    made = Calls(folder)
    return {**made.of_fields(), **made.of_losses(), **made.of_shapes(), **made.of_scans()}


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
