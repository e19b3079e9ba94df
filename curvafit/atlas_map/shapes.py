"""What a map shows of a shape: a thumbnail, a small volume to turn in the page, the command that grows it again."""

from __future__ import annotations

import io
import math
import zlib
from typing import NamedTuple

import numpy as np
from PIL import Image
from scipy.signal import resample

from curvafit.data_synth.store import Record, Settings
from curvafit.drawing.render import render
from curvafit.generation.flow import WORKING_BLUR
from curvafit.generation.schedule import SCHEDULES, present_name
from curvafit.priors.grid import WORKING_EPSILON

#: Width of a thumbnail in pixels, and the longest edge of a small volume in voxels.
THUMBNAIL, EDGE = 144, 32
#: A small volume holds u, cut off at ± this, in steps 0 to `LEVELS`: fine where the surface is, and it packs well.
CUT, LEVELS = 0.5, 31


class Shown(NamedTuple):
    """A shape's thumbnail (WebP) and small volume (zlib, one byte a voxel, z slowest, of `small_shape`)."""

    thumbnail: bytes
    volume: bytes


def shown(u: np.ndarray) -> Shown:
    """Return the thumbnail and the small volume of a periodic field `(Z, Y, X)`."""
    buffer = io.BytesIO()
    Image.fromarray(render(u, width=THUMBNAIL)[0]).save(buffer, "webp", quality=80, alpha_quality=80)
    return Shown(buffer.getvalue(), zlib.compress(small_volume(u).tobytes(), 9))


def small_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of a small volume: at most `EDGE` voxels an edge, and in proportion."""
    factor = min(1.0, EDGE / max(shape))
    return tuple(max(2, round(n * factor)) for n in shape)


def small_volume(u: np.ndarray) -> np.ndarray:
    """Return a periodic field `(Z, Y, X)` in fewer voxels (its lower frequencies), uint8 from 0 to `LEVELS`."""
    values = np.clip(u, -1, 1).astype(np.float64)
    for axis, count in enumerate(small_shape(u.shape)):
        if count < values.shape[axis]:
            values = np.asarray(resample(values, count, axis=axis))
    steps = (np.clip(values / CUT, -1, 1) + 1) / 2 * LEVELS
    return np.rint(steps).astype(np.uint8)


def regrow_command(record: Record, settings: Settings, name: str) -> str:
    """Return the `curvafit generate` line that makes a draw's field again: with the same versions, processor and number
    of threads (stores are made on one) bit for bit.

    Raises
    ------
    ValueError
        If the draw was made with a blur or a schedule that the command line does not offer.
    """
    options = [f"--coefficients {','.join(map(_plain, record.coefficients))}", f"--mass {_plain(record.mass)}"]
    sizes = settings.shape[:1] if len(set(settings.shape)) == 1 else settings.shape
    options += [f"--shape {','.join(map(str, sizes))}", f"--seed {record.seed}"]
    plan = present_name(settings.schedule)
    if plan not in SCHEDULES or not math.isclose(settings.blur, WORKING_BLUR):
        raise ValueError(f"expected a schedule of {', '.join(SCHEDULES)} and a blur of {WORKING_BLUR}, got others")
    options.append(f"--schedule {plan}")
    if settings.schedule["steps"] != SCHEDULES[plan].steps:
        options.append(f"--steps {settings.schedule['steps']}")
    if not math.isclose(settings.epsilon, WORKING_EPSILON):
        options.append(f"--epsilon {_plain(settings.epsilon)}")
    return f"curvafit generate {' '.join(options)} -o {name}"


def _plain(value: object) -> str:
    """Return all digits of a number without trailing zeros."""
    number = float(value)  # type: ignore[arg-type]
    return str(int(number)) if number.is_integer() else repr(number)
