"""The collecting: atlases and training sets."""

if __name__ != "curvafit.data_synth":
    raise ImportError(
        "import curvafit.data_synth, not data_synth: the folder at the project's root is a link into the package"
    )

from typing import TYPE_CHECKING

from curvafit.core.faces import offer

if TYPE_CHECKING:
    from curvafit.data_synth.atlas.build import build, extend
    from curvafit.data_synth.atlas.design import INTERVALS, Design, Draw, around, boxed
    from curvafit.data_synth.atlas.design_file import read_design
    from curvafit.data_synth.atlas.record import Record, Settings
    from curvafit.data_synth.atlas.store import Store, open_store
    from curvafit.data_synth.atlas.workers import Cluster, cluster
    from curvafit.data_synth.imaging.modalities import MODALITIES, modality
    from curvafit.data_synth.imaging.modality import Modality
    from curvafit.data_synth.imaging.parameters import (
        Contrast,
        Detector,
        Illumination,
        Imaging,
        Noise,
        Optics,
        Specimen,
    )
    from curvafit.data_synth.labels.labels import Labels, labels_of
    from curvafit.data_synth.sets.training import TextureDataset, as_dict, as_monai, as_subject
    from curvafit.geometry.diagram import diagrams

__all__ = [
    "INTERVALS",
    "MODALITIES",
    "Cluster",
    "Contrast",
    "Design",
    "Detector",
    "Draw",
    "Illumination",
    "Imaging",
    "Labels",
    "Modality",
    "Noise",
    "Optics",
    "Record",
    "Settings",
    "Specimen",
    "Store",
    "TextureDataset",
    "around",
    "as_dict",
    "as_monai",
    "as_subject",
    "boxed",
    "build",
    "cluster",
    "diagrams",
    "extend",
    "labels_of",
    "modality",
    "open_store",
    "read_design",
]

_HOMES = {
    "Cluster": "curvafit.data_synth.atlas.workers",
    "Contrast": "curvafit.data_synth.imaging.parameters",
    "Design": "curvafit.data_synth.atlas.design",
    "Detector": "curvafit.data_synth.imaging.parameters",
    "Draw": "curvafit.data_synth.atlas.design",
    "INTERVALS": "curvafit.data_synth.atlas.design",
    "Illumination": "curvafit.data_synth.imaging.parameters",
    "Imaging": "curvafit.data_synth.imaging.parameters",
    "Labels": "curvafit.data_synth.labels.labels",
    "MODALITIES": "curvafit.data_synth.imaging.modalities",
    "Modality": "curvafit.data_synth.imaging.modality",
    "Noise": "curvafit.data_synth.imaging.parameters",
    "Optics": "curvafit.data_synth.imaging.parameters",
    "Record": "curvafit.data_synth.atlas.record",
    "Settings": "curvafit.data_synth.atlas.record",
    "Specimen": "curvafit.data_synth.imaging.parameters",
    "Store": "curvafit.data_synth.atlas.store",
    "TextureDataset": "curvafit.data_synth.sets.training",
    "around": "curvafit.data_synth.atlas.design",
    "as_dict": "curvafit.data_synth.sets.training",
    "as_monai": "curvafit.data_synth.sets.training",
    "as_subject": "curvafit.data_synth.sets.training",
    "boxed": "curvafit.data_synth.atlas.design",
    "build": "curvafit.data_synth.atlas.build",
    "cluster": "curvafit.data_synth.atlas.workers",
    "diagrams": "curvafit.geometry.diagram",
    "extend": "curvafit.data_synth.atlas.build",
    "labels_of": "curvafit.data_synth.labels.labels",
    "modality": "curvafit.data_synth.imaging.modalities",
    "open_store": "curvafit.data_synth.atlas.store",
    "read_design": "curvafit.data_synth.atlas.design_file",
}

offer(__name__, _HOMES)
