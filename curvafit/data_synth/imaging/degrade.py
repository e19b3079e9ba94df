"""Degradations: pure, seeded functions from phase fields to images, one an effect, in the order of the physics.

Volumes are `(B, 1, Z, Y, X)` tensors of a floating type, on any device; lengths are in the unit of the spacing;
`seeds` holds one whole number a sample, which alone decides the sample's random numbers, whatever batch it is in and
whatever else is applied. `curvafit.data_synth.imaging.modality.image` chains them.
"""

from curvafit.data_synth.imaging.effects import bias, clutter, dropout, rings, stripes
from curvafit.data_synth.imaging.noise import digitised, gaussian_noise, poisson, poisson_gaussian, rician
from curvafit.data_synth.imaging.optics import EPSILON, blur, blur_with_depth, intensities, occupancy, sample, texture

__all__ = [
    "EPSILON",
    "bias",
    "blur",
    "blur_with_depth",
    "clutter",
    "digitised",
    "dropout",
    "gaussian_noise",
    "intensities",
    "occupancy",
    "poisson",
    "poisson_gaussian",
    "rician",
    "rings",
    "sample",
    "stripes",
    "texture",
]
