"""The figures of calibration against sbi's, and the local test, on normal posteriors that are exact or not."""

from __future__ import annotations

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks.closure import rank_p, ranks, tarp
from benchmarks.closure_local import local_p

N, DRAWS = 400, 200


def normal(spread: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contexts, truths and draws of two parameters: context plus noise of 1, draws with a spread that may be wrong."""
    rng = np.random.default_rng(0)
    context = rng.normal(size=(N, 2))
    truth = context + rng.normal(size=(N, 2))
    return context, truth, context[:, None] + spread * rng.normal(size=(N, DRAWS, 2))


def tensor(values: np.ndarray) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32)


@pytest.mark.parametrize("spread", [1.0, 0.5, 2.0])
def test_ranks_and_balls_tell_what_sbi_s_tell(spread: float) -> None:
    """TARP's random points differ, which moves the greatest difference by some 1/√N."""
    sbc, tarp_of = pytest.importorskip("sbi.diagnostics.sbc"), pytest.importorskip("sbi.diagnostics.tarp")
    context, truth, draws = normal(spread)
    theirs = sbc.check_uniformity_frequentist(tensor(DRAWS * ranks(truth, draws)), DRAWS).numpy()
    assert np.all((theirs < 0.01) == (rank_p(truth, draws) < 0.01))
    assert np.all((theirs < 0.01) == (spread != 1))
    sampler = SimpleNamespace(sample_batched=lambda shape, x, **_: tensor(draws).transpose(0, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ecp, alpha = tarp_of.run_tarp(tensor(truth), tensor(context), sampler, num_posterior_samples=DRAWS, num_bins=20)
    assert tarp(truth, draws) == pytest.approx(float((ecp - alpha).abs().max()), abs=2 / np.sqrt(N))


@pytest.mark.slow
def test_a_wrong_posterior_is_told_where_it_is_wrong() -> None:
    """Draws too narrow on one side of the context alone: there most queries alarm, on the other side few."""
    pytest.importorskip("sbi.diagnostics")
    context, truth, draws = normal(1.0)
    wrong = context[:, 0] > 0
    draws[wrong] = context[wrong, None] + 2 + 0.3 * (draws[wrong] - context[wrong, None])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        p = local_p(truth, context, draws, 40, trials=20)
    others = np.array_split(np.random.default_rng(0).permutation(N), 2)[1][:40]
    assert np.median(p[wrong[others]]) < 0.05 < np.median(p[~wrong[others]])
