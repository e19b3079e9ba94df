"""Cases that were wrong once: training sets on the fly, and small doors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from exact_store import exact_field, exact_record, exact_store
from pool_run import balls

import curvafit
from curvafit.data_synth import TextureDataset


def grow_once_for_all_epochs(folder: Path) -> None:
    """Copies of a set, as those in an epoch's new workers, read the shapes that the first one grew."""
    import pickle

    pairs = balls(str(folder / "log"), length=4)
    for _ in range(3):
        list(pickle.loads(pickle.dumps(pairs)))
    lines = (folder / "log").read_text().splitlines()
    assert lines and len(set(lines)) == len(lines)


def keep_every_law_of_a_list(folder: Path) -> None:
    pairs = TextureDataset(["tubes", "sponge"], "micro-ct", 16, shapes=1)
    assert "2 shapes of tubes, sponge" in repr(pairs)


def say_how_many_shapes_are_well_formed(folder: Path) -> None:
    """A viable shape that reaches |u| = 7 is a fragment, and is not cropped."""
    store, record = exact_store(folder / "s.zarr", 4), exact_record(4)
    torn = dataclasses.replace(record, viability=dataclasses.replace(record.viability, highest=7.0))
    store.write(torn, exact_field(4))
    assert "3 shapes of s.zarr, the well-formed ones of 4;" in repr(TextureDataset(store.path, "micro-ct", 12))


def refuse_arrays_as_diagrams(folder: Path) -> None:
    with pytest.raises(ValueError, match="diagram"):
        curvafit.wasserstein(np.zeros(3), np.zeros(3))  # type: ignore[arg-type]


CASES: dict[str, Callable[[Path], None]] = {
    "eng-10-pool-regrown-each-epoch": grow_once_for_all_epochs,
    "eng-12-list-of-laws": keep_every_law_of_a_list,
    "eng-12-store-of-four": say_how_many_shapes_are_well_formed,
    "eng-12-wasserstein": refuse_arrays_as_diagrams,
}


@pytest.mark.parametrize("case", CASES)
def test_handed(case, tmp_path):
    CASES[case](tmp_path)
