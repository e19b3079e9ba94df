"""The machine's memory."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def memory() -> int:
    """Return the bytes of memory of this machine, or of its container; `sys.maxsize` where neither is known."""
    return min(_installed(), _allowed())


def _installed() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return sys.maxsize


def _allowed() -> int:
    """Return the bytes that a container may use."""
    try:
        return int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return sys.maxsize
