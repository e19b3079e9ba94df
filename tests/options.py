"""Options of `segment` and `reconstruct` as tests list them."""

from dataclasses import fields
from typing import Any

from curvafit.segmentation.flow import Working

NAMES = [field.name for field in fields(Working)]


def grouped(**options: Any) -> dict[str, Any]:
    """The same options, those of `Working` in one."""
    rest = {name: value for name, value in options.items() if name not in NAMES}
    return {**rest, "working": Working(**{name: options[name] for name in NAMES if name in options})}
