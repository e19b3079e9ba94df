"""`atlas.png` and `atlas.html` of stores, made in steps that are not made twice."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.atlas_map.extract import Measured, extract, measured, shape_id
from curvafit.atlas_map.layout import AtlasMap, check_extra, check_size, diagram_distances, embed, map_atlas
from curvafit.atlas_map.page import Shown, page_html, regrow_command, shown
from curvafit.atlas_map.picture import map_picture
from curvafit.core.files import is_empty, write_content
from curvafit.core.records import can_write, has_mark, read_archive
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.data_synth.atlas import summarise
from curvafit.data_synth.store import Record, Store, open_store
from curvafit.generation.result import is_well_formed
from curvafit.geometry.diagram import Diagram
from curvafit.inference.atlas import Atlas

#: Folder beside the two files for what took long: measured shapes, distances, places.
CACHE = "cache"
#: Its mark, by which programs that make backups know it too (bford.info/cachedir), and that of the page.
TAG = "CACHEDIR.TAG"
_TAGGED = "Signature: 8a477f597d28d172789f06886806bc55\n# curvafit atlas map"
_MARK = '<meta name="generator" content="curvafit'
#: Goes up when what is kept changes.
_CACHE_VERSION = 1

_Arrays = dict[str, np.ndarray]


def check_map(directory: str | Path, stores: Sequence[str | Path], overwrite: bool = False) -> Path:
    """Return the folder, if the map of stores can be written there; for a check before long work.

    Raises
    ------
    ValueError
        If it is no folder that can be written to, lies in a store, or something else stands where a file goes.
    """
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
    """Write `atlas.png` and `atlas.html` of the stores' well-formed shapes into a folder; returns their paths.

    What takes long is kept in the folder's `cache`, shape by shape: a run that was stopped goes on where it was, one
    on larger stores measures the new shapes only. The cache may be deleted at any time.

    Raises
    ------
    ImportError
        If the extra `[atlas]` is not installed.
    FileNotFoundError, ValueError
        If there is no such store, there are too few well-formed shapes, or as `extract` and `check_map`; `overwrite`
        tells whether files that no such call wrote may be replaced.
    """
    check_extra()
    sources = [store if isinstance(store, Store) else open_store(store) for store in stores]
    check_map(directory, [store.path for store in sources], overwrite)
    check_size(sum(is_well_formed(store.record(index).viability) for store in sources for index in store.indices()))
    folder = Path(directory)
    (folder / CACHE).mkdir(parents=True, exist_ok=True)
    write_content(folder / CACHE / TAG, f"{_TAGGED}\n")
    atlas, draws, shapes, commands = _measures(sources, folder / CACHE, progress)
    mapped = _mapped(atlas, folder / CACHE, progress)
    progress("drawing", 0.95)
    picture = map_picture(mapped, lambda k: draws[k][0].field(draws[k][1]), folder / "atlas.png")
    text = page_html(mapped, shapes, commands, _account(mapped, sources, command))
    page = write_content(folder / "atlas.html", text)
    progress("done", 1.0)
    return picture, page


def _measures(
    stores: Sequence[Store], cache: Path, progress: Progress
) -> tuple[Atlas, list[tuple[Store, int]], list[Shown], list[str]]:
    """Return every shape's measures, and with each its draw, its pictures and the command that grows it again."""
    draws: list[tuple[Store, int]] = []
    shapes: list[Shown] = []
    commands: list[str] = []

    def look(store: Store, record: Record) -> Measured:
        draws.append((store, record.index))
        commands.append(regrow_command(record, store.settings, f"shape_{shape_id(store, record)}.nii.gz"))
        cached = _cached(cache / f"shape-{_key(store, record)}.npz", lambda: _measure(store, record))
        shapes.append(Shown(cached["thumbnail"].tobytes(), cached["volume"].tobytes()))
        return float(cached["fraction"]), _diagram(cached, "field"), _diagram(cached, "mask")

    atlas = extract(stores, measure=look, progress=sub_progress(progress, 0.0, 0.6))
    return atlas, draws, shapes, commands


def _measure(store: Store, record: Record) -> _Arrays:
    fraction, *diagrams = measured(store, record)
    views = shown(store.field(record.index))
    arrays = {"fraction": np.array(fraction)} | {
        name: np.frombuffer(view, dtype=np.uint8) for name, view in views._asdict().items()
    }
    for view, diagram in zip(("field", "mask"), diagrams, strict=True):
        figures = np.array([diagram.spread, diagram.excluded])
        arrays |= {f"{view}_points": diagram.points, f"{view}_weights": diagram.weights, f"{view}_figures": figures}
    return arrays


def _diagram(cached: _Arrays, view: str) -> Diagram:
    spread, excluded = map(float, cached[f"{view}_figures"])
    return Diagram(cached[f"{view}_points"], cached[f"{view}_weights"], spread=spread, excluded=excluded)


def _mapped(atlas: Atlas, cache: Path, progress: Progress) -> AtlasMap:
    """Return the map of an atlas, its distances and places from the cache where they are there."""
    saved, comparing = cache / "distances.npz", sub_progress(progress, 0.6, 0.85)
    compare = partial(diagram_distances, atlas.field_diagrams, progress=comparing, saved=saved)
    try:
        distances = compare()
    except ValueError:  # a file that is damaged, or of other settings
        saved.unlink(missing_ok=True)
        distances = compare()
    progress("laying out the map", 0.86)
    key = hashlib.sha256(distances.tobytes()).hexdigest()[:12]
    places = _cached(cache / f"places-{key}-{version('umap-learn')}.npz", lambda: {"positions": embed(distances)})
    return map_atlas(atlas, distances, places["positions"])


def _cached(path: Path, make: Callable[[], _Arrays]) -> _Arrays:
    """Return the arrays in a file; where there is no sound one, make them and write them there."""
    try:
        return read_archive(path)
    except (OSError, ValueError):
        arrays = make()
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_content(path, buffer.getvalue())
    return arrays


def _key(store: Store, record: Record) -> str:
    """Return a name that changes with anything a shape's measures and pictures depend on."""
    settings, facts = dataclasses.asdict(store.settings), dataclasses.asdict(record)
    content = json.dumps([_CACHE_VERSION, version("curvafit"), settings, facts], sort_keys=True, default=str)
    return f"{shape_id(store, record)}-{hashlib.sha256(content.encode()).hexdigest()[:12]}"


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
        "distances": _listed(settings["distances"]),
        "UMAP": _listed(settings["umap"]),
        "HDBSCAN": _listed(settings["hdbscan"]) + f": {max(mapped.clusters) + 1} clusters",
        "measured with": _listed(settings["versions"]),
        "measured on": mapped.atlas.provenance["date"],
    }
    return [(name, words) for name, words in rows.items() if words]


def _listed(values: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in values.items())
