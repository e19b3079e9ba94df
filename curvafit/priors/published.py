"""The published laws as numbers, which need no torch: coefficients in working units, mass, source."""

from __future__ import annotations

_GALLERY = "curvatubes results/gallery"
_TABLE_3, _TABLE_4 = "paper, Table 'four shapes'", "paper, Table 'spatialized'"
PUBLISHED: dict[str, tuple[tuple[float, ...], float, str]] = {
    "bilayers": ((1, 1, 1, 0, 0, 0), -0.4, _GALLERY),
    "exp-0366": ((1, -0.238, 11.988, -175.909, -27.167, 2117.037), -0.648, _GALLERY),
    "exp-0556": ((1, 3.225, 10.87, -146.309, 143.487, -2920.302), -0.499, _GALLERY),
    "exp-0625": ((1, 2.869, 9.711, -116.933, 61.261, 577.676), -0.657, _GALLERY),
    "exp-0830": ((1, 3.725, 0.649, -39.994, 64.093, 2758.058), -0.568, _GALLERY),
    "metatubes": ((0.924, 1.352, 2.932, 8.29, 61.066, 297.722), -0.53, _GALLERY),
    "pearls": ((1, 3.55, 1, -56, -56, 784), -0.77, _GALLERY),
    "sieve": ((0.946, 3.959, 1.942, 18.329, 28.008, 113.771), -0.534, _GALLERY),
    "sponge": ((1, 2.8, 2, -10, -10, 25), -0.25, _GALLERY),
    "trabec": ((2, 1.823, 12, -166, -14, 3548), -0.512, _GALLERY),
    "tubes": ((1, 2, 6, -40, -40, 400), -0.6, _GALLERY),
    "weird": ((1, 0.396, 1.095, -28.64, 190.906, 2062.082), -0.598, _GALLERY),
    "flow": ((1, 2.4, 9, 30, 170, -195), -0.66, "paper, Fig. 'cvg_1'"),
    "seeds": ((1, -0.35, 1.02, -40, 100, 1600), -0.69, "paper, Fig. 'var_1'"),
    "bilinear-layers": ((2, 2, 2, 0, 0, 0), -0.3, _TABLE_3),
    "bilinear-spheres": ((2, 2, 2, -75, -75, 937.5), -0.6, _TABLE_3),
    "bilinear-tubes": ((2, 2, 11, -100, -50, 1250), -0.7, _TABLE_3),
    "bilinear-sponges": ((1, 2.8, 2, -10, -10, 25), -0.25, _TABLE_3),
    "spatial-1": ((2, 2, 2, 0, 0, 0), -0.4, _TABLE_4),
    "spatial-2": ((1, 2, 6, -40, -40, 400), -0.6, _TABLE_4),
    "spatial-3": ((2, 2, 2, -75, -75, 937.5), -0.7, _TABLE_4),
    "spatial-4": ((2, 2, 11, -180, -90, 4050), -0.7, _TABLE_4),
}
