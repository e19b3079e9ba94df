"""Cases of a training set: one shape, its image and mask, each by its number alone."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from flat_recipe import SHAPE, flat_recipe

from curvafit.data_synth.case import Recipe
from curvafit.data_synth.imaging.modality import Imaging, Modality
from curvafit.data_synth.sources import Generated, PhaseField, decode_source
from curvafit.generation import loop as steering


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Recipe:
    return flat_recipe(tmp_path_factory.mktemp("shapes") / "s.zarr")


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
    assert decode_source(source.as_dict()) == source
    monkeypatch.setattr(steering, "FRACTION_LAST", -1.0)
    missed = source.shape((20, 20, 20), 0, np.random.default_rng(0))
    assert f"volume fraction {(missed.values > 0).mean():.4f} instead of 0.1500" in missed.origin["status"]


def test_a_shape_that_falls_between_the_slices_is_not_a_case():
    class Sheets:
        """Half sheets beside the only slice, the third one on it, if asked for."""

        edge, scales = 11.0, ()

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
    """The same shapes, cropped smaller and shown larger; one calibre leaves a case as it is."""
    thick = replace(recipe, calibres=(1.0, 2.0))
    cases = [thick.case(index) for index in range(4)]
    voxels = [case.record["voxel"] for case in cases]
    assert len(set(voxels)) == 4 and min(voxels) >= 0.5 and max(voxels) <= 1.0
    assert [case.epsilon for case in cases] == pytest.approx([2 * voxel for voxel in voxels])


def test_a_recipe_reads_back(recipe):
    thick = replace(recipe, calibres=(1.0, 2.0))
    assert Recipe.from_dict(json.loads(json.dumps(thick.as_dict()))) == thick
    kept = recipe.source.as_dict()
    assert decode_source(kept) == recipe.source and kept["draws"] > 0
