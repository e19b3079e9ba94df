"""What all tests share: where outside data is, and array shapes checked against their annotations."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

try:
    from jaxtyping import install_import_hook
except ImportError:  # the development extra is not installed: shapes go unchecked
    pass
else:
    install_import_hook(
        ["curvafit.priors.stencils", "curvafit.priors.profile", "curvafit.priors.energy"], "beartype.beartype"
    )


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of outside volumes that `$CURVAFIT_DATA` names."""
    named = os.environ.get("CURVAFIT_DATA")
    if not named:
        pytest.skip("needs outside data: set CURVAFIT_DATA to its folder")
    folder = Path(named)
    if not folder.is_dir():
        pytest.skip(f"needs outside data: CURVAFIT_DATA names {named}, which is not a folder")
    return folder


@pytest.fixture(scope="session")
def made():
    """A generated shape of 32³ voxels, tubes that meet, and its periodic grid."""
    from curvafit.generation import generate

    flow = generate("sponge", grid=32, seed=3)
    return flow.field, flow.grid
