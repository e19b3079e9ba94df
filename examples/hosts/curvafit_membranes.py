"""PolNet's `curvatubes` membranes, grown by curvafit on processors: PolNet's own generator asks for a CUDA device.

    python curvafit_membranes.py config.yaml -v

runs the `polnet` command with them; a program that calls PolNet imports this module first. The keys of a `.mbs` file
are PolNet's. Shapes come from the conservative flow, whatever `CT_FLOW_TYPE` says. `CT_SCHEDULE` is a
schedule of curvafit, by default `fast`, and takes the place of `CT_MAXEVAL` and `CT_LR`.
"""

from __future__ import annotations

import random
import sys

import numpy as np
from polnet.sample.membranes.mb import MbError
from polnet.sample.membranes.mb_curvatubes import CurvatubesGen
from polnet.sample.membranes.mb_factory import MbFactory

from curvafit.generation import generate
from curvafit.priors import Coefficients, Grid
from curvafit.priors.grid import WORKING_EPSILON


@MbFactory.register("curvatubes")
class CurvafitGen(CurvatubesGen):
    """Membranes at the zero level of a phase field that fills the volume of interest."""

    schedule = "fast"

    @classmethod
    def from_params(cls, params: dict) -> CurvafitGen:
        """Return a generator of the parameters in a `.mbs` file."""
        made = super().from_params(params)
        made.schedule = params.get("CT_SCHEDULE", cls.schedule)
        return made

    def _run_curvatubes(self, voi_shape: tuple[int, int, int]) -> np.ndarray:
        """Return the phase field (float32) of a shape; its seed follows from Python's, which PolNet sets."""
        scale = WORKING_EPSILON / self._eps  # working units of a unit of length of the file
        linear, constant = (np.array(each) / scale**k for k, each in enumerate(((self._b10, self._b01), self._c), 1))
        law = Coefficients(self._a20, self._a11, self._a02, *map(float, linear), float(constant))
        grid = Grid(tuple(map(int, voi_shape)), self._delta_x * scale, self._mode)
        flow = generate(law, self._M0, grid, schedule=self.schedule, blur=self._sigma_blur * grid.spacing[0],
                        seed=random.getrandbits(31))  # fmt: skip
        if not flow.viability.viable:
            raise MbError(f"the flow made no shape: {flow.status}")
        return flow.field.numpy().astype(np.float32)


if __name__ == "__main__":
    from polnet.cli import app

    sys.exit(app())
