"""Volume files and what they hold: values with spacing, unit and affine."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.volumes.field import Field
    from curvafit.volumes.formats.base import ScanError
    from curvafit.volumes.parameter_maps import read_maps
    from curvafit.volumes.scan import save
    from curvafit.volumes.source import Source, field_of, load

__all__ = [
    "Field",
    "ScanError",
    "Source",
    "field_of",
    "load",
    "read_maps",
    "save",
]

_HOMES = {
    "Field": "curvafit.volumes.field",
    "ScanError": "curvafit.volumes.formats.base",
    "Source": "curvafit.volumes.source",
    "field_of": "curvafit.volumes.source",
    "load": "curvafit.volumes.source",
    "read_maps": "curvafit.volumes.parameter_maps",
    "save": "curvafit.volumes.scan",
}

offer(__name__, _HOMES)
