"""An atlas on the plane, as a picture and as a page to explore."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.atlas_map.describe import describe
    from curvafit.atlas_map.extract import extract
    from curvafit.atlas_map.files import write_map
    from curvafit.atlas_map.layout import AtlasMap, map_atlas

__all__ = [
    "AtlasMap",
    "describe",
    "extract",
    "map_atlas",
    "write_map",
]

_HOMES = {
    "AtlasMap": "curvafit.atlas_map.layout",
    "describe": "curvafit.atlas_map.describe",
    "extract": "curvafit.atlas_map.extract",
    "map_atlas": "curvafit.atlas_map.layout",
    "write_map": "curvafit.atlas_map.files",
}

offer(__name__, _HOMES)
