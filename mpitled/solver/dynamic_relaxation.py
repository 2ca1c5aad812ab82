"""Dynamic relaxation: damped steps in a fictitious time to the static solution, ended by the distance from it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.parallel.halo import Halo, World
from mpitled.parallel.subdomain import Subdomain
from mpitled.solver.integrator import Integrator
from mpitled.terms import Figure, Scene, Side, State
from mpitled.terms.motion import RelaxationUpdate
from mpitled.terms.restart import Scope, nodal, reduced, replicated
from mpitled.terms.term import energy

#: Steps between checks.
BETWEEN = 10
#: Steps between estimates of the spectral radius.
ESTIMATE_INTERVAL = 50
#: The trace of a mass tensor falls to no less than this share from one check to the next.
MAX_MASS_DROP = 0.9
#: The estimated distance has to hold for so many steps, and the lowest eigenvalue to change by less than this share in
#: BETWEEN of them: it falls while the fast modes that hide the slow ones decay.
CONVERGED_STEPS, EIGENVALUE_RTOL = 50, 0.1
#: `load_steps` = "auto": most strain per step of a cell next to moved nodes, if nothing yielded; and the load takes at
#: least as long as a shear wave across so many cells, because incompressible tissue has to flow.
STRAIN_PER_STEP, SHEAR_CELLS = 0.2, 14
#: The relaxation has stalled, by round-off, if so many checks in a row have not improved the best estimate by this
#: factor.
STALL_CHECKS, MIN_IMPROVEMENT = 300, 0.99
#: The best estimate is void if the lowest eigenvalue has fallen to this share of its value then: a slower mode has
#: appeared than the estimate was made from.
EIGENVALUE_DROP = 0.5


@dataclass(init=False, eq=False, repr=False)
class DynamicRelaxation(Integrator):
    """Steps of length 1 with mass tensors that make each node as fast as stability allows.

    After Joldes, Wittek and Miller (2011): damping is critical for the lowest eigenvalue, which is estimated in each
    check by Rayleigh's quotient of the last changes of displacements and forces. In addition the mass of a support
    domain is a tensor: next to a grown tumour its stiffness across the stretched layers is thousands of times that
    along them, and scalar masses would make motion along them slow. While the load grows there is no damping: it would
    hold nodes back, and a growing seed would run into them. The distance to the static solution is estimated from the
    slowest mode, as its speed over its frequency and as its acceleration over its frequency squared, whichever is more.
    """

    figures = (
        *Integrator.figures,
        energy("kinetic", Side.KINETIC, always=True),
        # By damping and by changes of the masses, from the work of the forces.
        energy("dissipated", Side.DISSIPATED, always=True),
        Figure("initial_energy", side=Side.WORK),  # of the state that the relaxation started from
        Figure("rayleigh_force"),
        Figure("rayleigh_mass"),
        Figure("change", "max"),  # m, of a displacement in the last step
        Figure("residual", "max"),  # m, M^-1 f
    )
    rollback_scope = Scope.ROLLBACK_TO_REST

    mass: NDArray[np.float64] = nodal()  # (1 or 6, n_nodes), kg
    u_last: NDArray[np.float64] = nodal()  # (3, n_nodes), m, at the last check
    f_last: NDArray[np.float64] = nodal()  # (3, n_nodes), N
    lowest: float = replicated(default=0.0)  # eigenvalue
    distance: float = replicated(default=math.inf)  # m, to the static solution
    best: float = replicated(default=math.inf)  # the shortest distance
    best_lowest: float = replicated(default=0.0)  # the lowest eigenvalue then
    n_checks_since_best: int = replicated(default=0)
    converged_steps: int = replicated(default=0)
    next_frame: int = replicated(default=0)
    initial_energy: float = reduced("sum", default=0.0)  # J
    safety: float = replicated(control=True)
    between: int = replicated(control=True, default=BETWEEN)
    load_time: float = replicated(control=True)  # steps in which the load grows

    def __init__(self, scene: Scene, frames: int, world: World, halo: Halo | None) -> None:
        """See `Integrator`."""
        super().__init__(scene, frames, world, halo, 1.0)
        sub, solver = self.sub, self.solver
        self.first_safety, self.tolerance = solver.safety, solver.tolerance
        # With load_steps = auto the method may slow the load itself.
        self.recovers = solver.on_inversion == "recover" or solver.load_steps == "auto"
        self.load_time = self.state.load_time = self._load_steps()
        components = self.mass_components(sub)
        # kg, (1 or 6, n_nodes)
        self.required = self.stability.required if components == 1 else np.zeros((components, sub.n_nodes))
        self.mass, self.state.dt2_over_m = (np.zeros((components, sub.n_nodes)) for _ in range(2))
        self.u_last, self.f_last = np.zeros((3, sub.n_nodes)), np.zeros((3, sub.n_nodes))
        (self.update,) = (term for term in self.step.update if isinstance(term, RelaxationUpdate))
        self.free = sub.free()
        self.spectral_radius.interval = ESTIMATE_INTERVAL

    @staticmethod
    def mass_components(sub: Subdomain) -> int:
        """See `Integrator`: tensors if the model has support domains."""
        return 6 if sub.rows.n_domains else 1

    def _load_steps(self) -> float:
        """Steps in which the load grows. Collective.

        A step carries a pressure wave about one cell farther, whatever the cell, and a shear wave by as much less as it
        is slower. What counts is the speed of moved nodes in cells per step, at most 15/8 of the mean on the loading
        curve. The load takes at least five checks.
        """
        given = self.solver.load_steps
        if given != "auto":
            return float(given)
        slowness = math.sqrt(max((m.lam + 2 * m.mu) / m.mu for m in self.sub.rows.materials))
        steepest = self._largest(self.sub.steepest_load())
        return max(5.0 * BETWEEN, math.ceil(SHEAR_CELLS * slowness), math.ceil(15 / 8 * steepest / STRAIN_PER_STEP))

    def start_from(self, s: State, stored: float) -> None:
        """Continue from the displacements of another run at full load, at rest. stored: energy (J) of this rank."""
        self.state.set_displacement(s.u)
        self.state.time = self.state.load_time
        self.u_last[:] = s.u[:, : self.sub.n_nodes]
        self.initial_energy = stored
        self.next_frame = self.frames

    def begin(self) -> None:
        """See `Integrator`."""
        self.step.apply_forces(self.state)
        self._find_required()
        self.mass[:] = self.required
        self._estimate_spectral_radius()
        self.state.f[:] = 0

    @property
    def stalled(self) -> bool:
        """Whether the distance no longer decreases, although it is above the tolerance."""
        return self.n_checks_since_best >= STALL_CHECKS

    @property
    def frame_time(self) -> float:
        """See `Integrator`."""
        return self.state.share

    @property
    def expected_steps(self) -> int:
        """Steps in which the load grows; nobody knows beforehand how many follow."""
        return round(self.load_time)

    @property
    def expected_checks(self) -> int:
        """Checks in these steps."""
        return math.ceil(self.expected_steps / self.between)

    @property
    def progress(self) -> float:
        """See `Integrator`: half for the load, half for the rest, estimated."""
        s = self.state
        if s.share < 1:
            return 0.5 * s.share
        done = math.log10(self.tolerance / min(max(self.distance, self.tolerance), 1.0)) / math.log10(self.tolerance)
        return 0.5 + 0.5 * max(0.0, min(1.0, 1 - abs(done)))

    def clear(self) -> None:
        """See `Integrator`."""
        super().clear()
        for array in (self.mass, self.state.dt2_over_m, self.u_last, self.f_last):
            array[:] = 0

    def check(self) -> dict[str, float]:
        """See `Integrator`."""
        s = self.state
        found = self._find_required()
        kernels.limit_mass_decrease(self.mass, self.required, self.free, MAX_MASS_DROP)
        kernels.invert_masses(self.mass, self.free, s.dt2_over_m)
        kinetic, work, force, mass, change, residual = kernels.relaxation_norms(
            s.u, s.u_prev, s.f, self.mass, s.dt2_over_m, self.update.counted, self.u_last, self.f_last
        )
        return found | {
            "kinetic": kinetic,
            "dissipated": -self.update.free_work - work - kinetic,
            "initial_energy": self.initial_energy,
            "step_ratio": self.safety,
            "rayleigh_force": force,
            "rayleigh_mass": mass,
            "change": change,
            "residual": residual,
        }

    def reduce_step(self, restart: bool) -> None:
        """From rest, with a load half as fast, twice the masses and checks twice as frequent.

        restart: with masses and checks as at first.
        """
        self.state.set_displacement(self.state.u)
        self.mass[:] = 0
        self.u_last[:] = self.state.u[:, : self.sub.n_nodes]
        self.safety = self.first_safety if restart else self.safety / math.sqrt(2)
        self.between = BETWEEN if restart else max(1, self.between // 2)
        self.load_time *= 2
        self.state.time *= self.load_time / self.state.load_time
        self.state.load_time = self.load_time

    def _find_required(self) -> dict[str, float]:
        """Evaluate stability, and set `required` to the masses that a stable step needs, on all ranks."""
        if self.required is self.stability.required:
            found = self.stability.evaluate(self.state, self.step.terms, self.safety)
        else:
            self.required[:] = 0
            found = self.stability.evaluate(self.state, self.step.terms, self.safety, self.required)
            for diagonal in (0, 3, 5):
                self.required[diagonal] += self.stability.required[0]
        self._masses(self.required)
        return found

    def _estimate_spectral_radius(self) -> None:
        """Renew the spectral radius, by which the required masses are relaxed."""
        s, ratio = self.state, self.spectral_radius.ratio_to_bound or 1.0
        kernels.invert_masses(self.required, self.free, s.dt2_over_m)
        self.spectral_radius.update(s, s.dt2_over_m, (2 * self.safety) ** 2 / ratio)
        self.mass *= self.spectral_radius.ratio_to_bound / ratio
        kernels.invert_masses(self.mass, self.free, s.dt2_over_m)

    def decide(self, figures: dict[str, float]) -> tuple[bool, bool]:
        """See `Integrator`; sets the damping."""
        s = self.state
        if s.step >= self.spectral_radius.next_step and s.share < 1:
            self._estimate_spectral_radius()
        known = figures["rayleigh_force"] / figures["rayleigh_mass"] if figures["rayleigh_mass"] > 0 else 0.0
        loaded, steady, before = s.share >= 1, False, self.distance
        if loaded:
            if known > 0:
                steady = abs(known - self.lowest) < EIGENVALUE_RTOL * self.between / BETWEEN * self.lowest
                self.lowest = known
            if self.lowest > 0:
                self.distance = max(figures["change"] / math.sqrt(self.lowest), figures["residual"] / self.lowest)
            elif figures["change"] == figures["residual"] == 0:
                self.distance = 0.0  # nothing has ever moved
            steady = steady or self.distance < 1e-6 * self.tolerance  # round-off, whose quotient is no eigenvalue
            converged = steady and self.distance < self.tolerance
            self.converged_steps = self.converged_steps + self.between if converged else 0
        damping = 2 * math.sqrt(self.lowest)
        s.c1, s.c2 = (2 - damping) / (2 + damping), 2 / (2 + damping)
        if steady and (self.distance < MIN_IMPROVEMENT * self.best or self.lowest < EIGENVALUE_DROP * self.best_lowest):
            self.best, self.best_lowest, self.n_checks_since_best = self.distance, self.lowest, 0
        self.n_checks_since_best += loaded
        # A growing estimate is being overtaken by a slower mode, which the eigenvalue does not show yet.
        shrinks = self.distance <= max(before, 1e-6 * self.tolerance)
        if (self.converged_steps >= CONVERGED_STEPS and shrinks) or self.stalled:
            return True, True
        due = self.next_frame < self.frames and s.share >= self.next_frame / self.frames
        self.next_frame += due
        return due, False
