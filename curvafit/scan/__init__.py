"""A scan as it is read: what in it is structure, its blur and noise, the grid it is worked on, its measures."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
