"""`atlas.png` and `atlas.html` of stores, made in steps that are not made twice."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.atlas_map.extract import Measured, measure_shape, read_draws, shape_id, to_atlas
from curvafit.atlas_map.layout import AtlasMap, check_extra, check_size, diagram_distances, map_atlas
from curvafit.atlas_map.page import Miniature, page_html, regrow_command, shrink
from curvafit.atlas_map.picture import map_picture
from curvafit.core.files import is_empty, write_content
from curvafit.core.records import can_write, has_mark, read_archive
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.data_synth.atlas import summarise
from curvafit.data_synth.store import Record, Store, open_store
from curvafit.geometry.diagram import Diagram
from curvafit.inference.atlas import Atlas

#: Folder beside the two files for what took long: measured shapes and distances.
CACHE = "cache"
#: Mark of the folder, which programs that make backups know too (bford.info/cachedir), and mark of the page.
TAG = "CACHEDIR.TAG"
_TAGGED = "Signature: 8a477f597d28d172789f06886806bc55\n# curvafit atlas map"
_MARK = '<meta name="generator" content="curvafit'
#: Goes up when the content of the cache changes.
_CACHE_VERSION = 1

_Arrays = dict[str, np.ndarray]


def check_map(directory: str | Path, stores: Sequence[str | Path], overwrite: bool = False) -> Path:
    """Return the folder if the map of stores can be written there, else raise ValueError; call it before long work."""
    folder = Path(directory)
    page, cache = folder / "atlas.html", folder / CACHE

    def ours(path: Path) -> bool:
        if path == cache:
            return is_empty(cache) or has_mark(cache / TAG, _TAGGED)
        return path.is_file() and has_mark(page, _MARK)

    can_write(page, ours, more=[folder / "atlas.png", cache], inputs=stores, overwrite=overwrite)
    return folder


def write_map(
    stores: Sequence[str | Path | Store],
    directory: str | Path,
    *,
    command: str = "",
    overwrite: bool = False,
    progress: Progress = silent,
) -> tuple[Path, Path]:
    """Write `atlas.png` and `atlas.html` of the stores' well-formed shapes into a folder; return their paths.

    Measures and distances are kept in the folder's `cache`: a run that was stopped goes on where it was, and one on
    larger stores measures only the new shapes. The cache may be deleted at any time.

    Raises ImportError without the extra `[atlas]`; FileNotFoundError or ValueError as `extract` does, for too few
    shapes, and where a file of another origin would be replaced without `overwrite`.
    """
    check_extra()
    sources = [store if isinstance(store, Store) else open_store(store) for store in stores]
    folder = check_map(directory, [store.path for store in sources], overwrite)
    draws, shapes = read_draws(sources)
    check_size(len(shapes))
    commands = [
        regrow_command(record, store.settings, f"shape_{shape_id(store, record)}.nii.gz") for store, record in shapes
    ]
    cache = folder / CACHE
    cache.mkdir(parents=True, exist_ok=True)
    write_content(cache / TAG, f"{_TAGGED}\n")
    measures, views = [], []
    for done, (store, record) in enumerate(shapes):
        progress(f"measuring {len(shapes)} shapes", 0.6 * done / len(shapes))
        arrays = _measure_once(store, record, cache)
        fraction, thickness = map(float, arrays["numbers"])
        measures.append(Measured(fraction, thickness, _diagram(arrays, "field"), _diagram(arrays, "mask")))
        views.append(Miniature(arrays["thumbnail"].tobytes(), arrays["volume"].tobytes()))
    atlas = to_atlas(draws, shapes, measures)
    distances = _compare_once(atlas, cache, sub_progress(progress, 0.6, 0.85))
    progress("laying out the map", 0.86)
    mapped = map_atlas(atlas, distances)
    progress("drawing", 0.95)
    picture = map_picture(mapped, lambda k: shapes[k][0].field(shapes[k][1].index), folder / "atlas.png")
    text = page_html(mapped, views, commands, _account(mapped, sources, command))
    page = write_content(folder / "atlas.html", text)
    progress("done", 1.0)
    return picture, page


def _measure_once(store: Store, record: Record, cache: Path) -> _Arrays:
    """Return what is measured and shown of a shape, from the cache if it is there and sound."""
    settings, facts = dataclasses.asdict(store.settings), dataclasses.asdict(record)
    # All that the arrays depend on.
    content = json.dumps([_CACHE_VERSION, version("curvafit"), settings, facts], sort_keys=True, default=str)
    path = cache / f"shape-{shape_id(store, record)}-{hashlib.sha256(content.encode()).hexdigest()[:12]}.npz"
    try:
        return read_archive(path)
    except (OSError, ValueError):
        arrays = _measure(store, record)
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_content(path, buffer.getvalue())
    return arrays


def _measure(store: Store, record: Record) -> _Arrays:
    """Return what is measured and shown of a shape, as arrays."""
    measured = measure_shape(store, record)
    views = shrink(store.field(record.index))._asdict()
    arrays = {"numbers": np.array([measured.fraction, measured.thickness])}
    arrays |= {name: np.frombuffer(view, dtype=np.uint8) for name, view in views.items()}
    for view, diagram in (("field", measured.field), ("mask", measured.mask)):
        figures = np.array([diagram.spread, diagram.excluded])
        arrays |= {f"{view}_points": diagram.points, f"{view}_weights": diagram.weights, f"{view}_figures": figures}
    return arrays


def _diagram(cached: _Arrays, view: str) -> Diagram:
    """Return the diagram of a shape's field or mask."""
    spread, excluded = map(float, cached[f"{view}_figures"])
    return Diagram(cached[f"{view}_points"], cached[f"{view}_weights"], spread=spread, excluded=excluded)


def _compare_once(atlas: Atlas, cache: Path, progress: Progress) -> np.ndarray:
    """Return the distances between the shapes' diagrams; those in the cache are taken from there."""
    saved = cache / "distances.npz"
    try:
        return diagram_distances(atlas.field_diagrams, progress=progress, saved=saved)
    except ValueError:  # a file that is damaged, or of other settings
        saved.unlink(missing_ok=True)
        return diagram_distances(atlas.field_diagrams, progress=progress, saved=saved)


def _account(mapped: AtlasMap, stores: Sequence[Store], command: str) -> list[tuple[str, str]]:
    """Return the rows of the page that say how the map was made."""
    settings, several = mapped.settings, len(stores) > 1
    rows = {
        "command": command,
        "well-formed": f"{len(mapped)} of the shapes",
        **{
            f"{store.name}: {name}" if several else name: words
            for store in stores
            for name, words in summarise(store).items()
        },
        "distances": _join_words(settings["distances"]),
        "UMAP": _join_words(settings["umap"]),
        "HDBSCAN": _join_words(settings["hdbscan"]) + f": {max(mapped.clusters) + 1} clusters",
        "measured with": _join_words(settings["versions"]),
        "measured on": mapped.atlas.provenance["date"],
    }
    return [(name, words) for name, words in rows.items() if words]


def _join_words(values: dict[str, Any]) -> str:
    """Return names and values as one line."""
    return ", ".join(f"{name} {value}" for name, value in values.items())
