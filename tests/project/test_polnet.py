"""PolNet's generator in place of its own: by a stand-in for the three modules of PolNet that it builds on."""

from __future__ import annotations

import importlib.util
import random
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest

from curvafit.generation import generate
from curvafit.priors import Coefficients, Grid
from curvafit.priors.law import preset

FILE = Path(__file__).resolve().parents[2] / "integrations/polnet/curvafit_membranes.py"


class Error(Exception):
    pass


class Generator:
    """What PolNet's class does with parameters: it keeps those of a file."""

    @classmethod
    def from_params(cls, params: dict) -> Any:
        made = cls()
        defaults = {"EPS": 0.15, "DELTA_X": 0.03, "M0": -0.5, "MODE": "periodic", "SIGMA_BLUR": 1.0}
        for key, value in defaults.items():
            attribute = f"_{key}" if key == "M0" else f"_{key.lower()}"
            setattr(made, attribute, params.get(f"CT_{key}", value))
        for key in ("a20", "a11", "a02", "b10", "b01", "c"):
            setattr(made, f"_{key}", params.get(f"CT_{key.upper()}", 0.0))
        return made


class Factory:
    kinds: ClassVar[dict[str, Any]] = {}

    @classmethod
    def register(cls, name: str) -> Any:
        def keep(kind: Any) -> Any:
            cls.kinds[name] = kind
            return kind

        return keep


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The generator that PolNet's factory has under the name `curvatubes`."""
    Factory.register("curvatubes")(Generator)  # as PolNet's module does when it is imported
    for name, content in {
        "polnet": {}, "polnet.sample": {}, "polnet.sample.membranes": {},
        "polnet.sample.membranes.mb": {"MbError": Error},
        "polnet.sample.membranes.mb_curvatubes": {"CurvatubesGen": Generator},
        "polnet.sample.membranes.mb_factory": {"MbFactory": Factory},
    }.items():  # fmt: skip
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("curvafit_membranes", FILE)
    assert spec is not None and spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    assert Factory.kinds["curvatubes"] is not Generator
    return Factory.kinds["curvatubes"]


@pytest.mark.slow
def test_polnet_s_units_are_only_units(made: Any) -> None:
    law, s = preset("tubes"), 8  # lengths in the file are longer by s, a power of two: nothing is rounded
    numbers = dict(zip(("CT_A20", "CT_A11", "CT_A02", "CT_B10", "CT_B01", "CT_C"), law.coefficients, strict=True))
    numbers |= {"CT_B10": numbers["CT_B10"] / s, "CT_B01": numbers["CT_B01"] / s, "CT_C": numbers["CT_C"] / s**2}
    numbers |= {"CT_SIGMA_BLUR": 2.0, "CT_EPS": 0.02 * s, "CT_DELTA_X": 0.01 * s, "CT_M0": law.mass}
    random.seed(5)
    field = made.from_params(numbers)._run_curvatubes((24, 32, 28))
    random.seed(5)
    same = generate(Coefficients(*law.coefficients), law.mass, Grid((24, 32, 28)), seed=random.getrandbits(31))
    assert field.dtype == np.float32
    np.testing.assert_array_equal(field, same.field.numpy())


@pytest.mark.slow
def test_a_flow_that_makes_no_shape_is_polnet_s_error(made: Any) -> None:
    nothing = {"CT_A20": 1.0, "CT_A02": 1.0, "CT_M0": -0.999, "CT_MODE": "replicate"}
    with pytest.raises(Error, match="no shape"):
        made.from_params(nothing)._run_curvatubes((16, 16, 16))
