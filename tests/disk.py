"""What files hold, read without the package; and what the package refuses to read."""

import base64
import os
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from curvafit.volumes import ScanError, load


def unreadable(path: Path | str, word: str = "", **options: object) -> None:
    """Refused in one sentence with a key word."""
    with pytest.raises(ScanError, match=rf"^[^\n]*({word})[^\n]*$"):
        load(path, **options)  # type: ignore[arg-type]


def tree(folder: Path) -> dict[str, bytes]:
    """Every file under a folder with its content; a link's is where it leads."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_symlink() or path.is_file())
    return {
        str(path.relative_to(folder)): os.readlink(path).encode() if path.is_symlink() else path.read_bytes()
        for path in files
    }


def vtk_array(node: ElementTree.Element) -> np.ndarray:
    """Inline data as VTK's file formats define it: base64 of a count of bytes, in the header's type, and the bytes."""
    content = base64.b64decode(node.text or "", validate=True)
    (count,) = np.frombuffer(content[:8], "<u8")
    assert count == len(content) - 8
    values = np.frombuffer(content[8:], {"Float32": "<f4", "Int64": "<i8"}[node.attrib["type"]])
    return values.reshape(-1, int(node.attrib["NumberOfComponents"]))
