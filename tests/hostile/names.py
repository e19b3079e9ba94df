"""Odd names and odd files: pipes, devices, loops, links, newlines, dashes, names of 300 characters, wrong contents."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .case import INFER, Case, Place, Setup, every, nothing, taking
from .larder import LAW

_GENERATE = ("generate", *LAW, "--shape", "10", "--steps", "4")
_SEGMENT = ("--prior", "tubes", "--steps", "1", "-o", "out.nii.gz")

#: Names of a scan and of an output, before the suffix.
STEMS = {
    "newline": "a\nb", "spaces": "  a  b ", "colons": "a::b", "colon": "a:b", "dash": "-rf", "dashes": "--help",
    "300": "n" * 300, "245": "n" * 245, "accents": "über", "decomposed": "u\u0308ber", "emoji": "🦴", "quote": "it's",
    "dollar": "$HOME", "star": "*", "brackets": "[a]", "markup": "[red]a[/red]", "percent": "%s%d", "braces": "{0}",
    "dots": "...", "hidden": ".a", "tilde": "~", "backslash": "a\\b", "not-utf-8": "\udcff\udcfe", "tab": "a\tb",
    "two-suffixes": "a.nii.gz", "upper": "A.NII", "right-to-left": "\u202eabc", "bell": "a\ab", "escape": "\x1b[2Ja",
}  # fmt: skip


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _loop(path: Path) -> None:
    path.symlink_to(path.name)


def _dangling(path: Path) -> None:
    path.symlink_to("nowhere")


def _device(name: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(f"/dev/{name}")


def _locked(path: Path) -> None:
    path.write_bytes(b"")
    path.chmod(0)


def _text(path: Path) -> None:
    path.write_text("This is not what its name says.\n")


def _html(path: Path) -> None:
    path.write_text("<!DOCTYPE html><html><body>404</body></html>")


#: What stands where a file is expected.
THINGS: dict[str, Callable[[Path], None]] = {
    "pipe": _pipe, "loop": _loop, "dangling": _dangling, "null": _device("null"), "zero": _device("zero"),
    "full": _device("full"), "folder": Path.mkdir, "empty": lambda path: path.write_bytes(b"") and None, "text": _text,
    "html": _html, "locked": _locked,
}  # fmt: skip
SUFFIXES = (".nii.gz", ".nii", ".tif", ".npy", ".npz", ".h5", ".raw", ".zarr", ".nrrd", ".mha", ".mrc")


def cases(seed: int) -> Iterator[Case]:
    """Every name as an output and as a scan; every thing as an input of every kind, and as an output."""
    for name, stem in STEMS.items():
        command = (*_GENERATE, f"--output={stem}.npy")
        yield Case(f"names/output/{name}", nothing, command)
        command = ("segment", "--prior=tubes", "--steps=1", "-o", "out.nii.gz", "--", f"{stem}.nii.gz")
        yield Case(f"names/scan/{name}", _named(stem), command)
    for name, make in THINGS.items():
        for suffix in SUFFIXES:
            told = ("--raw-shape", "8,8,8") if suffix == ".raw" else ()
            yield Case(
                f"names/input{suffix}/{name}", _putting(make, f"a{suffix}"), ("segment", f"a{suffix}", *_SEGMENT, *told)
            )
        yield from _elsewhere(name, make)
    for name, write in STRANGE.items():
        file = name.partition("-")[0]
        source = "a" if file == "folder" else f"a.{file}"
        yield Case(f"names/strange/{name}", _putting(write, source), ("segment", source, *_SEGMENT))


def _elsewhere(name: str, make: Callable[[Path], None]) -> Iterator[Case]:
    """The same thing as a fit, a design, an atlas, maps, a store, a set, a checkpoint, and as outputs."""
    commands = {
        "fit.json": (*_GENERATE[:1], "--prior", "fit.json", "--shape", "10", "--steps", "4", "-o", "out.npy"),
        "box.yaml": ("atlas", "build", "out.zarr", "--design", "box.yaml", "--workers", "0"),
        "atlas.npz": (*INFER, "atlas.npz", "-o", "found"),
        "maps.npz": ("generate", "--maps", "maps.npz", "--shape", "10", "--steps", "4", "-o", "out.npy"),
        "store.zarr": ("atlas", "info", "store.zarr"),
        "set": ("synth", "-o", "set", "--atlas", "{larder}/store.zarr", "--modality", "mra", "--shape", "6",
            "--workers", "0"),
        "run.pt": (*_GENERATE, "--checkpoint", "run.pt", "-o", "out.npy"),
    }  # fmt: skip
    for target, command in commands.items():
        stays = ("set", "set/*") if target == "set" and name == "folder" else ()
        changes = ("set",) if target == "set" and name in ("folder",) else ()
        count = ("--count", "1") if target == "set" else ()
        yield Case(f"names/{target}/{name}", _putting(make, target), (*command, *count), changes, stays)
    for target in ("out.npy", "out.nii.gz", "out.png", "out.json", "out.zarr"):
        out = "out.npy" if target in ("out.png", "out.json") else target
        yield Case(
            f"names/as-{target}/{name}", _putting(make, target), (*_GENERATE, "-o", out), _replaced(name, target)
        )


def _replaced(name: str, target: str) -> tuple[str, ...]:
    """A file without a byte may be replaced, an empty folder may become a store."""
    return (target,) if name == "empty" or (name == "folder" and target == "out.zarr") else ()


def _named(stem: str) -> Setup:
    def setup(place: Place) -> None:
        try:
            place.take("scan.nii.gz", f"{stem}.nii.gz")
        except OSError:  # longer than the disk takes: the scan is not there, then
            return

    return setup


def _putting(make: Callable[[Path], None], name: str) -> Setup:
    return every(taking(), lambda place: make(place.here / name))


# ---- files that are sound, and strange -------------------------------------------------------------------------------


def _hdf5(fill: Callable[[Any], object]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import h5py

        with h5py.File(path, "w") as file:
            fill(file)

    return write


def _volume(file: Any, **attributes: Any) -> None:
    dataset = file.create_dataset("volume", data=np.arange(512.0).reshape(8, 8, 8))
    for name, value in attributes.items():
        dataset.attrs[name] = value


def _said(**attributes: Any) -> Callable[[Path], None]:
    return _hdf5(lambda file: _volume(file, **attributes))


def _linked(file: Any) -> None:
    import h5py

    file["volume"] = h5py.ExternalLink("elsewhere.h5", "/volume")
    file["soft"] = h5py.SoftLink("/nowhere")


def _circle(file: Any) -> None:
    file.create_group("a")
    file["a/again"] = file["/"]


def _tiff(values: np.ndarray, **options: Any) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import tifffile

        tifffile.imwrite(path, values, **options)

    return write


def _ome(text: str) -> Callable[[Path], None]:
    return _tiff(
        np.arange(512, dtype=np.uint8).reshape(8, 8, 8), description=text, photometric="minisblack", metadata=None
    )


def _dicom(change: Callable[[Any, int], object]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import pydicom

        from .volumes import write_dicom

        write_dicom(path)
        for k, file in enumerate(sorted(path.iterdir())):
            image = pydicom.dcmread(file)
            change(image, k)
            image.save_as(file)

    return write


def _without(name: str) -> Callable[[Path], None]:
    return _dicom(lambda image, k: image.pop(name, None) if hasattr(image, "pop") else delattr(image, name))


def _numpy(values: Any) -> Callable[[Path], None]:
    return lambda path: np.save(path, values)


_BAD_OME = (
    '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">'
    "<Image><Pixels {}/></Image></OME>"
)
_LAUGHS = '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "ha">' + "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefghij", "bcdefghijk", strict=True)
) + "]><OME>&k;</OME>"  # fmt: skip

STRANGE: dict[str, Callable[[Path], None]] = {
    "h5-scalar": _hdf5(lambda file: file.create_dataset("volume", data=3.0)),
    "h5-none": _hdf5(lambda file: None),
    "h5-empty": _hdf5(lambda file: file.create_dataset("volume", shape=(0, 8, 8), dtype="f4")),
    "h5-null": _hdf5(lambda file: file.create_dataset("volume", dtype="f4")),
    "h5-string": _hdf5(lambda file: file.create_dataset("volume", data="text")),
    "h5-strings": _hdf5(lambda file: file.create_dataset("volume", data=[["a", "b"]] * 3)),
    "h5-compound": _hdf5(lambda file: file.create_dataset("volume", shape=(4, 4, 4), dtype=[("a", "f4"), ("b", "i4")])),
    "h5-complex": _hdf5(lambda file: file.create_dataset("volume", shape=(4, 4, 4), dtype="c8")),
    "h5-links": _hdf5(_linked),
    "h5-circle": _hdf5(_circle),
    "h5-group-volume": _hdf5(lambda file: file.create_group("volume")),
    "h5-unit-list": _said(spacing=[1, 1, 1.0], unit=["mm", "um", "mm"]),
    "h5-unit-bytes": _said(spacing=[1, 1, 1.0], unit=np.bytes_(b"\xff\xfe")),
    "h5-unit-number": _said(spacing=[1, 1, 1.0], unit=3.0),
    "h5-unit-empty": _said(spacing=[1, 1, 1.0], unit=""),
    "h5-unit-null": _said(spacing=[1, 1, 1.0], unit=" mm "),
    "h5-spacing-text": _said(spacing="wide"),
    "h5-spacing-two": _said(spacing=[1.0, 2.0]),
    "h5-spacing-nan": _said(spacing=[np.nan] * 3),
    "h5-spacing-zero": _said(spacing=[0.0] * 3),
    "h5-spacing-none": _said(spacing=np.array([], float)),
    "h5-spacing-table": _said(spacing=np.ones((3, 3))),
    "h5-spacing-complex": _said(spacing=[1j, 1j, 1j]),
    "tif-one-page": _tiff(np.ones((9, 9), np.uint8)),
    "tif-colour": _tiff(np.zeros((9, 9, 9, 3), np.uint8), photometric="rgb"),
    "tif-constant": _tiff(np.ones((9, 9, 9), np.uint8)),
    "tif-complex": _tiff(np.ones((9, 9, 9), np.complex64), photometric="minisblack"),
    "tif-ome-empty": _ome(_BAD_OME.format("")),
    "tif-ome-word": _ome(_BAD_OME.format('PhysicalSizeX="wide" PhysicalSizeXUnit="mm"')),
    "tif-ome-zero": _ome(_BAD_OME.format('PhysicalSizeX="0"')),
    "tif-ome-unit": _ome(_BAD_OME.format('PhysicalSizeX="1" PhysicalSizeXUnit="parsec"')),
    "tif-ome-torn": _ome(_BAD_OME[:-12]),
    "tif-ome-laughs": _ome(_LAUGHS),
    "tif-json-spacing": _ome('{"shape": [8, 8, 8], "spacing": "wide"}'),
    "tif-json-table": _ome('{"shape": [8, 8, 8], "spacing": {"x": 1}}'),
    "tif-json-own": _ome('{"shape": [8, 8, 8], "curvafit_spacing": [1, 2]}'),
    "tif-json-unit": _ome('{"shape": [8, 8, 8], "curvafit_spacing": "1,1,1"}'),
    "tif-json-list": _ome('{"shape": [8, 8, 8], "spacing": [1, 1, 1], "unit": ["mm"]}'),
    "tif-imagej": _ome("ImageJ=1.11a\nimages=8\nslices=8\nunit=parsec\nspacing=wide\n"),
    "tif-imagej-nan": _ome("ImageJ=1.11a\nimages=8\nslices=8\nunit=mm\nspacing=nan\n"),
    "tif-imagej-images": _ome("ImageJ=1.11a\nimages=80000000\nslices=80000000\nunit=mm\n"),
    "npy-scalar": _numpy(3.0),
    "npy-empty": _numpy(np.ones((0, 8, 8))),
    "npy-nan": _numpy(np.full((8, 8, 8), np.nan)),
    "npy-infinite": _numpy(np.where(np.arange(512).reshape(8, 8, 8) > 9, np.inf, 0)),
    "npy-huge": _numpy(np.linspace(-8e307, 8e307, 512).reshape(8, 8, 8)),
    "npy-tiny": _numpy(np.linspace(0, 1e-310, 512).reshape(8, 8, 8)),
    "npy-bool": _numpy(np.ones((8, 8, 8), bool)),
    "npy-int64": _numpy(np.arange(512).reshape(8, 8, 8) + 2**62),
    "npy-thin": _numpy(np.arange(512.0).reshape(2, 2, 128)),
    "npy-axes": _numpy(np.ones((2,) + (1,) * 30)),
    "npy-big-endian": _numpy(np.arange(512, dtype=">i8").reshape(8, 8, 8)),
    "npy-half": _numpy(np.arange(512, dtype=np.float16).reshape(8, 8, 8)),
    "npy-longdouble": _numpy(np.arange(512, dtype=np.longdouble).reshape(8, 8, 8)),
    "folder-no-pixels": _without("PixelData"),
    "folder-no-spacing": _without("PixelSpacing"),
    "folder-no-position": _without("ImagePositionPatient"),
    "folder-no-orientation": _without("ImageOrientationPatient"),
    "folder-no-rows": _without("Rows"),
    "folder-one-plane": _dicom(lambda image, k: setattr(image, "ImagePositionPatient", [0, 0, 1])),
    "folder-spacing-zero": _dicom(lambda image, k: setattr(image, "PixelSpacing", [0, 0])),
    "folder-huge": _dicom(lambda image, k: setattr(image, "Rows", 65535)),
    "folder-rows": _dicom(lambda image, k: setattr(image, "Rows", 9 if k == 3 else 10)),
    "folder-series": _dicom(lambda image, k: setattr(image, "SeriesInstanceUID", f"1.{k % 2}")),
    "folder-bits": _dicom(lambda image, k: setattr(image, "BitsAllocated", 7)),
    "folder-nothing": Path.mkdir,
    "folder-text": lambda path: path.mkdir() or _text(path / "a.txt"),
    "folder-broken-tif": lambda path: path.mkdir() or _text(path / "a.tif"),
    "folder-folder-tif": lambda path: path.mkdir() or (path / "a.tif").mkdir(),
    "folder-pipe": lambda path: path.mkdir() or os.mkfifo(path / "a.tif"),
    "folder-loop": lambda path: path.mkdir() or _loop(path / "a.tif"),
}
