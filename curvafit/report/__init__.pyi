from .atlas import write_map as write_map
from .comparison import write_comparison as write_comparison
from .inference import describe as describe
from .inference import report_html as report_html
from .inference import write_inference as write_inference
from .measures import write_measures as write_measures
