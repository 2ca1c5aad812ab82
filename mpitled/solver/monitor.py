"""What is watched while a run goes on: energies, the balance between them, J; and the reason why it cannot go on."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mpitled.errors import UnstableError
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import Subdomain
from mpitled.solver.central_difference import March
from mpitled.solver.dynamic_relaxation import Relaxation
from mpitled.solver.restart import Kept

#: The energy balance may be wrong by this share of the largest energy; beyond it the run is unstable.
BALANCE_LIMIT = 0.05
#: So many steps from rest the ledger is too coarse to judge by: its trapezoidal rule is wrong by about 8 over the steps
#: squared of what little energy there is.
LEDGER_STARTS = 50
#: What is not summed over the ranks.
_EXTREMES = {"min_jacobian": min, "step_ratio": max, "change": max, "residual": max}


class Watch:
    """The ledger of a run on one rank, and its verdict, the same on all. Its calls are collective."""

    LASTING = Kept(alike=("figures", "largest_kinetic_ratio", "largest_energy"))

    def __init__(self, world: World, sub: Subdomain, volume: float, scene: str, remedy: str) -> None:
        """volume: of the whole model, m^3; scene: the deck's name; remedy: of instability."""
        self.world, self.sub, self.scene, self.remedy = world, sub, scene, remedy
        self.figures: dict[str, float] = {}  # of all ranks, at the last look
        self.own_energy = 0.0  # J, in this rank's cells
        self.largest_kinetic_ratio = 0.0
        self.request = 0  # the most that any rank asked for at the last look
        self.largest_energy = 0.0
        self._smallest = 0, math.inf  # this rank's cell of least J when all was well at the last look, and its J
        # The strain energy of the undeformed body is no better than this, J: tr C - 3 and ln J are not quite 0.
        self._noise = 8 * float(np.finfo(sub.precision).eps) * max(m.mu for m in sub.rows.materials) * volume

    def look(self, method: March | Relaxation, request: int) -> None:
        """Survey all ranks and keep the ledger; UnstableError, alike on all ranks, if the run cannot go on.

        request: what this rank asks of all.
        """
        state, world = method.state, self.world
        own = method.look()
        self.own_energy = own["strain"] + own["hourglass"] + own["stabilisation"]
        table = world.gather([*own.values(), float(request)])
        columns = dict(zip(own, table.T, strict=False))
        figures = {name: float(_EXTREMES.get(name, sum)(columns[name])) for name in own}
        internal = figures["strain"] + figures["hourglass"] + figures["stabilisation"]
        supplied = figures["external"] + figures["added"] - figures["dissipated"]
        largest = max(self.largest_energy, abs(figures["external"]), internal, figures["kinetic"])
        balance = abs(supplied - internal - figures["kinetic"])
        figures["balance_error"] = balance / (largest or 1.0)
        figures["kinetic_ratio"] = figures["kinetic"] / internal if internal > 0 else 0.0
        self.figures, self.request = figures, int(table[:, -1].max())
        finite = math.isfinite(internal + figures["kinetic"] + figures["external"])
        where = f"unstable at {state.share:.1%} of the load of {self.scene}"
        smallest = figures["min_jacobian"]  # J that are not a number count for nothing here, but make energies such
        if not math.isfinite(smallest) or (smallest > 0 and not finite):  # no cell is the worst now
            raise UnstableError(f"{where}: displacements grew without bound (diverged){self._before()}; {self.remedy}")
        if smallest <= 0:
            reason = "a cell is turned inside out"
        elif balance > BALANCE_LIMIT * largest + self._noise and state.step >= LEDGER_STARTS:
            reason = (
                f"the energy balance is wrong by {figures['balance_error']:.1%} (supplied {supplied:.3g} J, internal "
                f"{internal:.3g} J, kinetic {figures['kinetic']:.3g} J)"
            )
        else:
            self.largest_energy = largest
            if state.share >= 0.1:
                self.largest_kinetic_ratio = max(self.largest_kinetic_ratio, figures["kinetic_ratio"])
            jacobian = method.survey.jacobian[:-1]
            cell = int(jacobian.argmin())
            self._smallest = cell, float(jacobian[cell])
            return
        worst = int(np.argmin(columns["min_jacobian"]))
        cell = world.broadcast(self._worst_cell(method) if world.rank == worst else None, worst)
        raise UnstableError(
            f"{where}: {reason}; {cell}; the step is {figures['step_ratio']:.2f} of the longest stable one; "
            f"{self.remedy}"
        )

    def _worst_cell(self, method: March | Relaxation) -> str:
        """What and where the cell with the smallest J on this rank is, in a few words."""
        jacobian, state = method.survey.jacobian[:-1], method.state
        cell = int(np.argmin(jacobian))
        named, local = self._named(cell)
        points = self.sub.rows.read("points")[local]
        edges = points - points.mean(axis=0)
        stretched = edges + state.u[:, local].T - state.u[:, local].T.mean(axis=0)
        stretch = np.linalg.norm(stretched, axis=1).max() / np.linalg.norm(edges, axis=1).max()
        return (
            f"worst is {named} with J = {jacobian[cell]:.3g} now, {state.smallest_jacobian:.3g} at its worst, and a "
            f"stretch of {stretch:.3g}"
        )

    def _before(self) -> str:
        """Where J was smallest of all ranks at the last look that was well, if there was one. Collective."""
        cell, jacobian = self._smallest
        smallest = self.world.gather([jacobian])[:, 0]
        worst = int(smallest.argmin())
        if not math.isfinite(smallest[worst]):
            return ""
        named = self.world.broadcast(self._named(cell)[0] if self.world.rank == worst else None, worst)
        return f"; until then the worst was {named} with J = {smallest[worst]:.3g}"

    def _named(self, cell: int) -> tuple[str, NDArray[np.int64]]:
        """What and where a cell of this rank is, in a few words, and its nodes (k,), by this rank's numbers."""
        rows = self.sub.rows
        block, k = rows.find_cell(cell)
        local = rows.local(block.read("nodes", k, k + 1)[0])
        place = block.read("points", k, k + 1)[0] if block.kind.meshfree else rows.read("points")[local].mean(axis=0)
        x, y, z = 1e3 * place
        number, material = (rows.read(name, cell, cell + 1)[0] for name in ("cells", "material"))
        return (
            f"{block.kind.singular} {number} ({rows.materials[material].name}) at "
            f"({x:.1f}, {y:.1f}, {z:.1f}) mm on rank {self.world.rank}"
        ), local
