"""Messages on one line, in signs that show."""

from __future__ import annotations


def one_line(text: str) -> str:
    """Return a text on one line; signs that do not show, such as a line break in a name, are escaped."""
    return "".join(_visible(sign) for sign in text)


def _visible(sign: str) -> str:
    if sign.isprintable():
        return sign
    spaces = {"\u00a0": " ", "\u202f": " "}
    return spaces.get(sign) or sign.encode("unicode_escape").decode()
