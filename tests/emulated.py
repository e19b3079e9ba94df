"""An emulator whose law is known: five sums of the parameters, in noise, and nothing of the sixth."""

import numpy as np

from curvafit.geometry.description import BLOCKS
from curvafit.inference.emulator import Emulator, Layer
from curvafit.inference.table import USUAL, Compression
from curvafit.scan.measures import Reading

LOW, HIGH = np.array([-4, -2.7, -200, -200, -3000, -0.75]), np.array([4, 2.7, 200, 200, 3000, -0.15])
BOX = np.stack([LOW, HIGH], 1)
COLUMNS = sum(BLOCKS.values())
#: Deviation of the five components, and the direction of the parameters that none tells.
NOISE, HIDDEN = 0.1, np.array([1.0, 0, 0, 0, -1.0, 0]) / np.sqrt(2)
#: The first five columns as they come: no scale, no mixing.
PLAIN = Compression(np.zeros(COLUMNS), np.ones(COLUMNS), np.eye(COLUMNS)[:5])


def told(parameters: np.ndarray) -> np.ndarray:
    """Five sums of the parameters, none of which holds the difference of a11 and a00."""
    scaled = (parameters - BOX.mean(1)) / ((HIGH - LOW) / np.sqrt(12))
    return np.stack([scaled[:, [0, 4]].sum(1) / np.sqrt(2), *scaled[:, [1, 2, 3, 5]].T], 1)


def linear() -> Emulator:
    """An emulator that is what `told` says, by two networks whose mean it is, in noise of `NOISE`."""
    slope = np.zeros((5, 8))
    slope[0, [0, 4]] = 1 / np.sqrt(2)
    slope[[1, 2, 3, 4], [1, 2, 3, 5]] = 1
    mean = (Layer(np.stack([slope + 0.3, slope - 0.3]), np.zeros((2, 5))),)
    return Emulator(
        PLAIN, ("mask",), BOX, mean, (Layer(np.zeros((1, 5, 8)), np.full((1, 5), np.log(NOISE))),), np.eye(5), 1.0
    )


def row(parameters: np.ndarray) -> np.ndarray:
    descriptors = np.ones((len(parameters), COLUMNS))
    descriptors[:, :5] = told(parameters)
    return descriptors


def seen(rows: np.ndarray, view: str = "mask") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of descriptors, all of one view and of as much as is usually seen."""
    return rows, np.array([view] * len(rows)), np.full(len(rows), USUAL)


def reading(values: np.ndarray) -> Reading:
    """A row of descriptors as what is read of a mask."""
    return Reading(values[None], "mask", USUAL)
