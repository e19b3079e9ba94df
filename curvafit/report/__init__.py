"""The pages that show an inference, an atlas, measured scans, a comparison of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.report.atlas import write_map as write_map
    from curvafit.report.comparison import write_comparison as write_comparison
    from curvafit.report.measures import write_measures as write_measures
    from curvafit.report.page import describe as describe
    from curvafit.report.page import report_html as report_html
    from curvafit.report.page import write_inference as write_inference
    from curvafit.report.page import write_report as write_report

attach_lazy_names(__name__)
