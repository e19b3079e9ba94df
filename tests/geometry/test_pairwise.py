"""Many distances at once: geomloss's values, on both backends; and a file that saves work and never lies."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from geomloss import SamplesLoss

from curvafit.geometry import distances as module
from curvafit.geometry.diagram import Diagram
from curvafit.geometry.distances import one_to_many, pairwise, wasserstein
from curvafit.inference.atlas import load_atlas


def cloud(seed: int, count: int, centre: tuple[float, float] = (0.0, 0.0), width: float = 10.0) -> Diagram:
    """Points with weights over six orders of magnitude."""
    generator = np.random.default_rng(seed)
    return Diagram(generator.normal(centre, width, (count, 2)), 10 ** generator.uniform(-6, 0, count))


#: Near, far enough for exp(-C / blur²) to leave float32's range many times over, narrow, and a single point.
CLOUDS = [
    cloud(0, 60),
    cloud(1, 45, (15, -4), 6.0),
    cloud(2, 70, (-150, 200), 30.0),
    cloud(3, 30, (1, 1), 0.2),
    cloud(4, 1, (5, 5)),
]


def cost(a: Diagram, b: Diagram, blur: float, reach: float | None, falls: int) -> float:
    """OT_ε by geomloss in float64."""
    options = {"blur": blur, "reach": reach, "diameter": blur * 2.0 ** (falls - 0.5)}
    loss = SamplesLoss("sinkhorn", p=2, debias=False, backend="tensorized", **options)
    with torch.no_grad():
        return float(loss(*(torch.from_numpy(v) for d in (a, b) for v in (d.normalised.weights, d.points))))


def measures(diagrams: list[Diagram]) -> module.Clouds:
    return module.pack([d.points for d in diagrams], [d.normalised.weights for d in diagrams])


@pytest.mark.parametrize(("blur", "reach"), [(1.0, 20.0), (0.3, 5.0), (1.0, None)])
def test_costs_are_geomloss_s(blur: float, reach: float | None) -> None:
    """On processors and in torch, whose small batches hold sets of unlike sizes. Float32 keeps 1e-6 of a potential."""
    first, second = np.triu_indices(len(CLOUDS), 1)
    falls = module.pair_halvings(measures(CLOUDS), first, second, blur)
    truth = [cost(CLOUDS[i], CLOUDS[j], blur, reach, n) for i, j, n in zip(first, second, falls, strict=True)]
    values = module.costs(measures(CLOUDS), first, second, falls, blur=blur, reach=reach)
    np.testing.assert_allclose(values, truth, rtol=2e-5, atol=1e-4)


@pytest.mark.parametrize("edge", [1.0, 0.3, 3.7, 181.0, 181.1, 1e5])
def test_a_box_fits_its_diameter_and_would_not_fit_half_of_it(edge: float) -> None:
    """At 2^7.5 = 181.02 a further step is needed; points that are one start at blur · √½ above and end at blur."""
    n = int(module.halvings(np.array([edge, 0.0]), 1.0))
    assert max(edge, 1.0) <= 2.0 ** (n - 0.5) < 2 * max(edge, 1.0)
    assert module.halvings(np.zeros(2), 0.5) == 1


def close(distance: float, truth: float) -> bool:
    """To 1e-4 of itself; its square, the debiased cost, is a difference of costs that float32 holds to some 1e-6."""
    return abs(distance**2 - truth**2) <= 2e-4 * truth**2 + 1e-6


@pytest.mark.slow
def test_distances_are_wasserstein_s_on_the_packaged_atlas() -> None:
    """Of shapes of all sizes, and of each with its nearest by the sliced distance."""
    atlas = load_atlas()
    embeddings = atlas.embeddings("mask")
    for k in range(0, len(atlas), len(atlas) // 5):
        near = int(np.argsort(np.linalg.norm(embeddings - embeddings[k], axis=1))[1])
        others = [atlas.mask_diagrams[near], atlas.mask_diagrams[k // 2 + 1], atlas.field_diagrams[k]]
        distances = one_to_many(atlas.mask_diagrams[k], others)
        for distance, other in zip(distances, others, strict=True):
            assert close(distance, wasserstein(atlas.mask_diagrams[k], other))


@pytest.mark.parametrize(("blur", "reach"), [(1.0, 20.0), (0.3, 5.0), (1.0, None)])
def test_distances_are_wasserstein_s_far_near_narrow_and_on_single_points(blur: float, reach: float | None) -> None:
    near = [dataclasses.replace(CLOUDS[0], points=CLOUDS[0].points + shift) for shift in (0.01, 0.1, 1.0)]
    diagrams = [*CLOUDS, *near, cloud(5, 1, (900.0, -900.0))]
    distances = pairwise(diagrams, blur=blur, reach=reach, bin_width=0)
    for i, j in zip(*np.triu_indices(len(diagrams), 1), strict=True):
        assert close(distances[i, j], wasserstein(diagrams[i], diagrams[j], blur=blur, reach=reach, bin_width=0)), (
            i,
            j,
        )
    assert (distances == distances.T).all()
    assert (np.diag(distances) == 0).all()


def test_a_distance_is_the_pair_s_own_whoever_else_is_there() -> None:
    """Not of the company: the number of steps is the pair's."""
    together = pairwise(CLOUDS)
    for i, j in zip(*np.triu_indices(len(CLOUDS), 1), strict=True):
        assert pairwise([CLOUDS[i], CLOUDS[j]])[0, 1] == pytest.approx(together[i, j], rel=1e-5)


def test_one_to_many_is_a_row_and_weights_are_shares() -> None:
    others = [dataclasses.replace(d, weights=7 * d.weights) for d in CLOUDS]
    np.testing.assert_allclose(one_to_many(CLOUDS[1], others), pairwise(CLOUDS)[1], rtol=1e-5, atol=0.01)
    assert one_to_many(CLOUDS[0], []).shape == (0,)
    assert pairwise([]).shape == (0, 0)


def test_points_without_weight_do_not_count() -> None:
    a = CLOUDS[0]
    more = Diagram(np.concatenate([a.points, [[500.0, 0.0]]]), np.append(a.weights, 0.0))
    assert one_to_many(a, [more], bin_width=0)[0] == 0


def test_known_distances_are_not_computed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """What an interrupted run saved is taken by the next, and a longer list costs its new rows."""
    monkeypatch.setattr(module, "BLOCK", 2)
    truth, saved, shares = pairwise(CLOUDS), [], []

    def interrupt(text: str, share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pairwise(CLOUDS[:4], save=lambda distances: saved.append(distances.copy()), progress=interrupt)
    assert np.isnan(saved[0]).sum() == 12 and np.isnan(saved[-1]).sum() == 8
    resumed = pairwise(CLOUDS[:4], known=saved[-1], progress=lambda text, share: shares.append(share))
    assert shares == pytest.approx([4 / 6, 1])
    np.testing.assert_allclose(resumed, truth[:4, :4], rtol=1e-5)
    np.testing.assert_array_equal(pairwise(CLOUDS[:4], known=resumed, progress=interrupt), resumed)


def test_bad_input_is_one_sentence() -> None:
    with pytest.raises(ValueError, match="positive"):
        pairwise(CLOUDS[:2], reach=0.0)
    with pytest.raises(ValueError, match="unit"):
        one_to_many(CLOUDS[0], [dataclasses.replace(CLOUDS[1], unit="1/um")])
    with pytest.raises(ValueError, match="empty"):
        one_to_many(CLOUDS[0], [Diagram(np.zeros((0, 2)), np.zeros(0))])
