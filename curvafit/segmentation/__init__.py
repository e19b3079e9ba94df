"""From evidence and a prior to a volume: grey values, probabilities, or annotated slices."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
