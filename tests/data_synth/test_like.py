"""Parameters found again in images that were made from them, with the true mask and without; real scans where there
are some."""

from pathlib import Path

import numpy as np
import pytest
import torch
from exact import Cylinder, centres

from curvafit.data_synth.imaging.effects import EPSILON
from curvafit.data_synth.imaging.like import fit_modality
from curvafit.data_synth.imaging.modality import Contrast, Detector, Imaging, Noise, Optics, image, regrid
from curvafit.priors import Grid, optimal_profile
from curvafit.volumes import Volume, load

pytestmark = pytest.mark.slow

N = 72
TUBES = [
    Cylinder(5.0, (0.2, 1, 0.3), (18, 36, 20)), Cylinder(6.0, (1, 0.1, 0.4), (36, 50, 52)),
    Cylinder(4.5, (0.5, 0.4, 1), (54, 18, 36)),
]  # fmt: skip

PHOTONS = Imaging(
    contrast=Contrast(6, 60), optics=Optics((1.6, 0.9, 0.9)), noise=Noise(2), detector=Detector(3, 15, ceiling=4095)
)
SLICES = Imaging(
    spacing=(2, 1, 1), contrast=Contrast(40, 160), optics=Optics((2, 1.2, 1.2)), noise=Noise(12, width=(0, 0.7, 0.7))
)
UNEVEN = Contrast(60, 180, 0.15, 5, 0.2, 8)
TEXTURED = Imaging(contrast=UNEVEN, optics=Optics((1.2,) * 3), noise=Noise(8), detector=Detector(ceiling=255))
DARK = Imaging(contrast=Contrast(150, 60), optics=Optics(blur=(1.0, 1.0, 1.0)), noise=Noise(gaussian=5))
CASES = {"photons": PHOTONS, "slices": SLICES, "textured": TEXTURED, "dark": DARK}


@pytest.fixture(scope="module")
def shape() -> torch.Tensor:
    points = centres(Grid((N, N, N), (1.0, 1.0, 1.0)))
    distance = torch.stack([tube.distance(points) for tube in TUBES]).amax(0)
    return optimal_profile(distance, EPSILON).float()


def scan_of(shape: torch.Tensor, how: Imaging) -> tuple[Volume, np.ndarray]:
    values = image(shape, 1.0, how, 3).numpy()
    return Volume(values, how.spacing, "um"), regrid(shape, 1.0, how).numpy() > 0


@pytest.mark.parametrize(
    ("name", "masked"), [*((name, True) for name in CASES), *((name, False) for name in CASES if name != "dark")]
)
def test_parameters_are_found_again(shape: torch.Tensor, name: str, masked: bool) -> None:
    """With the mask, blur and levels to a tenth; without it they carry the error of the mask's edges."""
    how = CASES[name]
    scan, mask = scan_of(shape, how)
    found = fit_modality(scan, mask if masked else None)
    b, close = found.base, 0.12 if masked else 0.25
    assert (b.unit, b.spacing, found.voxel) == ("um", how.spacing, 1.0)
    assert b.optics.blur == pytest.approx(how.optics.blur, rel=close)
    unit, true = b.detector.gain or 1.0, how.detector.gain or 1.0
    level = b.contrast.background * unit + b.detector.offset
    assert level == pytest.approx(how.contrast.background * true + how.detector.offset, rel=0.06)
    contrast = (b.contrast.foreground - b.contrast.background) * unit
    assert contrast == pytest.approx((how.contrast.foreground - how.contrast.background) * true, rel=close)
    assert b.noise.width == pytest.approx(how.noise.width, abs=0.1)
    assert b.detector.ceiling is None
    if masked:  # the line of variance over mean: its slope, and its height at the background
        assert b.detector.gain == pytest.approx(how.detector.gain, rel=0.1, abs=0)
        heights = [one.detector.gain**2 * one.contrast.background + one.noise.gaussian**2 for one in (b, how)]
        assert heights[0] == pytest.approx(heights[1], rel=0.1)
    if (name, masked) == ("slices", True):
        small = fit_modality(Volume(scan.values, (2000.0, 1000.0, 1000.0), "nm"), mask).base
        assert small.optics.blur == pytest.approx(tuple(1000 * width for width in b.optics.blur))
        assert small.noise.gaussian == pytest.approx(b.noise.gaussian)


def test_textures_are_found_again(shape: torch.Tensor) -> None:
    b = fit_modality(*scan_of(shape, TEXTURED)).base
    assert b.contrast.background_texture == pytest.approx(0.15, rel=0.3)
    assert b.contrast.background_length == pytest.approx(5, rel=0.35)
    assert b.contrast.foreground_texture == pytest.approx(0.2, rel=0.6)
    assert b.contrast.foreground_length == pytest.approx(8, rel=0.6)
    scan, mask = scan_of(shape, TEXTURED)  # a scan with lost stain, which does not decide the texture
    scan.values[mask & (np.random.default_rng(0).random(mask.shape) < 0.03)] = scan.values[~mask].mean()
    assert fit_modality(scan, mask).base.contrast.foreground_texture < 0.5
    plain = fit_modality(*scan_of(shape, PHOTONS)).base
    assert plain.contrast.background_texture < 0.08 and plain.contrast.foreground_texture < 0.1


def test_odd_scans(shape: torch.Tensor) -> None:
    """Values below 0, a background of one value or next to no photons, light on dark 0: an estimate, or a sentence."""
    mask = regrid(shape, 1.0, Imaging()).numpy() > 0
    rng = np.random.default_rng(0)
    signed = np.where(mask, 500, -500) + rng.normal(0, 40, mask.shape)
    low = fit_modality(Volume(signed.astype(np.int16), (1.0, 1.0, 1.0), "um"), mask)
    assert low.base.detector.ceiling is None
    assert image(shape, 1.0, low.base, 0).amin() < -300
    few, light = rng.poisson(0.02 + 3.0 * mask), rng.normal(0, 10, mask.shape) + 100 * mask
    for values in (np.where(mask, 80.0, 0.0), few, light):
        found = fit_modality(Volume(values.astype(np.float32), (1.0, 1.0, 1.0), "um"), mask)
        assert 0 <= found.base.illumination.bias <= 0.9 and np.isfinite(found.base.detector.gain)
    small = fit_modality(Volume(signed[:40, :14, :40].astype(np.float32), (1.0, 1.0, 1.0), "um"), mask[:40, :14, :40])
    assert small.base.contrast.foreground > small.base.contrast.background
    scan, mask = scan_of(shape, PHOTONS)
    found = fit_modality(Volume(scan.values.astype(np.uint16), scan.spacing, "um"), mask)
    assert found.base.detector.ceiling == 65535
    low, high = found.ranges["detector.gain"]
    assert low < found.base.detector.gain < high and found.draw(1) != found.draw(2)


def test_a_real_bone(data: Path) -> None:
    """Two classes of grey; the noise as a difference of neighbours sees it; edges of one to two voxels."""
    scan = load(data / "scans" / "lhdl_trabecular_200.tif", spacing=19.5, unit="um")
    cut = Volume(scan.values[50:130, 50:130, 50:130], scan.spacing, "um")
    b = fit_modality(cut).base
    assert 10 < b.contrast.background * (b.detector.gain or 1) + b.detector.offset < 40
    assert 120 < b.contrast.foreground * (b.detector.gain or 1) + b.detector.offset < 220
    assert 15 < b.optics.blur[1] < 45 and 0.5 < b.noise.width[1] < 1.1
