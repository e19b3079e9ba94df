"""What long work says as it goes."""

from __future__ import annotations

from collections.abc import Callable

#: Called with a sentence on what is done now, and with the share of the work that is done, from 0 to 1.
Progress = Callable[[str, float], None]


def silent(text: str, share: float) -> None:
    """Say nothing: the progress of a call that was given none."""
