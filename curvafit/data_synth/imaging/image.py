"""The image that an `Imaging` makes of a shape, and the labels on the image's voxels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from curvafit.data_synth.imaging import effects
from curvafit.data_synth.imaging.effects import EPSILON
from curvafit.data_synth.imaging.maths import Triple, seeds_of
from curvafit.data_synth.imaging.modality import Imaging
from curvafit.priors.grid import Bool, Float


def image(
    shapes: Float[torch.Tensor, "b 1 z y x"],
    spacing: float,
    imaging: Sequence[Imaging],
    seeds: Sequence[int],
    epsilon: float = EPSILON,
) -> Float[torch.Tensor, "b 1 Z Y X"]:
    """Return images of phase fields, in float32 or the fields' own type: classes, blur, sampling, light, noise, in that
    order.

    A sample is made by itself, from its field, its `Imaging` and its seed alone.

    Parameters
    ----------
    spacing
        Edge of the fields' cubic voxels, in the unit of the imaging.
    epsilon
        Of the fields' profile, in voxels.

    Returns
    -------
    Of the shape `regrid` gives.
    """
    _check_batch(shapes, imaging)
    every = zip(shapes.split(1), imaging, seeds_of(seeds, len(shapes)), strict=True)
    return torch.cat([_make_image(one, spacing, how, [seed], epsilon) for one, how, seed in every])


def regrid(
    shapes: Float[torch.Tensor, "b 1 z y x"], spacing: float, imaging: Sequence[Imaging]
) -> Float[torch.Tensor, "b 1 Z Y X"]:
    """Return the phase fields at the centres of their images' voxels, interpolated linearly; for labels."""
    _check_batch(shapes, imaging)
    return effects.sample(shapes, spacing, imaging[0].spacing)


def visible(
    shapes: Float[torch.Tensor, "b 1 z y x"], spacing: float, imaging: Sequence[Imaging], epsilon: float = EPSILON
) -> Bool[torch.Tensor, "b 1 Z Y X"]:
    """Return the images' voxels that a share of the structure's light reaches (`Imaging.visible`), of even stain."""
    _check_batch(shapes, imaging)
    return torch.cat(
        [_find_visible(one, spacing, how, epsilon) for one, how in zip(shapes.split(1), imaging, strict=True)]
    )


def visible_share(imaging: Imaging) -> float:
    """Return the share of the structure's light at which an annotator is taken to see it.

    There the level is midway from the background's to the structure's in the logarithm, as contrast is seen: 1/2 at
    faint contrast, less where it is strong.
    """
    below, above = imaging.contrast.background, imaging.contrast.foreground
    return 1 / (1 + math.sqrt(above / max(below, 1e-3 * above, 1e-12)))


def field_shape(shape: Sequence[int], spacing: float, imaging: Imaging) -> tuple[int, int, int]:
    """Return the least voxels (z, y, x) of edge `spacing` that an image of a shape is made from."""
    z, y, x = (math.ceil(n * h / spacing - 1e-6) for n, h in zip(shape, imaging.spacing, strict=True))
    return z, y, x


def _make_image(shape: torch.Tensor, spacing: float, how: Imaging, seeds: list[int], epsilon: float) -> torch.Tensor:
    occupied = effects.occupancy(shape, epsilon)
    light = _blur_light(_emit(occupied, spacing, how, seeds), spacing, how)
    light = _illuminate(effects.sample(light, spacing, how.spacing, _window(how)), how, seeds)
    return _detect(light, how, seeds)


def _illuminate(light: torch.Tensor, how: Imaging, seeds: list[int]) -> torch.Tensor:
    """Return the light under uneven illumination."""
    lamp = how.illumination
    if lamp.bias:
        light = light * effects.bias(light, how.spacing, lamp.bias, lamp.bias_length, seeds)
    if lamp.stripes:
        light = light * effects.stripes(light, how.spacing, lamp.stripes, lamp.stripe_width, seeds)
    return light


def _detect(light: torch.Tensor, how: Imaging, seeds: list[int]) -> torch.Tensor:
    """Return the counts that a detector makes of light."""
    detector, noise, contrast = how.detector, how.noise, how.contrast
    counts = effects.poisson_gaussian(light, detector.gain, noise.gaussian, detector.offset, seeds, noise.width)
    if noise.rician:
        counts = effects.rician(counts, noise.rician, seeds, noise.width)
    if detector.rings:
        strength = detector.rings * abs(contrast.foreground - contrast.background) * (detector.gain or 1)
        counts = counts + effects.rings(counts, how.spacing, strength, detector.ring_width, seeds)
    return counts if detector.ceiling is None else effects.digitise(counts, detector.ceiling)


def _find_visible(shape: torch.Tensor, spacing: float, how: Imaging, epsilon: float) -> torch.Tensor:
    light = effects.blur_with_depth(effects.occupancy(shape, epsilon), spacing, how.optics.blur, how.optics.growth)
    return effects.sample(light, spacing, how.spacing, _window(how)) > how.visible


def _window(how: Imaging) -> Triple:
    return how.thickness, *how.spacing[1:]


def _emit(occupied: torch.Tensor, spacing: float, how: Imaging, seeds: list[int]) -> torch.Tensor:
    """Return the light that the specimen sends out."""
    contrast, specimen = how.contrast, how.specimen
    inside = occupied
    if specimen.dropout:
        lost = specimen.dropout, specimen.dropout_length, specimen.dropout_loss
        inside = occupied * effects.dropout(occupied, spacing, *lost, seeds)
    below = above = torch.ones_like(occupied[..., :1, :1, :1])
    if contrast.background_texture:
        grain = contrast.background_texture, contrast.background_length
        below = effects.texture(occupied, spacing, *grain, seeds, "background texture")
    if contrast.foreground_texture:
        grain = contrast.foreground_texture, contrast.foreground_length
        above = effects.texture(occupied, spacing, *grain, seeds, "foreground texture")
    base = contrast.background * below
    light = base + inside * (contrast.foreground * above - base)
    if specimen.clutter:
        height = specimen.clutter_height * (contrast.foreground - contrast.background)
        light = light + height * effects.clutter(occupied, spacing, specimen.clutter, specimen.clutter_radius, seeds)
    return light.clamp_min(0)


def _blur_light(light: torch.Tensor, spacing: float, how: Imaging) -> torch.Tensor:
    optics = how.optics
    if optics.growth or optics.attenuation:
        return effects.blur_with_depth(light, spacing, optics.blur, optics.growth, optics.attenuation)
    return effects.blur(light, spacing, optics.blur)


def _check_batch(shapes: torch.Tensor, imaging: Sequence[Imaging]) -> None:
    if len(imaging) != len(shapes) or not imaging:
        raise ValueError(f"each of {len(shapes)} fields needs its imaging, got {len(imaging)}")
    grids = {how.spacing for how in imaging}
    if len(grids) > 1:
        raise ValueError(f"images of a batch must have one spacing, got {sorted(grids)}")
