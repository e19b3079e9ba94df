"""The parameters of an image, grouped by the physics that they belong to; modalities, which draw them; the image."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from importlib.resources import files
from operator import attrgetter
from typing import Annotated, Any, get_type_hints

import numpy as np
import torch
import yaml

from curvafit.core.checks import check_choice, check_positive, check_seed, check_type, quoted, simplify_name
from curvafit.core.schema import Rule, decode
from curvafit.core.units import METRES
from curvafit.data_synth.imaging import effects
from curvafit.data_synth.imaging.effects import EPSILON, Voxels
from curvafit.priors.grid import Float

Amount = Annotated[float, Rule(least=0)]
Positive = Annotated[float, Rule(above=0)]
Share = Annotated[float, Rule(least=0, most=1)]
#: Numbers along (z, y, x).
Amounts = tuple[Amount, Amount, Amount]
Positives = tuple[Positive, Positive, Positive]


class Checked:
    """A dataclass whose parameters must be as their types say, or ValueError; numbers become floats."""

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            value = getattr(self, name)
            if is_dataclass(hint):
                check_type(value, hint, f"{name} of type {hint.__name__}")  # type: ignore[arg-type]
            else:
                plain = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
                object.__setattr__(self, name, decode(hint, plain, f"expected {name}"))


@dataclass(frozen=True)
class Contrast(Checked):
    """The levels of background and structure, in photons (grey values where the detector's gain is 0).

    A texture is the relative deviation of a level, and its length that of the deviation's correlation.
    """

    background: Amount = 10.0
    foreground: Amount = 100.0
    background_texture: Amount = 0.0
    background_length: Positive = 1.0
    foreground_texture: Amount = 0.0
    foreground_length: Positive = 1.0


@dataclass(frozen=True)
class Specimen(Checked):
    """The flaws of the specimen: lost stain and specks.

    A share `dropout` of the structure loses a share `dropout_loss` of its stain, in stretches of `dropout_length`.
    `clutter` is the number of specks per unit of volume; their height is a share of the contrast.
    """

    dropout: Share = 0.0
    dropout_length: Positive = 1.0
    dropout_loss: Share = 1.0
    clutter: Amount = 0.0
    clutter_radius: Positive = 1.0
    clutter_height: Amount = 1.0


@dataclass(frozen=True)
class Optics(Checked):
    """A Gaussian point-spread function of deviations `blur` (z, y, x) at depth 0.

    `growth` is the relative growth of the deviations, `attenuation` the loss of light, per unit of depth.
    """

    blur: Amounts = (0.0, 0.0, 0.0)
    growth: Amount = 0.0
    attenuation: Amount = 0.0


@dataclass(frozen=True)
class Illumination(Checked):
    """Uneven light: a factor within 1 ± bias, smooth over `bias_length`; stripes along x, `stripes` their deviation."""

    bias: Share = 0.0
    bias_length: Positive = 1.0
    stripes: Amount = 0.0
    stripe_width: Positive = 1.0


@dataclass(frozen=True)
class Noise(Checked):
    """Noise besides that of the photons, which the detector's gain brings; deviations in counts.

    `gaussian` is read noise, which does not depend on the signal; `rician` that of both channels of a magnitude. All
    noise is smoothed by a Gaussian of deviations `width` (z, y, x), in voxels of the image.
    """

    gaussian: Amount = 0.0
    rician: Amount = 0.0
    width: Amounts = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Detector(Checked):
    """A detector that makes counts of light.

    `gain` is counts per photon, where 0 means that levels are counts already; `offset` is counts in the dark. `rings`
    is the deviation of rings about z, as a share of the contrast. Counts are whole numbers up to the `ceiling`, or real
    numbers where it is None.
    """

    gain: Amount = 0.0
    offset: float = 0.0
    rings: Amount = 0.0
    ring_width: Positive = 1.0
    ceiling: Annotated[float | None, Rule(above=0)] = None


@dataclass(frozen=True)
class Imaging(Checked):
    """The parameters of one image, its parts in the order of the physics; an effect of strength 0 is not applied.

    `unit` is that of all lengths: a unit of length, or voxel. `spacing` is the edges of the image's voxels (z, y, x);
    `thickness` is what a slice averages over, 0 for optical sections. Masks hold the voxels that the share `visible` of
    a structure's light reaches, as an annotator sees them; at 0 the structure. A number out of range is a ValueError.
    """

    unit: str = "um"
    spacing: Positives = (1.0, 1.0, 1.0)
    thickness: Amount = 0.0
    contrast: Contrast = Contrast()
    specimen: Specimen = Specimen()
    optics: Optics = Optics()
    illumination: Illumination = Illumination()
    noise: Noise = Noise()
    detector: Detector = Detector()
    visible: Annotated[float, Rule(least=0, below=1)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice(self.unit, (*METRES, "voxel"), f"a unit among {', '.join(METRES)} and voxel")

    def assign(self, values: Mapping[str, Any]) -> Imaging:
        """Return a copy with other values, by name: `imaging.assign({"optics.blur": (3, 1, 1), "visible": 0.1})`."""
        parts: dict[str, dict[str, Any]] = {"": {}}
        for name, value in values.items():
            part, _, parameter = name.rpartition(".")  # the part is "" for a parameter of the image itself
            parts.setdefault(part, {})[parameter] = value
        top = parts.pop("")
        try:
            return replace(self, **top, **{name: replace(getattr(self, name), **part) for name, part in parts.items()})
        except (AttributeError, TypeError) as error:
            raise ValueError(f"an image has parameters such as optics.blur, got {quoted(', '.join(values))}") from error


@dataclass(frozen=True)
class Modality:
    """A kind of image: a typical one (`base`), and the ranges from which some parameters are drawn.

    `about` is the source of its numbers. `voxel` is the edge of a shape's voxels, in the unit of the imaging, which
    gives structures their usual thickness. `ranges` holds low and high by the name of a parameter, as `optics.blur`;
    three numbers change together. Draws are even in the logarithm where both ends are above zero, else even. A range
    with an unknown name or an end that an `Imaging` refuses is a ValueError.
    """

    name: str
    about: str
    voxel: float
    base: Imaging
    ranges: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_positive(self.voxel, "a shape's voxel of positive length")
        ranges = {
            name: tuple(attrgetter(name)(self.base.assign({name: end})) for end in ends)
            for name, ends in self.ranges.items()
        }
        for name, (low, high) in ranges.items():
            if np.any(np.asarray(low) > np.asarray(high)):
                raise ValueError(f"the range of {name} must go from low to high, got {low} to {high}")
        object.__setattr__(self, "ranges", ranges)

    def draw(self, seed: int) -> Imaging:
        """Draw one image's parameters, each of which depends on the seed and its own name alone."""
        seed, values = check_seed(seed), {}
        for name, ends in self.ranges.items():
            key = tuple(name.encode())
            t = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key)).random()
            low, high = (np.asarray(end, dtype=float) for end in ends)
            positive = bool(np.all(low > 0) and np.all(high > 0))
            value = np.exp(np.log(low) + t * (np.log(high) - np.log(low))) if positive else low + t * (high - low)
            values[name] = tuple(value.tolist()) if value.ndim else float(value)
        return self.base.assign(values)


_PRESETS = yaml.safe_load(files("curvafit.data_synth.imaging").joinpath("modalities.yaml").read_text("utf-8"))
#: The presets of `modalities.yaml` by name, as at the command line.
MODALITIES = {name: decode(Modality, {"name": name, **part}) for name, part in _PRESETS.items()}


def modality(name: str) -> Modality:
    """Return the preset of a name; capitals, spaces and underscores do not matter: `Two_Photon` is `two-photon`."""
    plain = simplify_name(str(name))
    check_choice(plain, MODALITIES, f"a modality among {', '.join(MODALITIES)}")
    return MODALITIES[plain]


# ---- the image and its labels ----------------------------------------------------------------------------------------


def image(
    field: Voxels,
    spacing: float,
    imaging: Imaging,
    seed: int,
    epsilon: float = EPSILON,
) -> Float[torch.Tensor, "Z Y X"]:
    """Return the image of a phase field, of the field's floating type and the shape that `regrid` gives.

    The order is light, blur, sampling, unevenness, noise. `spacing` is the edge of the field's cubic voxels, in the
    imaging's unit; ε of the field's profile is in voxels.
    """
    light, optics = _emit(effects.occupancy(field, epsilon), spacing, imaging, seed), imaging.optics
    light = effects.blur(light, spacing, optics.blur, optics.growth, optics.attenuation)
    light = effects.sample(light, spacing, imaging.spacing, (imaging.thickness, *imaging.spacing[1:]))
    uneven = imaging.illumination
    if uneven.bias:
        light = light * effects.bias(light, imaging.spacing, uneven.bias, uneven.bias_length, seed)
    if uneven.stripes:
        light = light * effects.stripes(light, imaging.spacing, uneven.stripes, uneven.stripe_width, seed)
    return _detect(light, imaging, seed)


def regrid(field: Voxels, spacing: float, imaging: Imaging) -> Float[torch.Tensor, "Z Y X"]:
    """Return the phase field at the centres of its image's voxels, interpolated linearly; for labels."""
    return effects.sample(field, spacing, imaging.spacing)


def label_voxels(
    field: Voxels, sampled: torch.Tensor, spacing: float, imaging: Imaging, epsilon: float = EPSILON
) -> torch.Tensor:
    """Return the labels of the image's voxels, uint8: 1 where `sampled`, the field on them (`regrid`), is above 0.

    With `Imaging.visible`, a voxel is labelled where it gets more than this share of an evenly stained field's light.
    """
    if not imaging.visible:
        return (sampled > 0).to(torch.uint8)
    optics, window = imaging.optics, (imaging.thickness, *imaging.spacing[1:])
    light = effects.blur(effects.occupancy(field, epsilon), spacing, optics.blur, optics.growth)
    return (effects.sample(light, spacing, imaging.spacing, window) > imaging.visible).to(torch.uint8)


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


def _emit(occupied: torch.Tensor, spacing: float, imaging: Imaging, seed: int) -> torch.Tensor:
    """Return the light of the specimen, before optics, where a fraction `occupied` of each voxel is structure."""
    contrast, specimen = imaging.contrast, imaging.specimen
    stain = occupied
    if specimen.dropout:
        loss = specimen.dropout, specimen.dropout_length, specimen.dropout_loss
        stain = occupied * effects.dropout(occupied, spacing, *loss, seed)
    background_texture = foreground_texture = torch.ones_like(occupied[:1, :1, :1])
    if contrast.background_texture:
        texture = contrast.background_texture, contrast.background_length
        background_texture = effects.texture(occupied, spacing, *texture, seed, "background texture")
    if contrast.foreground_texture:
        texture = contrast.foreground_texture, contrast.foreground_length
        foreground_texture = effects.texture(occupied, spacing, *texture, seed, "foreground texture")
    background = contrast.background * background_texture
    light = background + stain * (contrast.foreground * foreground_texture - background)
    if specimen.clutter:
        height = specimen.clutter_height * (contrast.foreground - contrast.background)
        light = light + height * effects.clutter(occupied, spacing, specimen.clutter, specimen.clutter_radius, seed)
    return light.clamp_min(0)


def _detect(light: torch.Tensor, imaging: Imaging, seed: int) -> torch.Tensor:
    """Return the counts that the detector makes of light: noise, then rings, rounded and cut where it saturates."""
    detector, noise, contrast = imaging.detector, imaging.noise, imaging.contrast
    counts = effects.poisson_gaussian(light, detector.gain, noise.gaussian, detector.offset, seed, noise.width)
    if noise.rician:
        counts = effects.rician(counts, noise.rician, seed, noise.width)
    if detector.rings:
        strength = detector.rings * abs(contrast.foreground - contrast.background) * (detector.gain or 1)
        counts = counts + effects.rings(counts, imaging.spacing, strength, detector.ring_width, seed)
    return counts if detector.ceiling is None else counts.round().clamp_(0, detector.ceiling)
