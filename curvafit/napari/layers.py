"""A napari layer as a volume, and a volume as a layer: values, voxel edges and their unit."""

from __future__ import annotations

from typing import Any

import numpy as np

from curvafit.core.units import convert_length, is_unit, parse_unit
from curvafit.volumes.volume import ScanError, Volume

#: Our unit -> napari's.
_UNITS = {"voxel": "pixel", "nm": "nanometer", "um": "micrometer", "mm": "millimeter", "m": "meter"}


def field_of_layer(layer: Any, kind: str = "a layer") -> Volume:
    """Return the values of a layer, of its finest level, with its scale and unit; else ScanError, which names the kind.

    The layer has three axes, besides any of length one before them, and no colours. A turned or sheared layer is read
    on its own axes.
    """
    if layer is None:
        raise ScanError(f"expected {kind}, got none: add one")
    if getattr(layer, "rgb", False):
        raise ScanError(f"expected grey levels or labels, got colours in the layer {layer.name}")
    data = layer.data[0] if layer.multiscale else layer.data
    if len(data.shape) < 3 or any(n != 1 for n in data.shape[:-3]):
        raise ScanError(f"expected a layer of three axes, got {layer.name} of shape {tuple(data.shape)}")
    values = np.asarray(data).reshape(data.shape[-3:])
    if faults := np.count_nonzero(~np.isfinite(values)):
        raise ScanError(f"expected finite values in the layer {layer.name}, got {faults} that are not")
    spacing, unit = _lengths(layer)
    return Volume(values, spacing, unit, source=layer.name)


def _lengths(layer: Any) -> tuple[tuple[float, float, float], str]:
    """Return voxel edges (z, y, x) and their unit, that of the last axis."""
    names = [str(each) for each in layer.units[-3:]]
    if wrong := next((name for name in names if not is_unit(name)), None):
        raise ScanError(f"expected lengths along the axes of {layer.name}, got the unit {wrong}")
    found = [parse_unit(name)[0] for name in names]
    if 0 < found.count("voxel") < 3:
        raise ScanError(f"expected one kind of unit along the axes of {layer.name}, got pixels and lengths")
    pairs = zip(layer.scale[-3:], names, strict=True)
    z, y, x = (convert_length(abs(float(length)), own, found[-1]) for length, own in pairs)
    return (z, y, x), found[-1]


def place_of_layer(layer: Any) -> dict[str, Any]:
    """Return options of a new layer that lies, with its three last axes, where a layer does."""
    return {
        "scale": layer.scale[-3:],
        "translate": layer.translate[-3:],
        "rotate": layer.rotate[-3:, -3:],
        "shear": layer.shear if len(layer.scale) == 3 else None,
        "units": layer.units[-3:],
    }


def place_of_field(field: Volume) -> dict[str, Any]:
    """Return options of a layer for a field."""
    return {"scale": field.spacing, "units": (_UNITS[field.unit],) * 3}


def list_layers(viewer: Any, *kinds: str) -> list[tuple[str, Any]]:
    """Return the layers of kinds such as `"Image"`, by name, without the images that the plugin added."""
    found = [each for each in viewer.layers if type(each).__name__ in kinds]
    return [(each.name, each) for each in found if type(each).__name__ != "Image" or "curvafit" not in each.metadata]


def put_layer(viewer: Any, kind: str, data: Any, name: str, **options: Any) -> Any:
    """Add a layer of a kind, such as `"labels"`, in the place of one of its name that the plugin added."""
    drop_layer(viewer, name)
    return getattr(viewer, f"add_{kind}")(data, name=name, metadata={"curvafit": name}, **options)


def drop_layer(viewer: Any, name: str) -> None:
    """Remove the layer of a name that the plugin added, if it is there."""
    for old in list(viewer.layers):
        if old.metadata.get("curvafit") == name:
            viewer.layers.remove(old)
