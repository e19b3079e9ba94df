"""Handed cases of volumes between known slices, each by its name."""

from pathlib import Path

import numpy as np
import pytest
from calling import call

IDS = (864691135000000017, 864691135000000033)


def bodies(ids: tuple[int, int], kind: type) -> np.ndarray:
    z, y, x = np.mgrid[:17, :28, :28]
    one, other = (y - 8 - 0.2 * z) ** 2 + (x - 8) ** 2 < 30, (y - 20) ** 2 + (x - 20 + 0.2 * z) ** 2 < 30
    return np.where(one, kind(ids[0]), np.where(other, kind(ids[1]), kind(0)))


@pytest.mark.parametrize(
    ("ids", "kind", "chosen"),
    [
        (IDS, np.uint64, "all"), (IDS, np.uint64, ",".join(map(str, IDS))), ((2**64 - 2, 2**64 - 1), np.uint64, "all"),
        (IDS, np.int64, "all"), ((3, 7), np.uint64, "3,7"),
    ],
    ids=[f"01-uint64-labels{which}" for which in ("", "-chosen", "-greatest", "-signed", "-small")],
)  # fmt: skip
def test_64_bit_ids_stay(ids: tuple[int, int], kind: type, chosen: str, tmp_path: Path) -> None:
    truth, out = bodies(ids, kind), tmp_path / "out.npy"
    np.save(tmp_path / "labels.npy", np.where((np.arange(17) % 8 == 0)[:, None, None], truth, kind(0)))
    done = call("reconstruct", tmp_path / "labels.npy", "--every", 8, "--labels", chosen, "-o", out)
    assert done.exit_code == 0, done.output
    found = np.load(out)
    assert found.dtype.kind in "iu" and np.unique(found).tolist() == [0, *ids]
    assert np.array_equal(found[::8], truth[::8])
    assert found.dtype == (kind if ids[0] > 255 else np.uint8)
