"""What files hold, read without the package; and what the package refuses to read."""

import os
from pathlib import Path

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
