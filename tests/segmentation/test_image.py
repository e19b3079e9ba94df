"""What an image says of a volume, and a filler that weighs it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import curvafit.segmentation.image as room
from curvafit.segmentation.filler import Filler, Gaps, Taught, fill
from curvafit.segmentation.image import read_image
from curvafit.segmentation.reconstruct import reconstruct
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.teach import Texture
from curvafit.segmentation.teach_image import ImageMix, image_shape, teach_image
from curvafit.segmentation.trials import dice
from curvafit.volumes.field import Field, ScanError

pytest.importorskip("sklearn", reason="reading an image needs scikit-learn")

EVERY = 6


def rods(n: int = 37) -> np.ndarray:
    """A leaning rod from end to end, and a ball that no known slice meets."""
    z, y, x = np.mgrid[:n, :n, :n]
    return (np.hypot(y - 10 - 0.3 * z, x - 9) < 4) | ((z - 15) ** 2 + (y - 12) ** 2 + (x - 26) ** 2 < 7)


def photograph(mask: np.ndarray, noise: float = 0.4, seed: int = 0) -> np.ndarray:
    return mask + noise * np.random.default_rng(seed).standard_normal(mask.shape).astype(np.float32)


def known(mask: np.ndarray, spacing=(1.0, 1.0, 1.0)) -> Slices:
    return Slices(mask[::EVERY], tuple(range(0, len(mask), EVERY)), len(mask), spacing)


# ---- reading ---------------------------------------------------------------------------------------------------------


def test_the_inside_is_found_whether_bright_or_dark() -> None:
    mask = rods()
    bright, dark = (read_image(values, known(mask))[0] > 0 for values in (photograph(mask), -photograph(mask)))
    assert dice(bright, mask) > 0.85 and dice(dark, mask) > 0.85


def test_the_unit_of_grey_levels_changes_nothing() -> None:
    mask = rods()
    once, other = (read_image(values, known(mask))[0] for values in (photograph(mask), 64 * photograph(mask)))
    assert np.array_equal(once, other)


def test_slices_that_are_read_in_parts_are_read_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    mask = rods()
    whole = read_image(photograph(mask), known(mask))[0]
    monkeypatch.setattr(room, "HELD", 5 * 37 * 37)
    parts = read_image(photograph(mask), known(mask))[0]
    assert np.median(np.abs(parts - whole)) < 1e-6 and ((parts > 0) == (whole > 0)).mean() > 0.995


# ---- filling ---------------------------------------------------------------------------------------------------------


def stirred() -> Filler:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        plain = Filler(8).eval()
        for weight in plain.parameters():
            torch.nn.init.normal_(weight, std=0.1)
    return plain


def test_a_filler_that_takes_images_begins_as_a_plain_one() -> None:
    plain, generator = stirred(), torch.Generator().manual_seed(0)
    distances = 3 * torch.randn(2, 4, 24, 24, generator=generator)
    gaps = Gaps(distances, torch.ones(2), torch.zeros(2, 3, 24, 24))
    with torch.no_grad():
        wider = Filler.with_image(plain)(replace(gaps, evidence=torch.zeros(2, 3, 24, 24)))
        assert torch.allclose(wider, plain(gaps), atol=1e-6)


def test_background_around_an_image_changes_nothing() -> None:
    mask = rods()
    said = np.where(mask, 3, -3).astype(np.float32)
    filler = Filler.with_image(stirred()).eval()
    torch.nn.init.normal_(filler.up_fine.first.weight, std=0.1, generator=torch.Generator().manual_seed(0))
    taught = Taught(filler, np.array([[4.0, 16.0], [1.0, 1.0]]), {}, 0.0)
    border = ((0, 0), (60, 60), (60, 60))
    wide = fill(known(np.pad(mask, border)), taught, evidence=np.pad(said, border, mode="edge"))
    narrow = fill(known(mask), taught, evidence=said)
    assert np.abs(wide[:, 60:-60, 60:-60] - narrow).max() < 1e-5


def test_the_packaged_filler_finds_what_only_the_image_shows() -> None:
    mask = rods()
    shown = Field(mask.astype(np.uint8))
    alone = reconstruct(shown, every=EVERY).mask.values > 0
    found = reconstruct(shown, every=EVERY, image=photograph(mask)).mask.values > 0
    ball = np.s_[13:18, 9:16, 23:30]
    assert dice(found, mask) > dice(alone, mask) + 0.02
    assert not alone[ball].any() and dice(found[ball], mask[ball]) > 0.8
    assert np.array_equal(found[::EVERY], mask[::EVERY])


def test_an_image_of_something_else_is_left_out() -> None:
    mask = rods()
    shown = Field(mask.astype(np.uint8))
    found = reconstruct(shown, every=EVERY, image=photograph(np.zeros_like(mask)))
    assert np.array_equal(found.mask.values, reconstruct(shown, every=EVERY).mask.values)
    assert any("image" in note for note in found.notes) and "image" not in found.status


def test_any_axis_may_lie_across_the_slices() -> None:
    mask = rods()
    turn = (1, 2, 0)
    shown, grey = Field(mask.astype(np.uint8)), photograph(mask)
    straight = reconstruct(shown, every=EVERY, image=grey).probability.values
    turned = Field(np.ascontiguousarray(mask.transpose(turn)).astype(np.uint8))
    other = reconstruct(turned, every=EVERY, axis=2, image=grey.transpose(turn)).probability.values
    assert np.abs(other.transpose(np.argsort(turn)) - straight).max() < 1e-3


# ---- teaching --------------------------------------------------------------------------------------------------------


def texture() -> Texture:
    z, y, x = np.mgrid[:24, :24, :24] * (2 * np.pi / 24)
    return Texture((np.sin(z) * np.cos(y) + np.sin(y) * np.cos(x) + np.sin(x) * np.cos(z)).astype(np.float32))


def test_imaged_shapes_depend_on_their_seed_alone() -> None:
    mix = ImageMix(edge=24, gap=(3, 4))
    one, same, other = (image_shape([[texture()]], mix, (0, k)) for k in (1, 1, 2))
    assert np.array_equal(one.distances, same.distances) and np.array_equal(one.evidence, same.evidence)
    assert one.distances.shape != other.distances.shape or not np.array_equal(one.evidence, other.evidence)
    assert (len(one.distances) - 1) % one.gap == 0 and one.evidence.shape == one.distances.shape


def test_teaching_with_images_makes_a_filler_for_images() -> None:
    plain = Taught(Filler(4).eval(), np.array([[2.0, 16.0], [1.0, 1.0]]), {"name": "plain"}, 0.0)
    taught = teach_image([[texture()]], plain, {}, steps=2, volumes=2, workers=0)
    assert taught.filler.image and taught.card["plain"] == {"name": "plain"} and taught.card["volumes"] == 2
    assert set(taught.card["losses"]) and np.isfinite(taught.card["held_out_loss"])


# ---- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("told", "word"),
    [
        ({"image": np.zeros((37, 37, 36))}, "shape"),
        ({"image": rods().astype(np.uint8)}, "grey"),
        ({"image": photograph(rods()), "prior": "tubes"}, "both"),
        ({"image": photograph(rods()), "example": rods()}, "both"),
    ],
)
def test_what_no_image_can_be_is_refused(told: dict, word: str) -> None:
    with pytest.raises(ScanError, match=word):
        reconstruct(Field(rods().astype(np.uint8)), every=EVERY, **told)
