"""Marching through time: the central difference with the model's masses, scaled (quasi-static) or not (dynamic)."""

from __future__ import annotations

import math
from copy import copy, deepcopy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.deck import Solver
from mpitled.errors import InputError
from mpitled.halo import Halo
from mpitled.step import at_rest, compose_forces, compose_march, rehearse
from mpitled.subdomain import Subdomain
from mpitled.survey import Survey

#: The cells are surveyed at least so many times in a run, and at least once in so many steps.
SURVEYS, LONGEST_UNWATCHED = 100, 50
#: A step that was shortened grows again when it could be longer by this factor.
REGAIN = 1.25


class March:
    """A run in steps of time. Every rank takes the same decisions, from figures that are the same on all.

    Where the step is longer than the survey proves stable, either the nodes that need it become heavier (quasi-static
    runs with `mass_scaling`) or the step shorter, with the central difference for variable steps.
    """

    def __init__(
        self,
        solver: Solver,
        frames: int,
        sub: Subdomain,
        force_halo: Halo | None,
        halo: Halo | None,
        model: dict[str, Any],
    ) -> None:
        """halo sums one component; model: figures of the preprocessor. InputError for too long a step."""
        self.sub, self.halo, self.safety = sub, halo, solver.safety
        self.scales_mass = solver.mass_scaling and solver.method == "quasi-static"
        if solver.time_step == "auto":
            typical = model["critical_step_typical_s" if self.scales_mass else "critical_step_min_s"]
            self.longest = solver.safety * typical
        else:
            self.longest, critical = float(solver.time_step), model["critical_step_min_s"]
            if not self.scales_mass and self.longest > critical:
                raise InputError(
                    f"solver.time_step = {self.longest:g}: is longer than the critical step of the undeformed model, "
                    f"{critical:.3g} s; give at most {math.floor(critical * 1e8) / 1e8:g}, or leave it to auto"
                )
        self.end = solver.load_time + solver.hold_time
        self.frame_span = self.end / frames
        self.frame = 0
        n_steps = self.end / self.longest
        self.between = int(min(LONGEST_UNWATCHED, max(1, n_steps // SURVEYS)))
        self.state = at_rest(sub, solver.load_time, self._fitting(self.longest, self.frame_span))
        self.survey = Survey(sub)
        self.held = np.concatenate([sub.fixed, sub.moving])
        nodes, directions = np.unique(self.held // 3, return_counts=True)
        self.prescribed: NDArray[np.int64] = nodes[directions == 3].astype(np.int64)  # need no mass for stability
        self.added_mass, self.added_energy = 0.0, 0.0
        self.forces, self.motion = compose_forces(sub, force_halo), compose_march(sub)

    def _fitting(self, longest: float, span: float) -> float:
        """The longest step, none longer than that, of which whole surveys fill the span."""
        return span / (self.between * math.ceil(span / (longest * self.between) * (1 - 1e-9)))

    @property
    def frame_time(self) -> float:
        """Time of the present frame, s."""
        return self.state.time

    @property
    def progress(self) -> float:
        """Share of the run that is done."""
        return self.state.time / self.end

    def warm_up(self) -> None:
        """Call every kernel once, on the state at rest, without other ranks."""
        twin = copy(self)
        twin.state, twin.halo = deepcopy(self.state), None
        rehearse(twin.state, (*self.forces, *self.motion))
        twin.look()

    def look(self) -> dict[str, float]:
        """This rank's share of the figures at the present time, for which the forces are there.

        Sums, in J: "external", "strain", "hourglass", "stabilisation", "kinetic", "added", "dissipated"; in kg:
        "added_mass". Extremes: "min_jacobian" (of all steps), "step_ratio": the step over the one proved stable.
        """
        s, required = self.state, self.survey.required[0]
        found = self.survey.look(s, self.safety)
        if self.halo is not None:
            self.halo.sum(self.survey.required)
        required[self.prescribed] = 0
        owned = self.sub.rows.owned
        found["kinetic"] = kernels.kinetic_energy(s.u, s.u_prev, s.f, s.mass, owned, self.held, s.time_step)
        found["step_ratio"] = self.safety * float(np.sqrt((required / s.mass).max()))
        if self.scales_mass:
            mass, energy = kernels.raise_mass(s.u, s.u_prev, s.mass, s.mobility, required, owned, s.time_step)
            self.added_mass += mass
            self.added_energy += energy
            found["step_ratio"] = min(found["step_ratio"], self.safety)
        return found | {
            "external": s.external_work,
            "added": self.added_energy,
            "added_mass": self.added_mass,
            "dissipated": 0.0,
        }

    def decide(self, figures: dict[str, float]) -> tuple[bool, bool]:
        """The length of the next steps; whether a frame is due now, and whether it is the last."""
        s = self.state
        due = s.time >= self.frame * self.frame_span - 0.5 * s.time_step
        if due:
            s.time = self.frame * self.frame_span  # without the round-off of its sum
            self.frame += 1
        if s.time >= self.end - 0.5 * s.time_step:
            return due, True
        allowed = min(self.longest, s.time_step * self.safety / figures["step_ratio"])
        if due or allowed < s.time_step or allowed > REGAIN * s.time_step:
            self._take(self._fitting(allowed, self.frame * self.frame_span - s.time))
        return due, False

    def _take(self, time_step: float) -> None:
        s = self.state
        ratio = time_step / s.time_step
        if abs(ratio - 1) < 1e-12:
            return
        np.divide(time_step**2, s.mass, out=s.mobility)
        kernels.change_step(s.u, s.u_prev, s.f, s.mobility, ratio)
        s.time_step = time_step
