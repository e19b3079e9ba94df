"""Volume files and what they hold: values with spacing, unit and affine."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.volumes.field import Field as Field
    from curvafit.volumes.formats.base import ScanError as ScanError
    from curvafit.volumes.parameter_maps import read_maps as read_maps
    from curvafit.volumes.scan import save as save
    from curvafit.volumes.source import Source as Source
    from curvafit.volumes.source import field_of as field_of
    from curvafit.volumes.source import load as load

attach_lazy_names(__name__)
