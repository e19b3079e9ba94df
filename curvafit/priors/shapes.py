"""Array shapes in signatures: jaxtyping's where it is installed, inert names in a bare training environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
else:
    try:
        from jaxtyping import Bool, Float
    except ImportError:

        class Float:
            def __class_getitem__(cls, item: Any) -> Any:
                return item[0]

        Bool = Float

__all__ = ["Bool", "Float"]
