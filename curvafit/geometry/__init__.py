"""What a surface is and measures: meshes, curvature diagrams and their distances, topology, morphometry."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
