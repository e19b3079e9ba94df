"""Jobs beside what one would run instead: seconds, processor time and memory, in one run, by turns.

Each side of a job is a program of its own: it gets the input's file, makes one small call, then the one that is timed.
The sides take turns, and the least of the rounds counts. `--python PATH` is an interpreter that has the peers
(`PEERS`); a side whose packages it lacks is left out. What they find is printed too: how far thicknesses are from the
truth is asked of exact bodies by `python -m benchmarks phantoms`, how well slices are filled by `… completion`.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from benchmarks.completion import EDGE, shape
from benchmarks.harness import Cases, Figure, Values, run_python, show

#: What the peers' environment has.
PEERS = (
    "localthickness porespy bone-microarchitecture pykarambola POT geomloss monai topolosses torchio sbi "
    "itk-morphologicalcontourinterpolation"
)
PROGRAM = """
import json, os, sys, time, warnings
from resource import RUSAGE_SELF, getrusage
import numpy as np
warnings.simplefilter("ignore")
given = np.load(sys.argv[1])
os.chdir(os.path.dirname(sys.argv[1]))  # some peers write logs where they run
SETUP
begun, used = time.perf_counter(), time.process_time()
found = JOB
seconds, processor = time.perf_counter() - begun, time.process_time() - used
memory = getrusage(RUSAGE_SELF).ru_maxrss * 1024 / 1e9
print()
print(json.dumps({"seconds": seconds, "processor": processor, "memory": memory, "found": [float(x) for x in found]}))
"""


class Side(NamedTuple):
    """A program: what goes before, and the expression that is timed; whether it is ours; the greatest size."""

    setup: str
    job: str
    ours: bool = False
    most: float = math.inf


class Job(NamedTuple):
    """A job at some sizes: how its input is made, and who does it."""

    sizes: tuple[int, ...]
    make: Callable[[int, Cases], dict[str, np.ndarray]]
    sides: dict[str, Side]


# ---- inputs ----------------------------------------------------------------------------------------------------------


def tubes(edge: int, cases: Cases) -> dict[str, np.ndarray]:
    """Return a mask of the edge, of a repeated shape."""
    times = math.ceil(edge / EDGE)
    return {"mask": np.tile(shape("tubes", 0, cases), (times,) * 3)[:edge, :edge, :edge]}


def diagrams(count: int, cases: Cases) -> dict[str, np.ndarray]:
    """Return so many normal clouds of 300 points (κ1, κ2), of weight 1."""
    random = np.random.default_rng(0)
    points = random.normal(
        random.uniform(-40, 40, (count, 1, 2)), random.uniform(5, 20, (count, 1, 2)), (count, 300, 2)
    )
    return {"points": points, "weights": np.full((count, 300), 1 / 300)}


def logits(edge: int, cases: Cases) -> dict[str, np.ndarray]:
    """Return logits of a noisy segmentation and its labels."""
    mask = tubes(edge, cases)["mask"]
    noise = np.random.default_rng(0).standard_normal(mask.shape)
    values = 8 * ndimage.gaussian_filter(mask.astype(np.float32), 1.0) - 4 + noise
    return {"logits": values.astype(np.float32)[None, None], "mask": mask.astype(np.float32)[None, None]}


# ---- programs --------------------------------------------------------------------------------------------------------

_NUMBERS = """
from skimage.measure import euler_number, marching_cubes, mesh_surface_area
def measure(mask):
    numbers = [2 * local_thickness(phase)[phase].mean() for phase in (mask, ~mask)]
    vertices, faces, _, _ = marching_cubes(mask.astype(np.float32), 0.5)
    return [*numbers, mesh_surface_area(vertices, faces) / mask.sum(), euler_number(mask)]
mask = given["mask"]
measure(mask[:40, :40, :40])
"""
_BONE = """
from bone_microarchitecture import hildebrand_thickness_map
def local_thickness(phase):
    return hildebrand_thickness_map(phase, (1, 1, 1), backend="cpu") / 2
"""
#: Volume, surface and Euler number of one mesh, with the tensors of its curvature; no thickness.
_KARAMBOLA = """
from pykarambola import minkowski_tensors_from_label_image
def measure(mask):
    found = minkowski_tensors_from_label_image(mask.astype(np.int32))[1]
    return [3 * found["w100"] / found["w000"], found["w300"] / (4 * np.pi / 3)]
mask = given["mask"]
measure(mask[:40, :40, :40])
"""
_OUR_NUMBERS = """
from curvafit import measure
mask = given["mask"]
measure(mask[:40, :40, :40])
def numbers():
    found = measure(mask)
    return [found[name].value for name in ("Tb.Th", "Tb.Sp", "BS/BV", "χ")]
"""
_PAIRS = """
import itertools
points, weights = given["points"], given["weights"]
pairs = list(itertools.combinations(range(len(points)), 2))
"""
_MEAN = "[sum(one(i, j) for i, j in pairs) / len(pairs)]"
_POT = (
    "import ot\ndef one(i, j):\n    return ot.emd2(weights[i], weights[j], ot.dist(points[i], points[j]) / 2) ** 0.5\n"
)
_GEOMLOSS = """
import torch
from geomloss import SamplesLoss
loss = SamplesLoss("sinkhorn", p=2, blur=1.0, reach=20.0)
clouds = [torch.tensor(cloud) for cloud in points]
def one(i, j):
    return loss(torch.tensor(weights[i]), clouds[i], torch.tensor(weights[j]), clouds[j]) ** 0.5
"""
_OUR_PAIRS = """
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.distances import pairwise
diagrams = [Diagram(p, w) for p, w in zip(given["points"], given["weights"])]
pairwise(diagrams[:3])
"""
_LOSS = """
import torch
x, y = (torch.from_numpy(given[name]) for name in ("logits", "mask"))
def both_ways(x, y):
    leaf = x.detach().requires_grad_()
    value = loss(leaf, y)
    value.backward()
    return [value.detach()]
def warm():
    both_ways(x[..., :24, :24, :24], y[..., :24, :24, :24])
"""
_IMAGE = """
import torchio as tio
ways = [tio.RandomBlur((1, 1)), tio.RandomAnisotropy(downsampling=2), tio.RandomBiasField(), tio.RandomNoise()]
chain = tio.Compose(ways)
import torch
volume = torch.from_numpy(given["mask"].astype(np.float32))[None]
chain(volume[:, :32, :32, :32])
"""
_OUR_IMAGE = """
import torch
from curvafit.data_synth.imaging.modality import image, modality
field = 2 * torch.from_numpy(given["mask"].astype(np.float32)) - 1
imaging = modality("confocal").draw(0)
image(field[:32, :32, :32], 0.1, imaging, 0)
"""
_SBI = """
import torch
from sbi.inference import NPE
from torch.distributions import Independent, Uniform
random = torch.Generator().manual_seed(0)
torch.manual_seed(0)
prior = Independent(Uniform(-3 * torch.ones(7), 3 * torch.ones(7)), 1)
theta = prior.sample((400,))
inference = NPE(prior, density_estimator="nsf").append_simulations(theta, theta + torch.randn(400, 7))
inference.train(max_num_epochs=3)
posterior, seen = inference.build_posterior(), torch.zeros(7)
posterior.sample((10,), x=seen, show_progress_bars=False)
count = len(given["count"])
"""
_OUR_DRAWS = """
from curvafit.inference.posterior import load_posterior
from curvafit.scan.measures import read_texture
from curvafit.scan.preparation import prepare
from curvafit.volumes.volume import Volume
seen, posterior = read_texture(prepare(Volume(given["mask"]))), load_posterior()
posterior.draw(seen, 10)
count = len(given["count"])
"""
_SLICES = """
truth = given["mask"]
def dice(mask):
    return [2 * (mask & truth).sum() / (mask.sum() + truth.sum())]
"""
_ITK = """
import itk
def fill(truth):
    labels = np.zeros(truth.shape, np.uint8)
    labels[::8] = truth[::8]
    interpolator = itk.MorphologicalContourInterpolator.New(itk.image_from_array(labels))
    interpolator.SetAxis(2)
    interpolator.Update()
    return itk.array_from_image(interpolator.GetOutput()) > 0
fill(truth[:17, :32, :32])
"""
_SPLINE = """
from scipy.interpolate import CubicSpline
from scipy.ndimage import distance_transform_edt
def fill(truth):
    known = range(0, len(truth), 8)
    levels = [distance_transform_edt(truth[z]) - distance_transform_edt(~truth[z]) for z in known]
    return CubicSpline(list(known), levels, axis=0)(np.arange(len(truth))) > 0
fill(truth[:17, :32, :32])
"""
_OUR_FILLING = """
from curvafit import Volume, reconstruct
def fill(truth):
    return reconstruct(Volume(truth.astype(np.uint8)), every=8).mask.values > 0
fill(truth[:33, :32, :32])
"""


def counted(count: int, cases: Cases) -> dict[str, np.ndarray]:
    """Return a mask, and an array as long as a count."""
    return {"mask": shape("tubes", 0, cases), "count": np.zeros(count, bool)}


JOBS = {
    "measure": Job(
        (64, 128, 160, 256),
        tubes,
        {
            "curvafit": Side(_OUR_NUMBERS, "numbers()", True),
            "localthickness": Side("from localthickness import local_thickness\n" + _NUMBERS, "measure(mask)"),
            "porespy": Side("from porespy.filters import local_thickness\n" + _NUMBERS, "measure(mask)"),
            "bone-microarchitecture": Side(_BONE + _NUMBERS, "measure(mask)", most=128),
            "pykarambola": Side(_KARAMBOLA, "measure(mask)"),
        },
    ),
    "distances": Job(
        (10, 30, 100),
        diagrams,
        {
            "curvafit": Side(_OUR_PAIRS, "[pairwise(diagrams)[np.triu_indices(len(diagrams), 1)].mean()]", True),
            "POT": Side(_PAIRS + _POT + "one(0, 1)\n", _MEAN),
            "geomloss": Side(_PAIRS + _GEOMLOSS + "one(0, 1)\n", _MEAN, most=30),
        },
    ),
    "loss": Job(
        (48, 64, 96),
        logits,
        {
            "curvafit": Side(
                "from curvafit.priors import CurvaturePrior\nloss = CurvaturePrior('tubes', sigmoid=True)\n"
                + _LOSS
                + "warm()\n",
                "both_ways(x, y)",
                True,
            ),
            "clDice": Side(
                "from monai.losses import SoftclDiceLoss\ncl = SoftclDiceLoss(iter_=3)\n"
                "loss = lambda x, y: cl(y, x.sigmoid())\n" + _LOSS + "warm()\n",
                "both_ways(x, y)",
            ),
            "Betti matching": Side(
                "from topolosses.losses import BettiMatchingLoss\n"
                "loss = BettiMatchingLoss(sigmoid=True, use_base_loss=False)\n" + _LOSS + "warm()\n",
                "both_ways(x, y)",
                most=64,
            ),
        },
    ),
    "filling": Job(
        (64, 128, 192),
        tubes,
        {
            "curvafit": Side(_SLICES + _OUR_FILLING, "dice(fill(truth))", True),
            "ITK": Side(_SLICES + _ITK, "dice(fill(truth))"),
            "spline": Side(_SLICES + _SPLINE, "dice(fill(truth))"),
        },
    ),
    "image": Job(
        (64, 128, 192),
        tubes,
        {
            "curvafit": Side(_OUR_IMAGE, "[image(field, 0.1, imaging, 0).mean()]", True),
            "TorchIO": Side(_IMAGE, "[chain(volume).mean()]"),
        },
    ),
    "draws": Job(
        (1000, 10_000, 100_000),
        counted,
        {
            "curvafit": Side(_OUR_DRAWS, "[posterior.draw(seen, count).mean()]", True),
            "sbi": Side(_SBI, "[posterior.sample((count,), x=seen, show_progress_bars=False).mean()]"),
        },
    ),
}  # fmt: skip


def timed(job: Job, size: int, rounds: int, python: Path, cases: Cases) -> Values:
    """Return what each side took and found, of the round in which it took least; empty where no round went well."""
    path = cases.folder / "input.npz"
    np.savez(path, **job.make(size, cases))  # type: ignore[arg-type]
    sides = {name: side for name, side in job.sides.items() if size <= side.most}
    found: dict[str, list[Values]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, side in sides.items():
            program = PROGRAM.replace("SETUP", side.setup).replace("JOB", side.job)
            try:
                said = run_python("-c", program, path, python=sys.executable if side.ours else python)
            except SystemExit as error:
                if side.ours:
                    raise
                print(f"  {name}: {str(error).strip().splitlines()[-1]}")  # packages are missing, or it crashed
                continue
            found[name].append(json.loads(said.strip().splitlines()[-1]))
    return {name: min(values, key=lambda each: each["seconds"]) if values else {} for name, values in found.items()}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--python", type=Path, default=Path(sys.executable), help=f"an interpreter that has {PEERS}")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--jobs", default=",".join(JOBS))


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    figures, rows = {}, []
    names = options.jobs.split(",")[:1] if options.quick else options.jobs.split(",")
    chosen = {
        f"{name}-{size}": (JOBS[name], size)
        for name in names
        for size in JOBS[name].sizes[: 1 if options.quick else None]
    }
    found = cases.all({
        case: partial(timed, job, size, options.rounds, options.python, cases) for case, (job, size) in chosen.items()
    })  # fmt: skip
    for case, sides in found.items():
        ours = sides["curvafit"]
        for side, values in sides.items():
            if not values:
                continue
            ratio = {key: values[key] / ours[key] for key in ("seconds", "processor", "memory")}
            numbers = [*(values[key] for key in ratio), *ratio.values()]
            rows.append([case, side, *(f"{n:.3g}" for n in numbers), " ".join(f"{n:.4g}" for n in values["found"])])
            figures |= {f"peers.{case}.{side.replace(' ', '_')}.{key}": Figure(times) for key, times in ratio.items()}
    show(["case", "side", "s", "processor s", "GB", "× s", "× processor", "× GB", "found"], rows)
    return figures
