"""A law of shapes, six coefficients and a mass with their units; and all the ways to state one."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Annotated, Literal, Protocol, TypeVar, runtime_checkable

from torch import Tensor

from curvafit.core.checks import quoted, simplify_name
from curvafit.core.records import parse_json
from curvafit.core.schema import Rule, decode
from curvafit.core.units import METRES
from curvafit.priors.coefficients import NAMES, Coefficients
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING
from curvafit.priors.published import PUBLISHED, no_law

Content = TypeVar("Content")
#: The format of a `fit.json`.
FORMAT = "curvafit-fit-5"


@dataclass(frozen=True)
class Law:
    """A law that shapes of one texture are grown by: coefficients and mass, their units, and their ε.

    Attributes
    ----------
    coefficients
        In working units where `working` is True; else in the unit of the grid or scan that uses them.
    mass
        m₀, the mean of u; None where the law states none.
    origin
        Where the law comes from, in a few words: `preset tubes`, `prior bone/fit.json`, `coefficients`.
    working
        Whether the coefficients are in working units.
    epsilon
        The ε that the coefficients are meant for, in their own unit.
    working_voxel, length_unit
        Of a fit: the edge of a working voxel and its unit, which make the law's lengths physical. Else None.
    volume_fraction
        Share of a fit's scan inside the structure; None where it is unknown.
    source
        The publication of a preset.
    status
        A fit's verdict on the law.
    """

    coefficients: Coefficients
    mass: float | None = None
    origin: str = field(default="coefficients", compare=False)
    working: bool = True
    epsilon: float = WORKING_EPSILON
    working_voxel: float | None = None
    length_unit: str | None = None
    volume_fraction: float | None = None
    source: str = field(default="", compare=False)
    status: str = field(default="", compare=False)

    @classmethod
    def of(cls, law: LawLike) -> Law:
        """Convert any statement of a law to a `Law`; every argument and option that takes a law is converted here.

        Parameters
        ----------
        law
            A `Law`, `Coefficients` or their numbers (six, a20 first, or by name), the name of a preset, the path of a
            `fit.json`, or a fit or an inference.

        Raises FileNotFoundError or ValueError where the value, or the file, states no law.
        """
        if isinstance(law, Law):
            return law
        if isinstance(law, Coefficients):
            return cls(law, working=False)
        if (name := preset_name(law)) is not None:
            return PRESETS[name]
        if isinstance(law, str) and not (law.endswith(".json") or os.path.isfile(law)):
            raise no_law(law)
        if isinstance(law, (str, PathLike)):
            return cls.load(law)
        if isinstance(law, HasLaw):
            return law.to_law()
        if (coefficients := _read_numbers(law)) is not None:
            return cls(coefficients, working=False)
        kinds = "Coefficients, their six numbers, a preset or its name, a fit.json or a fit"
        raise ValueError(f"expected a law ({kinds}), got {quoted(law)}")

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Law:
        """Read the law in a `fit.json`, whatever else the file holds.

        Raises FileNotFoundError where there is no file; ValueError where it is of another format or has no law.
        """
        file = read_fit(path, _LawFile)
        if file.coefficients is None or file.mass is None or file.coefficients_physical is None:
            raise ValueError(f"expected a fit with a law, got one without in {path}: {file.status}")
        epsilon = file.epsilon_physical * WORKING_SPACING / file.working_voxel
        volume_fraction = None if file.morphometry is None else file.morphometry.volume_fraction
        return cls(
            file.coefficients, file.mass, f"prior {os.fspath(path)}", epsilon=epsilon, working_voxel=file.working_voxel,
            length_unit=file.length_unit, volume_fraction=volume_fraction, status=file.status,
        )  # fmt: skip

    @property
    def doubt(self) -> str:
        """A warning where the fit's status is not `Supported`, with that status; else empty."""
        if not self.status or self.status.startswith("Supported"):
            return ""
        return f"The law ({self.origin}) may not be that of its scan: its fit is not `Supported`. {self.status}"

    @property
    def fitted(self) -> bool:
        """Whether the law was inferred from a scan, so that its lengths are physical too."""
        return self.working_voxel is not None

    @property
    def schedule(self) -> str:
        """The name in `generation.SCHEDULES` by which shapes of this law grow: a fit was read from shapes of `deep`."""
        return "deep" if self.fitted else "fast"

    @property
    def physical(self) -> Coefficients:
        """A fit's coefficients with lengths in `length_unit`: quadratic part unchanged, linear / λ, constant / λ²."""
        return self.coefficients.in_unit(1 / self._length)

    @property
    def epsilon_physical(self) -> float:
        """A fit's ε in `length_unit`."""
        return self.epsilon * self._length

    @property
    def point(self) -> tuple[float, ...]:
        """The six coefficients and the mass, as seven numbers; ValueError where they vary in space or lack a mass."""
        if self.mass is None:
            raise ValueError(f"expected a preset or a fit, which have a mass, got {self.origin}")
        return (*map(float, self._require_numbers()), float(self.mass))  # type: ignore[arg-type]

    def in_unit(self, unit: str | None, edge: float | None = None) -> Coefficients:
        """Return the coefficients with lengths in the unit of a scan or a training patch.

        A fit is converted to `unit` (nm, um, mm or m), or stays in its own where `unit` is None. A preset's working
        voxel gets the length `edge`, the smallest edge of a voxel in `unit`. Coefficients that are not in working units
        stay as they are.

        Raises ValueError where the coefficients vary in space, or the two units cannot be compared.
        """
        coefficients = self._require_numbers()
        if not self.fitted:
            return coefficients.in_unit(WORKING_SPACING / edge) if self.working and edge is not None else coefficients
        if unit is None or unit == self.length_unit:
            return self.physical
        if unit not in METRES or self.length_unit not in METRES:
            remedy = ": run `curvafit infer` again with --spacing and --unit" if self.length_unit not in METRES else ""
            units = f"{unit} and the fit's {self.length_unit}"
            raise ValueError(f"expected two units among {', '.join(METRES)}, got {units}{remedy}")
        return self.physical.in_unit(METRES[unit] / METRES[self.length_unit])

    @property
    def _length(self) -> float:
        """λ: a working length of 1 in `length_unit`; ValueError where the law is no fit."""
        if self.working_voxel is None:
            raise ValueError(f"expected a fit, whose lengths are physical, got {self.origin}")
        return self.working_voxel / WORKING_SPACING

    def _require_numbers(self) -> Coefficients:
        """Return the coefficients; raise ValueError where they vary in space."""
        if any(isinstance(value, Tensor) and value.dim() > 0 for value in self.coefficients):
            raise ValueError("expected coefficients that are numbers, got coefficients that vary in space")
        return self.coefficients


@runtime_checkable
class HasLaw(Protocol):
    """A result that holds a law: a fit, or the inference that made it."""

    def to_law(self) -> Law:
        """Return the law."""
        ...


#: All that states a law: see `Law.of`.
LawLike = Law | Coefficients | str | PathLike[str] | HasLaw
#: The same as types, for `isinstance`.
LAW_TYPES = (Law, Coefficients, str, PathLike, HasLaw)


def read_laws(laws: LawLike | Iterable[LawLike]) -> tuple[Law, ...]:
    """Return one law or several, each stated as in `Law.of`, as a tuple."""
    single = isinstance(laws, LAW_TYPES) or not isinstance(laws, Iterable) or _read_numbers(laws) is not None
    return (Law.of(laws),) if single else tuple(map(Law.of, laws))  # type: ignore[arg-type]


def _read_numbers(law: object) -> Coefficients | None:
    """Return coefficients that are stated by name, or as six numbers; None where they are not."""
    if isinstance(law, Mapping) and {*NAMES[:3]} <= {*law} <= {*NAMES}:
        return Coefficients(**law)
    if isinstance(law, (tuple, list)) and len(law) == 6 and all(isinstance(a, Real) for a in law):
        return Coefficients(*law)
    return None


# ---- fit.json --------------------------------------------------------------------------------------------------------

Positive = Annotated[float, Rule(above=0)]
Mass = Annotated[float | None, Rule(above=-1, below=1)]


@dataclass(frozen=True)
class _Filling:
    """What a law needs of a `fit.json`'s morphometry."""

    volume_fraction: Annotated[float | None, Rule(least=0, most=1)] = None


@dataclass(frozen=True)
class _LawFile:
    """The fields of a `fit.json` that a law needs; `inference.fit` reads the others."""

    coefficients: Coefficients | None
    mass: Mass
    coefficients_physical: Coefficients | None
    epsilon_physical: Positive
    working_voxel: Positive
    length_unit: Literal["voxel", *METRES]  # type: ignore[valid-type]
    status: str = ""
    morphometry: _Filling | None = None


def read_fit(path: str | PathLike[str], kind: type[Content]) -> Content:
    """Read a `fit.json` as a dataclass; raise FileNotFoundError if there is none, ValueError as `parse_fit` does."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"expected a fit.json, found no file {path}")
    return parse_fit(Path(path).read_bytes(), path, kind)


def parse_fit(text: str | bytes, place: object, kind: type[Content]) -> Content:
    """Parse a `fit.json`'s text as the dataclass `kind`, whose fields are the keys that are read.

    Raises ValueError, which calls the file `place`, if the text is of another format or lacks a key.
    """
    expected = "a fit.json written by `curvafit infer`"
    content = parse_json(text, expected, place)
    version = content.get("format", FORMAT) if isinstance(content, dict) else FORMAT
    if version != FORMAT:
        got = f"got {quoted(version)} in {place}: run `curvafit infer` again"
        raise ValueError(f"expected a fit.json of format {FORMAT}, {got}")
    try:
        return decode(kind, content)
    except ValueError as error:
        fault = str(error).removeprefix("expected ")  # of a dataclass that checks itself
        raise ValueError(f"expected {expected} with {fault} in {place}") from None


# ---- presets ---------------------------------------------------------------------------------------------------------

#: The published laws by name, in working units.
PRESETS: dict[str, Law] = {
    name: Law(Coefficients(*values), mass, f"preset {name}", source=source)
    for name, (values, mass, source) in PUBLISHED.items()
}


def preset(name: str) -> Law:
    """Return the law of a published shape.

    Capitals do not matter, and spaces, underscores and hyphens are alike: `Bilinear_Tubes` is `bilinear-tubes`. Raises
    ValueError where the name is not in `PRESETS`.
    """
    if (key := preset_name(name)) is None:
        raise ValueError(f"expected a preset among {', '.join(PRESETS)}, got {quoted(name)}")
    return PRESETS[key]


def preset_name(name: object) -> str | None:
    """Return the name in `PRESETS` that a text means (see `preset`), or None."""
    key = simplify_name(name) if isinstance(name, str) else None
    return key if key in PRESETS else None
