"""An atlas on the plane, as a picture and as a page to explore."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.atlas_map.extract import describe as describe
    from curvafit.atlas_map.extract import extract as extract
    from curvafit.atlas_map.files import write_map as write_map
    from curvafit.atlas_map.layout import AtlasMap as AtlasMap
    from curvafit.atlas_map.layout import map_atlas as map_atlas

attach_lazy_names(__name__)
