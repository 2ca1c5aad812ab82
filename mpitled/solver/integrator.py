"""What an integrator is: the state, the composed step, and the decisions between steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mpitled.parallel.halo import Halo, World
from mpitled.parallel.subdomain import Subdomain
from mpitled.solver.spectral_radius import SpectralRadius
from mpitled.solver.stability_check import StabilityCheck
from mpitled.terms import Figure, Scene, State, Step, warm_up
from mpitled.terms.restart import Objects, Scope, declared, restore, snapshot


class Integrator(ABC):
    """Advances a state through its load. All ranks take the same decisions, from figures that are the same on all."""

    figures: ClassVar[tuple[Figure, ...]] = (
        Figure("min_jacobian", "min", "min_jacobian", always=True),  # of all steps so far
        Figure("step_ratio", "max", "step_ratio", always=True),  # the step over the longest stable one
    )
    rollback_scope: ClassVar[Scope]

    recovers: bool  # whether an unstable run rolls back
    safety: float  # share of the longest stable step
    between: int  # steps between checks

    def __init__(self, scene: Scene, frames: int, world: World, halo: Halo | None, load_time: float) -> None:
        """halo sums nodal masses of `mass_components`. Collective."""
        self.scene, self.sub, self.solver, self.world, self.halo = scene, scene.sub, scene.solver, world, halo
        self.frames, self.safety = frames, scene.solver.safety
        self.state = State.at_rest(self.sub, load_time, 1.0)
        self.step = Step(scene)
        self.stability = StabilityCheck(self.sub)
        self.spectral_radius = SpectralRadius(self.sub, world, self.step.forces)

    @staticmethod
    def mass_components(sub: Subdomain) -> int:
        """Components of the nodal mass: 1 (scalar) or 6 (symmetric tensor)."""
        return 1

    @property
    def restart_objects(self) -> Objects:
        """All objects of the integrator that have restart fields, by name."""
        terms = {f"term {term.name}": term for term in self.step.terms if declared(term)}
        return {"integrator": self, "spectral_radius": self.spectral_radius, "state": self.state, **terms}

    @property
    @abstractmethod
    def frame_time(self) -> float:
        """Time of the present frame, s; in relaxation, whose time is fictitious, the share of the load."""

    @property
    @abstractmethod
    def expected_steps(self) -> int:
        """Steps of the run, as far as they are known."""

    @property
    @abstractmethod
    def expected_checks(self) -> int:
        """Stability checks in these steps."""

    @property
    @abstractmethod
    def progress(self) -> float:
        """Share of the run that is done."""

    @abstractmethod
    def begin(self) -> None:
        """Find the first step. Collective. InputError, the same on all ranks, if `solver.time_step` is too long."""

    @abstractmethod
    def check(self) -> dict[str, float]:
        """This rank's figures at the present time, whose forces are complete; renews masses. Collective."""

    @abstractmethod
    def decide(self, figures: dict[str, float]) -> tuple[bool, bool]:
        """Set the next steps by the figures of all ranks; whether a frame is due, and whether it is the last."""

    @abstractmethod
    def reduce_step(self, restart: bool) -> None:
        """Continue more carefully after a rollback; restart: from where the load began."""

    def warm_up(self) -> None:
        """Call every kernel once, on the state at rest and without effect or other ranks."""
        before = snapshot(self.restart_objects, Scope.NUMBERS)
        halo, self.halo = self.halo, None
        state = self.state
        self.state = copy(state)  # numbers are copies; arrays are not: they may be the largest of the run
        warm_up(self.state, self.step.terms)
        self.check()
        self.state, self.halo = state, halo
        restore(self.restart_objects, Scope.NUMBERS, before)
        self.clear()

    def clear(self) -> None:
        """Set displacements, forces and the arrays of terms to 0."""
        self.state.clear()
        for term in self.step.terms:
            term.clear()

    def _largest(self, value: float) -> float:
        return float(self.world.gather([value]).max())

    def _masses(self, required: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum required masses (components, n_nodes) over the ranks and relax them by the spectral radius, in place."""
        if self.halo is not None:
            self.halo.sum(required)
        required *= self.spectral_radius.ratio_to_bound or 1.0
        return required
