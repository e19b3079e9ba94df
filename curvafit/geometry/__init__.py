"""What a surface is and measures: meshes, curvature diagrams and their distances, topology, morphometry."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.geometry.descriptors import Descriptors as Descriptors
    from curvafit.geometry.descriptors import descriptors as descriptors
    from curvafit.geometry.diagram import Diagram as Diagram
    from curvafit.geometry.diagram import diagram as diagram
    from curvafit.geometry.diagram import family_of as family_of
    from curvafit.geometry.diagram import family_shares as family_shares
    from curvafit.geometry.diagram import half_thickness as half_thickness
    from curvafit.geometry.distances import one_to_many as one_to_many
    from curvafit.geometry.distances import pairwise as pairwise
    from curvafit.geometry.distances import sliced_embedding as sliced_embedding
    from curvafit.geometry.distances import wasserstein as wasserstein
    from curvafit.geometry.mesh import NoSurface as NoSurface
    from curvafit.geometry.mesh import Surface as Surface
    from curvafit.geometry.mesh import areas as areas
    from curvafit.geometry.mesh import capped_surface as capped_surface
    from curvafit.geometry.mesh import solid_surface as solid_surface
    from curvafit.geometry.mesh import surface as surface
    from curvafit.geometry.mesh import volume as volume
    from curvafit.geometry.mesh import write_surface as write_surface
    from curvafit.geometry.morphometry import Morphometry as Morphometry
    from curvafit.geometry.morphometry import local_thickness as local_thickness
    from curvafit.geometry.morphometry import morphometry as morphometry
    from curvafit.geometry.topology import betti_numbers as betti_numbers
    from curvafit.geometry.topology import components as components
    from curvafit.geometry.topology import euler_number as euler_number

attach_lazy_names(__name__)
