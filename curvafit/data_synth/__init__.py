"""The collecting: atlases and training sets."""

import lazy_loader

from curvafit.core.checks import refuse_link

refuse_link(__name__)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
