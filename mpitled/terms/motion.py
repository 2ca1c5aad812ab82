"""Terms that move the nodes: the work of prescribed displacements, and the update of all displacements."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.parallel.subdomain import Subdomain
from mpitled.terms.restart import owned_dofs, reduced
from mpitled.terms.state import State
from mpitled.terms.term import Method, Scene, Side, StabilityBound, Stage, Term, energy


class PrescribedMotion:
    """Displacements of moving dofs at the next step: `share(state)` times `full`.

    Where nodes rotate, `share` renews `full` to the next position and returns 1.
    """

    def __init__(self, sub: Subdomain, owned_only: bool) -> None:
        some = sub.rows.owned[sub.moving // 3] if owned_only else slice(None)
        self.dofs = sub.moving[some]  # (n,), 3 node + direction
        self.full = sub.moving_full[some]  # (n,), m
        self.share: Callable[[State], float] = lambda s: s.next_load
        if sub.moving_turns is not None:
            ends, turns, path = self.full, sub.moving_turns[some], self.full.copy()

            def rotate(s: State) -> float:
                kernels.rotate_prescribed(path, ends, turns, s.next_load)
                return 1.0

            self.full, self.share = path, rotate


@dataclass(slots=True, eq=False)
class Reactions(Term):
    """Reactions at moving dofs and their work, the external work. In relaxation moving dofs have no inertia."""

    motion: PrescribedMotion
    has_inertia: bool
    reaction: NDArray[np.float64] = owned_dofs()  # N
    external_work: float = reduced("sum", default=0.0)  # J, of the dofs that this rank owns

    name = "reactions"
    stage = Stage.WORK
    figures = (energy("external", Side.WORK, "external_work", always=True),)

    @classmethod
    def from_scene(cls, scene: Scene) -> Iterator[Term]:
        """Where any dof of any rank moves."""
        if scene.anywhere(len(scene.sub.moving) > 0):
            motion = PrescribedMotion(scene.sub, owned_only=True)
            yield cls(motion, scene.method is not Method.RELAXATION, np.zeros(len(motion.dofs)))

    @classmethod
    def left_out(cls, scene: Scene, present: bool) -> Iterator[str]:
        """Nodes that are moved or rotated."""
        if not len(scene.sub.moving):
            yield f"{cls.name}: no node is moved" + (" on this rank" if scene.sub.rows.n_parts > 1 else "")
        if scene.sub.moving_turns is None:
            yield "rotation of prescribed nodes: no node is rotated"

    def apply(self, s: State) -> None:
        """Add the work of the last step by the trapezoidal rule."""
        m, dt2_over_m = self.motion, s.dt2_over_m if self.has_inertia else None
        self.external_work += kernels.reaction_work(
            s.u, s.u_prev, s.f, dt2_over_m, m.dofs, m.full, m.share(s), self.reaction
        )

    def check(self, s: State, bound: StabilityBound) -> Mapping[str, float]:
        """The external work."""
        return {"external": self.external_work}


class _Update(Term):
    """Base of the terms that move the nodes and end the step."""

    name = "update"
    stage = Stage.UPDATE

    def _prepare(self, sub: Subdomain) -> None:
        self._fixed, self._motion = sub.fixed, PrescribedMotion(sub, owned_only=False)
        # The cells read u itself, or a copy in single precision that the kernel fills.
        self._aliased = sub.precision == np.float64
        self._copy: Callable[[State], Any] = (lambda s: None) if self._aliased else (lambda s: s.u_cells)
        self._end_step = _swap_and_alias if self._aliased else _swap


def _swap(s: State) -> None:
    s.u, s.u_prev = s.u_prev, s.u
    s.time += s.time_step
    s.step += 1


def _swap_and_alias(s: State) -> None:
    _swap(s)
    s.u_cells = s.u


class CentralDifferenceUpdate(_Update):
    """The central difference with scalar masses."""

    def __init__(self, sub: Subdomain) -> None:
        self._prepare(sub)

    @classmethod
    def from_scene(cls, scene: Scene) -> Iterator[Term]:
        """For all methods but relaxation."""
        if scene.method is not Method.RELAXATION:
            yield cls(scene.sub)

    @classmethod
    def left_out(cls, scene: Scene, present: bool) -> Iterator[str]:
        """The method, and the copy of displacements in another precision."""
        if not present:
            yield f'central difference, mass scaling, kinetic energy: solver.method = "{scene.method.value}"'
        elif scene.method is Method.DYNAMIC:
            yield f'mass scaling: solver.method = "{scene.method.value}"'
        elif not scene.solver.mass_scaling:
            yield "mass scaling: solver.mass_scaling = false"
        if scene.sub.precision == np.float64:
            yield f'copy of displacements for the cells: solver.precision = "{scene.solver.precision}"'

    def apply(self, s: State) -> None:
        """Move the nodes and end the step."""
        m = self._motion
        kernels.update(s.u, s.u_prev, s.f, s.dt2_over_m, self._fixed, m.dofs, m.full, m.share(s), self._copy(s))
        self._end_step(s)


@dataclass(eq=False)
class RelaxationUpdate(_Update):
    """The damped update with a mass tensor at each node."""

    sub: Subdomain
    counted: NDArray[np.bool_] = field(init=False)  # (3, n_nodes), free dofs that the rank owns
    #: J, of the internal forces at free dofs that this rank owns.
    free_work: float = reduced("sum", default=0.0)

    def __post_init__(self) -> None:
        self._prepare(self.sub)
        self.counted = self.sub.free() & self.sub.rows.owned

    @classmethod
    def from_scene(cls, scene: Scene) -> Iterator[Term]:
        """For relaxation."""
        if scene.method is Method.RELAXATION:
            yield cls(scene.sub)

    @classmethod
    def left_out(cls, scene: Scene, present: bool) -> Iterator[str]:
        """The method, and mass tensors."""
        if not present:
            yield f'relaxation, damping, mass tensors: solver.method = "{scene.method.value}"'
        elif not scene.sub.rows.n_domains:
            yield "mass tensors: no support domains, whose stiffness depends on the direction"

    def apply(self, s: State) -> None:
        """Move the nodes and end the step."""
        m = self._motion
        self.free_work += kernels.relax(
            s.u, s.u_prev, s.f, s.dt2_over_m, self.counted, self._fixed, m.dofs, m.full, m.share(s), s.c1, s.c2,
            self._copy(s),
        )  # fmt: skip
        self._end_step(s)
