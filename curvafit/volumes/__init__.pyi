from .formats.base import ScanError as ScanError
from .parameter_maps import read_maps as read_maps
from .read import Source as Source
from .read import load as load
from .volume import Volume as Volume
from .write import save as save
