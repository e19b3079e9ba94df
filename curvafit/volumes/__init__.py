"""Volume files and what they hold: values with spacing, unit and affine."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
