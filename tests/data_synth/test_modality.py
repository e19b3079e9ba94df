"""Images of modalities: drawn parameters, the chain, one grid for image and labels, presets."""

import json
from dataclasses import replace
from operator import attrgetter

import pytest
import torch
from exact import Cylinder, Sphere, centres, profile

from curvafit.core.schema import decode, encode
from curvafit.data_synth.imaging import effects
from curvafit.data_synth.imaging.modality import (
    MODALITIES,
    Contrast,
    Imaging,
    Modality,
    Optics,
    annotator_threshold,
    field_shape,
    image,
    label_voxels,
    modality,
    regrid,
)
from curvafit.priors.grid import Grid

N = 32
POINTS = centres(Grid((N, N, N), (1.0, 1.0, 1.0)))
SHAPES = [Cylinder(5.0, (0.3, 1, 0.2), (16, 16, 16)), Sphere(9.0, (16, 16, 16))]
FIELDS = [profile(shape, POINTS, effects.EPSILON).float() for shape in SHAPES]

PLAIN = Imaging(contrast=Contrast(background=10, foreground=60))


@pytest.mark.parametrize("name", MODALITIES)
def test_presets_make_images(name: str) -> None:
    kind = MODALITIES[name]
    for seed, field in enumerate(FIELDS):
        drawn = kind.draw(seed)
        seen, inside = image(field, kind.voxel, drawn, seed), regrid(field, kind.voxel, drawn) > 0
        assert seen.shape == inside.shape and bool(torch.isfinite(seen).all())
        assert float(seen.amin()) >= 0 and float(seen.amax()) <= drawn.detector.ceiling
        assert torch.equal(seen, seen.round())
        sign = 1 if drawn.contrast.foreground > drawn.contrast.background else -1
        contrast = sign * float(seen[inside].mean() - seen[~inside].mean())
        assert contrast > 0.5 * float(seen[~inside].std())
    # The same voxels, bit by bit, from the same seed.
    assert torch.equal(seen, image(field, kind.voxel, drawn, seed))
    assert not torch.equal(seen, image(field, kind.voxel, drawn, seed + 1))


@pytest.mark.parametrize(
    "effect",
    [
        {"contrast.background_texture": 0.3}, {"contrast.foreground_texture": 0.3}, {"optics.blur": (2.0, 1.0, 1.0)},
        {"optics.attenuation": 0.02}, {"illumination.bias": 0.2, "illumination.bias_length": 20},
        {"illumination.stripes": 0.1}, {"detector.rings": 0.1}, {"specimen.dropout": 0.3, "specimen.dropout_length": 5},
        {"specimen.clutter": 1e-3}, {"detector.gain": 2.0}, {"noise.gaussian": 3.0}, {"noise.rician": 3.0},
        {"detector.offset": 7.0}, {"detector.ceiling": 40.0},
    ],
)  # fmt: skip
def test_every_effect_counts_and_leaves_the_others_numbers(effect: dict) -> None:
    torch.testing.assert_close(image(FIELDS[1], 1.0, PLAIN, 0), 10 + 50 * effects.occupancy(FIELDS[1]))  # without any
    noisy = PLAIN.assign({"noise.gaussian": 2.0})
    with_it = image(FIELDS[0], 1.0, PLAIN.assign(effect), 5)
    assert not torch.equal(with_it, image(FIELDS[0], 1.0, PLAIN, 5))
    if not {"noise.gaussian", "noise.rician", "detector.gain", "detector.ceiling"} & set(effect):
        noise = image(FIELDS[0], 1.0, noisy, 5) - image(FIELDS[0], 1.0, PLAIN, 5)
        same = image(FIELDS[0], 1.0, noisy.assign(effect), 5) - with_it
        torch.testing.assert_close(same, noise, rtol=0, atol=1e-4)


def test_images_and_labels_share_a_grid() -> None:
    how = replace(PLAIN, spacing=(2.5, 1.0, 1.5), thickness=2.5)
    assert field_shape((12, 32, 20), 1.0, how) == (30, 32, 30)
    for field in FIELDS:
        seen, labels = image(field, 1.0, how, 1), regrid(field, 1.0, how)
        assert tuple(seen.shape) == tuple(labels.shape) == (12, 32, 21)
        agree = (seen > 35) == (labels > 0)
        assert float(agree.double().mean()) > 0.985


def test_masks_of_what_is_seen() -> None:
    """With even stain and no noise, a share of the light is that share of the contrast, but where the image is within
    what float32 rounds off some fifty levels."""
    how = replace(PLAIN, spacing=(2.5, 1.0, 1.0), thickness=2.5, optics=Optics((3.0, 1.0, 1.0), 0.02), visible=0.1)
    found = torch.stack([label_voxels(u, u, 1.0, how) > 0 for u in FIELDS])
    clean = torch.stack([image(u, 1.0, how, 1) for u in FIELDS])
    clear = (clean - (10 + 0.1 * 50)).abs() > 1e-4
    assert found.dtype == torch.bool and torch.equal(found[clear], clean[clear] > 10 + 0.1 * 50)
    assert float(clear.double().mean()) > 0.99
    level = 10 + annotator_threshold(how) * 50
    assert level == pytest.approx((10 * 60) ** 0.5)
    dark = replace(PLAIN, contrast=Contrast(60, 10))
    assert 60 - annotator_threshold(dark) * 50 == pytest.approx((10 * 60) ** 0.5)
    assert 0 < annotator_threshold(PLAIN.assign({"contrast.background": 0})) < 0.05
    inside = torch.stack([regrid(u, 1.0, how) for u in FIELDS]) > 0
    assert bool((found | ~inside).all()) and float(found.sum()) > 1.5 * float(inside.sum())


def test_parameters_are_drawn_in_range_and_reproducibly() -> None:
    """And go through JSON; names are forgiving."""
    for kind in MODALITIES.values():
        draws = [kind.draw(seed) for seed in range(40)]
        assert draws[3] == kind.draw(3) and draws[3] != draws[4]
        for name, (low, high) in kind.ranges.items():
            values = [attrgetter(name)(each) for each in draws]
            first = [value[0] if isinstance(value, tuple) else value for value in values]
            ends = [end[0] if isinstance(end, tuple) else end for end in (low, high)]
            assert ends[0] <= min(first) < max(first) <= ends[1], name
    one = Modality("one", "", 1.0, PLAIN, {"illumination.bias": (0.0, 0.5)})
    both = replace(one, ranges={"illumination.stripes": (0.1, 0.2), **one.ranges})
    assert one.draw(3).illumination == replace(both.draw(3).illumination, stripes=0.0)
    for name, kind in MODALITIES.items():
        assert kind.name == name and decode(Modality, json.loads(json.dumps(encode(kind)))) == kind
        assert decode(Imaging, json.loads(json.dumps(encode(kind.draw(5))))) == kind.draw(5)
        for written in (name, name.replace("-", "_"), name.upper(), f" {name.replace('-', ' ')} "):
            assert modality(written) is kind
