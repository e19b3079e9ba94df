"""A law, however it is stated: six coefficients, and what is known beside them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from typing import Protocol, runtime_checkable

from torch import Tensor

from curvafit.priors.bounds import quoted
from curvafit.priors.coefficients import PRESETS, Coefficients, Preset
from curvafit.priors.fit_file import Prior, read_fit
from curvafit.priors.grid import WORKING_SPACING


@runtime_checkable
class Inferred(Protocol):
    """A result that holds a prior: an inference, or its `Fit`."""

    def to_prior(self) -> Prior:
        """Return the coefficients and the mass, and what ties these to the scan."""
        ...


#: What states a law: coefficients, a preset or its name, the path of a `fit.json`, or what was read from one.
Law = Coefficients | Preset | str | PathLike[str] | Prior | Inferred
_STATED = (Coefficients, Preset, str, PathLike, Prior, Inferred)


@dataclass(frozen=True)
class Texture:
    """What a law says.

    Attributes
    ----------
    coefficients
        In working units; bare `Coefficients` are in the unit of the grid or scan that they are used with.
    mass
        m₀ of a preset or a fit, None for bare coefficients.
    origin
        Where the law comes from, in a few words: `preset tubes`, `prior bone/fit.json`, `coefficients`.
    working
        Whether the coefficients are in working units.
    prior
        What a `fit.json` says beside them; None for other laws.
    """

    coefficients: Coefficients
    mass: float | None
    origin: str
    working: bool = True
    prior: Prior | None = None

    @property
    def epsilon(self) -> float | None:
        """ε of the fit in `unit`, None where the law is no fit."""
        return None if self.prior is None else self.prior.epsilon

    @property
    def unit(self) -> str | None:
        """The unit of a fit's lengths, None where the law is no fit."""
        return None if self.prior is None else self.prior.unit

    @property
    def point(self) -> tuple[float, ...]:
        """The six coefficients and the mass: seven numbers.

        Raises
        ------
        ValueError
            If the law has no mass, or its coefficients vary in space.
        """
        if self.mass is None:
            raise ValueError(f"expected a preset or a fit, which have a mass, got {self.origin}")
        return (*map(float, self._numbers()), float(self.mass))  # type: ignore[arg-type]

    def in_unit(self, unit: str | None, edge: float) -> Coefficients:
        """Return the coefficients with lengths in the unit of a scan or a training patch.

        A fit is converted to `unit`, or stays in its own where none is named. A preset takes a voxel's edge for its
        working voxel. Bare coefficients stay as they are.

        Parameters
        ----------
        unit
            nm, um, mm or m.
        edge
            The smallest edge of a voxel, in `unit`.

        Raises
        ------
        ValueError
            If the coefficients vary in space, or the two units cannot be compared.
        """
        numbers = self._numbers()
        if self.prior is not None:
            return self.prior.in_unit(unit)
        return numbers.in_unit(WORKING_SPACING / edge) if self.working else numbers

    def _numbers(self) -> Coefficients:
        if any(isinstance(value, Tensor) and value.dim() > 0 for value in self.coefficients):
            raise ValueError("expected coefficients that are numbers, got some that vary")
        return self.coefficients


def texture_of(law: Law) -> Texture:
    """Return what a law says: the one reading of every argument and option that takes a law.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no preset of that name, no such file, the file is no `fit.json` (`read_fit`), or the value is none
        of what states a law.
    """
    if isinstance(law, Coefficients):
        return Texture(law, None, "coefficients", working=False)
    if isinstance(law, Preset):
        return Texture(law.coefficients, law.mass, f"preset of {law.source}")
    if isinstance(law, str) and law in PRESETS:
        return Texture(PRESETS[law].coefficients, PRESETS[law].mass, f"preset {law}")
    if isinstance(law, str) and not (law.endswith(".json") or os.path.isfile(law)):
        raise ValueError(f"expected a preset among {', '.join(PRESETS)}, or a fit.json, got {quoted(law)}")
    if isinstance(law, (str, PathLike)):
        return _fitted(read_fit(law), f"prior {os.fspath(law)}")
    if isinstance(law, Prior):
        return _fitted(law, "prior")
    if isinstance(law, Inferred):
        return _fitted(law.to_prior(), "prior")
    known = "Coefficients, a preset or its name, a fit.json or a fit"
    raise ValueError(f"expected a law ({known}), got {quoted(law)}")


def textures_of(laws: Law | Iterable[Law]) -> tuple[Texture, ...]:
    """Return what one law says, or each of several.

    Raises
    ------
    FileNotFoundError, ValueError
        As `texture_of`.
    """
    one = isinstance(laws, _STATED) or not isinstance(laws, Iterable)
    return (texture_of(laws),) if one else tuple(map(texture_of, laws))  # type: ignore[arg-type]


def _fitted(prior: Prior, origin: str) -> Texture:
    return Texture(prior.coefficients, prior.mass, origin, prior=prior)
