"""A law in any of its forms, and the texture that it describes: six coefficients, the mass, and the fit's units."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from typing import Protocol, runtime_checkable

from torch import Tensor

from curvafit.core.checks import quoted
from curvafit.priors.coefficients import PRESETS, Coefficients, Preset, preset_name
from curvafit.priors.fit_file import Prior, read_fit
from curvafit.priors.grid import WORKING_SPACING


@runtime_checkable
class Inferred(Protocol):
    """A result that holds a prior: an inference, or its `Fit`."""

    def to_prior(self) -> Prior:
        """Return coefficients and mass, with the lengths that relate them to the scan."""
        ...


#: A law: coefficients, a preset or its name, the path of a `fit.json`, or what `read_fit` returns for one, or a fit.
Law = Coefficients | Preset | str | PathLike[str] | Prior | Inferred
_LAWS = (Coefficients, Preset, str, PathLike, Prior, Inferred)


@dataclass(frozen=True)
class Texture:
    """Coefficients and mass of a law.

    Attributes
    ----------
    coefficients
        In working units, or, where the law is `Coefficients`, in the unit of the grid or scan that uses them.
    mass
        m₀ of a preset or a fit, None for bare coefficients.
    origin
        Where the law comes from, in a few words: `preset tubes`, `prior bone/fit.json`, `coefficients`.
    working
        Whether the coefficients are in working units.
    prior
        The content of a `fit.json`; None for other laws.
    """

    coefficients: Coefficients
    mass: float | None
    origin: str
    working: bool = True
    prior: Prior | None = None

    @property
    def epsilon(self) -> float | None:
        """ε of the fit in `unit`; None where the law is not a fit."""
        return None if self.prior is None else self.prior.epsilon

    @property
    def unit(self) -> str | None:
        """The unit of the fit's lengths; None where the law is not a fit."""
        return None if self.prior is None else self.prior.unit

    @property
    def point(self) -> tuple[float, ...]:
        """The six coefficients and the mass, as seven numbers.

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

        A fit is converted to `unit`, or stays in the fit's unit where `unit` is None. A preset's working voxel is
        taken to be `edge` long. `Coefficients` stay as they are.

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
        """Return the coefficients; raise ValueError where they vary in space."""
        if any(isinstance(value, Tensor) and value.dim() > 0 for value in self.coefficients):
            raise ValueError("expected coefficients that are numbers, got coefficients that vary in space")
        return self.coefficients


def texture_of(law: Law) -> Texture:
    """Return the texture of a law; every argument and option that takes a law is read here.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no preset of that name and no such file, the file is not a `fit.json` (`read_fit`), or the value is
        not a law.
    """
    if isinstance(law, Coefficients):
        return Texture(law, None, "coefficients", working=False)
    if isinstance(law, Preset):
        return Texture(law.coefficients, law.mass, f"preset of {law.source}")
    if (name := preset_name(law)) is not None:
        return Texture(PRESETS[name].coefficients, PRESETS[name].mass, f"preset {name}")
    if isinstance(law, str) and not (law.endswith(".json") or os.path.isfile(law)):
        raise ValueError(f"expected a preset among {', '.join(PRESETS)}, or a fit.json, got {quoted(law)}")
    if isinstance(law, (str, PathLike)):
        return _fitted(read_fit(law), f"prior {os.fspath(law)}")
    if isinstance(law, Prior):
        return _fitted(law, "prior")
    if isinstance(law, Inferred):
        return _fitted(law.to_prior(), "prior")
    raise ValueError(f"expected a law (Coefficients, a preset or its name, a fit.json or a fit), got {quoted(law)}")


def textures_of(laws: Law | Iterable[Law]) -> tuple[Texture, ...]:
    """Return the textures of one law or of several.

    Raises
    ------
    FileNotFoundError, ValueError
        As `texture_of` does.
    """
    single = isinstance(laws, _LAWS) or not isinstance(laws, Iterable)
    return (texture_of(laws),) if single else tuple(map(texture_of, laws))  # type: ignore[arg-type]


def _fitted(prior: Prior, origin: str) -> Texture:
    """Return the texture of a fit."""
    return Texture(prior.coefficients, prior.mass, origin, prior=prior)
