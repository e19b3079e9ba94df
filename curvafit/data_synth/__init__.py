"""The collecting: atlases and training sets."""

if __name__ != "curvafit.data_synth":
    raise ImportError(
        "import curvafit.data_synth, not data_synth: the folder at the project's root is a link into the package"
    )

from curvafit.data_synth.atlas.build import build, diagrams, extend
from curvafit.data_synth.atlas.design import INTERVALS, Design, Draw, around, boxed
from curvafit.data_synth.atlas.design_file import read_design
from curvafit.data_synth.atlas.store import Record, Settings, Store, open_store
from curvafit.data_synth.atlas.workers import Cluster, cluster
from curvafit.data_synth.imaging.modalities import MODALITIES
from curvafit.data_synth.imaging.modality import Imaging, Modality
from curvafit.data_synth.labels.labels import Labels, labels_of
from curvafit.data_synth.sets.training import TextureDataset, as_dict, as_monai, as_subject

__all__ = [
    "INTERVALS",
    "MODALITIES",
    "Cluster",
    "Design",
    "Draw",
    "Imaging",
    "Labels",
    "Modality",
    "Record",
    "Settings",
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
    "open_store",
    "read_design",
]
