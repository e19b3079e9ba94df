"""From a scan to its parameters: prepare, measure, read the posterior, grow, compare, judge."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
