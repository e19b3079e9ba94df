from .formats.base import ScanError as ScanError
from .read import Source as Source
from .read import load as load
from .read import read_maps as read_maps
from .volume import Volume as Volume
from .write import save as save
