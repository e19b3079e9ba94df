"""What the machine has."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def memory() -> int:
    """Bytes of memory that this machine has, or a container may use; `sys.maxsize` where neither is known."""
    return min(_installed(), _allowed())


def _installed() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return sys.maxsize


def _allowed() -> int:
    """What a container may use."""
    try:
        return int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return sys.maxsize
