"""The network of `benchmarks.network`: what it reads is the same for a shape wherever its periodic box begins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from exact_store import FAMILIES, exact_store

from benchmarks.network import PERIOD, ROWS, Reader, Shapes, Training, packed_masks
from curvafit.atlas_map.describe import describe
from curvafit.data_synth.sets.moves import SYMMETRIES, turned

EDGE = 2 * PERIOD


def shapes(count: int) -> Shapes:
    """Random masks, with random descriptors and parameters."""
    rng = np.random.default_rng(0)
    masks = rng.random((count, EDGE**3)) < rng.uniform(0.1, 0.9, (count, 1))
    return Shapes(np.packbits(masks, axis=1), EDGE, rng.normal(size=(count, 5)), rng.normal(size=(count, 6)))


@pytest.fixture
def reader() -> Reader:
    torch.manual_seed(0)
    return Reader(5, half=False).double().eval()


@pytest.fixture
def views() -> tuple[torch.Tensor, torch.Tensor]:
    """Masks and descriptors, in the reader's precision."""
    masks, descriptors, _ = shapes(3).batch(range(3), np.random.default_rng(0))
    return masks, descriptors.double()


def test_the_symmetries_are_48_and_keep_the_count():
    mask = np.random.default_rng(0).random((4, 4, 4)) < 0.5
    moved = [turned(mask, k) for k in range(SYMMETRIES)]
    assert len({each.tobytes() for each in moved}) == SYMMETRIES == 48
    assert {int(each.sum()) for each in moved} == {int(mask.sum())}


def test_answers_stay_the_same_under_shifts_by_the_period(reader, views):
    masks, descriptors = views
    first = reader(masks, descriptors)
    shifted = reader(masks.roll((PERIOD, -PERIOD, 0), (1, 2, 3)), descriptors)
    for row in ROWS:
        assert torch.allclose(first[row], shifted[row], rtol=1e-9, atol=1e-9)
    others = reader(masks.roll(1, 3), descriptors)
    assert not torch.allclose(first["masks"], others["masks"], rtol=1e-6)


def test_rows_read_what_they_say(reader, views):
    masks, descriptors = views
    first = reader(masks, descriptors)
    for case, same in (((1 - masks, descriptors), "descriptors"), ((masks, -descriptors), "masks")):
        other = reader(*case)
        changed = {row for row in ROWS if not torch.allclose(first[row], other[row], rtol=1e-9, atol=1e-9)}
        assert changed == {*ROWS} - {same}


def test_a_batch_is_moved_and_otherwise_the_same():
    content = shapes(4)
    masks, descriptors, parameters = content.batch([2, 0], np.random.default_rng(0))
    whole = np.unpackbits(content.packed, axis=1)
    assert masks.flatten(1).sum(1).tolist() == whole[[2, 0]].sum(1).tolist()
    assert (masks.flatten(1).numpy() != whole[[2, 0]]).any(1).all()
    assert np.allclose(descriptors, content.descriptors[[2, 0]]) and np.allclose(parameters, content.parameters[[2, 0]])


def test_a_stopped_training_ends_as_one_that_was_not(tmp_path):
    validation = np.arange(12) < 4
    whole, stopped, resumed = (Training(shapes(12), validation, 2, half=False) for _ in range(3))
    costs = list(whole.run())
    next(stopped.run())
    stopped.save(tmp_path / "state.pt")
    resumed.load(tmp_path / "state.pt")
    (last,) = resumed.run()
    assert {row: pytest.approx(cost, rel=1e-3) for row, cost in costs[1].items()} == last
    for row in ROWS:
        assert whole.best[row][0] == pytest.approx(min(each[row] for each in costs), rel=1e-9)


def test_masks_are_those_of_the_table(tmp_path):
    store = exact_store(tmp_path / "s.zarr", len(FAMILIES))
    table = describe([store.path], tmp_path / "t.npz", ["mask"])
    packed = packed_masks([store.path], table, tmp_path)
    for shape, row in zip(table.shapes.tolist(), packed, strict=True):
        field = store.field(int(shape.partition("/")[2]))
        assert (np.unpackbits(row).reshape(field.shape) == (field > 0)).all()
    with pytest.raises(ValueError, match="expected the stores of the table, got none of s"):
        packed_masks([Path(exact_store(tmp_path / "other.zarr", 1).path)], table, tmp_path / "elsewhere")
