"""The collecting: atlases and training sets."""

if __name__ != "curvafit.data_synth":
    raise ImportError(
        "import curvafit.data_synth, not data_synth: the folder at the project's root is a link into the package"
    )
