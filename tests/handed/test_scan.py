"""Cases that were handed in: regions elsewhere, surfaces of windows, padding, thin stacks, label maps, small doors."""

import csv
import itertools
import logging
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

import curvafit
from curvafit.core.runtime import log_stages
from curvafit.scan.measures import measure_surface
from curvafit.scan.preparation import prepare
from curvafit.studies.scans import format_csv
from curvafit.volumes.volume import Volume


def level_set(shape: Sequence[int], width: float, share: float, seed: int = 0) -> np.ndarray:
    """A window of a level set of a Gaussian field, bool: it does not repeat."""
    field = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal([n + 12 for n in shape]), width)
    field = field[6:-6, 6:-6, 6:-6]
    return field > np.quantile(field, 1 - share)


def test_a_region_elsewhere() -> None:
    """A region that is stored with x reversed has the numbers of the one that is not."""
    mask = np.concatenate([level_set((24, 32, 20), width, 0.3) for width in (1.8, 3.0)], axis=2)
    labels = np.zeros(mask.shape, np.uint8)
    labels[..., :18], labels[..., 22:] = 1, 2
    affine = np.diag([0.02, 0.02, 0.02, 1.0])
    affine[:3, 3] = 1, 2, 3
    turned = affine @ np.diag([-1.0, 1.0, 1.0, 1.0])
    turned[0, 3] += 39 * 0.02
    scan = Volume(mask.astype(np.uint8), 0.02, "mm", affine)
    same = curvafit.measure(scan, roi=Volume(labels, 0.02, "mm", affine))
    flipped = curvafit.measure(scan, roi=Volume(labels[..., ::-1], 0.02, "mm", turned))
    for label in (1, 2):
        values = [each.compartments[label]["Tb.Th"].value for each in (same, flipped)]
        assert values[0] == pytest.approx(values[1], rel=1e-12)
    assert any("laid on the scan" in note for note in flipped.notes)
    assert not any("laid on the scan" in note for note in same.notes)


def test_surfaces_of_parts() -> None:
    """Parts of 16 voxels and more average to the whole within 1 %, of a texture that does not repeat.

    Of 216 windows of 16³ the areas' deviation is .16 of their mean, and neighbours share edges: their mean is the
    whole's to some .4 %, on average over textures to .1 % (measured).
    """
    mask = level_set((96, 96, 96), 2.5, 0.31)
    whole = surface(mask)
    for edge in (16, 32):
        starts = range(0, 96, edge)
        corners = itertools.product(starts, repeat=3)
        parts = [surface(mask[i : i + edge, j : j + edge, k : k + edge]) for i, j, k in corners]
        assert np.mean(parts, axis=0)[0] == pytest.approx(whole[0], rel=0.01)
    slabs = np.mean([surface(mask[k : k + 16]) for k in range(0, 96, 16)], axis=0)
    assert slabs == pytest.approx(whole, rel=0.01)
    z, y, x = np.mgrid[:16, :64, :64]
    rods = (((y % 32) - 15.5) ** 2 + ((x % 32) - 15.5) ** 2 < 36) & (z >= 0)
    assert surface(rods)[0] == pytest.approx(surface(np.concatenate([rods] * 4))[0], rel=1e-3)


def surface(mask: np.ndarray) -> np.ndarray:
    """The surface density, and surface to volume."""
    area = measure_surface(mask, (1.0, 1.0, 1.0), False)[1][:, 0].sum()
    return np.array([area / mask.size, area / mask.sum()])


def grey(mask: np.ndarray, low: float = 700.0, high: float = 1500.0, noise: float = 60.0) -> np.ndarray:
    """Blurred grey levels of a mask, with noise, int16."""
    levels = ndimage.gaussian_filter(np.where(mask, high, low), 0.6)
    return (levels + np.random.default_rng(1).normal(0, noise, mask.shape)).astype(np.int16)


def test_a_padded_scan() -> None:
    """What a scanner writes outside of its circle sets no threshold: with the region BV/TV is the mask's.

    Smoothing by a voxel takes 5 % of the volume of structures that are 4 voxels thick.
    """
    _, y, x = np.indices((48, 48, 48)) - 23.5
    inside, mask = y**2 + x**2 < 23.5**2, level_set((48, 48, 48), 2.6, 0.2)
    scan = np.where(inside, grey(mask), -1000).astype(np.int16)
    whole, within = curvafit.measure(scan), curvafit.measure(scan, roi=inside.astype(np.uint8))
    assert within["BV/TV"].value == pytest.approx(mask[inside].mean(), rel=0.1)
    assert whole["BV/TV"].value == pytest.approx(mask[inside].mean() * inside.mean(), rel=0.1)
    assert any("exactly -1000" in note and "inside the region" in note for note in within.notes)
    assert any("exactly -1000" in note and "without them" in note for note in whole.notes)
    tiled = curvafit.measure(scan, tile=32)
    for one, other in zip(tiled.quantities, whole.quantities, strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-5)
    assert next(note for note in whole.notes if "exactly" in note) in tiled.notes


def test_a_thin_stack() -> None:
    z, y, x = np.mgrid[:16, :64, :64]
    rods = ((((y % 32) - 15.5) ** 2 + ((x % 32) - 15.5) ** 2 < 36) & (z >= 0)).astype(np.uint8)
    for count in (3, 5, 8):
        found = curvafit.measure(rods[:count], spacing=1.0, unit="um")
        assert found["BV/TV"].value == rods[0].mean()
        assert found["Tb.Th"].value == pytest.approx(11.5, abs=1)  # up to a voxel too little on tubes
        assert found["BS/TV"].value == pytest.approx(4 * np.pi * 12 / 64**2, rel=0.01)
        assert np.isfinite([found[symbol].value for symbol in ("Tb.Sp", "Tb.N", "Conn.D", "BS/BV", "DA")]).all()
        assert np.isnan([found[symbol].value for symbol in ("H", "K", "share of tubes")]).all()
        assert any("No curvature" in note for note in found.notes)
        assert curvafit.windows(rods[:count], (count, 64, 64), (count, 32, 32)).known.all()
        tiled = curvafit.measure(rods[:count], spacing=1.0, unit="um", tile=32)
        with pytest.raises(ValueError, match="too thin"):
            curvafit.compare([found, found], [found, found])
        assert tiled["BS/TV"].value == pytest.approx(found["BS/TV"].value, rel=1e-6)


def sheet(thickness: float, radius: float = 20.0) -> np.ndarray:
    """An open sheet: the upper half of a shell, about its middle."""
    z, y, x = np.indices((34, 64, 64)) - np.array([33.5, 31.5, 31.5])[:, None, None, None]
    return np.abs(np.sqrt(z**2 + y**2 + x**2) - radius) < thickness / 2


def test_a_membrane_of_one_voxel_says_why_it_has_no_curvature() -> None:
    one, two, six = (curvafit.measure(sheet(thickness), spacing=1.0, unit="nm") for thickness in (1, 2, 6))
    assert [any("stairs" in note for note in found.notes) for found in (one, two, six)] == [True, True, False]
    assert np.isnan([one[symbol].value for symbol in ("H", "K", "share of tubes")]).all()
    area = 2 * 2 * np.pi * 20**2 / (34 * 64 * 64)  # of both sides; smoothing tears holes into a single voxel
    assert two["BS/TV"].value == pytest.approx(area, rel=0.1) and 0 < one["BS/TV"].value < 0.8 * area
    tiled = curvafit.measure(sheet(1), spacing=1.0, unit="nm", tile=32)
    assert next(note for note in one.notes if "stairs" in note) in tiled.notes
    for symbol in ("BV/TV", "Tb.Th", "BS/TV", "χ"):
        assert tiled[symbol].value == pytest.approx(one[symbol].value, rel=1e-5)
    with pytest.raises(ValueError, match="stairs"):
        prepare(Volume(sheet(1)))
    with pytest.raises(ValueError, match="too thin"):
        curvafit.compare([one, one], [one, one])


def test_a_membrane_that_is_thickened_has_its_own_curvature() -> None:
    """Within a fifth, where that of two voxels is several times too large: both sides count, without the rim."""
    whole, thick = sheet(1), ndimage.distance_transform_edt(~sheet(1)) <= 3
    inner = np.broadcast_to((np.arange(34) < 24)[:, None, None], whole.shape).astype(np.uint8)
    found, raw = curvafit.measure(thick, roi=inner), curvafit.measure(sheet(2), roi=inner)
    assert found["C"].value == pytest.approx(1 / 20, rel=0.2) and raw["C"].value > 3 / 20
    assert found["K"].value == pytest.approx(1 / 20**2, rel=0.2)
    assert abs(found["H"].value) < 0.4 / 20 and not any("stairs" in note for note in found.notes)


def test_an_empty_mask() -> None:
    empty = np.zeros((20, 20, 20))
    for dtype in (bool, np.uint8, np.float32):
        with pytest.raises(ValueError, match="structure in the scan, got none"):
            curvafit.measure(empty.astype(dtype))
        with pytest.raises(ValueError, match="background in the scan, got none"):
            curvafit.measure((empty + 1).astype(dtype))


def test_labels_without_a_name() -> None:
    """Whole numbers of a few values are labels: their union is measured, and a note says so; kind image splits them."""
    labels = level_set((40, 40, 40), 2.5, 0.3).astype(np.int64)
    labels[20:] *= 3
    labels[:, 20:] *= 2
    found = curvafit.measure(labels)
    assert (found.kind, found["BV/TV"].value) == ("mask", (labels > 0).mean())
    assert any("labels" in note for note in found.notes)
    assert any("labels" in note for note in curvafit.measure(labels, tile=32).notes)
    assert curvafit.measure(labels, kind="image").kind == "image"
    few = np.clip(np.random.default_rng(0).normal(np.where(labels > 0, 11, 4), 1.5), 0, 15).astype(np.uint8)
    assert curvafit.measure(few).kind == "image"  # of 4 bits, with noise


def test_unknown_keywords() -> None:
    for call in (curvafit.measure, curvafit.windows, curvafit.measure_instances, curvafit.infer):
        for scan in (np.eye(3), "none.npy"):
            with pytest.raises(TypeError, match="nonsense"):
                call(scan, nonsense=1)


def blobs(count: int, n: int = 48) -> np.ndarray:
    """Bright balls without a background: levels that fall to exactly 0."""
    places = np.random.default_rng(0).uniform(0.25 * n, 0.75 * n, (count, 3))
    grid = np.moveaxis(np.indices((n, n, n)), 0, -1)
    near = np.min([np.linalg.norm(grid - place, axis=-1) for place in places], axis=0)
    levels = 200 * ndimage.gaussian_filter((near < 8).astype(np.float32), 1.5)
    return np.clip(levels + np.random.default_rng(1).normal(0, 4, near.shape) - 15, 0, 255).astype(np.uint8)


def porous_body() -> np.ndarray:
    """A bright ball with pores, in air that is exactly 0 (all within the ball is the scan of a bone)."""
    near = np.linalg.norm(np.moveaxis(np.indices((48,) * 3), 0, -1) - 23.5, axis=-1) < 20
    return np.where(near & ~level_set((48, 48, 48), 2.5, 0.3), grey(near, 0, 1500), 0).clip(0).astype(np.uint16)


@pytest.mark.parametrize(
    "scan",
    [
        blobs(1), blobs(6), porous_body(),
        np.where(level_set((48, 48, 48), 2.5, 0.3), grey(np.ones((48,) * 3, bool)), 0),
        grey(level_set((48, 48, 48), 2.5, 0.3), 0, 1500, 200).clip(0),
    ],
    ids=["one blob", "blobs", "porous body", "masked levels", "cut noise"],
)  # fmt: skip
def test_a_background_of_one_value_stays_a_background(scan: np.ndarray) -> None:
    """The threshold is Otsu's of all voxels."""
    from skimage.filters import threshold_otsu

    found = curvafit.measure(scan)
    high = scan > threshold_otsu(scan)
    level = (scan[high].mean() + scan[~high].mean()) / 2
    assert any(f"threshold of {level:.4g}" in note for note in found.notes), found.notes


def test_inputs_are_refused_before_libraries(tmp_path: Path) -> None:
    """The commands end before torch is imported."""
    code = (
        "import sys\nfrom curvafit.cli.app import app\nfor line in sys.argv[1:]:\n    try:\n        app(line.split())\n"
    )
    code += "    except SystemExit as end:\n        print(end.code, 'torch' in sys.modules)"
    refusals = {
        "measure typo.tif": "no such file: typo.tif",
        "reconstruct typo.h5::a -o a.tif": "no such file: typo.h5",
        "generate --preset tubez -o a.tif": "--preset takes a preset or a fit.json, got 'tubez': did you mean tubes?",
        "synth --presets tubes,spunge --modality confocal -o set": "got 'spunge'",
    }
    run = subprocess.run([sys.executable, "-c", code, *refusals], cwd=tmp_path, capture_output=True, text=True)
    assert run.stdout.splitlines() == ["2 False"] * len(refusals), run
    assert all(sentence in run.stderr for sentence in refusals.values()), run


def test_formulas_are_kept_out_of_a_spreadsheet() -> None:
    odd = {"=1+1": "@SUM(A1)", "b": "-x", "c": "+1.5", "d": "-0.5 0.1 -1e-05", "e": -2.5, "f": "-1+cmd|' /C calc'!A0"}
    head, row = csv.reader(format_csv([odd]).splitlines())
    assert head[:2] == ["'=1+1", "b"]
    assert row == ["'@SUM(A1)", "'-x", "+1.5", "-0.5 0.1 -1e-05", "-2.5", "'-1+cmd|' /C calc'!A0"]


def test_measures_show_in_a_notebook() -> None:
    """A table of all numbers, of each compartment; a figure."""
    phase = np.indices((32, 32, 32)).sum(0) % 16 < 8
    halves = np.ones(phase.shape, np.uint8)
    halves[16:] = 2
    whole, parted = curvafit.measure(phase), curvafit.measure(phase, roi=halves)
    for found, columns in ((whole, 1), (parted, 2)):
        table = found._repr_html_()
        assert all(each.symbol in table for each in found.quantities)
        assert table.count("<td>") == (len(found.quantities) + 1) * (3 + columns)
        assert len(found.plot().axes) >= columns


def test_the_stages_of_an_inference_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "curvafit"):
        curvafit.infer(np.indices((32, 32, 32)).sum(0) % 16 < 5, growth=None)  # layers are told that they have no law
        log = log_stages()
        for share in (0.5, 0.6):
            log(f"shape {share}", share)
    said = [record.getMessage() for record in caplog.records if record.name == "curvafit"]
    assert said == ["reading the scan (0 % done)", "measuring curvature (5 % done)", "shape 0.5 (50 % done)"]
