"""A user's own files where a command writes: folders of an output's name, stores, pictures, records, links elsewhere.

The command may refuse, or write beside them; what it may not is change or delete one. `--overwrite` is never given.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

from .case import INFER, Case, Place, Setup, every, nothing, taking
from .larder import LAW, QUICK

_SEGMENT = ("segment", "scan.nii.gz", "--prior", "tubes", "--steps", "1")
_RECONSTRUCT = ("reconstruct", "mask.nii.gz", "--prior", "tubes", "--steps", "1", "--every", "4")
_SYNTH = (
    "synth",
    "--atlas",
    "{larder}/store.zarr",
    "--modality",
    "confocal",
    "--shape",
    "6",
    "--count",
    "1",
    "--workers",
    "0",
)
_BUILD = ("atlas", "build", "OUT", "--shape", "16", "--around", "tubes", "--count", "1", "--workers", "0")

#: Commands that write a file or a store of some name: `OUT` stands for it.
WRITERS: dict[str, tuple[tuple[str, ...], Setup, tuple[str, ...]]] = {
    "generate": (("generate", *LAW, "--shape", "10", "--steps", "4", "-o", "OUT"), nothing, (".zarr", ".ome.zarr",
        ".npy", ".nii.gz", ".stl")),
    "segment": ((*_SEGMENT, "-o", "OUT"), taking("scan.nii.gz"), (".zarr", ".nii.gz", ".tif")),
    "reconstruct": ((*_RECONSTRUCT, "-o", "OUT"), taking("mask.nii.gz"), (".zarr",)),
}  # fmt: skip


def _thesis(out: str) -> Setup:
    return lambda place: place.plant(f"{out}/thesis.txt")


def _hidden(out: str) -> Setup:
    return lambda place: place.plant(f"{out}/.git/config")


def _deep(out: str) -> Setup:
    return lambda place: place.plant(f"{out}/a/b/c/data.bin", bytes(range(256)))


def _empty_folders(out: str) -> Setup:
    return lambda place: (place.here / out / "kept").mkdir(parents=True)


def _file(out: str) -> Setup:
    return lambda place: place.plant(out)


def _shapes(out: str) -> Setup:
    return lambda place: place.take("store.zarr", out)


def _image(out: str) -> Setup:
    return lambda place: place.take("v3_group.zarr", out)


def _older_image(out: str) -> Setup:
    return lambda place: place.take("v2_zlib.zarr", out)


def _set(out: str) -> Setup:
    return lambda place: place.take("set", out)


def _link_to_folder(out: str) -> Setup:
    def setup(place: Place) -> None:
        place.plant("elsewhere/thesis.txt")
        (place.here / out).symlink_to("elsewhere")

    return setup


def _link_to_store(out: str) -> Setup:
    def setup(place: Place) -> None:
        place.take("store.zarr", "elsewhere.zarr")
        (place.here / out).symlink_to("elsewhere.zarr")

    return setup


def _link_to_file(out: str) -> Setup:
    def setup(place: Place) -> None:
        place.plant("elsewhere.txt")
        (place.here / out).symlink_to("elsewhere.txt")

    return setup


def _stem(out: str) -> str:
    return out.removesuffix(".gz").rpartition(".")[0].removesuffix(".ome")


def _picture(out: str) -> Setup:
    return lambda place: place.plant(f"{_stem(out)}.png")


def _record(out: str) -> Setup:
    return lambda place: place.plant(f"{_stem(out)}.json", json.dumps({"mine": 1}))


def _both(out: str) -> Setup:
    return every(_picture(out), _record(out))


def _quoting_record(out: str) -> Setup:
    """A record of the user's that only mentions the program's word."""
    text = json.dumps({"note": "made with curvafit-shape-1 and curvafit-mask-1", "mine": [1, 2, 3]})
    return lambda place: place.plant(f"{_stem(out)}.json", text)


def _list_record(out: str) -> Setup:
    return lambda place: place.plant(f"{_stem(out)}.json", '["curvafit-shape-1", "curvafit-mask-1"]')


def _record_link(out: str) -> Setup:
    def setup(place: Place) -> None:
        place.plant("elsewhere.json", "{}")
        (place.here / f"{_stem(out)}.json").symlink_to("elsewhere.json")
        (place.here / f"{_stem(out)}.png").symlink_to("elsewhere.json")

    return setup


def _volume(out: str) -> Setup:
    """A scan of the user's: a volume like any other, that the program did not make."""
    names = {".npy": "plain.npy", ".nii.gz": "scan.nii.gz", ".tif": "plain.tif", ".stl": "plain.npy"}
    source = next((name for suffix, name in names.items() if out.endswith(suffix)), "plain.npy")
    return lambda place: place.take(source, out)


BELONGINGS: dict[str, Callable[[str], Setup]] = {
    "thesis": _thesis, "hidden": _hidden, "deep": _deep, "empty-folders": _empty_folders, "file": _file,
    "store-of-shapes": _shapes, "image": _image, "older-image": _older_image, "set": _set,
    "link-to-folder": _link_to_folder, "link-to-store": _link_to_store, "link-to-file": _link_to_file,
    "picture": _picture, "record": _record, "picture-and-record": _both, "record-that-quotes": _quoting_record,
    "record-of-a-list": _list_record, "record-link": _record_link, "volume": _volume,
}  # fmt: skip


#: What is tried with a command that writes as another does.
_FEW = ("thesis", "store-of-shapes", "link-to-folder", "record-that-quotes", "picture")


def cases(seed: int) -> Iterator[Case]:
    """Every thing of a user's where every command writes."""
    for name, (command, setup, suffixes) in WRITERS.items():
        for suffix in suffixes:
            for what, put in BELONGINGS.items():
                if (what == "volume" and suffix == ".zarr") or (name == "reconstruct" and what not in _FEW):
                    continue
                out = f"home{suffix}"
                told = tuple(out if part == "OUT" else part for part in command)
                yield Case(f"belongings/{name}{suffix}/{what}", every(setup, put(out)), told)
    yield from _folders()
    yield from _single()


def _folders() -> Iterator[Case]:
    """Commands that fill a folder: what is in it already stays."""
    names = {
        "synth": ((*_SYNTH, "-o", "home"), ("curvafit.json", "dataset.json", "preview.png", "card.md",
            "imagesTr/case_00000_0000.nii.gz", "notes.txt")),
        "build": (tuple("home" if part == "OUT" else part for part in _BUILD), ("zarr.json", "draws/000000/zarr.json",
            "notes.txt", ".hidden")),
        "map": (("atlas", "map", "{larder}/store.zarr", "-o", "home"), ("atlas.html", "atlas.png",
            "cache/distances.npz", "notes.txt")),
        "infer": (
            (*INFER, "{larder}/atlas.npz", "-o", "home"),
            ("fit.json", "report.html", "regenerated.nii.gz", "notes.txt"),
        ),
    }  # fmt: skip
    for name, (command, files) in names.items():
        for file in files:
            setup = _planting(f"home/{file}")
            yield Case(f"belongings/{name}/{file}", setup, command, quick=name not in ("infer", "map"))
        for what in ("link-to-folder", "set", "image", "store-of-shapes", "link-to-store"):
            own = ("home/dataset.json", "home/preview.png", "home/card.md") if (name, what) == ("synth", "set") else ()
            put = BELONGINGS[what]("home")
            yield Case(f"belongings/{name}/{what}", put, command, own, quick=name not in ("infer", "map"))


def _planting(name: str) -> Setup:
    return lambda place: place.plant(name)


def _single() -> Iterator[Case]:
    """Snapshots, checkpoints, atlases, samples; inputs that are outputs; a store extended with other settings."""
    npy = ("generate", *QUICK, "-o", "home.npy")
    told: dict[str, tuple[tuple[str, ...], Setup]] = {
        "snapshot": ((*npy, "--snapshots", "10"), _planting("home_step00010.npy")),
        "snapshot-zarr": (("generate", *QUICK, "-o", "home.zarr", "--snapshots", "10"), _thesis("home_step00010.zarr")),
        "checkpoint-text": ((*npy, "--checkpoint", "notes.txt"), _planting("notes.txt")),
        "checkpoint-part": ((*npy, "--checkpoint", "run.pt", "--checkpoint-every", "0"), _planting("run.pt.part")),
        "checkpoint-folder": ((*npy, "--checkpoint", "run"), _thesis("run")),
        "checkpoint-volume": ((*npy, "--checkpoint", "plain.npy"), taking("plain.npy")),
        "checkpoint-of-another": ((*npy, "--checkpoint", "run.pt"), taking("run.pt")),
        "extract-other": (("atlas", "extract", "{larder}/store.zarr", "-o", "home.npz"), _planting("home.npz")),
        "extract-maps": (("atlas", "extract", "{larder}/store.zarr", "-o", "maps.npz"), taking("maps.npz")),
        "extract-folder": (("atlas", "extract", "{larder}/store.zarr", "-o", "home.npz"), _thesis("home.npz")),
        "sample": (("samples", "get", "synthetic", "-o", "mine.nii.gz"), _planting("mine.nii.gz")),
        "segment-prior": ((*_SEGMENT[:3], "fit.json", "-o", "fit.npy"), taking("scan.nii.gz", "fit.json")),
        "segment-scan": ((*_SEGMENT, "-o", "scan.nii.gz"), taking("scan.nii.gz")),
        "segment-scan-stem": ((*_SEGMENT, "-o", "scan.nii"), taking("scan.nii.gz")),
        "segment-inside": (("segment", "series", "--prior", "tubes", "-o", "series/out.npy"), taking("series")),
        "segment-around": (("segment", "a.zarr/in.npy", "--prior", "tubes", "-o", "a.zarr"), _inside),
        "segment-store": (("segment", "v3_group.zarr", "--prior", "tubes", "-o", "v3_group.zarr"),
            taking("v3_group.zarr")),
        "generate-prior": (("generate", "--prior", "fit.json", "--shape", "10", "--steps", "4", "-o", "fit.npy"),
            taking("fit.json")),
        "generate-maps": (("generate", "--maps", "maps.npz", "--steps", "2", "-o", "maps.npy"), taking("maps.npz")),
        "synth-into-store": ((*_SYNTH, "-o", "store.zarr"), taking("store.zarr")),
        "build-into-set": (("atlas", "build", "set", "--shape", "8", "--count", "1", "--workers", "0"), taking("set")),
        "build-other-shape": (("atlas", "build", "store.zarr", "--shape", "8", "--count", "1", "--workers", "0"),
            taking("store.zarr")),
        "build-other-seed": (("atlas", "build", "store.zarr", "--shape", "16", "--seed", "9", "--count", "1",
            "--workers", "0"), taking("store.zarr")),
        "build-unreadable": (("atlas", "build", "store.zarr", "--shape", "16", "--count", "1", "--workers", "0"),
            _torn_store),
        "map-into-store": (("atlas", "map", "store.zarr", "-o", "store.zarr"), taking("store.zarr")),
        "extract-into-store": (("atlas", "extract", "store.zarr", "-o", "store.zarr/atlas.npz"), taking("store.zarr")),
        "infer-into-scan": (
            ("infer", "series", "--fast", "--atlas", "{larder}/atlas.npz", "-o", "series"), taking("series"),
        ),
    }  # fmt: skip
    for name, (command, setup) in told.items():
        yield Case(f"belongings/single/{name}", setup, command, quick=not name.startswith(("infer", "map")))


def _inside(place: Place) -> Path:
    return place.take("plain.npy", "a.zarr/in.npy")


def _torn_store(place: Place) -> None:
    place.take("store.zarr")
    (place.here / "store.zarr" / "zarr.json").write_text("{")
