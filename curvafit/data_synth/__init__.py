"""The collecting: atlases and training sets."""

from typing import TYPE_CHECKING

from curvafit.core.faces import attach_lazy_names

if TYPE_CHECKING:
    from curvafit.core.workers import Cluster as Cluster
    from curvafit.core.workers import cluster as cluster
    from curvafit.data_synth.atlas import build as build
    from curvafit.data_synth.atlas import extend as extend
    from curvafit.data_synth.dataset import TextureDataset as TextureDataset
    from curvafit.data_synth.dataset import as_dict as as_dict
    from curvafit.data_synth.dataset import as_monai as as_monai
    from curvafit.data_synth.design import INTERVALS as INTERVALS
    from curvafit.data_synth.design import Design as Design
    from curvafit.data_synth.design import Draw as Draw
    from curvafit.data_synth.design import design_around as design_around
    from curvafit.data_synth.design import design_box as design_box
    from curvafit.data_synth.design import read_design as read_design
    from curvafit.data_synth.extract import describe as describe
    from curvafit.data_synth.extract import extract as extract
    from curvafit.data_synth.imaging.modality import MODALITIES as MODALITIES
    from curvafit.data_synth.imaging.modality import Contrast as Contrast
    from curvafit.data_synth.imaging.modality import Detector as Detector
    from curvafit.data_synth.imaging.modality import Illumination as Illumination
    from curvafit.data_synth.imaging.modality import Imaging as Imaging
    from curvafit.data_synth.imaging.modality import Modality as Modality
    from curvafit.data_synth.imaging.modality import Noise as Noise
    from curvafit.data_synth.imaging.modality import Optics as Optics
    from curvafit.data_synth.imaging.modality import Specimen as Specimen
    from curvafit.data_synth.imaging.modality import modality as modality
    from curvafit.data_synth.labels import labels_of as labels_of
    from curvafit.data_synth.store import Record as Record
    from curvafit.data_synth.store import Settings as Settings
    from curvafit.data_synth.store import Store as Store
    from curvafit.data_synth.store import open_store as open_store

attach_lazy_names(__name__)
