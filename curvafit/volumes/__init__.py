"""Volume files and what they hold: values with spacing, unit and affine."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.faces import offer

if TYPE_CHECKING:
    from curvafit.volumes.formats.base import ScanError
    from curvafit.volumes.parameter_maps import read_maps
    from curvafit.volumes.scan import Field, load, save

__all__ = [
    "Field",
    "ScanError",
    "load",
    "read_maps",
    "save",
]

_HOMES = {
    "Field": "curvafit.volumes.scan",
    "ScanError": "curvafit.volumes.formats.base",
    "load": "curvafit.volumes.scan",
    "read_maps": "curvafit.volumes.parameter_maps",
    "save": "curvafit.volumes.scan",
}

offer(__name__, _HOMES)
