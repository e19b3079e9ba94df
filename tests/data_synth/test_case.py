"""Cases of a training set: one shape, its image and mask by number alone; where shapes come from."""

import json
from dataclasses import replace

import numpy as np
import pytest
from exact_store import CROP as SHAPE
from exact_store import flat_recipe

from curvafit.data_synth import sources
from curvafit.data_synth.dataset import Recipe
from curvafit.data_synth.imaging.modality import Imaging, Modality
from curvafit.data_synth.sources import SYMMETRIES, Generated, PhaseField, apply_symmetry, crop_periodic, random_crop
from curvafit.generation import loop as steering


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Recipe:
    return flat_recipe(tmp_path_factory.mktemp("shapes") / "s")


def test_a_case_is_the_image_of_its_field(recipe):
    case = recipe.case(3)
    assert case.image.shape == case.field.shape == SHAPE and case.image.dtype == np.uint16
    assert case.spacing == (1.0, 0.5, 0.5) and case.unit == "um" and case.epsilon == pytest.approx(1.0)
    inside, outside = (case.image[part].mean() for part in (case.field > 0.9, case.field < -0.9))
    level = case.record["imaging"]["contrast"]["foreground"]
    assert abs(inside - level) < 0.15 * level and abs(outside - 10) < 6
    again, other = recipe.case(3), recipe.case(4)
    assert (again.image == case.image).all() and again.record == case.record
    assert (other.image != case.image).any()


def test_generated_shapes_take_turns_and_other_seeds():
    tubes, sheet = (1.0, 2.0, 6.0, -40.0, -40.0, 400.0, -0.5), (1.0, 0.0, 1.0, 0.0, 0.0, 0.0, -0.2)
    source = Generated((tubes, sheet), ("tubes", "sheet"))
    made = [source.shape((16, 16, 16), index, np.random.default_rng(index)) for index in (0, 2)]
    assert [each.origin["name"] for each in made] == ["tubes", "tubes"]
    assert made[0].origin["seed"] != made[1].origin["seed"] and (made[0].values != made[1].values).any()
    assert made[0].epsilon == 2.0 and made[0].values.dtype == np.float32
    again = source.shape((16, 16, 16), 0, np.random.default_rng(0))
    assert (again.values == made[0].values).all()


def test_shapes_fill_the_share_that_is_asked_for(monkeypatch):
    point = (1.0, 2.0, 6.0, -40.0, -40.0, 400.0, -0.5)
    source = Generated((point,), ("tubes",), fraction=0.15)
    made = source.shape((20, 20, 20), 0, np.random.default_rng(0))
    assert (made.values > 0).mean() == 0.15 and made.origin["parameters"]["mass"] != -0.5
    assert "after 1500 steps" in made.origin["status"] and "volume fraction" not in made.origin["status"]
    assert sources.decode_source(source.as_dict()) == source
    monkeypatch.setattr(steering, "FRACTION_LAST", -1.0)
    missed = source.shape((20, 20, 20), 0, np.random.default_rng(0))
    assert f"volume fraction {(missed.values > 0).mean():.4f} instead of 0.1500" in missed.origin["status"]


def test_a_shape_that_falls_between_the_slices_is_not_a_case():
    class Sheets:
        """Half sheets beside the only slice, the third one on it, if asked for."""

        edge = 11.0

        def __init__(self, third: int) -> None:
            self.asked, self.places = 0, [0, 0, third]

        def shape(self, voxels, index, rng):
            field = np.full(voxels, -1.0, np.float32)
            field[self.places[min(self.asked, 2)], :4] = 1.0
            self.asked += 1
            return PhaseField(field, 2.0, {"name": "sheet"})

    coarse = Modality("coarse", "for tests", 1.0, Imaging(spacing=(11.0, 1.0, 1.0)))
    seen = Sheets(third=5)
    case = Recipe(seen, coarse, (1, 8, 8), 1.0).case(0)
    assert seen.asked == 3 and (case.field[0, :4] > 0).all() and (case.field[0, 4:] < 0).all()
    with pytest.raises(ValueError, match="1 x 8 x 8"):
        Recipe(Sheets(third=0), coarse, (1, 8, 8), 1.0).case(0)


def test_structures_of_many_calibres(recipe):
    """The same shapes, cropped smaller and shown larger; such a recipe reads back."""
    thick = replace(recipe, calibres=(1.0, 2.0))
    cases = [thick.case(index) for index in range(4)]
    voxels = [case.record["voxel"] for case in cases]
    assert len(set(voxels)) == 4 and min(voxels) >= 0.5 and max(voxels) <= 1.0
    assert [case.epsilon for case in cases] == pytest.approx([2 * voxel for voxel in voxels])
    assert Recipe.from_dict(json.loads(json.dumps(thick.as_dict()))) == thick
    kept = recipe.source.as_dict()
    assert sources.decode_source(kept) == recipe.source and kept["draws"] > 0


VALUES = np.random.default_rng(0).random((3, 4, 5))


def test_the_48_symmetries_are_a_group_of_which_the_first_is_none():
    """They move the last three axes."""
    cube = np.arange(27).reshape(3, 3, 3)
    moved = [apply_symmetry(cube, k) for k in range(SYMMETRIES)]
    each = {part.tobytes() for part in moved}
    assert len(each) == 48 and (moved[0] == cube).all()
    assert {apply_symmetry(part, k).tobytes() for part in moved for k in range(SYMMETRIES)} == each
    pair = np.stack([VALUES, 2 * VALUES])
    for k in range(0, SYMMETRIES, 7):
        assert (apply_symmetry(pair, k)[1] == 2 * apply_symmetry(VALUES, k)).all()


def test_a_crop_goes_on_across_the_faces():
    """And of the whole it is a shift."""
    tiled = np.tile(VALUES, (2, 2, 2))
    for corner in ((0, 0, 0), (2, 3, 4), (1, 3, 0)):
        z, y, x = corner
        assert (crop_periodic(VALUES, corner, (3, 2, 4)) == tiled[z : z + 3, y : y + 2, x : x + 4]).all()
    found, how = random_crop(VALUES, (3, 3, 3), np.random.default_rng(5))
    again, _ = random_crop(VALUES, (3, 3, 3), np.random.default_rng(5))
    assert found.shape == (3, 3, 3) and (found == again).all() and found.flags["C_CONTIGUOUS"]
    assert (crop_periodic(apply_symmetry(VALUES, how["symmetry"]), how["corner"], (3, 3, 3)) == found).all()
