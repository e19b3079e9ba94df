from .generation.flow import descend as descend
from .generation.flow import generate as generate
from .generation.result import Flow as Flow
from .geometry.diagrams import Diagram as Diagram
from .geometry.diagrams import diagram as diagram
from .geometry.distances import wasserstein as wasserstein
from .inference.fit import Fit as Fit
from .inference.inference import Inference as Inference
from .inference.inference import infer as infer
from .priors.coefficients import Coefficients as Coefficients
from .priors.grid import Grid as Grid
from .priors.law import preset as preset
from .scan.instances import measure_instances as measure_instances
from .scan.measures import Measures as Measures
from .scan.tiles import measure as measure
from .segmentation.reconstruction import reconstruct as reconstruct
from .segmentation.result import Segmentation as Segmentation
from .segmentation.segmentation import segment as segment
from .studies.comparison import Comparison as Comparison
from .studies.comparison import compare as compare
from .studies.windowed import Windows as Windows
from .studies.windowed import windows as windows
from .volumes.read import load as load
from .volumes.volume import Volume as Volume
from .volumes.write import save as save

__version__: str
