"""The progress of long work."""

from __future__ import annotations

from collections.abc import Callable

#: Called with a sentence on the present step, and with the share of the work that is done, from 0 to 1.
Progress = Callable[[str, float], None]


def silent(text: str, share: float) -> None:
    """Say nothing: the default progress."""


def part(progress: Progress, start: float, stop: float) -> Progress:
    """Return the progress of a part of the work, from one share of the whole to another."""
    return lambda text, share: progress(text, start + (stop - start) * share)
