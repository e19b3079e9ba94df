from .flow import Working as Working
from .labels import reconstruct_labels as reconstruct_labels
from .reconstruction import reconstruct as reconstruct
from .result import Segmentation as Segmentation
from .result import write_mask as write_mask
from .segmentation import Calibration as Calibration
from .segmentation import calibrate as calibrate
from .segmentation import segment as segment
