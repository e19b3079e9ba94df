"""A map as one page: everything in it, nothing from elsewhere.

Small things (places, parameters, neighbours) are one JSON text. Thumbnails, small volumes, diagrams and embeddings are
pieces of base64 in four more texts, found by their offsets and decoded when they are looked at.
"""

from __future__ import annotations

import base64
import io
import json
import math
import zlib
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from PIL import Image
from scipy.signal import resample
from scipy.spatial.distance import cdist

from curvafit.atlas_map.layout import NOISE, AtlasMap
from curvafit.atlas_map.picture import CLUSTER_COLOURS, FAMILY_COLOURS
from curvafit.data_synth.store import Record, Settings
from curvafit.drawing.plot import DENSITY, shared_limits
from curvafit.drawing.render import render
from curvafit.generation.flow import WORKING_BLUR
from curvafit.generation.schedule import SCHEDULES, present_name
from curvafit.geometry.diagram import FAMILIES, Diagram
from curvafit.inference.atlas import SEEN_AS
from curvafit.inference.fit import FIT_SCHEMA
from curvafit.priors.coefficients import NAMES
from curvafit.priors.grid import WORKING_EPSILON

#: How many nearest shapes are shown beside one, and how many a scan is placed by.
NEIGHBOURS, PLACED_BY = 8, 5
#: Columns that points can be coloured by: key, symbol, what it is. a20 is the gauge in most designs.
_COLUMNS = {
    "a20": ("a₂₀", "coefficient of κ₁²"),
    "a11": ("a₁₁", "coefficient of κ₁κ₂"),
    "a02": ("a₀₂", "coefficient of κ₂²"),
    "a10": ("a₁₀", "coefficient of κ₁"),
    "a01": ("a₀₁", "coefficient of κ₂"),
    "a00": ("a₀₀", "constant coefficient"),
    "m0": ("m₀", "mass: mean of the field"),
    "volume": ("volume", "share of the box inside"),
}
_SCRIPTS = ("data", "chart", "moves", "diagram", "solid", "hands", "panel", "schema", "scan", "start")
#: Width of a thumbnail in pixels, and the longest edge of a small volume in voxels.
THUMBNAIL, EDGE = 144, 32
#: A small volume holds u, cut off at ± this, in steps 0 to `LEVELS`: fine where the surface is, and it packs well.
CUT, LEVELS = 0.5, 31


def page_html(
    mapped: AtlasMap, shapes: Sequence[Miniature], commands: Sequence[str], account: Sequence[tuple[str, str]]
) -> str:
    """Return the text of the page, from each shape's miniature and the command that grows it again, in the atlas's
    order.

    `account` is rows, name and text, on how the map was made.
    """
    blobs = {
        "thumbnails": _join_base64(one.thumbnail for one in shapes),
        "volumes": _join_base64(one.volume for one in shapes),
    }
    data = _page_data(mapped, commands)
    scale, pieces = _encode_diagrams(mapped.atlas.field_diagrams)
    data["diagram"]["scale"], blobs["diagrams"] = scale, _join_base64(pieces)
    scale, pieces = _embeddings(mapped)
    data["embedding"]["scale"], blobs["embeddings"] = scale, _join_base64(pieces)
    data["offsets"] = {name: offsets for name, (_, offsets) in blobs.items()}
    return Template(_template("atlas.html")).substitute(
        version=escape(str(mapped.settings["versions"]["curvafit"])),
        title=f"Atlas of {len(mapped)} shapes",
        style=_template("atlas.css"),
        script="\n".join(_template(f"atlas_{name}.js") for name in _SCRIPTS),
        made="\n".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in account),
        data=json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        blobs="\n".join(f'<script type="text/plain" id="{name}">{text}</script>' for name, (text, _) in blobs.items()),
    )


def _page_data(mapped: AtlasMap, commands: Sequence[str]) -> dict[str, Any]:
    """Return the data that the page decodes at its start."""
    near = mapped.neighbours(NEIGHBOURS)
    sampling = mapped.atlas.provenance["settings"]
    box = np.array(sampling["shape"]) * sampling["spacing"]
    limits = np.array([shared_limits([diagram]) for diagram in mapped.atlas.field_diagrams])
    return {
        "ids": mapped.atlas.ids,
        "places": _unit_square(mapped.positions).round(5).tolist(),
        "family": [FAMILIES.index(name) for name in mapped.families],
        "families": [[name, FAMILY_COLOURS[name]] for name in FAMILIES],
        "cluster": mapped.clusters.tolist(),
        "clusters": [
            [f"{name} ({number + 1})", CLUSTER_COLOURS[number % len(CLUSTER_COLOURS)]]
            for number, name in enumerate(mapped.cluster_families)
        ],
        "noise": NOISE,
        "columns": _columns(mapped),
        "commands": list(commands),
        "neighbours": near.tolist(),
        "distances": np.take_along_axis(mapped.distances, near, axis=1).round(3).tolist(),
        "volume": {
            "shape": small_shape(sampling["shape"]),
            "box": (box / box.max()).tolist(),
            "levels": LEVELS,
            "cut": CUT,
            "slope": float(np.sqrt(2) * sampling["epsilon"] / box.max()),
        },
        "diagram": {"limits": [float(np.quantile(limits[:, 0], 0.05)), float(np.quantile(limits[:, 1], 0.95))]},
        "fit": FIT_SCHEMA,
        "embedding": {
            "usual": {view: _nearest_quantiles(mapped.atlas.embeddings(view)) for view in SEEN_AS},
            "nearest": PLACED_BY,
        },
        "ramps": {
            "values": [to_hex(colour) for colour in colormaps["viridis"](np.linspace(0, 1, 17))],
            "density": [to_hex(colour) for colour in DENSITY(np.linspace(0, 1, 17))],
        },
    }


def _columns(mapped: AtlasMap) -> list[dict[str, Any]]:
    """Return the parameters that points can be coloured by, with their values."""
    atlas = mapped.atlas
    values = dict(zip(NAMES, atlas.coefficients.T, strict=True))
    values |= {"m0": atlas.masses, "volume": atlas.volume_fractions}
    return [
        {"key": key, "symbol": symbol, "says": says, "values": values[key].tolist()}
        for key, (symbol, says) in _COLUMNS.items()
        if key != "a20" or np.ptp(values[key]) > 0
    ]


def _unit_square(positions: np.ndarray) -> np.ndarray:
    """Return the places centred in [0, 1]², both axes scaled alike."""
    low, high = positions.min(0), positions.max(0)
    return (positions - (low + high) / 2) / max(float((high - low).max()), 1e-9) + 0.5


def _nearest_quantiles(embeddings: np.ndarray) -> list[float]:
    """Return the median and the 95 % quantile of the distance to the nearest other shape."""
    apart = cdist(embeddings, embeddings)
    np.fill_diagonal(apart, np.inf)
    return np.quantile(apart.min(1), [0.5, 0.95]).round(4).tolist()


def _encode_diagrams(diagrams: Sequence[Diagram]) -> tuple[float, list[bytes]]:
    """Return the step of κ, and each diagram's κ1, κ2 (int16, in steps) and shares of area (uint16, of 65535)."""
    step = max(float(np.abs(diagram.points).max()) for diagram in diagrams) / 32767
    return step, [
        np.rint(diagram.points.T / step).astype("<i2").tobytes()
        + np.rint(diagram.normalised.weights * 65535).astype("<u2").tobytes()
        for diagram in diagrams
    ]


def _embeddings(mapped: AtlasMap) -> tuple[float, list[bytes]]:
    """Return the step, and the sliced embeddings of fields and of masks `(N, 288)`, int16 in steps."""
    views = [mapped.atlas.embeddings(view) for view in SEEN_AS]
    step = max(float(np.abs(each).max()) for each in views) / 32767
    return step, [np.rint(each / step).astype("<i2").tobytes() for each in views]


def _join_base64(pieces: Iterable[bytes]) -> tuple[str, list[int]]:
    """Return pieces as one text in base64, and the offsets where each begins and the last ends."""
    texts = [base64.b64encode(piece).decode("ascii") for piece in pieces]
    return "".join(texts), np.cumsum([0, *map(len, texts)]).tolist()


def _template(name: str) -> str:
    return files("curvafit.atlas_map").joinpath("templates", name).read_text(encoding="utf-8")


# ---- one shape -------------------------------------------------------------------------------------------------------


class Miniature(NamedTuple):
    """A shape's thumbnail (WebP) and small volume (zlib, one byte a voxel, z slowest, of `small_shape`)."""

    thumbnail: bytes
    volume: bytes


def shrink(u: np.ndarray) -> Miniature:
    """Return the thumbnail and the small volume of a periodic field `(Z, Y, X)`."""
    buffer = io.BytesIO()
    Image.fromarray(render(u, width=THUMBNAIL)[0]).save(buffer, "webp", quality=80, alpha_quality=80)
    return Miniature(buffer.getvalue(), zlib.compress(small_volume(u).tobytes(), 9))


def small_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of a small volume: at most `EDGE` voxels an edge, and in proportion."""
    factor = min(1.0, EDGE / max(shape))
    return tuple(max(2, round(n * factor)) for n in shape)


def small_volume(u: np.ndarray) -> np.ndarray:
    """Return a periodic field `(Z, Y, X)` in fewer voxels (its lower frequencies), uint8 from 0 to `LEVELS`."""
    values = np.clip(u, -1, 1).astype(np.float64)
    for axis, count in enumerate(small_shape(u.shape)):
        if count < values.shape[axis]:
            values = np.asarray(resample(values, count, axis=axis))
    steps = (np.clip(values / CUT, -1, 1) + 1) / 2 * LEVELS
    return np.rint(steps).astype(np.uint8)


def regrow_command(record: Record, settings: Settings, name: str) -> str:
    """Return the `curvafit generate` line that makes a draw's field again; raise ValueError where there is none.

    With the same versions, processor and number of threads (stores are made on one) it is the same bit for bit.
    """
    options = [
        f"--coefficients {','.join(map(_all_digits, record.coefficients))}",
        f"--mass {_all_digits(record.mass)}",
    ]
    sizes = settings.shape[:1] if len(set(settings.shape)) == 1 else settings.shape
    options += [f"--shape {','.join(map(str, sizes))}", f"--seed {record.seed}"]
    plan = present_name(settings.schedule)
    if plan not in SCHEDULES or not math.isclose(settings.blur, WORKING_BLUR):
        raise ValueError(f"`curvafit generate` has no schedule {plan} with a blur of {settings.blur:g}")
    options.append(f"--schedule {plan}")
    if settings.schedule["steps"] != SCHEDULES[plan].steps:
        options.append(f"--steps {settings.schedule['steps']}")
    if not math.isclose(settings.epsilon, WORKING_EPSILON):
        options.append(f"--epsilon {_all_digits(settings.epsilon)}")
    return f"curvafit generate {' '.join(options)} -o {name}"


def _all_digits(value: object) -> str:
    """Return a number with all its digits, a whole one without a decimal point."""
    number = float(value)  # type: ignore[arg-type]
    return str(int(number)) if number.is_integer() else repr(number)
