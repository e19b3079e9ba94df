"""The making: flows that lower the cost."""

if __name__ != "curvafit.generation":
    raise ImportError(
        "import curvafit.generation, not generation: the folder at the project's root is a link into the package"
    )
