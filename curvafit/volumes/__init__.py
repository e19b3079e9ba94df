"""Volume files and what they hold: values with spacing, unit and affine."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.volumes.formats.base import ScanError as ScanError
    from curvafit.volumes.parameter_maps import read_maps as read_maps
    from curvafit.volumes.read import Source as Source
    from curvafit.volumes.read import load as load
    from curvafit.volumes.volume import Volume as Volume
    from curvafit.volumes.write import save as save

attach_lazy_names(__name__)
