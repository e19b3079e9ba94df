"""The page that shows an inference."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.report.page import report_html, write_inference, write_report
    from curvafit.report.wording import describe

__all__ = [
    "describe",
    "report_html",
    "write_inference",
    "write_report",
]

_HOMES = {
    "describe": "curvafit.report.wording",
    "report_html": "curvafit.report.page",
    "write_inference": "curvafit.report.page",
    "write_report": "curvafit.report.page",
}

offer(__name__, _HOMES)
