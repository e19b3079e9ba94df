"""The published laws as numbers, which need no torch: coefficients in working units, mass, source."""

from __future__ import annotations

import os
from difflib import get_close_matches

from curvafit.core.checks import quoted, simplify_name

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
    "exp-0253": ((1, -1.284, 9.626, -77.283, 39.681, -633.849), -0.421, _GALLERY),
    "exp-0374": ((1, 0.63, 4.399, 132.459, 195.066, -2378.53), -0.364, _GALLERY),
    "exp-0684": ((1, -3.705, 0.645, -136.976, 160.991, 2450.756), -0.258, _GALLERY),
    "exp-0716": ((1, 2.034, 11.166, 14.553, 28.829, -565.092), -0.356, _GALLERY),
    "exp-0848": ((1, 2.993, 10.787, -114.752, 86.448, -1806.436), -0.172, _GALLERY),
    "exp-0868": ((1, 0.903, 14.586, -57.566, -14.842, -1387.043), -0.56, _GALLERY),
    "exp-0872": ((1, 2.694, 11.363, -189.682, 183.883, 695.812), -0.521, _GALLERY),
    "tightlayers": ((3, 3.741, 11, -268, -4, 6156), -0.633, _GALLERY),
    "tightlayers-2": ((0.997, 1.321, 3.619, -88.68, -1.718, 2053.259), -0.614, _GALLERY),
    "tightlayers-3": ((6, 3.403, 7, -500, 26, 10854), -0.716, _GALLERY),
    "tortuous": ((1, 2.221, 2.667, -103.614, 154.632, -1633.36), -0.745, _GALLERY),
    "trabec-2": ((0.948, 0.836, 6.099, -82.925, -7.377, 1770.118), -0.419, _GALLERY),
    "trabec-3": ((1.069, 0.958, 6.074, -83.758, -7.676, 1767.964), -0.445, _GALLERY),
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


def no_law(text: str, expected: str = "expected") -> ValueError:
    """Return the error of a text that is neither the name of a preset nor a file, with what may be meant."""
    fit = os.path.join(text, "fit.json")
    meant = [fit] if os.path.isfile(fit) else get_close_matches(simplify_name(text), PUBLISHED, 1)
    presets, hint = ("", f": did you mean {meant[0]}?") if meant else (f" among {', '.join(PUBLISHED)},", "")
    return ValueError(f"{expected} a preset{presets} or a fit.json, got {quoted(text)}{hint}")
