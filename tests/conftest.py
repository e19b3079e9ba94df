"""What all tests share: where outside data is, and array shapes checked against their annotations."""

import os
from pathlib import Path

import pytest

try:
    from jaxtyping import install_import_hook
except ImportError:  # the development extra is not installed: shapes go unchecked
    pass
else:
    install_import_hook(
        ["curvafit.priors.stencils", "curvafit.priors.profile", "curvafit.priors.energies"], "beartype.beartype"
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
def labyrinth():
    """The profile of one side of a gyroid, 32³ voxels: tubes that meet, by formula; and its periodic grid."""
    from exact import Gyroid, centres, profile

    from curvafit.priors.grid import Grid

    grid = Grid((32, 32, 32))
    return profile(Gyroid(0.32), centres(grid), 0.02).float(), grid


@pytest.fixture(params=["torch", "fused"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Flows step in plain torch, as on a GPU, or in the fused kernels."""
    if request.param == "torch":
        monkeypatch.setattr("curvafit.priors.kernels.has_kernel", lambda device: False)
    return request.param
