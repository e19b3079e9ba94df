"""Every command and public call gives what it gave. A number that is to change is frozen anew, by a commit that says
why: `python -m tests.golden freeze ROW`. Left out are `demo`, which fetches its scan, `atlas map`, whose page is
another library's, and the teaching of networks, which takes hours."""

import copy
from pathlib import Path

import numpy as np
import pytest

from tests.golden.frozen import STRAY, compare, read, volume
from tests.golden.rows import ROWS, closeness, run

KEPT = read()
#: Megabytes that the corpus may take.
MOST = 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_a_row_gives_what_it_gave(name: str, tmp_path: Path) -> None:
    assert not (said := compare(KEPT[name], run(name, tmp_path), close=closeness(name))), said


def test_the_corpus_is_small_and_has_a_record_of_each_row() -> None:
    assert list(KEPT) == list(ROWS)
    assert sum(path.stat().st_size for path in Path(__file__).parent.rglob("*") if path.is_file()) < MOST * 2**20


def test_a_difference_is_noticed() -> None:
    kept = {"a": [[1.0, 250.0], ["Tb.Th", 0.1234]], "b": {"shape": [3], "n": 7}}
    assert compare(kept, copy.deepcopy(kept)) == []
    far = {"a": [[1.0, 251.0], ["Tb.Th", 0.1234]]}
    for change in (far, {"b": {"shape": [3], "n": 8}}, {"b": {"shape": [3]}}, {"c": 1}):
        assert len(compare(kept, kept | change)) == 1
    assert compare(kept, kept | {"a": [[1.0, 250.1], ["Tb.Th", 0.1235]]}) == []  # a last digit
    mask = np.arange(10 / STRAY).reshape(1, 1, -1) % 8 < 3
    for count in (10, 11):  # voxels that may stray, and one more
        assert len(compare(volume(mask), volume(mask ^ (np.arange(mask.size) < count)))) == count - 10
