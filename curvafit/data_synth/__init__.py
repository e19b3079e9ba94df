"""The collecting: atlases and training sets."""

if __name__ != "curvafit.data_synth":
    raise ImportError(
        "import curvafit.data_synth, not data_synth: the folder at the project's root is a link into the package"
    )

from curvafit.data_synth.atlas import build, diagrams
from curvafit.data_synth.design import INTERVALS, random_law, start_seed
from curvafit.data_synth.store import Record, Settings, Store, open_store

__all__ = [
    "INTERVALS",
    "Record",
    "Settings",
    "Store",
    "build",
    "diagrams",
    "open_store",
    "random_law",
    "start_seed",
]
