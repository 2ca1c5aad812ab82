"""The survey of all cells of a rank every few steps: energies, J, and the mass that a stable step needs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mpitled.parallel.subdomain import Subdomain
from mpitled.solver.step import State


@dataclass(slots=True)
class Survey:
    """Arrays that a survey fills.

    A step is stable where each node's mass is at least dt^2 / 4 times the sum of its cells' largest eigenvalues, for
    which the kernels give a bound in the present configuration. The same holds for mass tensors and tensors of bounds.
    """

    sub: Subdomain
    jacobian: NDArray[np.float32] = field(init=False)  # (n_cells + 1,), the last for lanes without a cell
    required: NDArray[np.float64] = field(init=False)  # (1, n_nodes), kg

    def __post_init__(self) -> None:
        self.jacobian = np.ones(self.sub.n_cells + 1, np.float32)
        self.required = np.zeros((1, self.sub.n_nodes))

    def look(self, s: State, safety: float, tensor: NDArray[np.float64] | None = None) -> dict[str, float]:
        """Energies (J) of this rank's cells by kind, and the smallest J of all steps so far.

        Fills `jacobian` with the cells' J and `required` with the mass that keeps the step `safety` below the bound,
        without the shares of other ranks. Where tensor (6, n_nodes) is given, what support domains ask goes there.
        """
        sub, required, jacobian = self.sub, self.required[0], self.jacobian
        required[:] = 0
        factor = (s.time_step / (2 * safety)) ** 2
        energies = dict.fromkeys(("strain", "hourglass", "stabilisation"), 0.0)
        for cells in sub.packed:
            for name, energy in cells.check(s.seen, required, factor, jacobian, tensor).items():
                energies[name] += energy
        s.smallest_jacobian = min(s.smallest_jacobian, float(jacobian[:-1].min()))
        return energies | {"min_jacobian": s.smallest_jacobian}
