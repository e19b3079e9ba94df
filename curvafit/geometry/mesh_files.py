"""Surfaces on disk: binary STL, PLY and VTP (VTK's XML), in (x, y, z) order and the surface's unit."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from curvafit.core.files import write_content
from curvafit.geometry.mesh import Surface, area_vectors

#: Suffixes that `write_surface` knows.
SUFFIXES = (".stl", ".ply", ".vtp")

Data = Mapping[str, np.ndarray]


def write_surface(mesh: Surface, path: str | Path, *, unit: str = "voxel", data: Data | None = None) -> Path:
    """Write a binary STL, PLY or VTP file by suffix; whole or not at all.

    Parameters
    ----------
    unit
        Of the lengths: a remark in the file, none of the formats has a field for it.
    data
        Numbers `(V,)` at the vertices by name, for PLY and VTP; STL cannot hold them.

    Raises
    ------
    ValueError
        If the suffix is another, or there is not one number a vertex.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"expected a surface file ending in one of {', '.join(SUFFIXES)}, got {path.name!r}")
    for name, values in (data or {}).items():
        if np.shape(values) != (len(mesh.vertices),):
            raise ValueError(f"expected {name} of shape ({len(mesh.vertices)},), got {np.shape(values)}")
    remark = f"curvafit surface, lengths in {unit}"
    content = _stl(mesh, remark) if suffix == ".stl" else (_ply if suffix == ".ply" else _vtp)(mesh, remark, data or {})
    return write_content(path, content)


def _stl(mesh: Surface, remark: str) -> bytes:
    vectors = area_vectors(mesh)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles = np.zeros(len(mesh.faces), dtype=record)
    triangles["normal"] = vectors / np.where(lengths > 0, lengths, 1)
    triangles["corners"] = mesh.vertices[mesh.faces][:, :, ::-1]
    return remark.encode().ljust(80) + np.uint32(len(triangles)).astype("<u4").tobytes() + triangles.tobytes()


def _ply(mesh: Surface, remark: str, data: Data) -> bytes:
    properties = {**dict(zip("zyx", mesh.vertices.T, strict=True)), **data}
    names = ["x", "y", "z", *data]
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {remark}\nelement vertex {len(mesh.vertices)}\n"
        + "".join(f"property float {name}\n" for name in names)
        + f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.zeros(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    vertices = np.stack([properties[name] for name in names], axis=1).astype("<f4")
    return header.encode() + vertices.tobytes() + faces.tobytes()


def _vtp(mesh: Surface, remark: str, data: Data) -> bytes:
    """Return XML PolyData; every array inline, base64 of its length in bytes and its numbers."""
    count, ends = len(mesh.vertices), np.arange(3, 3 * len(mesh.faces) + 1, 3)
    lines = (
        '<?xml version="1.0"?>',
        f"<!-- {remark} -->",
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        "<PolyData>",
        f'<Piece NumberOfPoints="{count}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" '
        f'NumberOfPolys="{len(mesh.faces)}">',
        *("<PointData>", *(_vtk_array(name, values, "f4") for name, values in data.items()), "</PointData>"),
        *("<Points>", _vtk_array("Points", mesh.vertices[:, ::-1], "f4", 3), "</Points>"),
        *("<Polys>", _vtk_array("connectivity", mesh.faces, "i8"), _vtk_array("offsets", ends, "i8"), "</Polys>"),
        *("</Piece>", "</PolyData>", "</VTKFile>", ""),
    )
    return "\n".join(lines).encode()


def _vtk_array(name: str, values: np.ndarray, kind: str, components: int = 1) -> str:
    content = np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()
    text = base64.b64encode(np.uint64(len(content)).astype("<u8").tobytes() + content).decode()
    what = {"f4": "Float32", "i8": "Int64"}[kind]
    return (
        f'<DataArray type="{what}" Name="{name}" NumberOfComponents="{components}" format="binary">{text}</DataArray>'
    )
