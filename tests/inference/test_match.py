"""Matching: a shape finds itself, the short list keeps the true nearest, order and errors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from curvafit.geometry.diagram import Diagram
from curvafit.geometry.distances import one_to_many, wasserstein
from curvafit.inference.atlas import Atlas, load_atlas, nearest


def blob(centre: tuple[float, float], count: int = 60) -> Diagram:
    """A cloud of width 5 about a centre, with κ1 ≥ κ2."""
    points = np.random.default_rng(0).normal(centre, 5, (count, 2))
    return Diagram(np.sort(points, axis=1)[:, ::-1].copy(), np.full(count, 0.1)).bin(2.0)


def atlas_of(fields: tuple[Diagram, ...], masks: tuple[Diagram, ...]) -> Atlas:
    n = len(fields)
    coefficients = np.arange(6.0 * n).reshape(n, 6) + 1
    ids = tuple(f"0-{i:05d}" for i in range(n))
    return Atlas(
        ids, coefficients, -0.1 * np.arange(n), np.arange(n) + 100, np.full(n, 0.3), np.full(n, 8.0), fields, masks, {}
    )


def every_third(atlas: Atlas) -> Atlas:
    names = ("ids", "coefficients", "masses", "seeds", "volume_fractions", "thicknesses")
    names += ("field_diagrams", "mask_diagrams")
    return dataclasses.replace(atlas, **{name: getattr(atlas, name)[::3] for name in names})


@pytest.fixture(scope="module")
def packaged() -> Atlas:
    return load_atlas()


def test_matches_come_by_distance_with_the_parameters_of_their_shape():
    fields = tuple(blob((30.0 + 10 * k, 0.0)) for k in (3, 0, 2, 1))
    atlas = atlas_of(fields, fields)
    found = nearest(blob((30.0, 0.0)), atlas, count=3)
    assert [match.id for match in found] == ["0-00001", "0-00003", "0-00002"]
    assert found[0].distance == pytest.approx(0, abs=1e-3)
    assert found[1].distance == pytest.approx(wasserstein(blob((30.0, 0.0)), fields[3]), rel=1e-4)
    assert list(found[1].coefficients) == list(atlas.coefficients[3])
    assert (found[1].mass, found[1].seed) == (atlas.masses[3], 103)


def test_a_query_meets_shapes_seen_as_it_is():
    near, far = blob((30.0, 0.0)), blob((60.0, 0.0))
    atlas = atlas_of((near, far), (far, near))
    assert nearest(near, atlas, seen_as="field")[0].id == "0-00000"
    assert nearest(near, atlas, seen_as="mask")[0].id == "0-00001"


def test_no_more_matches_than_shapes_and_a_short_list_is_never_shorter_than_the_count():
    atlas = atlas_of(*[tuple(blob((30.0 + k, 0.0)) for k in range(4))] * 2)
    assert len(nearest(blob((30.0, 0.0)), atlas, count=9)) == 4
    assert len(nearest(blob((30.0, 0.0)), atlas, count=3, shortlist=1)) == 3


@pytest.mark.parametrize("seen_as", ["field", "mask"])
def test_every_shape_looked_up_in_the_packaged_atlas_is_itself(packaged, seen_as):
    for position in range(0, len(packaged), len(packaged) // 6):
        first, second = nearest(packaged.diagrams(seen_as)[position], packaged, seen_as=seen_as, count=2, shortlist=2)
        assert first.id == packaged.ids[position]
        assert first.distance < 0.05 < second.distance


@pytest.mark.slow
def test_the_short_list_keeps_the_true_nearest(packaged):
    """Against the distances to every third shape, with a third of the default short list: the nearest, and 4 of 5."""
    part, kept = every_third(packaged), 0
    positions = range(1, len(packaged), len(packaged) // 15 * 3)  # these leave 1 when divided by 3: not in the part
    for position in positions:
        query = packaged.mask_diagrams[position]
        distances = one_to_many(query, part.mask_diagrams)
        truth = [part.ids[i] for i in np.argsort(distances)[:5]]
        matches = [match.id for match in nearest(query, part, seen_as="mask", count=5, shortlist=14)]
        assert matches[0] == truth[0]
        kept += len(set(truth) & set(matches))
    assert kept >= 4 * len(positions)


def test_wrong_requests_are_refused_in_one_sentence():
    fields = (blob((30.0, 0.0)),)
    atlas = atlas_of(fields, fields)
    with pytest.raises(ValueError, match="shortlist"):
        nearest(fields[0], atlas, count=0)
    with pytest.raises(ValueError, match="image"):
        nearest(fields[0], atlas, seen_as="image")
    with pytest.raises(ValueError, match="empty"):
        nearest(Diagram(np.zeros((0, 2)), np.zeros(0)), atlas)
