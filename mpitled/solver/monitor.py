"""The energy ledger of a run, and the verdict whether the run can continue."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpitled.errors import UnstableError
from mpitled.parallel.halo import World
from mpitled.solver.integrator import Integrator
from mpitled.solver.integrators import INTEGRATORS
from mpitled.terms import TERMS, Figure, Side, Step, Term
from mpitled.terms.restart import replicated

#: The energy balance may be wrong by this share of the largest energy; beyond it the run is unstable.
BALANCE_LIMIT = 0.05
#: In so many steps from rest the balance is too coarse to judge by: the error of its trapezoidal rule is about 8 over
#: the square of the number of steps, as a share of little energy.
FIRST_JUDGED_STEP = 50
_REDUCE: dict[str, Callable[[Iterable[float]], float]] = {"sum": sum, "min": min, "max": max}
#: Figures that the ledger itself makes, in every series.
RATIOS = ("balance_error", "kinetic_ratio")


class Ledger:
    """All figures of a run's terms and integrator: their reduction over the ranks, and the balance of energies."""

    def __init__(self, integrator: type[Integrator], step: Step) -> None:
        present = {integrator, *(type(term) for term in step.terms)}
        known: tuple[type[Term] | type[Integrator], ...] = (*TERMS, *INTEGRATORS)
        listed = (f for cls in known for f in cls.figures if f.always or cls in present)
        self.figures: tuple[Figure, ...] = tuple({f.name: f for f in listed}.values())
        #: Name of each figure in the series of the result -> its own name.
        self.series = {f.series: f.name for f in self.figures if f.series} | {name: name for name in RATIOS}

    def reduce(self, columns: Mapping[str, NDArray[np.float64]]) -> dict[str, float]:
        """One number of each figure from those of all ranks, (n ranks,)."""
        return {f.name: float(_REDUCE[f.reduce](columns[f.name])) for f in self.figures}

    def total(self, figures: Mapping[str, float], side: Side) -> float:
        """Sum of the energies (J) on one side."""
        return sum((figures[f.name] for f in self.figures if f.side is side), 0.0)

    def report(self, figures: Mapping[str, float]) -> dict[str, float]:
        """The energies (J) of report.json."""
        lines = {f.name: figures[f.name] for f in self.figures if f.side and f.series}
        return lines | {"internal": self.total(figures, Side.STORED), "balance_error": figures["balance_error"]}


@dataclass(init=False, eq=False, repr=False)
class Monitor:
    """Keeps the ledger of an integrator and judges its state, alike on all ranks. Its calls are collective."""

    figures: dict[str, float] = replicated(control=True, default_factory=dict)  # of all ranks, at the last check
    largest_kinetic_ratio: float = replicated(control=True, default=0.0)
    largest_energy: float = replicated(control=True, default=0.0)  # J

    def __init__(self, world: World, integrator: Integrator, volume: float, scene: str, remedy: str) -> None:
        """volume: of the whole model, m^3; scene: name of the deck; remedy: of instability."""
        self.world, self.integrator, self.sub = world, integrator, integrator.sub
        self.scene, self.remedy = scene, remedy
        self.ledger = Ledger(type(integrator), integrator.step)
        self.figures = {}
        self.own_energy = 0.0  # J, stored on this rank
        self.request = 0  # the highest request of any rank at the last check
        self._smallest = 0, math.inf  # this rank's cell of smallest J at the last good check, and its J
        # Round-off of the strain energy of the undeformed body, J: tr C - 3 and ln J are not exactly 0.
        self._noise = 8 * float(np.finfo(self.sub.precision).eps) * max(m.mu for m in self.sub.rows.materials) * volume

    def update(self, request: int) -> None:
        """Check all ranks and renew the figures; UnstableError, the same on all ranks, if the run cannot continue.

        request: what this rank asks all ranks for.
        """
        state, world, ledger = self.integrator.state, self.world, self.ledger
        found = self.integrator.check()
        own = {f.name: found.get(f.name, 0.0) for f in ledger.figures}
        self.own_energy = ledger.total(own, Side.STORED)
        table = world.gather([*own.values(), float(request)])
        columns = dict(zip(own, table.T, strict=False))
        figures = ledger.reduce(columns)
        work, stored, kinetic = (ledger.total(figures, side) for side in (Side.WORK, Side.STORED, Side.KINETIC))
        supplied = work + ledger.total(figures, Side.NUMERICAL) - ledger.total(figures, Side.DISSIPATED)
        largest = max(self.largest_energy, abs(work), stored, kinetic)
        error = abs(supplied - stored - kinetic)
        figures["balance_error"] = error / (largest or 1.0)
        figures["kinetic_ratio"] = kinetic / stored if stored > 0 else 0.0
        self.figures, self.request = figures, int(table[:, -1].max())
        finite = math.isfinite(stored + kinetic + work)
        where = f"unstable at {state.share:.1%} of the load of {self.scene}"
        smallest = figures["min_jacobian"]  # a J that is not a number is skipped here, but makes energies infinite
        if not math.isfinite(smallest) or (smallest > 0 and not finite):  # no cell is the worst now
            raise UnstableError(f"{where}: displacements grew without bound (diverged){self._before()}; {self.remedy}")
        if smallest <= 0:
            reason = "a cell is turned inside out"
        elif error > BALANCE_LIMIT * largest + self._noise and state.step >= FIRST_JUDGED_STEP:
            reason = (
                f"the energy balance is wrong by {figures['balance_error']:.1%} (supplied {supplied:.3g} J, internal "
                f"{stored:.3g} J, kinetic {kinetic:.3g} J)"
            )
        else:
            self.largest_energy = largest
            if state.share >= 0.1:
                self.largest_kinetic_ratio = max(self.largest_kinetic_ratio, figures["kinetic_ratio"])
            jacobian = self.integrator.stability.jacobian[:-1]
            cell = int(jacobian.argmin())
            self._smallest = cell, float(jacobian[cell])
            return
        worst = int(np.argmin(columns["min_jacobian"]))
        cell = world.broadcast(self._worst_cell() if world.rank == worst else None, worst)
        raise UnstableError(
            f"{where}: {reason}; {cell}; the step is {figures['step_ratio']:.2f} of the longest stable one; "
            f"{self.remedy}"
        )

    def _worst_cell(self) -> str:
        """Description of the cell with the smallest J on this rank."""
        jacobian, state = self.integrator.stability.jacobian[:-1], self.integrator.state
        cell = int(np.argmin(jacobian))
        described, local = self._describe(cell)
        points = self.sub.rows.read("points")[local]
        edges = points - points.mean(axis=0)
        stretched = edges + state.u[:, local].T - state.u[:, local].T.mean(axis=0)
        stretch = np.linalg.norm(stretched, axis=1).max() / np.linalg.norm(edges, axis=1).max()
        return (
            f"worst is {described} with J = {jacobian[cell]:.3g} now, {state.smallest_jacobian:.3g} at its worst, and "
            f"a stretch of {stretch:.3g}"
        )

    def _before(self) -> str:
        """The cell of smallest J on all ranks at the last good check, if there was one. Collective."""
        cell, jacobian = self._smallest
        smallest = self.world.gather([jacobian])[:, 0]
        worst = int(smallest.argmin())
        if not math.isfinite(smallest[worst]):
            return ""
        described = self.world.broadcast(self._describe(cell)[0] if self.world.rank == worst else None, worst)
        return f"; until then the worst was {described} with J = {smallest[worst]:.3g}"

    def _describe(self, cell: int) -> tuple[str, NDArray[np.int64]]:
        """Kind, number, material and place of a cell of this rank, and its local nodes (k,)."""
        rows = self.sub.rows
        hexahedron = cell < rows.n_own_hexahedra
        kind, k = ("hexahedra", cell) if hexahedron else ("domains", cell - rows.n_own_hexahedra)
        local = rows.local(rows.read(kind, k, k + 1)[0])
        centre = rows.read("points")[local].mean(axis=0) if hexahedron else rows.read("domain_points", k, k + 1)[0]
        x, y, z = 1e3 * centre
        number, material = (rows.read(name, cell, cell + 1)[0] for name in ("cells", "material"))
        return (
            f"{'hexahedron' if hexahedron else 'support domain'} {number} ({rows.materials[material].name}) at "
            f"({x:.1f}, {y:.1f}, {z:.1f}) mm on rank {self.world.rank}"
        ), local
