"""How far out a scan's descriptors lie among those of shapes that the model makes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

#: A scan made by the model lies as far out as this with probability 0.01: beyond, no twin is believable.
UNBELIEVABLE = 0.01


@dataclass(frozen=True)
class Misfit:
    """Part of shapes of the model that lie as far out as the scan does: in all descriptors together
    (`probability`), and by block of descriptors (`blocks`). `method` says against what."""

    probability: float
    blocks: dict[str, float]
    method: str

    @property
    def strangest(self) -> tuple[str, ...]:
        """Return the blocks that are unbelievable by themselves, the strangest first."""
        order = sorted(self.blocks, key=self.blocks.__getitem__)
        return tuple(name for name in order if self.blocks[name] < UNBELIEVABLE)

    def as_dict(self) -> dict[str, Any]:
        """Return the misfit in JSON's types."""
        return asdict(self)

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Misfit:
        """Return what `as_dict` wrote."""
        blocks = {str(name): float(value) for name, value in content["blocks"].items()}
        return Misfit(float(content["probability"]), blocks, str(content["method"]))
