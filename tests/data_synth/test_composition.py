"""What an image shows: walls of even thickness, classes in front of one another."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from exact import Sphere, centres
from exact_store import flat_recipe

from curvafit.data_synth.case import Case, Composition, Recipe, shell_of
from curvafit.data_synth.imaging.effects import occupancy
from curvafit.data_synth.imaging.image import share_voxels
from curvafit.data_synth.imaging.modality import Contrast, Imaging, Modality
from curvafit.data_synth.sources import Generated
from curvafit.priors.grid import Grid
from curvafit.priors.profile import optimal_profile

N, EPSILON = 48, 2.0
GRID = Grid((N, N, N), (1.0, 1.0, 1.0))
MIDDLE = (N / 2, N / 2, N / 2)
CLEAR = Modality("clear", "for tests", 1.0, Imaging(contrast=Contrast(10.0, 110.0)))
LAWS = Generated.of(["tubes", "sponge"])


def recipe_of(source: Generated, **options: Any) -> Recipe:
    return Recipe(source, CLEAR, (16, 16, 16), 1.0, composition=Composition(**options))


@pytest.fixture(scope="module")
def solid(tmp_path_factory: pytest.TempPathFactory) -> Recipe:
    return flat_recipe(tmp_path_factory.mktemp("shapes") / "s.zarr")


@pytest.fixture(scope="module")
def shell(solid: Recipe) -> Recipe:
    return replace(solid, composition=Composition(wall=0.8))


@pytest.fixture(scope="module")
def two() -> Case:
    return recipe_of(LAWS, classes=True, levels=(1, 0.4)).case(0)


@pytest.mark.parametrize("thickness", [4.0, 6.5])
def test_the_wall_of_a_ball_is_a_shell_and_the_lumen_a_ball(thickness):
    distance = Sphere(16.0, MIDDLE).distance(centres(GRID))
    wall, lumen = shell_of(optimal_profile(distance, EPSILON).float(), EPSILON, thickness)
    inner = 4 / 3 * np.pi * (16 - thickness) ** 3
    assert float(occupancy(wall, EPSILON).sum()) == pytest.approx(4 / 3 * np.pi * 16**3 - inner, rel=0.02)
    assert float(occupancy(lumen, EPSILON).sum()) == pytest.approx(inner, rel=0.03)
    depth = distance.numpy()
    assert (wall.numpy()[(depth > 0.5) & (depth < thickness - 0.5)] > 0).all()
    assert (wall.numpy()[(depth < -0.1) | (depth > thickness + 0.5)] < 0).all()


def test_wall_and_lumen_fill_the_shape_without_a_gap():
    u = optimal_profile(Sphere(16.3, MIDDLE).distance(centres(GRID)), EPSILON).float()
    shares, whole = share_voxels(shell_of(u, EPSILON, 5.0), EPSILON), occupancy(u, EPSILON)
    assert float((sum(shares) - whole).abs().max()) < 0.1
    assert float(sum(shares).sum() / whole.sum()) == pytest.approx(1, abs=1e-3)
    assert float(shares[1][whole < 1].max()) == 0  # no light of the lumen at the outer surface


def test_a_shell_has_a_bright_wall_and_a_dark_lumen(solid, shell):
    case, whole = shell.case(2), solid.case(2)
    assert shell.classes == ("wall", "lumen") and case.labels.dtype == np.uint8
    assert ((case.labels > 0) == (case.field > 0)).all() and set(np.unique(case.labels)) == {0, 1, 2}
    wall, lumen, outside = (float(case.image[case.labels == k].mean()) for k in (1, 2, 0))
    assert wall > 2 * lumen and lumen < 0.5 * whole.image[whole.labels > 0].mean() and outside < lumen
    counts = [float((case.labels == k).mean()) for k in (1, 2)]
    assert case.record["class_fractions"] == pytest.approx(counts) and sum(counts) < 1
    one_slice = replace(shell, shape=(1, 16, 16)).case(0)
    assert set(np.unique(one_slice.labels)) == {0, 1, 2}
    wide = replace(solid.modality, base=solid.modality.base.assign({"visible": 0.2}))
    exact, seen = shell.case(2), replace(shell, modality=wide).case(2)
    assert set(np.unique(seen.labels[exact.labels == 0])) == {0, 1}  # what is seen beyond the surface is wall
    counts = [[np.count_nonzero(case.labels == k) for k in (1, 2)] for case in (exact, seen)]
    assert counts[1][0] > counts[0][0] and counts[1][1] > 0.5 * counts[0][1]


def test_classes_are_a_shape_of_each_law_the_first_in_front(two):
    assert [origin["name"] for origin in two.record["source"]] == ["tubes", "sponge"]
    alone = recipe_of(Generated.of(["tubes"])).case(0)
    assert ((two.labels == 1) == (alone.labels == 1)).all()  # no part of the first is hidden
    assert [np.median(two.image[two.labels == k]) for k in range(3)] == pytest.approx([10, 110, 50])
    assert Composition(classes=True).names(Generated.of(["tubes", "tubes"])) == ("tubes 1", "tubes 2")
