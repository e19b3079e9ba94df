"""One scan's numbers with their errors, and what many scans say together."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.scan.measure import Measures as Measures
    from curvafit.scan.measure import Quantity as Quantity
    from curvafit.scan.tiles import measure as measure
    from curvafit.studies.compare import Comparison as Comparison
    from curvafit.studies.compare import Number as Number
    from curvafit.studies.compare import compare as compare
    from curvafit.studies.tables import write_table as write_table
    from curvafit.studies.windows import Windows as Windows
    from curvafit.studies.windows import windows as windows

attach_lazy_names(__name__)
