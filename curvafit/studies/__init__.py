"""One scan's numbers with their errors, and what many scans say together."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.scan.measure import Measures, Quantity, measure
    from curvafit.studies.tables import write_table

__all__ = ["Measures", "Quantity", "measure", "write_table"]

_HOMES = {
    "Measures": "curvafit.scan.measure",
    "Quantity": "curvafit.scan.measure",
    "measure": "curvafit.scan.measure",
    "write_table": "curvafit.studies.tables",
}

offer(__name__, _HOMES)
