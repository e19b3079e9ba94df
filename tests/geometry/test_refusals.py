"""What is asked for wrongly is refused, in one sentence that names what is wrong."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from exact import Cylinder, Sphere, centres, profile

from curvafit.geometry.description import descriptors
from curvafit.geometry.diagrams import Diagram, diagram
from curvafit.geometry.distances import one_to_many, pairwise, wasserstein
from curvafit.geometry.mesh import NoSurface, solid_surface, surface, write_surface
from curvafit.geometry.morphology import morphometry
from curvafit.priors.grid import Grid

GRID, CUBE = Grid((28, 28, 28), (1.0, 1.0, 1.0), "replicate"), Grid((16, 16, 16))
U = profile(Cylinder(6.0, (1.0, 0.8, 0.1), (14.0, 14.0, 14.0)), centres(GRID), 2.0)
TORN, NOWHERE = torch.where(U > 0.9, torch.nan, U), np.zeros(GRID.shape, dtype=bool)
BALL, ONES = surface(Sphere(9.0, (14.0, 14.0, 14.0)).distance(centres(GRID)), GRID), np.ones((16, 16, 16))
A, NONE = Diagram(np.array([[1.0, 2.0], [3.0, 4.0]]), np.ones(2)), Diagram(np.zeros((0, 2)), np.zeros(0))

REFUSALS: list[tuple[str, type[ValueError], Callable[[Path], object]]] = [
    ("crosses", NoSurface, lambda _: surface(U - 5, GRID)),
    ("shape", ValueError, lambda _: surface(torch.zeros(4, 4, 4), GRID)),
    ("finite", ValueError, lambda _: surface(TORN, GRID)),
    ("exceeds", NoSurface, lambda _: solid_surface(-ONES, CUBE)),
    ("stl", ValueError, lambda folder: write_surface(BALL, folder / "ball.obj")),
    ("kappa1", ValueError, lambda folder: write_surface(BALL, folder / "ball.ply", data={"kappa1": np.zeros(3)})),
    ("30 voxels", ValueError, lambda _: diagram(U, GRID, 2.0, margin=13)),
    ("part", NoSurface, lambda _: diagram(U, GRID, 2.0, where=NOWHERE)),
    ("mask", ValueError, lambda _: diagram(U, GRID, 2.0, where=NOWHERE[1:])),
    ("epsilon", ValueError, lambda _: diagram(U, GRID, 0.0)),
    ("curvature", ValueError, lambda _: diagram(U, GRID, 2.0, curvature="mean")),  # type: ignore[arg-type]
    ("points", ValueError, lambda _: Diagram(np.zeros((3, 3)), np.ones(3))),
    ("weights", ValueError, lambda _: Diagram(np.zeros((3, 2)), -np.ones(3))),
    ("width", ValueError, lambda _: A.bin(0.0)),
    ("share", ValueError, lambda _: A.thin(1.0, 0.0)),
    ("empty", ValueError, lambda _: wasserstein(A, NONE)),
    ("unit", ValueError, lambda _: one_to_many(A, [replace(A, unit="1/um")])),
    ("positive", ValueError, lambda _: wasserstein(A, A, blur=0.0)),
    ("positive", ValueError, lambda _: pairwise([A, A], reach=0.0)),
    ("diagram", ValueError, lambda _: wasserstein(np.zeros(3), np.zeros(3))),  # type: ignore[arg-type]
    ("cubic", ValueError, lambda _: descriptors(ONES > 0, Grid((16, 16, 16), (1.0, 1.0, 2.0)))),
    ("inside", NoSurface, lambda _: descriptors(ONES, CUBE)),
    ("inside", NoSurface, lambda _: descriptors(ONES < 0, CUBE)),
    *(("mask", ValueError, lambda _, mask=mask: morphometry(mask)) for mask in (ONES, 0 * ONES, np.eye(5))),
]


@pytest.mark.parametrize(("word", "kind", "ask"), REFUSALS, ids=[f"{k}-{row[0]}" for k, row in enumerate(REFUSALS)])
def test_what_is_wrong_is_named(tmp_path: Path, word: str, kind: type[ValueError], ask: Callable) -> None:
    with pytest.raises(kind, match=word) as error:
        ask(tmp_path)
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())
