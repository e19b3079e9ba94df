"""Labels against shapes that are known exactly, on cubic and anisotropic voxels."""

import numpy as np
import pytest
import torch
from exact import Cylinder, Plane, Shape, Sphere, Torus, Tubes, centres, profile
from scipy import ndimage
from scipy.spatial import cKDTree

from curvafit.data_synth.labels import NAMES, field_distance, instances_of, labels_of
from curvafit.geometry import betti_numbers, surface
from curvafit.geometry.centreline import skeleton_of
from curvafit.geometry.diagrams import MARGIN
from curvafit.priors.grid import Grid

pytestmark = pytest.mark.slow

CUBES, FLAT = (1.0, 1.0, 1.0), (1.0, 0.7, 0.5)
MIDDLE = (14.1, 14.3, 13.8)


def grid(spacing: tuple[float, float, float]) -> Grid:
    z, y, x = (round(28 / h) for h in spacing)
    return Grid((z, y, x), spacing, "replicate")


SHAPES: dict[str, Shape] = {
    "plane": Plane((1.0, 0.4, 0.3), MIDDLE), "sphere": Sphere(5.0, MIDDLE), "torus": Torus(9.0, 4.0, MIDDLE),
    "cylinder": Cylinder(5.0, (0.3, 1.0, 0.4), MIDDLE),
}  # fmt: skip


@pytest.mark.parametrize("spacing", [CUBES, FLAT])
@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("width", [1.0, 1.25])
def test_distance(name: str, spacing: tuple[float, float, float], width: float) -> None:
    """Whatever the profile's width: as generated fields' are, it may be up to a quarter wider than tanh."""
    box = grid(spacing)
    truth = SHAPES[name].distance(centres(box)).numpy()
    u = profile(SHAPES[name], centres(box), 2.0 * width).float()
    found = field_distance(u, box, 2.0)
    inner = (slice(6, -6),) * 3
    error, depth = np.abs(found - truth)[inner], np.abs(truth)[inner]
    assert np.array_equal(found > 0, (u > 0).numpy())
    assert error[depth < 1].max() < 0.05
    assert error.mean() < 0.04 and error.max() < 0.45


def test_distance_of_a_hard_field_is_that_of_the_faces() -> None:
    box = Grid((16, 16, 16), 1.0, "replicate")  # type: ignore[arg-type]
    u = torch.where(torch.arange(16) < 7, 1.0, -1.0).expand(16, 16, 16)
    assert np.allclose(field_distance(u, box, 2.0)[3, 4], 6.5 - np.arange(16), atol=1e-5)


def test_distance_agrees_with_the_mesh_of_a_labyrinth(labyrinth) -> None:
    """Half a voxel or less from the surface, whose mesh is a hundredth of a voxel off itself."""
    u, box = labyrinth
    mesh = surface(u, box)
    corners = mesh.vertices[mesh.faces]
    weights = np.random.default_rng(0).dirichlet((1, 1, 1), (len(corners), 24))
    cloud = np.einsum("nkc,ncd->nkd", weights, corners).reshape(-1, 3)
    found = field_distance(u, box, 0.02)
    near = np.argwhere(np.abs(found) < 0.005)
    near = near[(near > 1).all(1) & (near < 30).all(1)]
    expected = cKDTree(cloud).query(near * 0.01)[0]
    error = np.abs(np.abs(found[tuple(near.T)]) - expected) / 0.01
    assert error.mean() < 0.03 and np.quantile(error, 0.99) < 0.1


#: Betti numbers of shapes, and how deep their skeletons lie.
KNOWN = {"sphere": ((1, 0, 0), 2.5), "cylinder": ((1, 0, 0), 4.0), "torus": ((1, 1, 0), 3.0)}


@pytest.mark.parametrize("spacing", [CUBES, FLAT])
@pytest.mark.parametrize("name", KNOWN)
def test_labels_of_known_shapes(name: str, spacing: tuple[float, float, float]) -> None:
    """Curvatures within 6 % of the greater one: of the surface itself, though the voxels are beside it. The largest
    ball's radius, half a voxel too little at most; at the rim of the box as inside it. A skeleton with the mask's Betti
    numbers."""
    box, shape, (betti, depth) = grid(spacing), SHAPES[name], KNOWN[name]
    labels = labels_of(profile(shape, centres(box), 2.0), box, 2.0)
    mask, known = labels["mask"], np.isfinite(labels["kappa1"])
    assert np.array_equal(known, np.isfinite(labels["kappa2"])) and known.sum() > 300
    d, curvatures = shape.distance(centres(box)), shape.curvatures(centres(box))
    truth = [(κ / (1 + κ * d)).numpy()[known] for κ in curvatures]
    for found, right in zip((labels["kappa1"][known], labels["kappa2"][known]), truth, strict=True):
        assert np.abs(found - right).max() < 0.06 * np.abs(truth[0]).max()
    assert np.abs(d.numpy()[known]).max() <= max(spacing)
    beside, inner = ndimage.binary_dilation(mask) & ~ndimage.binary_erosion(mask), (slice(MARGIN, -MARGIN),) * 3
    assert np.array_equal(known[inner], beside[inner]) and known.sum() == known[inner].sum()
    assert np.all(labels["radius"][~mask] == 0)
    if name != "torus":
        inside = labels["radius"][mask]
        assert 5 - 0.6 * max(spacing) < inside.mean() < 5 + 0.1 and inside.max() < 5 + 0.5 * max(spacing)
    assert labels["betti"] == betti_numbers(labels["skeleton"]) == betti
    assert labels["distance"][labels["skeleton"]].min() > depth - max(spacing)


def test_the_skeleton_of_a_labyrinth_has_its_topology(labyrinth) -> None:
    """In one piece without a cavity; the faces of the box leave two tunnels of half a gyroid's."""
    labels = labels_of(*labyrinth, 0.02)
    assert not (labels["skeleton"] & ~labels["mask"]).any()
    assert betti_numbers(labels["skeleton"]) == labels["betti"] == (1, 2, 0)


@pytest.mark.parametrize(("gap", "count"), [(3.0, 2), (-0.5, 2), (-6.0, 1)])
@pytest.mark.parametrize("spacing", [CUBES, FLAT])
def test_two_balls_are_two_until_they_are_one(gap: float, count: int, spacing: tuple[float, float, float]) -> None:
    """Apart, touching, and overlapping by half."""
    box = grid(spacing)
    balls = [Sphere(5.0, (14.1, 14.2, 14.0 + side * (5 + gap / 2))) for side in (-1, 1)]
    u = torch.stack([profile(ball, centres(box), 1.0) for ball in balls]).amax(0)
    labels = labels_of(u, box, 1.0, ("instances", "mask", "betti"))
    found = labels["instances"]
    assert found.max() == count and np.array_equal(found > 0, labels["mask"])
    assert labels["betti"][0] == (2 if gap > 0 else 1)
    if count == 2:
        sides = centres(box)[..., 2].numpy() > 14.0
        assert (found[labels["mask"]] == sides[labels["mask"]] + found[labels["mask"] & ~sides][0] * 1.0).mean() > 0.98


def test_beads_on_a_string_and_an_even_tube() -> None:
    """And a shell with its cavity, and a ball whose eighths lie in the corners of the box."""
    box = grid(CUBES)
    line = np.array([(14.0, 14.2, -20.0), (14.0, 14.2, 50.0)])
    thin, even = Tubes(1.5, (line,)).distance(centres(box)), Tubes(4.0, (line,)).distance(centres(box))
    beads = torch.stack([Sphere(5.0, (14.0, 14.2, x)).distance(centres(box)) for x in (7.0, 21.0)]).amax(0)
    strung = torch.maximum(thin, beads).numpy().astype(np.float32)
    assert instances_of(strung).max() == 2 and betti_numbers(strung > 0)[0] == 1
    assert instances_of(even.numpy().astype(np.float32)).max() == 1
    d = Sphere(9.0, MIDDLE).distance(centres(box))
    distance = torch.minimum(d, 5 - d).numpy().astype(np.float32)
    assert betti_numbers(distance > 0) == betti_numbers(skeleton_of(distance)) == (1, 0, 1)
    cut = torch.roll(profile(Sphere(5.0, MIDDLE), centres(box), 1.0), (14, 14, 14), (0, 1, 2))
    assert labels_of(cut, box, 1.0, "instances")["instances"].max() == 8


def test_only_what_is_asked_for() -> None:
    box = grid(CUBES)
    u = profile(SHAPES["sphere"], centres(box), 2.0)
    for name in NAMES:
        assert list(labels_of(u, box, 2.0, name)) == [name]
    assert tuple(labels_of(u.numpy(), box, 2.0)) == NAMES
