"""The parameters of one image, and the image that they make of a shape."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import torch

from curvafit.data_synth.imaging import degrade
from curvafit.data_synth.imaging.optics import EPSILON
from curvafit.data_synth.imaging.randomness import seeds_of
from curvafit.data_synth.imaging.separable import Triple, sampled
from curvafit.priors.shapes import Bool, Float
from curvafit.units import METRES

#: Fields of an `Imaging` that are three numbers (z, y, x).
TRIPLES = ("spacing", "blur", "noise_width")
#: Those that are shares, those that are above zero; all other numbers are from zero.
SHARES = ("dropout", "dropout_loss", "bias", "visible")
POSITIVE = ("spacing", "texture_length", "foreground_length", "bias_length", "stripe_width", "ring_width")
POSITIVE += ("dropout_length", "clutter_radius")


@dataclass(frozen=True)
class Imaging:
    """The parameters of one image; an effect whose strength is 0 is left out.

    Lengths are in `unit`, levels in photons (grey values where `gain` is 0).

    Parameters
    ----------
    spacing, thickness
        Edges of the image's voxels (z, y, x); what a slice averages over (0: a point on z, as optical sections).
    background, foreground
        Levels of the two classes.
    background_texture, texture_length, foreground_texture, foreground_length
        Relative deviation of each class and the length it is correlated by.
    blur, blur_growth, attenuation
        Deviations of the point-spread function (z, y, x) at depth 0; relative growth and loss of light per length.
    bias, bias_length
        Uneven light between 1 - bias and 1 + bias.
    stripes, stripe_width
        Relative deviation of stripes along x.
    rings, ring_width
        Deviation of rings about z, as a part of the contrast.
    dropout, dropout_length, dropout_loss
        Share of the structure whose stain is lost, over which length, and how much of it.
    clutter, clutter_radius, clutter_height
        Specks per unit of volume, their half-width, and their height as a part of the contrast.
    gain, read_noise, offset, rician, noise_width
        Counts a photon; deviations of the read noise and of both channels of a magnitude, and the offset, in counts;
        the noise's smoothing (z, y, x) in voxels of the image.
    ceiling
        Counts are whole and end here; not so where it is None.
    visible
        What masks hold: voxels that this share of a structure's light reaches, as an annotator sees them, or, at 0, the
        structure itself.

    Raises
    ------
    ValueError
        If a number is out of range or the unit has no known name.
    """

    unit: str = "um"
    spacing: Triple = (1.0, 1.0, 1.0)
    thickness: float = 0.0
    background: float = 10.0
    foreground: float = 100.0
    background_texture: float = 0.0
    texture_length: float = 1.0
    foreground_texture: float = 0.0
    foreground_length: float = 1.0
    blur: Triple = (0.0, 0.0, 0.0)
    blur_growth: float = 0.0
    attenuation: float = 0.0
    bias: float = 0.0
    bias_length: float = 1.0
    stripes: float = 0.0
    stripe_width: float = 1.0
    rings: float = 0.0
    ring_width: float = 1.0
    dropout: float = 0.0
    dropout_length: float = 1.0
    dropout_loss: float = 1.0
    clutter: float = 0.0
    clutter_radius: float = 1.0
    clutter_height: float = 1.0
    gain: float = 0.0
    read_noise: float = 0.0
    offset: float = 0.0
    rician: float = 0.0
    noise_width: Triple = (0.0, 0.0, 0.0)
    ceiling: float | None = None
    visible: float = 0.0

    def __post_init__(self) -> None:
        if self.unit not in (*METRES, "voxel"):
            raise ValueError(f"expected a unit among {', '.join(METRES)} or voxel, got {self.unit!r}")
        for name, value in asdict(self).items():
            if name == "unit" or (name == "ceiling" and value is None):
                continue
            numbers = value if name in TRIPLES else (value,)
            if not _in_range(name, numbers):
                raise ValueError(f"expected {name} as {_law(name)}, got {value!r}")
            whole = tuple(float(number) for number in numbers)
            object.__setattr__(self, name, whole if name in TRIPLES else whole[0])

    def as_dict(self) -> dict[str, Any]:
        """All fields in JSON's types."""
        return {name: list(value) if name in TRIPLES else value for name, value in asdict(self).items()}

    @staticmethod
    def from_dict(kept: Mapping[str, Any]) -> Imaging:
        """The inverse of `as_dict`; what is not there is as in `Imaging()`.

        Raises
        ------
        ValueError
            If a name is not a field's, or a value out of range.
        """
        known_fields(kept, "an image")
        given: dict[str, Any] = {name: tuple(value) if name in TRIPLES else value for name, value in kept.items()}
        return Imaging(**given)


def image(
    shapes: Float[torch.Tensor, "b 1 z y x"],
    spacing: float,
    imaging: Sequence[Imaging],
    seeds: Sequence[int],
    epsilon: float = EPSILON,
) -> Float[torch.Tensor, "b 1 Z Y X"]:
    """Images of phase fields, in float32 or the fields' own type: classes, blur, sampling, light, noise, in that order.

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

    Raises
    ------
    ValueError
        If a field is not finite, there is not one imaging and one seed a field, or the images' spacings differ.
    """
    _alike(shapes, imaging)
    every = zip(shapes.split(1), imaging, seeds_of(seeds, len(shapes)), strict=True)
    return torch.cat([_image(one, spacing, how, [seed], epsilon) for one, how, seed in every])


def regrid(
    shapes: Float[torch.Tensor, "b 1 z y x"], spacing: float, imaging: Sequence[Imaging]
) -> Float[torch.Tensor, "b 1 Z Y X"]:
    """The phase fields at the centres of their images' voxels, interpolated linearly: what labels are made of.

    Raises
    ------
    ValueError
        As `image` does.
    """
    _alike(shapes, imaging)
    return degrade.sample(shapes, spacing, imaging[0].spacing)


def visible(
    shapes: Float[torch.Tensor, "b 1 z y x"], spacing: float, imaging: Sequence[Imaging], epsilon: float = EPSILON
) -> Bool[torch.Tensor, "b 1 Z Y X"]:
    """The images' voxels that a share of the structure's light reaches (`Imaging.visible`), evenly stained as it is.

    Raises
    ------
    ValueError
        As `image` does.
    """
    _alike(shapes, imaging)
    return torch.cat([_reached(one, spacing, how, epsilon) for one, how in zip(shapes.split(1), imaging, strict=True)])


def visible_share(imaging: Imaging) -> float:
    """The share of the structure's light at which an annotator is taken to see it: where its level is midway from the
    background's to its own in the logarithm, as contrast is seen. 1/2 at faint contrast, less where it is strong."""
    return 1 / (1 + math.sqrt(imaging.foreground / max(imaging.background, 1e-3 * imaging.foreground, 1e-12)))


def field_shape(shape: Sequence[int], spacing: float, imaging: Imaging) -> tuple[int, int, int]:
    """The least voxels (z, y, x) of edge `spacing` that an image of a shape is made from."""
    z, y, x = (math.ceil(n * h / spacing - 1e-6) for n, h in zip(shape, imaging.spacing, strict=True))
    return z, y, x


def image_shape(shape: Sequence[int], spacing: float, imaging: Imaging) -> tuple[int, int, int]:
    """Voxels (z, y, x) of the image of a field of `shape`."""
    z, y, x = (sampled(n, spacing, h) for n, h in zip(shape, imaging.spacing, strict=True))
    return z, y, x


def known_fields(names: Mapping[str, Any], whose: str) -> None:
    """Raise where a name is not a field's."""
    unknown = set(names) - {each.name for each in fields(Imaging)}
    if unknown:
        raise ValueError(f"expected fields of an image in {whose}, got {', '.join(sorted(unknown))}")


def _image(shape: torch.Tensor, spacing: float, how: Imaging, seeds: list[int], epsilon: float) -> torch.Tensor:
    occupied = degrade.occupancy(shape, epsilon)
    light = _blurred(_emitted(occupied, spacing, how, seeds), spacing, how)
    light = degrade.sample(light, spacing, how.spacing, _window(how))
    if how.bias:
        light = light * degrade.bias(light, how.spacing, how.bias, how.bias_length, seeds)
    if how.stripes:
        light = light * degrade.stripes(light, how.spacing, how.stripes, how.stripe_width, seeds)
    counts = degrade.poisson_gaussian(light, how.gain, how.read_noise, how.offset, seeds, how.noise_width)
    if how.rician:
        counts = degrade.rician(counts, how.rician, seeds, how.noise_width)
    if how.rings:
        strength = how.rings * abs(how.foreground - how.background) * (how.gain or 1)
        counts = counts + degrade.rings(counts, how.spacing, strength, how.ring_width, seeds)
    return counts if how.ceiling is None else degrade.digitised(counts, how.ceiling)


def _reached(shape: torch.Tensor, spacing: float, how: Imaging, epsilon: float) -> torch.Tensor:
    light = degrade.blur_with_depth(degrade.occupancy(shape, epsilon), spacing, how.blur, how.blur_growth)
    return degrade.sample(light, spacing, how.spacing, _window(how)) > how.visible


def _window(how: Imaging) -> Triple:
    return how.thickness, *how.spacing[1:]


def _emitted(occupied: torch.Tensor, spacing: float, how: Imaging, seeds: list[int]) -> torch.Tensor:
    """What the specimen sends out."""
    stain = None
    if how.dropout:
        stain = degrade.dropout(occupied, spacing, how.dropout, how.dropout_length, how.dropout_loss, seeds)
    inside = occupied if stain is None else occupied * stain
    below = above = torch.ones_like(occupied[..., :1, :1, :1])
    if how.background_texture:
        below = degrade.texture(
            occupied, spacing, how.background_texture, how.texture_length, seeds, "background texture"
        )
    if how.foreground_texture:
        above = degrade.texture(
            occupied, spacing, how.foreground_texture, how.foreground_length, seeds, "foreground texture"
        )
    base = how.background * below
    light = base + inside * (how.foreground * above - base)
    if how.clutter:
        height = how.clutter_height * (how.foreground - how.background)
        specks = degrade.clutter(occupied, spacing, how.clutter, how.clutter_radius, seeds)
        light = light + height * specks
    return light.clamp_min(0)


def _blurred(light: torch.Tensor, spacing: float, how: Imaging) -> torch.Tensor:
    if how.blur_growth or how.attenuation:
        return degrade.blur_with_depth(light, spacing, how.blur, how.blur_growth, how.attenuation)
    return degrade.blur(light, spacing, how.blur)


def _alike(shapes: torch.Tensor, imaging: Sequence[Imaging]) -> None:
    if len(imaging) != len(shapes) or not imaging:
        raise ValueError(f"expected one imaging a field, {len(shapes)}, got {len(imaging)}")
    grids = {how.spacing for how in imaging}
    if len(grids) > 1:
        raise ValueError(f"expected images of one spacing in a batch, got {sorted(grids)}")


def _in_range(name: str, numbers: Any) -> bool:
    if not isinstance(numbers, (tuple, list)) or (name in TRIPLES and len(numbers) != 3):
        return False
    for number in numbers:
        if isinstance(number, bool) or not isinstance(number, (int, float, np.number)) or not math.isfinite(number):
            return False
        low, high = -math.inf if name == "offset" else 0.0, 1.0 if name in SHARES else math.inf
        if not low <= number <= high or (number == 0 and name in (*POSITIVE, "ceiling")):
            return False
        if name == "visible" and number == 1:
            return False
    return True


def _law(name: str) -> str:
    if name == "offset":
        return "a finite number"
    kind = "a share" if name in SHARES else "a number above 0" if name in (*POSITIVE, "ceiling") else "a number from 0"
    return f"3 numbers (z, y, x), each {kind}" if name in TRIPLES else kind
