"""Options at their limits: every number and word of every command, with numbers and words that it cannot mean."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from .case import Case, Place, Setup, dice, nothing, taking
from .larder import LAW

#: Whatever a user or a script may put there.
VALUES: dict[str, str] = {
    "zero": "0", "minus-zero": "-0", "one": "1", "minus-one": "-1", "half": "0.5", "two": "2",
    "1e9": "1e9", "-1e9": "-1e9", "1e-9": "1e-9", "1e30": "1e30", "-1e30": "-1e30", "1e-30": "1e-30",
    "1e300": "1e300", "-1e300": "-1e300", "1e-300": "1e-300", "nan": "nan", "inf": "inf", "-inf": "-inf",
    "400-digits": "9" * 400, "minus-400-digits": "-" + "9" * 400, "5000-digits": "7" * 5000,
    "400-places": "0." + "0" * 400 + "1", "2e63": str(2**63), "2e64": str(2**64), "2e31": str(2**31),
        "2e32": str(2**32),
    "empty": "", "space": " ", "word": "word", "umlaut": "fünf", "wide": "１２", "hindi": "३", "roman": "Ⅳ",
    "hex": "0x10", "underscore": "1_0", "minus": "-", "dashes": "--", "percent": "50%", "comma": ",", "commas": ",,,",
    "two-numbers": "1,2", "eight-numbers": "1,2,3,4,5,6,7,8", "semicolons": "1;2;3", "spaces": "8, 8, 8",
    "newline": "1\n2", "tab": "\t8", "slash": "/", "dots": "..", "emoji": "🦴", "markup": "[bold]8[/bold]",
    "format": "%s{0}", "true": "true", "none": "None", "list": "[8,8,8]", "fraction": "1/3", "complex": "1j",
    "long-word": "w" * 5000, "low-surrogate": "\udcff", "backslash": "\\", "quotes": "'\"",
}  # fmt: skip

#: Values that one option can mean, or nearly: all of them are tried.
OWN: dict[str, dict[str, str]] = {
    "channel": {"first": "0", "second": "1", "third": "2", "last": "-1", "name": "red", "range": "0:1"},
    "label": {"background": "0", "structure": "1", "other": "2", "missing": "7", "several": "1,2", "decimal": "1.0"},
    "crop": {
        "all": ":,:,:", "most": "0:16,0:16,0:16", "tail": "2:,2:,2:", "ends": "-12:,-12:,:-1", "signs": " : , : , : ",
        "plane": "3:4,:,:", "nothing": "4:4,:,:", "backwards": "9:2,:,:", "beyond": ":,:,0:900", "before": "-900:,:,:",
        "step": "::2,:,:", "flat": "0:8,0:8", "four": ":,:,:,:", "point": "4,4,4", "decimal": "0.5:9,:,:",
        "long": f"0:{10**400},:,:", "semicolons": "0:8;0:8;0:8", "words": "a:b,c:d,e:f",
    },
}  # fmt: skip

#: Numbers that are only very long, not wrong: what asks for that much work is no fault.
_LARGE = re.compile(r"^\s*\+?(\d{5,}|[1-9]\d*e[1-9]\d*|inf)\s*$")


class Command(NamedTuple):
    """A command that succeeds, the options to try, and those whose large numbers only ask for much work."""

    arguments: tuple[str, ...]
    options: str
    work: str = ""
    setup: Setup = nothing
    stays: tuple[str, ...] = ()
    changes: tuple[str, ...] = ()
    each: int = 5


def _take_groups(place: Place) -> None:
    """Two folders of two masks each."""
    for name in ("first/a", "first/b", "second/c", "second/d"):
        place.take("mask.nii.gz", f"{name}.nii.gz")


_SMALL = ("--shape", "10", "--steps", "4")
#: Nothing is grown, as in `case.INFER`.
_INFER = ("--fast", "--atlas", "{larder}/atlas.npz")
_PRIOR = ("--prior", "tubes", "--steps", "2", "-o", "out.nii.gz")
_STORE = ("store.zarr", "store.zarr/*")

COMMANDS: dict[str, Command] = {
    "generate": Command(
        ("generate", *LAW, *_SMALL, "-o", "out.npy"),
        "mass shape epsilon seed schedule steps device checkpoint-every spacing tile snapshots boundary orientation "
        "coefficients volume-fraction",
        "steps",
        each=7,
    ),
    "generate-unit": Command(
        ("generate", *LAW, *_SMALL, "--spacing", "0.1", "--unit", "mm", "-o", "out.nii.gz"), "spacing unit tile",
        each=6
    ),
    "generate-surface": Command(
        ("generate", *LAW, "--shape", "12", "--steps", "20", "--spacing", "2", "-o", "out.stl"), "spacing tile", each=4
    ),
    "generate-preset": Command(("generate", *_SMALL, "-o", "out.npy"), "preset prior maps", each=5),
    "segment": Command(
        ("segment", "scan.nii.gz", *_PRIOR),
        "weight threshold epsilon steps spacing unit key prior raw-shape dtype channel label crop",
        "steps",
        taking("scan.nii.gz"),
        each=6,
    ),
    "segment-channels": Command(
        ("segment", "channels.nii.gz", "--channel", "0", *_PRIOR), "channel crop", setup=taking("channels.nii.gz")
    ),
    "refine": Command(
        ("refine", "chances.npz", "--channel", "1", "--weight", "1", *_PRIOR),
        "weight epsilon steps spacing unit key prior channel label crop like",
        "steps",
        taking("chances.npz", "chances.nii.gz"),
        each=6,
    ),
    "refine-example": Command(
        ("refine", "chances.npz", "--channel", "1", "--example", "{larder}/chances.nii.gz", "--example-probabilities",
         "{larder}/chances.npz", *_PRIOR),
        "weight example example-probabilities channel label",
        setup=taking("chances.npz", "chances.nii.gz"),
        each=3,
    ),
    "reconstruct": Command(
        ("reconstruct", "mask.nii.gz", "--every", "4", *_PRIOR),
        "every first slices axis example stiffness periodic suggest sure epsilon steps spacing unit channel label crop",
        "steps",
        taking("mask.nii.gz"),
        each=5,
    ),
    "reconstruct-labels": Command(
        ("reconstruct", "labels.npy", "--every", "4", *_PRIOR), "label crop", setup=taking("labels.npy")
    ),
    "reconstruct-slices": Command(
        ("reconstruct", "mask.nii.gz", *_PRIOR), "slices", setup=taking("mask.nii.gz"), each=5
    ),
    "raw": Command(
        ("segment", "bare.raw", "--raw-shape", "9,10,12", "--dtype", "u2", *_PRIOR),
        "raw-shape dtype",
        setup=taking("bare.raw"),
        each=6,
    ),
    "infer": Command(
        ("infer", "long.npy", *_INFER, "--kind", "field", "--periodic", "-o", "found"),
        "spacing unit threshold label raw-shape dtype key seed kind atlas roi channel crop",
        setup=taking("long.npy"),
        each=3,
    ),
    "infer-channels": Command(
        ("infer", "long-channels.npy", *_INFER, "--kind", "field", "--periodic", "-o", "found"),
        "channel",
        setup=taking("long-channels.npy"),
        each=2,
    ),
    "infer-labels": Command(
        ("infer", "labels.npy", *_INFER, "--kind", "mask", "--periodic", "-o", "found"),
        "label",
        setup=taking("labels.npy"),
        each=2,
    ),
    "compare": Command(
        ("compare", "first", "second", "-o", "out"),
        "by kind threshold spacing subjects permutations seed workers",
        "permutations workers",
        _take_groups,
        each=2,
    ),
    "build": Command(
        ("atlas", "build", "out.zarr", "--count", "1", "--shape", "16", "--around", "tubes", "--workers", "0"),
        "count shape seed design around spread schedule steps workers scheduler",
        "count workers shape",
        stays=("out.zarr", "out.zarr/*"),
        each=6,
    ),
    "extend": Command(
        ("atlas", "extend", "store.zarr", "--count", "0", "--workers", "0"),
        "count workers", "count workers", taking("store.zarr"), changes=_STORE,
    ),
    "verify": Command(("atlas", "verify", "store.zarr"), "", "", taking("store.zarr")),
    "map": Command(("atlas", "map", "store.zarr", "-o", "map"), "device", "", taking("store.zarr"), each=3),
    "synth": Command(
        ("synth", "-o", "set", "--atlas", "{larder}/store.zarr", "--modality", "confocal", "--shape", "6", "--count",
        "1",
         "--workers", "0"),
        "count shape seed modality visible voxel calibres unit layout labels volume-fraction workers scheduler",
        "count workers",
        stays=("set", "set/*"),
        each=6,
    ),
    "synth-like": Command(
        ("synth", "-o", "set", "--atlas", "{larder}/store.zarr", "--like", "{larder}/scan.nii.gz", "--shape", "6",
         "--count", "1", "--workers", "0"),
        "spacing unit like like-mask visible channel label crop", stays=("set", "set/*"), each=3,
    ),
    "synth-channels": Command(
        ("synth", "-o", "set", "--atlas", "{larder}/store.zarr", "--like", "{larder}/channels.nii.gz", "--channel",
         "0", "--like-mask", "{larder}/mask.nii.gz", "--label", "1", "--shape", "6", "--count", "1", "--workers", "0"),
        "channel label crop", stays=("set", "set/*"), each=2,
    ),
    "synth-grown": Command(
        ("synth", "-o", "set", "--modality", "confocal", "--shape", "8", "--count", "1", "--workers", "0"),
        "presets prior atlas", stays=("set", "set/*"), each=4,
    ),
    "nnunet": Command(("nnunet", "--prior", "tubes"), "share weight epsilon warmup prior", each=7),
}  # fmt: skip


def cases(seed: int) -> Iterator[Case]:
    """Each option of each command with some values, drawn by the seed; and commands without sense."""
    for name, each in COMMANDS.items():
        for option in each.options.split():
            rng, own = dice(seed, f"{name} {option}"), OWN.get(option, {})
            drawn = rng.sample(sorted(VALUES), len(VALUES))[: each.each]
            for value, text in (own | {value: VALUES[value] for value in drawn}).items():
                if option in each.work.split() and _LARGE.match(text):
                    continue
                command = (*_without(each.arguments, option), f"--{option}={text}")
                yield Case(
                    f"options/{name}/{option}-{value}",
                    each.setup,
                    command,
                    each.changes,
                    each.stays,
                    quick=_short(name),
                )
    yield from _senseless()


def _without(arguments: tuple[str, ...], option: str) -> tuple[str, ...]:
    """The arguments, without that option's own value where there is one."""
    found = list(arguments)
    for k, part in enumerate(found):
        if part == f"--{option}":
            return tuple(found[:k] + found[k + 2 :])
    return tuple(part for part in found if not part.startswith(f"--{option}="))


def _short(name: str) -> bool:
    return name not in ("build", "synth-grown") and not name.startswith(
        ("compare", "infer", "synth-like", "synth-channels")
    )


_SENSELESS: dict[str, tuple[str, ...]] = {
    "none": ("nonsense",),
    "empty": ("",),
    "no-option": ("generate", "--no-such-option"),
    "no-target": ("generate", "--preset", "tubes"),
    "no-value": ("generate", "--preset"),
    "two-laws": ("generate", "--preset", "tubes", *LAW, "-o", "out.npy"),
    "twice": ("generate", *LAW, *_SMALL, "-o", "out.npy", "--mass=0.5", "--mass=nan"),
    "extra": ("generate", *LAW, *_SMALL, "-o", "out.npy", "more", "words"),
    "presets-word": ("presets", "tubes"),
    "samples-none": ("samples", "nonsense"),
    "samples-unknown": ("samples", "get", "none"),
    "samples-path": ("samples", "get", "../../bone"),
    "samples-empty": ("samples", "get", ""),
    "samples-suffix": ("samples", "get", "synthetic", "-o", "out.exe"),
    "atlas-none": ("atlas", "nonsense"),
    "atlas-info-none": ("atlas", "info", "none.zarr"),
    "atlas-info-file": ("atlas", "info", "file.txt"),
    "atlas-extract-suffix": ("atlas", "extract", "{larder}/store.zarr", "-o", "out.txt"),
    "atlas-extract-none": ("atlas", "extract", "none.zarr", "-o", "out.npz"),
    "atlas-map-none": ("atlas", "map", "none.zarr", "-o", "map"),
    "infer-none": ("infer", "none.nii.gz", "-o", "out"),
    "infer-no-output": ("infer", "file.txt"),
    "infer-text": ("infer", "file.txt", "-o", "out"),
    "infer-small": ("infer", "mask.nii.gz", "--fast", "--kind", "mask", "--atlas", "{larder}/atlas.npz", "-o", "out"),
    "infer-empty": ("infer", "", "-o", "out"),
    "segment-itself": ("segment", "mask.nii.gz", "--prior", "tubes", "-o", "mask.nii.gz"),
    "refine-neither": ("refine", "chances.npz", "--channel", "1", "--prior", "tubes", "-o", "a.npy"),
    "refine-grey": ("refine", "scan.nii.gz", "--prior", "tubes", "--weight", "1", "-o", "a.npy"),
    "reconstruct-both": (
        "reconstruct",
        "mask.nii.gz",
        "--every",
        "2",
        "--known",
        "1,2",
        "--prior",
        "tubes",
        "-o",
        "a.npy",
    ),
    "output-empty": ("generate", *LAW, *_SMALL, "-o", ""),
    "output-dot": ("generate", *LAW, *_SMALL, "-o", "."),
    "output-none": ("generate", *LAW, *_SMALL, "-o", "out.xyz"),
    "output-file-as-folder": ("generate", *LAW, *_SMALL, "-o", "file.txt/out.npy"),
    "tile-walls": ("generate", *LAW, *_SMALL, "--boundary", "replicate", "--tile", "2", "-o", "out.npy"),
    "synth-none": ("synth", "-o", "set"),
    "synth-three": ("synth", "-o", "set", "--presets", "tubes", "--atlas", "a", "--prior", "b", "--modality", "mra"),
    "nnunet-none": ("nnunet",),
    "nnunet-both": ("nnunet", "--prior", "tubes", "--share", "1", "--weight", "1"),
}


def _senseless() -> Iterator[Case]:
    def setup(place: Place) -> None:
        place.plant("file.txt")
        place.take("mask.nii.gz")

    for name, command in _SENSELESS.items():
        yield Case(f"options/senseless/{name}", setup, command)
