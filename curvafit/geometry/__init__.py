"""What a surface is and measures: meshes, curvature diagrams and their distances, topology, morphometry."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.geometry.descriptors import Descriptors, descriptors
    from curvafit.geometry.diagram import (
        Diagram,
        SurfaceCurvatures,
        diagram,
        diagrams,
        family_of,
        family_shares,
        half_thickness,
        surface_curvatures,
    )
    from curvafit.geometry.distances import one_to_many, pairwise, sinkhorn_divergence, sliced_embedding, wasserstein
    from curvafit.geometry.mesh import (
        NoSurface,
        Surface,
        areas,
        capped_surface,
        solid_surface,
        surface,
        volume,
        write_surface,
    )
    from curvafit.geometry.morphometry import Morphometry, local_thickness, morphometry
    from curvafit.geometry.topology import betti_numbers, components, euler_number

__all__ = [
    "Descriptors",
    "Diagram",
    "Morphometry",
    "NoSurface",
    "Surface",
    "SurfaceCurvatures",
    "areas",
    "betti_numbers",
    "capped_surface",
    "components",
    "descriptors",
    "diagram",
    "diagrams",
    "euler_number",
    "family_of",
    "family_shares",
    "half_thickness",
    "local_thickness",
    "morphometry",
    "one_to_many",
    "pairwise",
    "sinkhorn_divergence",
    "sliced_embedding",
    "solid_surface",
    "surface",
    "surface_curvatures",
    "volume",
    "wasserstein",
    "write_surface",
]

_HOMES = {
    "Descriptors": "curvafit.geometry.descriptors",
    "Diagram": "curvafit.geometry.diagram",
    "Morphometry": "curvafit.geometry.morphometry",
    "NoSurface": "curvafit.geometry.mesh",
    "Surface": "curvafit.geometry.mesh",
    "SurfaceCurvatures": "curvafit.geometry.diagram",
    "areas": "curvafit.geometry.mesh",
    "betti_numbers": "curvafit.geometry.topology",
    "capped_surface": "curvafit.geometry.mesh",
    "components": "curvafit.geometry.topology",
    "descriptors": "curvafit.geometry.descriptors",
    "diagram": "curvafit.geometry.diagram",
    "diagrams": "curvafit.geometry.diagram",
    "euler_number": "curvafit.geometry.topology",
    "family_of": "curvafit.geometry.diagram",
    "family_shares": "curvafit.geometry.diagram",
    "half_thickness": "curvafit.geometry.diagram",
    "local_thickness": "curvafit.geometry.morphometry",
    "morphometry": "curvafit.geometry.morphometry",
    "one_to_many": "curvafit.geometry.distances",
    "pairwise": "curvafit.geometry.distances",
    "sinkhorn_divergence": "curvafit.geometry.distances",
    "sliced_embedding": "curvafit.geometry.distances",
    "solid_surface": "curvafit.geometry.mesh",
    "surface": "curvafit.geometry.mesh",
    "surface_curvatures": "curvafit.geometry.diagram",
    "volume": "curvafit.geometry.mesh",
    "wasserstein": "curvafit.geometry.distances",
    "write_surface": "curvafit.geometry.mesh",
}

offer(__name__, _HOMES)
