"""Marching through time: the central difference with the model's masses, scaled (quasi-static) or not (dynamic)."""

from __future__ import annotations

import math
from copy import copy

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.deck import Solver
from mpitled.errors import InputError
from mpitled.model import ModelFigures
from mpitled.parallel.halo import Halo, World
from mpitled.parallel.subdomain import Subdomain
from mpitled.solver.restart import Kept
from mpitled.solver.spectral_radius import Sharpness
from mpitled.solver.stability_check import Survey
from mpitled.solver.step import State, at_rest, compose_forces, compose_march, rehearse, take

#: Surveys of a run where what is stable changes fast, and where it does not; and the most steps from one to the next. A
#: survey takes about the time of one step and a half.
MANY, FEW, LONGEST_UNWATCHED = 100, 20, 100
#: So often in a run is it looked at how sharp the bound is, and every which time whole, though nothing seems changed.
SHARPENED, WHOLE = 40, 6
#: Where a step still stable has shrunk since the last survey by less than the first, the next ones come half as often;
#: by more than the second, which `solver.safety` leaves room for, twice as often.
CALM, HASTY = 1.03, 1.1
#: More steps than that nobody waits for: they come of a slip in the units of a density or a modulus.
MOST_STEPS = 1e8
#: A step that was shortened grows again when it could be longer by this factor.
REGAIN = 1.25


class March:
    """A run in steps of time. Every rank takes the same decisions, from figures that are the same on all.

    Where the step is longer than the survey proves stable, either the nodes that need it become heavier (quasi-static
    runs with `mass_scaling`) or the step shorter, with the central difference for variable steps.
    """

    #: Beside the state: what an unstable run goes back to, and what stays as it is when it does.
    PASSING = Kept(sums=("added_mass", "added_energy"), alike=("frame",))
    LASTING = Kept(alike=("safety", "longest", "between", "interval", "shortest_interval", "longest_interval"))
    #: What it goes back to, of itself and of the state.
    HEALTHY = (PASSING, State.KEPT)

    def __init__(
        self,
        solver: Solver,
        frames: int,
        sub: Subdomain,
        world: World,
        force_halo: Halo | None,
        halo: Halo | None,
        model: ModelFigures,
    ) -> None:
        """halo sums one component; model: figures of the preprocessor."""
        self.sub, self.world, self.halo, self.solver, self.safety = sub, world, halo, solver, solver.safety
        self.recovers = solver.on_inversion == "recover"
        self.scales_mass = solver.mass_scaling and solver.method == "quasi-static"
        self.typical = model.critical_step_typical_s  # by the bound
        self.end = solver.load_time + solver.hold_time
        self.frames, self.frame_span = frames, self.end / frames
        self.frame = 0
        self.state = at_rest(sub, solver.load_time, 1.0)
        self.survey = Survey(sub)
        self.held = sub.held
        nodes, directions = np.unique(self.held // 3, return_counts=True)
        self.prescribed: NDArray[np.int64] = nodes[directions == 3].astype(np.int64)  # need no mass for stability
        self.added_mass, self.added_energy = 0.0, 0.0
        self.longest, self.between = math.inf, 1  # found by `begin`, as is how many steps a survey lasts
        # at most. Fewer are taken, `between`, so that surveys fill a frame.
        self.interval, self.shortest_interval, self.longest_interval = 1, 1, 1
        self.forces, self.motion = compose_forces(sub, force_halo), compose_march(sub)
        self.sharpness = Sharpness(sub, world, self.forces)

    def begin(self) -> None:
        """Find the step. Collective. InputError, alike on all ranks, for a step that is too long."""
        s, solver = self.state, self.solver
        take(s, self.forces)
        self.survey.look(s, self.safety)
        required = self._required()
        self._sharpen()
        s.f[:] = 0
        if self.scales_mass:
            critical = self.typical / math.sqrt(self.sharpness.share)
        else:
            critical = s.time_step / (self.safety * math.sqrt(self._largest(self._needed(required))))
        if solver.time_step == "auto":
            self.longest = self.safety * critical
        else:
            self.longest = float(solver.time_step)
            if not self.scales_mass and self.longest > critical:
                raise InputError(
                    f"solver.time_step = {self.longest:.10g}: is longer than the critical step of the undeformed "
                    f"model, {critical:.3g} s; give at most {math.floor(critical * 1e8) / 1e8:g} (s), or leave it to "
                    "auto"
                )
            if self.longest * FEW > self.end:
                raise InputError(
                    f"solver.time_step = {self.longest:.10g}: leaves {self.end / self.longest:.2g} steps for a run of "
                    f"{self.end:g} s; give at most {self.end / FEW:g} (s), or leave it to auto"
                )
        if self.end / self.longest > MOST_STEPS:
            raise InputError(
                f"solver.load_time = {solver.load_time:.10g}: takes {self.end / self.longest:.2g} steps of "
                f"{self.longest:.2g} s; check the units of densities and moduli, or shorten it"
            )
        shortest, longest = (int(min(LONGEST_UNWATCHED, max(1, self.end / self.longest // n))) for n in (MANY, FEW))
        self.interval = self.shortest_interval = shortest
        # Where a wave may run, one survey does not tell of the next.
        self.longest_interval = longest if self.solver.method == "quasi-static" else shortest
        self.sharpness.seldom = self.sharpness.next = max(1, int(self.end / self.longest / SHARPENED))
        self.sharpness.whole = WHOLE
        s.time_step = self._fitting(self.longest, self.frame_span)
        s.mobility *= s.time_step**2  # from a step of 1 s
        if self.scales_mass:
            required *= s.time_step**2
            self._raise_mass(required)

    def _needed(self, required: NDArray[np.float64]) -> float:
        """The most of its mass that a node of this rank needs."""
        return float((required * self.state.mobility).max()) / self.state.time_step**2

    def _largest(self, value: float) -> float:
        return float(self.world.gather([value]).max())

    def _fitting(self, longest: float, span: float) -> float:
        """The longest step, none longer than that, of which whole surveys fill the span; renews `between`."""
        steps = math.ceil(span / longest * (1 - 1e-9))
        surveys = math.ceil(steps / self.interval)
        self.between = math.ceil(steps / surveys)
        return span / (self.between * surveys)

    @property
    def frame_time(self) -> float:
        """Time of the present frame, s."""
        return self.state.time

    @property
    def expected_steps(self) -> int:
        """Steps of the whole run, if the step stays what it is."""
        return round(self.end / self.state.time_step)

    @property
    def expected_surveys(self) -> int:
        """Surveys of the whole run, if what is stable changes slowly."""
        denser = math.ceil(math.log2(self.longest_interval / self.interval))
        return denser + max(self.frames, math.ceil(self.expected_steps / self.longest_interval))

    @property
    def progress(self) -> float:
        """Share of the run that is done."""
        return self.state.time / self.end

    def warm_up(self) -> None:
        """Call every kernel once, on the state at rest and to no effect, without other ranks."""
        twin = copy(self)
        # Its numbers are copies, its arrays are not: at millions of nodes they would be the largest that a run takes.
        twin.state, twin.halo = copy(self.state), None
        rehearse(twin.state, (*self.forces, *self.motion))
        twin.look()
        self.state.rest()
        np.divide(self.state.time_step**2, self.sub.rows.read("mass"), out=self.state.mobility)

    def look(self) -> dict[str, float]:
        """This rank's share of the figures at the present time, for which the forces are there.

        Sums, in J: "external", "strain", "hourglass", "stabilisation", "kinetic", "added", "dissipated"; in kg:
        "added_mass". Extremes: "min_jacobian" (of all steps), "step_ratio": the steps since the last survey over the
        one that this survey proves stable.
        """
        s, owned = self.state, self.sub.rows.owned
        found = self.survey.look(s, self.safety)
        required = self._required()
        found["kinetic"] = kernels.kinetic_energy(s.u, s.u_prev, s.f, s.mobility, owned, self.held)
        found["step_ratio"] = self.safety * math.sqrt(self._needed(required))
        if self.scales_mass:
            self._raise_mass(required)
        return found | {
            "external": s.external_work,
            "added": self.added_energy,
            "added_mass": self.added_mass,
            "dissipated": 0.0,
        }

    def _raise_mass(self, required: NDArray[np.float64]) -> None:
        s = self.state
        mass, energy = kernels.raise_mass(s.u, s.u_prev, s.mobility, required, self.sub.rows.owned, s.time_step)
        self.added_mass += mass
        self.added_energy += energy

    def _required(self) -> NDArray[np.float64]:
        """Mass (kg) that each node needs after a survey, on all ranks."""
        required = self.survey.required[0]
        if self.halo is not None:
            self.halo.sum(self.survey.required)
        required[self.prescribed] = 0
        required *= self.sharpness.share or 1.0
        return required

    def _sharpen(self) -> float:
        """Renew how sharp the bound is, of which `required` is this share; by what factor the stable step shrank."""
        s, required, share = self.state, self.survey.required[0], self.sharpness.share or 1.0
        mobility, bound = s.mobility, (2 * self.safety) ** 2 / share
        if self.scales_mass:
            mobility = np.divide(s.time_step**2, required, out=np.zeros_like(required), where=required > 0)
        else:
            bound *= self._largest(self._needed(required))
        self.sharpness.renew(s, mobility[None], bound)
        grown = self.sharpness.share / share
        required *= grown
        return math.sqrt(grown)

    def decide(self, figures: dict[str, float]) -> tuple[bool, bool]:
        """The length of the next steps; whether a frame is due now, and whether it is the last. Spoils `State.good`."""
        s = self.state
        due = s.time >= self.frame * self.frame_span - 0.5 * s.time_step
        if due:
            s.time = self.frame * self.frame_span  # without the round-off of its sum
            self.frame += 1
        if s.time >= self.end - 0.5 * s.time_step:
            return due, True
        # Only now: it needs the room of the last good state, which this one is.
        if s.step >= self.sharpness.next:
            figures["step_ratio"] *= self._sharpen()
            if self.scales_mass:
                self._raise_mass(self.survey.required[0])
        shrunk = figures["step_ratio"] / self.safety
        allowed = self.longest if self.scales_mass else min(self.longest, s.time_step / shrunk)
        longer = False
        if s.step >= self.sharpness.next:  # still, for it has grown
            self.interval = self.shortest_interval
        elif shrunk > HASTY:
            self.interval = max(self.shortest_interval, self.interval // 2)
        elif longer := shrunk < CALM and self.interval < self.longest_interval:
            self.interval = min(self.longest_interval, 2 * self.interval)
        fits = not longer and self.between <= self.interval and s.time_step <= allowed <= REGAIN * s.time_step
        if due or not fits:
            self._take(self._fitting(allowed, self.frame * self.frame_span - s.time))
        return due, False

    def harden(self, _: bool) -> None:
        """Go on with steps shorter by a third, or twice the mass where the step needs it, watched twice as often."""
        self.safety /= math.sqrt(2)
        if not self.scales_mass:
            self.longest /= math.sqrt(2)
        self.interval = self.shortest_interval = max(1, self.shortest_interval // 2)

    def _take(self, time_step: float) -> None:
        s = self.state
        ratio = time_step / s.time_step
        if abs(ratio - 1) < 1e-12:
            return
        s.mobility *= ratio**2
        kernels.change_step(s.u, s.u_prev, s.f, s.mobility, ratio)
        s.time_step = time_step
