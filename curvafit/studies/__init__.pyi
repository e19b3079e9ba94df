from .comparison import Comparison as Comparison
from .comparison import Number as Number
from .comparison import compare as compare
from .scans import write_table as write_table
from .windowed import Windows as Windows
from .windowed import windows as windows
