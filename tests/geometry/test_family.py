"""Families are named by where a diagram's mass lies, whatever the unit of length."""

from __future__ import annotations

import numpy as np
import pytest

from curvafit.geometry.diagram import Diagram, family_of, family_shares, half_thickness

RADIUS = 0.04


def at(*points: tuple[float, float]) -> Diagram:
    return Diagram(np.array(points) / RADIUS, np.ones(len(points)))


@pytest.mark.parametrize(
    ("point", "name"),
    [
        ((1.0, 1.0), "spheres"),
        ((1.0, 0.1), "tubes"),
        ((1.0, -0.9), "sponge"),
        ((0.05, -0.05), "layers"),
        ((0.1, -1.0), "tubular cavities"),
        ((-1.0, -1.1), "bubbles"),
    ],
)
def test_ideal_shapes_are_named(point: tuple[float, float], name: str) -> None:
    assert family_of(at(point), RADIUS) == name
    grown = Diagram(at(point).points / 7, np.ones(1))
    assert family_of(grown, 7 * RADIUS) == name


def test_shares_are_a_partition_of_the_area() -> None:
    rng = np.random.default_rng(0)
    points = np.sort(rng.normal(size=(200, 2)), axis=1)[:, ::-1] / RADIUS
    shares = family_shares(Diagram(points, rng.uniform(size=200)), RADIUS)
    assert sum(shares.values()) == pytest.approx(1)
    assert all(share >= 0 for share in shares.values())


def test_a_flat_half_makes_layers() -> None:
    assert family_of(at((1, 0), (0.01, 0), (0.01, 0)), RADIUS) == "layers"
    assert family_of(at((1, 0), (1, 0), (0.01, 0)), RADIUS) == "tubes"


@pytest.mark.parametrize(
    ("point", "area", "volume"),
    [
        ((0.0, 0.0), 2.0, 2 * RADIUS),
        ((1 / RADIUS, 0.0), 2 * np.pi * RADIUS, np.pi * RADIUS**2),
        ((1 / RADIUS, 1 / RADIUS), 4 * np.pi * RADIUS**2, 4 / 3 * np.pi * RADIUS**3),
        ((1 / RADIUS, -1 / RADIUS), 1.0, 2 / 3 * RADIUS),
    ],
)
def test_volume_and_curvatures_tell_how_thick_plates_cylinders_and_balls_are(
    point: tuple[float, float], area: float, volume: float
) -> None:
    several = 3.0
    measured = Diagram(np.array([point]), np.array([several * area]))
    assert half_thickness(measured, several * volume) == pytest.approx(RADIUS, rel=0.02)


def test_a_thick_shell_is_as_thick_as_its_wall() -> None:
    outer, inner = 0.11, 0.05
    areas = 4 * np.pi * np.array([outer, inner]) ** 2
    shell = Diagram(np.array([[1 / outer] * 2, [-1 / inner] * 2]), areas)
    thickness = half_thickness(shell, 4 / 3 * np.pi * (outer**3 - inner**3))
    assert thickness == pytest.approx((outer - inner) / 2, rel=0.02)
