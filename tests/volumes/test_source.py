"""A volume given as a path, a Field, an array or a tensor is the same volume."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

from curvafit import infer, reconstruct, refine, segment
from curvafit.volumes import Field, ScanError, field_of, load, save


def ramp(shape: tuple[int, ...] = (4, 5, 6), dtype: str = "float32") -> np.ndarray:
    """Every voxel different."""
    return np.arange(np.prod(shape)).reshape(shape).astype(dtype)


def test_every_kind_of_source_is_one_field(tmp_path: Path) -> None:
    field = Field(ramp(), (3.0, 2.0, 1.0), "um")
    path = save(field, tmp_path / "scan.nii.gz")
    at = {"spacing": (3.0, 2.0, 1.0), "unit": "um"}
    assert field_of(field) is field
    for given in (
        field_of(str(path)),
        field_of(path),
        field_of(ramp(), **at),
        field_of(torch.from_numpy(ramp()), **at),
    ):
        assert np.array_equal(given.values, ramp())
        assert (given.spacing, given.unit) == ((3, 2, 1), "um")
    bare = field_of(torch.from_numpy(ramp()).bfloat16().requires_grad_())
    assert (bare.spacing, bare.unit, bare.values.dtype) == ((1, 1, 1), "voxel", np.float32)


def test_save_takes_a_source(tmp_path: Path) -> None:
    path = save(ramp(), tmp_path / "array.nii.gz", spacing=0.5, unit="mm")
    again = save(path, tmp_path / "again.tif")
    tensor = save(torch.from_numpy(ramp()), tmp_path / "tensor.zarr", spacing=(0.5, 0.5, 0.5), unit="mm")
    for each in (path, again, tensor):
        back = load(each)
        assert np.array_equal(back.values, ramp())
        assert (back.spacing, back.unit) == ((0.5, 0.5, 0.5), "mm")


@pytest.mark.parametrize(
    ("source", "options", "complaint"),
    [
        (Field(ramp()), {"spacing": 2}, "expected spacing only with a file or an array, got it with a Field"),
        (Field(ramp()), {"unit": "mm"}, "expected unit only with a file or an array, got it with a Field"),
        (Field(ramp()), {"key": "raw"}, "expected key only with the path of a file, got it with a Field"),
        (ramp(), {"raw_shape": (4, 5, 6)}, "expected raw_shape only with the path of a file, got it with an array"),
        (ramp(), {"spacing": (1, 2)}, r"expected a spacing of 3 positive numbers \(z, y, x\)"),
        (ramp(), {"unit": ""}, None),
        (ramp(), {"unit": "furlong"}, "expected a unit of voxel, nm, um, mm or m, got 'furlong'"),
        (ramp((5, 6)), {}, r"expected a 3D volume, got an array of shape \(5, 6\)"),
        (np.where(ramp() == 7, np.nan, ramp()), {}, "expected finite values, got 1 that are NaN in an array"),
        (ramp() * 1j, {}, "expected numbers, got an array of type complex64"),
        ([[[1.0]]], {}, "expected a volume as the path of a file, a Field, an array or a tensor, got"),
    ],
)
def test_what_counts_for_nothing_is_refused(source, options: dict, complaint: str | None) -> None:
    if complaint is None:
        assert field_of(source, **options).unit == "voxel"
        return
    with pytest.raises(ValueError, match=complaint):
        field_of(source, **options)


# ---- what a field says of itself -------------------------------------------------------------------------------------


def test_a_field_is_one_line_and_equals_itself() -> None:
    field = Field(ramp(), (3.0, 2.0, 1.0), "um", source="scan\n.nii.gz")
    assert repr(field) == "Field(4 x 5 x 6 voxels of 3 x 2 x 1 um, float32 from 0 to 119, from scan\\n.nii.gz)"
    assert repr(Field(ramp(dtype="uint8"), 0.0195, "mm")) == "Field(4 x 5 x 6 voxels of 0.0195 mm, uint8 from 0 to 119)"
    assert field == field and field != Field(ramp()) and len({field, field}) == 1


# ---- the jobs take each alike ----------------------------------------------------------------------------------------

BALL = (np.linalg.norm(np.indices((10, 11, 12)).T - (4.5, 5.0, 5.5), axis=-1).T < 4).astype(np.float32)
AT = {"spacing": (3.0, 2.0, 2.0), "unit": "um"}


def test_segment_takes_each_source(tmp_path: Path) -> None:
    scan = Field(100 * BALL + np.random.default_rng(0).normal(0, 20, BALL.shape).astype(np.float32), **AT)
    path = save(scan, tmp_path / "scan.nii.gz")
    wanted = segment(scan, "tubes", steps=2)
    tensor = torch.from_numpy(scan.values)
    for found in (
        segment(path, "tubes", steps=2),
        segment(scan.values, "tubes", steps=2, **AT),
        segment(tensor, "tubes", steps=2, **AT),
    ):
        assert np.array_equal(found.mask.values, wanted.mask.values)
        assert (found.mask.spacing, found.mask.unit) == (scan.spacing, "um")
    assert repr(wanted).startswith(f"Segmentation(10 x 11 x 12 voxels of 3 x 2 x 2 um, {wanted.mask.values.sum()} in")
    assert repr(wanted).endswith(f"%): {wanted.status})") and "\n" not in repr(wanted) and wanted == wanted


def test_refine_takes_each_source(tmp_path: Path) -> None:
    likely = Field((0.1 + 0.8 * BALL).astype(np.float32), **AT)
    wanted = refine(likely, "tubes", weight=1.0, steps=2)
    for source, options in (
        (save(likely, tmp_path / "likely.nii.gz"), {}),
        (likely.values, AT),
        (torch.from_numpy(likely.values), AT),
    ):
        found = refine(source, "tubes", weight=1.0, steps=2, **options)
        assert np.array_equal(found.phase.values, wanted.phase.values) and found.mask.spacing == likely.spacing


def test_reconstruct_takes_each_source(tmp_path: Path) -> None:
    mask = Field(BALL.astype(np.uint8), **AT)
    wanted = reconstruct(mask, "tubes", every=4, steps=2)
    for source, options in ((save(mask, tmp_path / "mask.nii"), {}), (mask.values, AT)):
        assert np.array_equal(reconstruct(source, "tubes", every=4, steps=2, **options).mask.values, wanted.mask.values)


@pytest.mark.parametrize(
    "job", [infer, lambda *a, **o: segment(*a, "tubes", **o), lambda *a, **o: refine(*a, "tubes", weight=1, **o)]
)
def test_no_job_drops_an_option_in_silence(job) -> None:
    for options, got in (({"spacing": 2}, "spacing"), ({"unit": "mm"}, "unit"), ({"strict": True}, "strict")):
        with pytest.raises(ScanError, match=f"expected {got} only with .*, got it with a Field"):
            job(Field(BALL), **options)
    with pytest.raises(ScanError, match="expected a volume as the path of a file, a Field, an array or a tensor"):
        job(None)


def test_infer_prepares_the_field_of_an_array(monkeypatch) -> None:
    seen: list[Field] = []

    def prepare(field: Field, **_: object) -> None:
        seen.append(field)
        raise ScanError("enough")

    monkeypatch.setattr(import_module("curvafit.inference.infer"), "prepare", prepare)
    for source in (BALL, torch.from_numpy(BALL)):
        with pytest.raises(ScanError, match="enough"):
            infer(source, **AT)
        assert np.array_equal(seen[-1].values, BALL)
        assert (seen[-1].spacing, seen[-1].unit) == (AT["spacing"], "um")
