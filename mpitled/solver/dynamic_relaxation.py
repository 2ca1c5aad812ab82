"""Dynamic relaxation: damped steps of a fictitious time to the static solution, ended by their distance from it."""

from __future__ import annotations

import math
from copy import copy
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.deck import Solver
from mpitled.parallel.halo import Halo, World
from mpitled.parallel.subdomain import Subdomain
from mpitled.solver.restart import Kept
from mpitled.solver.spectral_radius import Sharpness
from mpitled.solver.stability_check import Survey
from mpitled.solver.step import State, at_rest, compose_forces, compose_relaxation, rehearse, take

#: Steps between surveys.
BETWEEN = 10
#: Steps from one time that it is looked for how sharp the bound of stiffness is to the next.
SHARPENED = 50
#: A mass tensor's trace falls to no less than this share from one survey to the next.
KEEP = 0.9
#: The estimate has to hold for so many steps, and the lowest eigenvalue to change by less than this share in BETWEEN of
#: them: it falls while the quick modes that hide the slow ones die.
SETTLED, STEADY = 50, 0.1
#: `load_steps` = "auto": at most so much would a cell next to moved nodes be strained in a step, if nothing gave way;
#: and the load takes no less than a shear wave across so many cells, for what keeps its volume has to flow.
STRAIN_PER_STEP, SHEAR_CELLS = 0.2, 14
#: It has stalled when so many surveys in a row have not brought the least estimate down by this factor: round-off.
STALLED, BETTER = 300, 0.99
#: The least estimate counts for nothing when the lowest eigenvalue has fallen to this share of what it was then: a mode
#: has come to light that is slower than what the estimate was made of.
FALLEN = 0.5


class Relaxation:
    """Steps of length 1 with mass tensors that make each node as fast as stability lets it be.

    After Joldes, Wittek and Miller (2011): damping is critical for the lowest eigenvalue, which Rayleigh's quotient of
    the last changes of displacements and forces estimates as it goes. Beyond it: a support domain's mass is a tensor,
    because next to a grown tumour its stiffness across the stretched layers is thousands of times that along them, and
    scalar masses would make the latter slow. While the load grows nothing is damped: drag would hold nodes back, and a
    growing seed run into them. The distance to the static solution is taken from the slowest mode, as its
    speed over its frequency and as its acceleration over its frequency squared, whichever is more.
    """

    #: Beside the state: what an unstable run goes back to, and what stays as it is when it does.
    PASSING = Kept(
        nodes=("mass", "u_then", "f_then"),
        alike=("lowest", "distance", "frame", "settled", "best", "best_lowest", "waited"),
    )
    LASTING = Kept(alike=("safety", "between", "load_time"))
    #: What it goes back to, of itself and of the state.
    HEALTHY = (PASSING.numbers, State.KEPT_AT_REST)

    def __init__(
        self,
        solver: Solver,
        frames: int,
        sub: Subdomain,
        world: World,
        force_halo: Halo | None,
        halo: Halo | None,
    ) -> None:
        """halo sums `components`."""
        self.sub, self.halo, self.frames = sub, halo, frames
        self.safety = self.first_safety = solver.safety
        self.tolerance = solver.tolerance
        # Where the pace is its own, it is for it to find a slower one.
        self.recovers = solver.on_inversion == "recover" or solver.load_steps == "auto"
        self.between = BETWEEN
        self.load_time = self._load_steps(solver.load_steps, world)
        self.state = at_rest(sub, self.load_time, 1.0)
        self.survey = Survey(sub)
        components = self.components(sub)
        self.required = self.survey.required if components == 1 else np.zeros((components, sub.n_nodes))
        self.mass, self.state.mobility = (np.zeros((components, sub.n_nodes)) for _ in range(2))
        self.free = sub.free()
        self.counted: NDArray[np.bool_] = self.free & sub.rows.owned  # free dofs that this rank owns
        self.u_then, self.f_then = np.zeros((3, sub.n_nodes)), np.zeros((3, sub.n_nodes))
        self.lowest, self.distance, self.frame, self.settled = 0.0, math.inf, 0, 0
        self.best, self.best_lowest, self.waited = math.inf, 0.0, 0
        self.forces, self.motion = compose_forces(sub, force_halo), compose_relaxation(sub, self.counted)
        self.sharpness = Sharpness(sub, world, self.forces)
        self.sharpness.seldom = SHARPENED

    @staticmethod
    def components(sub: Subdomain) -> int:
        """Numbers of a node's mass: a tensor's, if there is a support domain in the model, else one."""
        return 6 if any(block.kind.meshfree for block in sub.rows.blocks) else 1

    def _load_steps(self, given: Literal["auto"] | int, world: World) -> float:
        """Steps in which the load grows. Collective.

        A step carries a pressure wave about one cell farther, whatever the cell, and a shear wave as much less as it is
        slower: what counts is the speed of moved nodes, at its largest 15/8 of the mean on the loading curve, in cells
        a step. The load takes no less than five surveys.
        """
        if given != "auto":
            return float(given)
        slowness = math.sqrt(max((m.lam + 2 * m.mu) / m.mu for m in self.sub.rows.materials))
        steepest = float(world.gather([self.sub.steepest_load()]).max())
        return max(5.0 * BETWEEN, math.ceil(SHEAR_CELLS * slowness), math.ceil(15 / 8 * steepest / STRAIN_PER_STEP))

    def start_from(self, s: State, energy: float) -> None:
        """Go on from the displacements of another run at the end of its load, at rest; `energy` (J) is in its cells."""
        self.state.place(s.u)
        self.state.time = self.state.load_time
        self.u_then[:] = s.u[:, : self.sub.n_nodes]
        self.state.external_work = energy
        self.frame = self.frames

    def begin(self) -> None:
        """Find how sharp the bound of stiffness is. Collective."""
        take(self.state, self.forces)
        self._bound()
        self.mass[:] = self.required
        self._sharpen()
        self.state.f[:] = 0

    @property
    def stalled(self) -> bool:
        """Whether it comes no nearer to the static solution, though that is farther than the tolerance."""
        return self.waited >= STALLED

    @property
    def frame_time(self) -> float:
        """Share of the load at the present frame: time is fictitious here."""
        return self.state.share

    @property
    def expected_steps(self) -> int:
        """Steps in which the load grows; how many follow nobody knows beforehand."""
        return round(self.load_time)

    @property
    def expected_surveys(self) -> int:
        """Surveys of these steps."""
        return math.ceil(self.expected_steps / self.between)

    @property
    def progress(self) -> float:
        """Share of the run that is done, as far as one can tell: half for the load, half for what follows."""
        s = self.state
        if s.share < 1:
            return 0.5 * s.share
        done = math.log10(self.tolerance / min(max(self.distance, self.tolerance), 1.0)) / math.log10(self.tolerance)
        return 0.5 + 0.5 * max(0.0, min(1.0, 1 - abs(done)))

    def warm_up(self) -> None:
        """Call every kernel once, on the state at rest and to no effect, without other ranks."""
        twin = copy(self)
        # Its numbers are copies, its arrays are not: at millions of nodes they would be the largest that a run takes.
        twin.state, twin.halo = copy(self.state), None
        rehearse(twin.state, (*self.forces, *self.motion))
        twin.look()
        self.state.rest()
        for array in (self.mass, self.state.mobility, self.u_then, self.f_then):
            array[:] = 0

    def look(self) -> dict[str, float]:
        """As `March.look`; "dissipated" (J) is what damping and the change of masses took, by the work of the forces.

        More sums: "rayleigh_force", "rayleigh_mass". More extremes: "change", "residual" (m).
        """
        s = self.state
        found = self._bound()
        kernels.keep_masses(self.mass, self.required, self.free, KEEP)
        kernels.invert_masses(self.mass, self.free, s.mobility)
        kinetic, work, force, mass, change, residual = kernels.watch_relaxation(
            s.u, s.u_prev, s.f, self.mass, s.mobility, self.counted, self.u_then, self.f_then
        )
        return found | {
            "kinetic": kinetic,
            "external": s.external_work,
            "added": 0.0,
            "added_mass": 0.0,
            "dissipated": -s.free_work - work - kinetic,
            "step_ratio": self.safety,
            "rayleigh_force": force,
            "rayleigh_mass": mass,
            "change": change,
            "residual": residual,
        }

    def harden(self, anew: bool) -> None:
        """Go on from rest with the load half as fast, and with masses twice as large, watched twice as often.

        anew: from where the load began, with masses and watch as at first.
        """
        self.state.place(self.state.u)
        self.mass[:] = 0
        self.u_then[:] = self.state.u[:, : self.sub.n_nodes]
        self.safety = self.first_safety if anew else self.safety / math.sqrt(2)
        self.between = BETWEEN if anew else max(1, self.between // 2)
        self.load_time *= 2
        self.state.time *= self.load_time / self.state.load_time
        self.state.load_time = self.load_time

    def _bound(self) -> dict[str, float]:
        """Survey, and fill `required` with the masses that a stable step needs, on all ranks."""
        s = self.state
        if len(self.required) == 1:
            found = self.survey.look(s, self.safety)
        else:
            self.required[:] = 0
            found = self.survey.look(s, self.safety, self.required)
            for diagonal in (0, 3, 5):
                self.required[diagonal] += self.survey.required[0]
        if self.halo is not None:
            self.halo.sum(self.required)
        self.required *= self.sharpness.share or 1.0
        return found

    def _sharpen(self) -> None:
        """Renew how sharp the bound is, of which `required` is this share."""
        s, share = self.state, self.sharpness.share or 1.0
        kernels.invert_masses(self.required, self.free, s.mobility)
        self.sharpness.renew(s, s.mobility, (2 * self.safety) ** 2 / share)
        self.mass *= self.sharpness.share / share
        kernels.invert_masses(self.mass, self.free, s.mobility)

    def decide(self, figures: dict[str, float]) -> tuple[bool, bool]:
        """Damping of the next steps; whether a frame is due now, and whether the static solution is reached.

        Spoils `State.good`.
        """
        s = self.state
        if s.step >= self.sharpness.next and s.share < 1:
            self._sharpen()
        known = figures["rayleigh_force"] / figures["rayleigh_mass"] if figures["rayleigh_mass"] > 0 else 0.0
        loaded, steady, before = s.share >= 1, False, self.distance
        if loaded:
            if known > 0:
                steady = abs(known - self.lowest) < STEADY * self.between / BETWEEN * self.lowest
                self.lowest = known
            if self.lowest > 0:
                self.distance = max(figures["change"] / math.sqrt(self.lowest), figures["residual"] / self.lowest)
            elif figures["change"] == figures["residual"] == 0:
                self.distance = 0.0  # nothing has ever moved since
            steady = steady or self.distance < 1e-6 * self.tolerance  # round-off, whose quotient is no eigenvalue
            self.settled = self.settled + self.between if steady and self.distance < self.tolerance else 0
        damping = 2 * math.sqrt(self.lowest)
        s.retain, s.gain = (2 - damping) / (2 + damping), 2 / (2 + damping)
        if steady and (self.distance < BETTER * self.best or self.lowest < FALLEN * self.best_lowest):
            self.best, self.best_lowest, self.waited = self.distance, self.lowest, 0
        self.waited += loaded
        # An estimate that grows is being overtaken by a slower mode, which that of the eigenvalue has not found yet.
        shrinks = self.distance <= max(before, 1e-6 * self.tolerance)
        if (self.settled >= SETTLED and shrinks) or self.stalled:
            return True, True
        due = self.frame < self.frames and s.share >= self.frame / self.frames
        self.frame += due
        return due, False
