"""Units of length: how files name them, and lengths as text in a fitting unit and number of digits."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence

from curvafit.core.checks import quoted

#: Metres in each unit of length that files name, small to large.
METRES = {"nm": 1e-9, "um": 1e-6, "mm": 1e-3, "m": 1.0}
#: Name of a unit in a file -> (our name, factor to it).
_UNITS: dict[str, tuple[str, float]] = {
    **dict.fromkeys(
        ("", "voxel", "voxels", "pixel", "pixels", "px", "unknown", "none", "null", "reference frame"), ("voxel", 1.0)
    ),
    **dict.fromkeys(("pm", "picometer", "picometers", "picometre", "picometres"), ("nm", 1e-3)),
    **dict.fromkeys(("nm", "nanometer", "nanometers", "nanometre", "nanometres"), ("nm", 1.0)),
    **dict.fromkeys(("a", "å", "angstrom", "angstroms", "ångström", "ångströms", "ångstrom"), ("nm", 0.1)),
    **dict.fromkeys(
        ("um", "μm", "micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres"), ("um", 1.0)
    ),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), ("mm", 1.0)),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), ("mm", 10.0)),
    **dict.fromkeys(("inch", "inches", "in", '"'), ("mm", 25.4)),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), ("m", 1.0)),
}
#: The page that explains words with a special meaning, each under its own anchor.
GLOSSARY = "https://curvafit.readthedocs.io/en/latest/glossary/"
#: A space at which no line breaks.
_GLUE = "\u00a0"


def parse_unit(unit: str | None) -> tuple[str, float]:
    """Return our name of a length unit and the factor to it, `("mm", 10.0)` for `"cm"`; raise ValueError if unknown."""
    if not is_unit(unit):
        raise ValueError(f"expected a unit of voxel, nm, um, mm or m, got {quoted(unit)}")
    return _UNITS[_plain_name(unit)]


def is_unit(unit: str | None) -> bool:
    """Return whether a unit is one that `parse_unit` knows."""
    return isinstance(unit, str | None) and _plain_name(unit) in _UNITS


def common_unit(units: Sequence[str | None]) -> tuple[str | None, tuple[float, ...]]:
    """Return the last of several units of length, and the factor from each unit to it.

    Units that cannot be converted, as one is unknown or only some are voxels, are joined by "and", with factors of 1.
    """
    if all(map(is_unit, units)) and len({parse_unit(unit)[0] == "voxel" for unit in units}) == 1:
        # In 15 digits 1 um is 1000 nm, not 999.9999999999999.
        return units[-1], tuple(float(f"{convert_length(1.0, unit, units[-1]):.15g}") for unit in units)
    return " and ".join(dict.fromkeys(map(str, units))), (1.0,) * len(units)


def _plain_name(unit: str | None) -> str:
    """Return a unit's name in small letters, with one form of µ for its two Unicode codes and Java's `\\u00B5`."""
    text = re.sub(r"\\u([0-9a-fA-F]{4})", lambda escape: chr(int(escape[1], 16)), unit or "")
    return unicodedata.normalize("NFKC", text.strip().casefold())


def convert_length(length: float, unit: str | None, to: str | None) -> float:
    """Convert a length from `unit` to the unit `to`.

    A voxel has no length: if one of the two is the voxel, only a factor such as that of cm to mm is applied.
    """
    (name, factor), (target, target_factor) = parse_unit(unit), parse_unit(to)
    if "voxel" in (name, target):
        return length * factor
    return length * factor * METRES[name] / (METRES[target] * target_factor)


def format_number(value: float | None, digits: int = 3) -> str:
    """Return a number to some significant digits, without an exponent where possible; a dash for None or NaN."""
    if value is None or math.isnan(value):
        return "–"
    if value == 0 or math.isinf(value):
        return f"{value:g}"
    rounded = f"{value:.{digits - 1}e}"
    power = int(rounded.partition("e")[2])
    if -4 <= power <= 6:
        rounded = f"{float(rounded):,.{max(0, digits - 1 - power)}f}".replace(",", "\u202f")
    return rounded.replace("-", "−")


def format_sampling(shape: Sequence[int], spacing: Sequence[float], unit: str = "") -> str:
    """Return the number and the size of voxels (z, y, x) as text; three equal edges are written once."""
    edges = " x ".join(f"{h:.4g}" for h in spacing[: 1 if len(set(spacing)) == 1 else 3])
    size = "" if (edges, unit) == ("1", "voxel") else f" of {edges} {unit_name(unit)}".rstrip()
    return f"{' x '.join(map(str, shape))} voxels{size}"


def format_percent(share: float) -> str:
    """Return a share in percent."""
    return f"{format_number(100 * share, 2)}{_GLUE}%"


def format_length(value: float, unit: str, digits: int = 2) -> str:
    """Return a length in the unit in which it is 1 to 1000."""
    if unit not in METRES or not math.isfinite(value) or value <= 0:
        return f"{format_number(value, digits)}{_GLUE}{unit_name(unit, value)}"
    metres = value * METRES[unit]
    not_longer = [name for name, size in METRES.items() if metres / size >= 0.9995]  # 999.5 um is shown as 1 mm
    best = not_longer[-1] if not_longer else "nm"
    return f"{format_number(metres / METRES[best], digits)}{_GLUE}{unit_name(best)}"


def plain_unit(unit: str, power: int) -> str:
    """Return a unit to a power in plain signs: mm, 1/mm, 1/mm^3."""
    raised = unit if abs(power) == 1 else f"{unit}^{abs(power)}"
    return "" if power == 0 else raised if power > 0 else f"1/{raised}"


def power_name(unit: str, power: int) -> str:
    """Return a unit to a power as written in text: µm, µm³, 1/µm³, or nothing for a plain number."""
    return plain_unit(unit_name(unit), power).replace("^2", "²").replace("^3", "³")


def unit_name(unit: str, count: float = 1) -> str:
    """Return a unit as written in text: µm for `um`, voxels for several."""
    return "µm" if unit == "um" else "voxels" if unit == "voxel" and count != 1 else unit
