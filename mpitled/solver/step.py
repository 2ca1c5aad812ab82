"""The step of a scene, composed of the terms that it needs: a term that a scene lacks is not in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.cells.packing import Forces, PackedCells
from mpitled.model.loading import loading_curve
from mpitled.parallel.halo import Halo
from mpitled.parallel.subdomain import Subdomain
from mpitled.solver.restart import Kept


@dataclass(slots=True)
class State:
    """What a step changes, on one rank."""

    #: `seen` and `f` follow from u.
    KEPT: ClassVar = Kept(
        nodes=("u", "u_prev", "mobility"),
        moving=("reaction",),
        sums=("external_work", "free_work"),
        least=("smallest_jacobian",),
        alike=("load_time", "time_step", "time", "step", "retain", "gain"),
    )
    #: Of a state that is gone on from at rest, with masses made anew.
    KEPT_AT_REST: ClassVar = replace(KEPT.numbers, rough=("u",))

    u: NDArray[np.float64]  # (3, n_nodes + PADDING), m, at the time of `step`
    u_prev: NDArray[np.float64]  # (3, n_nodes + PADDING), m, one step before
    seen: NDArray[np.floating]  # u as the cells read it: u itself, or its copy in single precision
    f: NDArray[np.floating]  # (3, n_nodes + PADDING), N, internal forces, in the precision of `seen`
    mobility: NDArray[np.float64]  # (n_nodes,), s^2/kg: dt^2 / m, m as scaled; in relaxation its tensors (6, n_nodes)
    reaction: NDArray[np.float64]  # (n owned moving dofs,), N
    good: NDArray[np.float32]  # (3, n_nodes), m, the last displacements that were found good; room between steps
    load_time: float  # s
    time_step: float  # s
    time: float = 0.0  # s
    step: int = 0
    retain: float = 1.0  # share of the last step's motion that the next keeps in relaxation, and
    gain: float = 1.0  # of the force that acts: see `kernels.relax`
    smallest_jacobian: float = 1.0  # of all steps so far
    external_work: float = 0.0  # J, of the moving dofs that this rank owns
    free_work: float = 0.0  # J, of the internal forces at free dofs that this rank owns; counted in relaxation

    def place(self, u: NDArray[np.floating]) -> None:
        """Put the nodes at the displacements u (3, n_nodes), at rest."""
        self.u[:, : u.shape[1]] = self.u_prev[:, : u.shape[1]] = u
        self.show()

    def rest(self) -> None:
        """Back to no displacement."""
        for array in (self.u, self.u_prev, self.seen, self.f, self.reaction):
            array[:] = 0

    def show(self) -> None:
        """Let the cells see u after it was changed from outside, with no forces yet."""
        self.seen[:] = self.u
        self.f[:] = 0

    @property
    def share(self) -> float:
        """Share of the load time that has passed."""
        return min(1.0, self.time / self.load_time)

    @property
    def next_load(self) -> float:
        """Share of the full load after the next step."""
        return loading_curve((self.time + self.time_step) / self.load_time)


Term = tuple[str, Callable[[State], None]]


def at_rest(sub: Subdomain, load_time: float, time_step: float) -> State:
    """The undeformed state, with the model's masses."""
    u, u_prev = (np.zeros((3, sub.n_nodes + kernels.PADDING)) for _ in range(2))
    seen = u if sub.precision == u.dtype else u.astype(sub.precision)
    f = np.zeros_like(seen)
    mobility = time_step**2 / sub.rows.read("mass")
    owned_moving = int(np.count_nonzero(sub.rows.owned[sub.moving // 3]))
    good = np.zeros((3, sub.n_nodes), np.float32)
    return State(u, u_prev, seen, f, mobility, np.zeros(owned_moving), good, load_time, time_step)


def compose_forces(sub: Subdomain, halo: Halo | None) -> tuple[Term, ...]:
    """The terms that make the nodal forces, in order: each kind of cell that is there.

    With a halo the cells that have shared nodes come first, and the others while their forces travel: a rank that was
    held up for a moment does not hold up its neighbours.
    """
    if halo is None:
        return _compose_cells(sub, lambda cells: slice(None))
    return (
        *_compose_cells(sub, lambda cells: slice(cells.n_border)),
        ("halo", lambda s: halo.start(s.f)),
        *_compose_cells(sub, lambda cells: slice(cells.n_border, None)),
        ("halo", lambda s: halo.finish(s.f)),
    )


def _compose_cells(sub: Subdomain, part: Callable[[PackedCells], slice]) -> tuple[Term, ...]:
    """The terms of a part of the runs and batches."""
    return tuple(
        (cells.name, _cell_forces(cells.forces(part(cells))))
        for cells in sub.packed
        if len(range(len(cells))[part(cells)])
    )


def _cell_forces(forces: Forces) -> Callable[[State], None]:
    def add(s: State) -> None:
        s.smallest_jacobian = min(s.smallest_jacobian, forces(s.seen, s.f))

    return add


@dataclass(frozen=True, slots=True)
class _Motion:
    """Where the moving dofs go next: a share of where they go at full load, which on arcs asking for it renews."""

    full: NDArray[np.float64]  # (n moving dofs,), m
    dofs: NDArray[np.uint32]  # (n owned moving dofs,)
    own_full: NDArray[np.float64]  # m
    share: Callable[[State], float]  # of full
    own_share: Callable[[State], float]  # of own_full


def _compose_motion(sub: Subdomain) -> _Motion:
    owned = sub.rows.owned[sub.moving // 3]
    full, turns = sub.moving_full, sub.moving_turns
    dofs, own_full = sub.moving[owned], full[owned]
    if turns is None:
        return _Motion(full, dofs, own_full, lambda s: s.next_load, lambda s: s.next_load)
    ends, own_ends, own_turns = full, own_full, turns[owned]
    full, own_full = full.copy(), own_full.copy()

    def follow(s: State) -> float:
        kernels.follow(full, ends, turns, s.next_load)
        return 1.0

    def own_follow(s: State) -> float:
        kernels.follow(own_full, own_ends, own_turns, s.next_load)
        return 1.0

    return _Motion(full, dofs, own_full, follow, own_follow)


def compose_march(sub: Subdomain) -> tuple[Term, ...]:
    """The terms that move the nodes by their masses: the reactions where any dof moves, then the central difference."""
    m, (copied, advance) = _compose_motion(sub), _compose_copy(sub)

    def reactions(s: State) -> None:
        s.external_work += kernels.react(s.u, s.u_prev, s.f, s.mobility, m.dofs, m.own_full, m.own_share(s), s.reaction)

    def update(s: State) -> None:
        kernels.update(s.u, s.u_prev, s.f, s.mobility, sub.fixed, sub.moving, m.full, m.share(s), copied(s))
        advance(s)

    return (*((("reactions", reactions),) if len(m.dofs) else ()), ("update", update))


def compose_relaxation(sub: Subdomain, counted: NDArray[np.bool_]) -> tuple[Term, ...]:
    """As `compose_march`, damped, and with a mass tensor at each node; counted (3, n_nodes): see `kernels.relax`."""
    m, (copied, advance) = _compose_motion(sub), _compose_copy(sub)

    def reactions(s: State) -> None:
        s.external_work += kernels.react(s.u, s.u_prev, s.f, None, m.dofs, m.own_full, m.own_share(s), s.reaction)

    def relax(s: State) -> None:
        s.free_work += kernels.relax(
            s.u, s.u_prev, s.f, s.mobility, counted, sub.fixed, sub.moving, m.full, m.share(s), s.retain, s.gain,
            copied(s),
        )  # fmt: skip
        advance(s)

    return (*((("reactions", reactions),) if len(m.dofs) else ()), ("update", relax))


def take(s: State, terms: tuple[Term, ...]) -> None:
    """Take the terms in their order. Collective if there is a halo among them."""
    for _, term in terms:
        term(s)


def rehearse(s: State, terms: tuple[Term, ...]) -> None:
    """Take the terms once without other ranks, so that their kernels are compiled or loaded from the disk's cache."""
    for name, term in terms:
        if name != "halo":
            term(s)


def _compose_copy(sub: Subdomain) -> tuple[Callable[[State], Any], Callable[[State], None]]:
    """What an update fills with the new displacements for the cells to read, and what ends the step."""

    def swap(s: State) -> None:
        s.u, s.u_prev = s.u_prev, s.u
        s.time += s.time_step
        s.step += 1

    def swap_and_see(s: State) -> None:
        swap(s)
        s.seen = s.u

    if sub.precision == np.float64:
        return (lambda s: None), swap_and_see
    return (lambda s: s.seen), swap
