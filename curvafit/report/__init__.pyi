from .atlas import write_map as write_map
from .comparison import write_comparison as write_comparison
from .measures import write_measures as write_measures
from .page import describe as describe
from .page import report_html as report_html
from .page import write_inference as write_inference
from .page import write_report as write_report
