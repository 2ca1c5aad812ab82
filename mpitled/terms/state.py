"""The state that the terms of a step change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.model.loading import loading_curve
from mpitled.parallel.subdomain import Subdomain
from mpitled.terms.restart import nodal, reduced, replicated


@dataclass(slots=True, kw_only=True)
class State:
    """Displacements, forces, masses and time of one rank."""

    u: NDArray[np.float64] = nodal(single_precision=True)  # (3, n_nodes + PADDING), m, at the time of `step`
    u_prev: NDArray[np.float64] = nodal()  # (3, n_nodes + PADDING), m, one step before
    u_cells: NDArray[np.floating]  # u as the cells read it: u itself, or a copy in single precision
    f: NDArray[np.floating]  # (3, n_nodes + PADDING), N, internal forces, in the precision of `u_cells`
    dt2_over_m: NDArray[np.float64] = nodal()  # s^2/kg: scalars (n_nodes,); in relaxation (1 or 6, n_nodes), dt = 1
    load_time: float = replicated()  # s
    time_step: float = replicated()  # s
    time: float = replicated(default=0.0)  # s
    step: int = replicated(default=0)
    c1: float = replicated(default=1.0)  # damping coefficients of relaxation, see `kernels.relax`
    c2: float = replicated(default=1.0)
    smallest_jacobian: float = reduced("min", default=1.0)  # of this rank's cells in all steps so far

    @classmethod
    def at_rest(cls, sub: Subdomain, load_time: float, time_step: float) -> State:
        """The undeformed state, with the masses of the model."""
        u, u_prev = (np.zeros((3, sub.n_nodes + kernels.PADDING)) for _ in range(2))
        u_cells = u if sub.precision == u.dtype else u.astype(sub.precision)
        return cls(
            u=u, u_prev=u_prev, u_cells=u_cells, f=np.zeros_like(u_cells),
            dt2_over_m=time_step**2 / sub.rows.read("mass"), load_time=load_time, time_step=time_step,
        )  # fmt: skip

    def set_displacement(self, u: NDArray[np.floating]) -> None:
        """Put the nodes at the displacements u (3, n_nodes), m, at rest."""
        self.u[:, : u.shape[1]] = self.u_prev[:, : u.shape[1]] = u
        self.sync_cell_copy()

    def sync_cell_copy(self) -> None:
        """Renew `u_cells` and clear the forces after u was changed outside of a step."""
        self.u_cells[:] = self.u
        self.f[:] = 0

    def clear(self) -> None:
        """Set displacements and forces to 0."""
        for array in (self.u, self.u_prev, self.u_cells, self.f):
            array[:] = 0

    @property
    def share(self) -> float:
        """Share of the load time that has passed."""
        return min(1.0, self.time / self.load_time)

    @property
    def next_load(self) -> float:
        """Share of the full load after the next step."""
        return loading_curve((self.time + self.time_step) / self.load_time)
