"""Texts of a `fit.json` with one thing wrong: what its readers must refuse, in Python and in a browser alike."""

import json

from found import made_fit

#: Where, what stands there as JSON, what every reader says that it expected.
BROKEN = [
    ("mass", "1", "mass as a number between -1 and 1, or null, got 1"),
    ("mass", "-1.5", "mass as a number between -1 and 1, or null, got -1.5"),
    ("mass", "true", "mass as a number between -1 and 1, or null, got"),
    ("mass", None, "mass, got none"),
    ("epsilon_physical", "0", "epsilon_physical as a positive number, got 0"),
    ("epsilon_physical", '"0.02"', "epsilon_physical as a positive number, got"),
    ("working_voxel", "-1", "working_voxel as a positive number, got -1"),
    ("working_voxel", "[0.01]", "working_voxel as a positive number, got"),
    ("length_unit", '"furlong"', "length_unit as one of voxel, nm, um, mm, m, got"),
    ("length_unit", "[]", "length_unit as one of voxel, nm, um, mm, m, got"),
    ("coefficients", "[1, 2, 3, 4, 5, 6]", "coefficients as an object of six coefficients, or null, got"),
    ("coefficients.a02", None, "coefficients.a02, got none"),
    ("coefficients_physical.a10", '"x"', "coefficients_physical.a10 as a finite number, got"),
    ("morphometry.volume_fraction", "2", "morphometry.volume_fraction as a number from 0 to 1, or null, got 2"),
    ("morphometry", "7", "morphometry as an object, or null, got 7"),
    ("kind", "3", "kind as field, mask or image, got 3"),
    ("family", "{}", "family as a text, got"),
    ("matches", "{}", "matches as a list, got"),
    ("matches", "[7]", "matches[0] as an object, got 7"),
    ("diagram", "7", "diagram as an object of columns, or null, got 7"),
    ("diagram", '{"kappa1": [1], "kappa2": [true], "share": [1]}', "diagram.kappa2[0] as a finite number, got"),
    ("diagram", '{"kappa1": [1], "kappa2": [2], "share": [-1]}', "diagram.share[0] as a number from 0, got -1"),
    ("diagram", '{"kappa1": [1], "kappa2": [2], "share": []}', "diagram.share as a list of numbers, got"),
    ("provenance", '{"scan": 5}', "provenance.scan as a text, or null, got 5"),
]


def broken(where: str, text: str | None) -> str:
    """The text of a `fit.json` in which other JSON stands in one place, or nothing."""
    content = json.loads(made_fit().to_json())
    *path, name = where.split(".")
    inner = content
    for key in path:
        inner = inner[key]
    inner[name] = "\0"
    if text is None:
        del inner[name]
    return json.dumps(content).replace('"\\u0000"', text or "")
