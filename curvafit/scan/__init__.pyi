from .instances import measure_instances as measure_instances
from .measures import Measures as Measures
from .measures import Quantity as Quantity
from .measures import scan_diagram as scan_diagram
from .preparation import Prepared as Prepared
from .preparation import prepare as prepare
from .tiles import measure as measure
