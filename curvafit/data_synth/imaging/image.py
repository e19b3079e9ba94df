"""The image that an `Imaging` makes of a shape, and the labels on the image's voxels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from curvafit.data_synth.imaging import effects
from curvafit.data_synth.imaging.effects import EPSILON, Voxels
from curvafit.data_synth.imaging.modality import Imaging
from curvafit.priors.grid import Float


def image(
    field: Voxels,
    spacing: float,
    imaging: Imaging,
    seed: int,
    epsilon: float = EPSILON,
    levels: Sequence[float] | None = None,
) -> Float[torch.Tensor, "Z Y X"]:
    """Return the image of a phase field, of the field's floating type and the shape that `regrid` gives.

    The order is classes, blur, sampling, light, noise. `spacing` is the edge of the field's cubic voxels, in the
    imaging's unit; ε of the field's profile is in voxels. Where `levels` are given, the field is those of several
    classes (C, Z, Y, X), the first in front, with the light of each: 0 as the background's, 1 as the structure's.
    """
    fields, lights = (field[None], (1.0,)) if levels is None else (field, levels)
    stain = torch.stack([light * share for light, share in zip(lights, share_voxels(fields, epsilon), strict=True)])
    light, optics = _emit(stain.sum(0), spacing, imaging, seed), imaging.optics
    if optics.growth or optics.attenuation:
        light = effects.blur_with_depth(light, spacing, optics.blur, optics.growth, optics.attenuation)
    else:
        light = effects.blur(light, spacing, optics.blur)
    light = effects.sample(light, spacing, imaging.spacing, (imaging.thickness, *imaging.spacing[1:]))
    lamp = imaging.illumination
    if lamp.bias:
        light = light * effects.bias(light, imaging.spacing, lamp.bias, lamp.bias_length, seed)
    if lamp.stripes:
        light = light * effects.stripes(light, imaging.spacing, lamp.stripes, lamp.stripe_width, seed)
    return _detect(light, imaging, seed)


def regrid(field: Voxels, spacing: float, imaging: Imaging) -> Float[torch.Tensor, "Z Y X"]:
    """Return the phase field at the centres of its image's voxels, interpolated linearly; for labels."""
    return effects.sample(field, spacing, imaging.spacing)


def label_voxels(
    fields: torch.Tensor, sampled: torch.Tensor, spacing: float, imaging: Imaging, epsilon: float = EPSILON
) -> torch.Tensor:
    """Return the labels of the image's voxels, uint8: 0 outside, 1, 2, … in the classes of fields (C, Z, Y, X).

    `sampled` is the field of all classes together on the image's voxels (`regrid`). Where it is above 0, a voxel is of
    the first class whose field is, too. With `Imaging.visible` labels hold the voxels that this share of the light of
    all classes reaches, stained alike, and a voxel is of the class with most of it.
    """
    if imaging.visible:
        optics, window = imaging.optics, (imaging.thickness, *imaging.spacing[1:])
        stains = share_voxels(fields, epsilon)
        lights = (effects.blur_with_depth(stain, spacing, optics.blur, optics.growth) for stain in stains)
        shares = torch.stack([effects.sample(light, spacing, imaging.spacing, window) for light in lights])
        return torch.where(shares.sum(0) > imaging.visible, shares.argmax(0) + 1, 0).to(torch.uint8)
    if len(fields) == 1:
        return (sampled > 0).to(torch.uint8)
    levels = torch.stack([regrid(field, spacing, imaging) for field in fields])
    inside = levels > 0
    first = torch.where(inside.any(0), inside.to(torch.uint8).argmax(0), levels.argmax(0))
    return torch.where(inside.any(0) | (sampled > 0), first + 1, 0).to(torch.uint8)


def annotator_threshold(imaging: Imaging) -> float:
    """Return the share of the structure's light in a voxel from which an annotator marks it, for `Imaging.visible`.

    There the grey level is the geometric mean of background and structure: share 1/2 at faint contrast, less where it
    is strong.
    """
    below, above = imaging.contrast.background, imaging.contrast.foreground
    return 1 / (1 + math.sqrt(above / max(below, 1e-3 * above, 1e-12)))


def field_shape(shape: Sequence[int], spacing: float, imaging: Imaging) -> tuple[int, int, int]:
    """Return the number of voxels (z, y, x) of edge `spacing` that an image of `shape` is made from."""
    z, y, x = (math.ceil(n * h / spacing - 1e-6) for n, h in zip(shape, imaging.spacing, strict=True))
    return z, y, x


def share_voxels(fields: torch.Tensor, epsilon: float) -> list[torch.Tensor]:
    """Return the share of each voxel (Z, Y, X) that each class fills, of fields (C, Z, Y, X), the first in front.

    A class fills what those in front of it leave, as far as it reaches: classes that meet leave no gap.
    """
    shares, free = [], torch.ones_like(fields[0])
    for field in fields:
        shares.append(torch.minimum(free, effects.occupancy(field, epsilon)))
        free = free - shares[-1]
    return shares


def _emit(occupied: torch.Tensor, spacing: float, how: Imaging, seed: int) -> torch.Tensor:
    contrast, specimen = how.contrast, how.specimen
    inside = occupied
    if specimen.dropout:
        lost = specimen.dropout, specimen.dropout_length, specimen.dropout_loss
        inside = occupied * effects.dropout(occupied, spacing, *lost, seed)
    below = above = torch.ones_like(occupied[:1, :1, :1])
    if contrast.background_texture:
        grain = contrast.background_texture, contrast.background_length
        below = effects.texture(occupied, spacing, *grain, seed, "background texture")
    if contrast.foreground_texture:
        grain = contrast.foreground_texture, contrast.foreground_length
        above = effects.texture(occupied, spacing, *grain, seed, "foreground texture")
    base = contrast.background * below
    light = base + inside * (contrast.foreground * above - base)
    if specimen.clutter:
        height = specimen.clutter_height * (contrast.foreground - contrast.background)
        light = light + height * effects.clutter(occupied, spacing, specimen.clutter, specimen.clutter_radius, seed)
    return light.clamp_min(0)


def _detect(light: torch.Tensor, how: Imaging, seed: int) -> torch.Tensor:
    detector, noise, contrast = how.detector, how.noise, how.contrast
    counts = effects.poisson_gaussian(light, detector.gain, noise.gaussian, detector.offset, seed, noise.width)
    if noise.rician:
        counts = effects.rician(counts, noise.rician, seed, noise.width)
    if detector.rings:
        strength = detector.rings * abs(contrast.foreground - contrast.background) * (detector.gain or 1)
        counts = counts + effects.rings(counts, how.spacing, strength, detector.ring_width, seed)
    return counts if detector.ceiling is None else counts.round().clamp_(0, detector.ceiling)  # where it saturates
