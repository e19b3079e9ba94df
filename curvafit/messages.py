"""How a message is written: on one line, in signs that show."""

from __future__ import annotations


def one_line(text: str) -> str:
    """Return a text on one line: what a name can bring along and does not show, such as a line break, is escaped."""
    return "".join(_shown(sign) for sign in text)


def _shown(sign: str) -> str:
    if sign.isprintable():
        return sign
    spaces = {"\u00a0": " ", "\u202f": " "}
    return spaces.get(sign) or sign.encode("unicode_escape").decode()
