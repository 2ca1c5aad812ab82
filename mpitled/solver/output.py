"""The frames of the result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import store
from mpitled.deck import Deck
from mpitled.parallel.halo import Halo
from mpitled.parallel.subdomain import Subdomain
from mpitled.solver.cauchy_stress import cauchy
from mpitled.solver.integrator import Integrator
from mpitled.terms.restart import replicated


def cell_data(deck: Deck) -> dict[str, int]:
    """Components of the cell data of each frame."""
    return {"J": 1} | ({"stress": 6} if deck.output.stress else {})


@dataclass(init=False, eq=False, repr=False)
class Output:
    """Writes frames, and keeps the last stable state to be written when the run fails."""

    n_frames: int = replicated(default=0)
    last_time: float = replicated(default=-math.inf)  # of the last frame
    stable_time: float = replicated(control=True, default=0.0)  # frame time of `u_last_stable`
    stable_figures: dict[str, float] = replicated(control=True, default_factory=dict)

    def __init__(self, deck: Deck, sub: Subdomain, halo: Halo | None, series: Mapping[str, str]) -> None:
        """halo sums three components; series: name in the result -> name of the figure."""
        self._deck, self._sub, self._halo, self._series = deck, sub, halo, series
        self.stable_figures = {}
        self.u_last_stable = np.zeros((3, sub.n_nodes), np.float32)  # m
        self.writer: store.ResultWriter

    def open(self, directory: Any, comm: Any, metadata: Mapping[str, Any]) -> None:
        """Begin the result, or continue it with the frames that it has. Collective; errors of `ResultWriter`."""
        self.writer = store.ResultWriter(
            directory,
            comm,
            self._sub.rows,
            self._deck.output.frames + 1,
            metadata,
            cell_data=cell_data(self._deck),
            series=list(self._series),
            frames=self.n_frames,
        )

    def keep_stable(self, integrator: Integrator, figures: dict[str, float]) -> None:
        """Remember the present state as the last stable one."""
        self.u_last_stable[:] = integrator.state.u[:, : self._sub.n_nodes]
        self.stable_time, self.stable_figures = integrator.frame_time, figures

    def write_last_stable(self, integrator: Integrator) -> bool:
        """Write the last stable state as a frame, unless there is one of its time; whether it did. Collective."""
        if self.stable_time <= self.last_time:
            return False
        integrator.state.set_displacement(self.u_last_stable)
        integrator.stability.evaluate(integrator.state, integrator.step.terms, integrator.safety)
        self.write(integrator, self.stable_figures, self.stable_time)
        return True

    def write(self, integrator: Integrator, figures: Mapping[str, float], frame_time: float) -> None:
        """Write the present state as a frame. Collective."""
        sub, u = self._sub, integrator.state.u[:, : self._sub.n_nodes]
        at_points = np.einsum("ga,cga->gc", sub.domain_shapes, u[:, sub.domain_nodes])
        displacement = field = self._owned(u)
        if sub.rows.n_domains:
            field = np.concatenate([self._owned(self._field(u)), at_points])
            displacement = np.concatenate([displacement, at_points])
        of_cells: dict[str, NDArray[np.floating]] = {"J": integrator.stability.jacobian[:-1]}
        if self._deck.output.stress:
            of_cells["stress"] = cauchy(sub.rows, u, self._deck.hexahedra.gradient)
        series = {name: figures[figure] for name, figure in self._series.items()}
        self.n_frames, self.last_time = self.n_frames + 1, frame_time
        self.writer.write_frame(frame_time, {"parameters": displacement, "displacement": field}, of_cells, series)

    def _owned(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (n_owned, 3) of values (3, n_nodes)."""
        owned = self._sub.rows.owned
        return u.T if owned.all() else u.T[owned]

    def _field(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """The field u_h (3, n_nodes), m: at EFG nodes the MLS interpolation of one domain, not the parameter."""
        rows = self._sub.rows
        field = np.where(rows.owned & (rows.nodes < rows.n_fe_nodes), u, 0.0)
        domains = rows.read("cells", rows.n_own_hexahedra) - rows.n_hexahedra
        giving = self._sub.domain_nodes[np.searchsorted(domains, rows.field_domains)]
        field[:, rows.local(rows.field_nodes)] = np.einsum("ga,cga->cg", rows.field_shapes, u[:, giving])
        if self._halo is not None:
            self._halo.sum(field)
        return field
