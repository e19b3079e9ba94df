"""Which parameters to draw: the random law of the paper's Experiment 4, one independent stream a draw."""

from __future__ import annotations

import numpy as np

from curvafit.priors.coefficients import NAMES, Coefficients

#: Name of the law, as stores record it.
LAW = "experiment-4"
#: Open intervals of the uniform law, in working units; a20 = 1 is the gauge (paper, "Experiment 4").
INTERVALS: dict[str, tuple[float, float]] = {
    "a11": (-4.0, 4.0),
    "a02": (1 / 15, 15.0),
    "a10": (-200.0, 200.0),
    "a01": (-200.0, 200.0),
    "a00": (-3000.0, 3000.0),
    "mass": (-0.75, -0.15),
}


def random_law(seed: int, index: int) -> tuple[Coefficients, float]:
    """The parameters (a, m₀) of draw `index`: a20 = 1, the others uniform and independent (paper, Experiment 4).

    Every (seed, index) has its own random stream, so a draw never depends on which others were made before it.

    Parameters
    ----------
    seed, index
        Whole numbers from 0.

    Returns
    -------
    Coefficients in working units (spacing 0.01), and the mass m₀.

    Raises
    ------
    ValueError
        If the seed or the index is not a whole number from 0.
    """
    generator = np.random.default_rng(_stream(seed, index, "parameters"))
    drawn = {name: float(generator.uniform(low, high)) for name, (low, high) in INTERVALS.items()}
    mass = drawn.pop("mass")
    values = {"a20": 1.0} | drawn
    return Coefficients(*(values[name] for name in NAMES)), mass


def start_seed(seed: int, index: int) -> int:
    """The seed of draw `index`'s white noise, a number below 2³²; independent of its parameters.

    Raises
    ------
    ValueError
        If the seed or the index is not a whole number from 0.
    """
    return int(_stream(seed, index, "start").generate_state(1)[0])


def _stream(seed: int, index: int, purpose: str) -> np.random.SeedSequence:
    for name, value in (("seed", seed), ("index", index)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
            raise ValueError(f"expected a {name} that is a whole number from 0, got {value!r}")
    return np.random.SeedSequence(int(seed), spawn_key=(int(index), ("parameters", "start").index(purpose)))
