"""Central difference in time: with masses scaled to the step (quasi-static), or with the masses of the model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.errors import InputError
from mpitled.parallel.halo import Halo, World
from mpitled.solver.integrator import Integrator
from mpitled.terms import Figure, Scene, Side
from mpitled.terms.restart import Scope, reduced, replicated
from mpitled.terms.term import Method, energy

#: Checks of a run where the stable step changes fast, and where it does not; and the most steps between two checks. A
#: check takes about as long as one and a half steps.
MAX_CHECKS, MIN_CHECKS, MAX_CHECK_INTERVAL = 100, 20, 100
#: Estimates of the spectral radius in a run, and every which one is made in full although nothing seems changed.
N_ESTIMATES, FULL_EVERY = 40, 6
#: If the stable step has shrunk since the last check by less than the first factor, checks become half as frequent; by
#: more than the second, which `solver.safety` covers, twice as frequent.
GROW_INTERVAL_BELOW, SHRINK_INTERVAL_ABOVE = 1.03, 1.1
#: Step limit: catches wrong units of a density or a modulus.
MAX_STEPS = 1e8
#: A shortened step grows again when it could be longer by this factor.
GROW_STEP_ABOVE = 1.25


@dataclass(init=False, eq=False, repr=False)
class CentralDifference(Integrator):
    """Steps of time.

    If the step is longer than a check proves stable, either the nodes that need it become heavier (quasi-static runs
    with `mass_scaling`) or the step becomes shorter, by the central difference with a variable step.
    """

    figures = (
        *Integrator.figures,
        energy("kinetic", Side.KINETIC, always=True),
        energy("added_mass", Side.NUMERICAL, "energy_of_added_mass", always=True),
        Figure("added_mass_kg", series="added_mass", always=True),
    )
    rollback_scope = Scope.ROLLBACK

    next_frame: int = replicated(default=0)
    added_mass: float = reduced("sum", default=0.0)  # kg
    added_energy: float = reduced("sum", default=0.0)  # J
    safety: float = replicated(control=True)
    longest: float = replicated(control=True, default=math.inf)  # s, of the steps to be taken
    between: int = replicated(control=True, default=1)  # a whole number of checks fills a frame
    interval: int = replicated(control=True, default=1)  # most steps between checks at present
    shortest_interval: int = replicated(control=True, default=1)
    longest_interval: int = replicated(control=True, default=1)

    def __init__(self, scene: Scene, frames: int, world: World, halo: Halo | None, model: dict[str, Any]) -> None:
        """model: figures of the model. See `Integrator`."""
        super().__init__(scene, frames, world, halo, scene.solver.load_time)
        solver = self.solver
        self.recovers = solver.on_inversion == "recover"
        self.scales_mass = solver.mass_scaling and scene.method is Method.QUASI_STATIC
        self.critical_step_by_bound = model["critical_step_typical_s"]
        self.end = solver.load_time + solver.hold_time
        self.frame_span = self.end / frames
        self.held = self.sub.held
        nodes, directions = np.unique(self.held // 3, return_counts=True)
        self.prescribed: NDArray[np.int64] = nodes[directions == 3].astype(np.int64)  # need no mass for stability

    def begin(self) -> None:
        """See `Integrator`."""
        s = self.state
        self.step.apply_forces(s)
        self.stability.evaluate(s, self.step.terms, self.safety)
        required = self._required()
        self._estimate_spectral_radius()
        s.f[:] = 0
        if self.scales_mass:
            critical = self.critical_step_by_bound / math.sqrt(self.spectral_radius.ratio_to_bound)
        else:
            critical = s.time_step / (self.safety * math.sqrt(self._largest(self._needed(required))))
        self.longest = self._longest_step(critical)
        steps = self.end / self.longest
        shortest, longest = (int(min(MAX_CHECK_INTERVAL, max(1, steps // n))) for n in (MAX_CHECKS, MIN_CHECKS))
        self.interval = self.shortest_interval = shortest
        # Where waves may travel, one check says little of the next.
        self.longest_interval = longest if self.scene.method is Method.QUASI_STATIC else shortest
        self.spectral_radius.interval = self.spectral_radius.next_step = max(1, int(steps / N_ESTIMATES))
        self.spectral_radius.full_every = FULL_EVERY
        s.time_step = self._fitting(self.longest, self.frame_span)
        s.dt2_over_m *= s.time_step**2  # from a step of 1 s
        if self.scales_mass:
            required *= s.time_step**2
            self._raise_mass(required)

    def _longest_step(self, critical: float) -> float:
        """The step (s) by the deck. InputError if it is unstable, or a run has too few or too many of them."""
        solver = self.solver
        longest = self.safety * critical if solver.time_step == "auto" else float(solver.time_step)
        if solver.time_step != "auto":
            key = f"solver.time_step = {longest:.10g}"
            if not self.scales_mass and longest > critical:
                raise InputError(
                    f"{key}: is longer than the critical step of the undeformed model, {critical:.3g} s; give at most "
                    f"{math.floor(critical * 1e8) / 1e8:g} (s), or leave it to auto"
                )
            if longest * MIN_CHECKS > self.end:
                raise InputError(
                    f"{key}: leaves {self.end / longest:.2g} steps for a run of {self.end:g} s; give at most "
                    f"{self.end / MIN_CHECKS:g} (s), or leave it to auto"
                )
        if self.end / longest > MAX_STEPS:
            raise InputError(
                f"solver.load_time = {solver.load_time:.10g}: takes {self.end / longest:.2g} steps of {longest:.2g} s; "
                "check the units of densities and moduli, or shorten it"
            )
        return longest

    def _needed(self, required: NDArray[np.float64]) -> float:
        """The largest share of its mass that a node of this rank needs."""
        return float((required * self.state.dt2_over_m).max()) / self.state.time_step**2

    def _fitting(self, longest: float, span: float) -> float:
        """The longest step, at most that, with which a whole number of checks fills the span; sets `between`."""
        steps = math.ceil(span / longest * (1 - 1e-9))
        checks = math.ceil(steps / self.interval)
        self.between = math.ceil(steps / checks)
        return span / (self.between * checks)

    @property
    def frame_time(self) -> float:
        """See `Integrator`."""
        return self.state.time

    @property
    def expected_steps(self) -> int:
        """Steps of the run, if the step stays the same."""
        return round(self.end / self.state.time_step)

    @property
    def expected_checks(self) -> int:
        """Checks of the run, if the stable step changes slowly."""
        denser = math.ceil(math.log2(self.longest_interval / self.interval))
        return denser + max(self.frames, math.ceil(self.expected_steps / self.longest_interval))

    @property
    def progress(self) -> float:
        """See `Integrator`."""
        return self.state.time / self.end

    def clear(self) -> None:
        """See `Integrator`; masses become those of the model."""
        super().clear()
        np.divide(self.state.time_step**2, self.sub.rows.read("mass"), out=self.state.dt2_over_m)

    def check(self) -> dict[str, float]:
        """See `Integrator`."""
        s = self.state
        found = self.stability.evaluate(s, self.step.terms, self.safety)
        required = self._required()
        found["kinetic"] = kernels.kinetic_energy(s.u, s.u_prev, s.f, s.dt2_over_m, self.sub.rows.owned, self.held)
        found["step_ratio"] = self.safety * math.sqrt(self._needed(required))
        if self.scales_mass:
            self._raise_mass(required)
        return found | {"added_mass": self.added_energy, "added_mass_kg": self.added_mass}

    def _raise_mass(self, required: NDArray[np.float64]) -> None:
        s = self.state
        mass, added = kernels.raise_mass(s.u, s.u_prev, s.dt2_over_m, required, self.sub.rows.owned, s.time_step)
        self.added_mass += mass
        self.added_energy += added

    def _required(self) -> NDArray[np.float64]:
        """Mass (kg) that each node needs by the last check, on all ranks."""
        required = self._masses(self.stability.required)[0]
        required[self.prescribed] = 0
        return required

    def _estimate_spectral_radius(self) -> float:
        """Renew the spectral radius, by which the required masses are relaxed; the factor by which the step shrank."""
        s, required, ratio = self.state, self.stability.required[0], self.spectral_radius.ratio_to_bound or 1.0
        dt2_over_m, bound = s.dt2_over_m, (2 * self.safety) ** 2 / ratio
        if self.scales_mass:
            dt2_over_m = np.divide(s.time_step**2, required, out=np.zeros_like(required), where=required > 0)
        else:
            bound *= self._largest(self._needed(required))
        self.spectral_radius.update(s, dt2_over_m[None], bound)
        grown = self.spectral_radius.ratio_to_bound / ratio
        required *= grown
        return math.sqrt(grown)

    def decide(self, figures: dict[str, float]) -> tuple[bool, bool]:
        """See `Integrator`."""
        s = self.state
        due = s.time >= self.next_frame * self.frame_span - 0.5 * s.time_step
        if due:
            s.time = self.next_frame * self.frame_span  # without the round-off of its sum
            self.next_frame += 1
        if s.time >= self.end - 0.5 * s.time_step:
            return due, True
        if s.step >= self.spectral_radius.next_step:
            figures["step_ratio"] *= self._estimate_spectral_radius()
            if self.scales_mass:
                self._raise_mass(self.stability.required[0])
        shrunk = figures["step_ratio"] / self.safety
        allowed = self.longest if self.scales_mass else min(self.longest, s.time_step / shrunk)
        longer = False
        if s.step >= self.spectral_radius.next_step:  # the estimate has grown and is repeated
            self.interval = self.shortest_interval
        elif shrunk > SHRINK_INTERVAL_ABOVE:
            self.interval = max(self.shortest_interval, self.interval // 2)
        elif longer := shrunk < GROW_INTERVAL_BELOW and self.interval < self.longest_interval:
            self.interval = min(self.longest_interval, 2 * self.interval)
        fits = not longer and self.between <= self.interval and s.time_step <= allowed <= GROW_STEP_ABOVE * s.time_step
        if due or not fits:
            self._change_step(self._fitting(allowed, self.next_frame * self.frame_span - s.time))
        return due, False

    def reduce_step(self, restart: bool) -> None:
        """Steps shorter by a third, or twice the mass where the step needs it; checks twice as frequent."""
        self.safety /= math.sqrt(2)
        if not self.scales_mass:
            self.longest /= math.sqrt(2)
        self.interval = self.shortest_interval = max(1, self.shortest_interval // 2)

    def _change_step(self, time_step: float) -> None:
        s = self.state
        ratio = time_step / s.time_step
        if abs(ratio - 1) < 1e-12:
            return
        s.dt2_over_m *= ratio**2
        kernels.change_step(s.u, s.u_prev, s.f, s.dt2_over_m, ratio)
        s.time_step = time_step
