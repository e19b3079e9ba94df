"""What a result shows of itself: one line, a figure, and a small picture in a notebook."""

from __future__ import annotations

import dataclasses
import importlib
import re

import pytest
import torch
from matplotlib.figure import Figure

import curvafit
from curvafit.core.pictures import Pictured
from curvafit.generation import Schedule, generate

BRIEF = Schedule("brief", 60, 1e-2, 1e-3, "constant")


@pytest.fixture(scope="module")
def flow():
    return generate("tubes", grid=16, schedule=BRIEF)


def test_every_type_with_a_picture_has_a_function_that_draws_it() -> None:
    for name, place in curvafit._FIGURES.items():
        module, _, function = place.partition(":")
        assert callable(getattr(importlib.import_module(module), function))
        assert issubclass(getattr(curvafit, name), Pictured)
    kinds = (getattr(curvafit, name) for name in curvafit.__all__)
    pictured = {kind.__name__ for kind in kinds if isinstance(kind, type) and issubclass(kind, Pictured)}
    assert pictured == set(curvafit._FIGURES)


def test_a_flow_is_one_line(flow) -> None:
    text = repr(flow)
    assert "\n" not in text and len(text) < 300
    assert "16 x 16 x 16 voxels of 0.01" in text and flow.status in text and "viable" in text


def test_a_picture_of_a_shape_and_none_of_what_is_not_finite(flow) -> None:
    ball = 5 - (torch.stack(torch.meshgrid(*[torch.arange(16.0) - 8] * 3, indexing="ij")) ** 2).sum(0).sqrt()
    assert isinstance(dataclasses.replace(flow, field=ball).plot(width=64), Figure)
    shown = dataclasses.replace(flow, field=ball)._repr_html_()
    assert re.search(r'<img src="data:image/png;base64,[\w+/=]{100,}" width="320"', shown)
    broken = dataclasses.replace(flow, field=torch.full((16, 16, 16), torch.nan))
    with pytest.raises(ValueError, match="finite"):
        broken.plot()
    assert "<img" not in broken._repr_html_() and "16 x 16 x 16" in broken._repr_html_()
