"""The step of a scene, composed of the terms that it needs: a term that a scene lacks is not in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.halo import Halo
from mpitled.loading import loading_curve
from mpitled.subdomain import Subdomain


@dataclass(slots=True)
class State:
    """What a step changes, on one rank."""

    u: NDArray[np.float64]  # (3, n_nodes + PADDING), m, at the time of `step`
    u_prev: NDArray[np.float64]  # (3, n_nodes + PADDING), m, one step before
    f: NDArray[np.float64]  # (3, n_nodes + PADDING), N, internal forces
    mass: NDArray[np.float64]  # (n_nodes,), kg, as scaled
    mobility: NDArray[np.float64]  # (n_nodes,), s^2/kg, dt^2 / mass
    reaction: NDArray[np.float64]  # (n owned moving dofs,), N
    n_steps: int
    time_step: float  # s
    step: int = 0
    smallest_jacobian: float = 1.0  # of all steps so far
    external_work: float = 0.0  # J, of the moving dofs that this rank owns

    @property
    def share(self) -> float:
        """Share of the load time that has passed."""
        return self.step / self.n_steps


Term = tuple[str, Callable[[State], None]]


def start(sub: Subdomain, n_steps: int, time_step: float) -> State:
    """The state at rest."""
    u, u_prev, f = (np.zeros((3, sub.n_nodes + kernels.PADDING)) for _ in range(3))
    mass = sub.rows.mass.copy()
    owned_moving = int(np.count_nonzero(sub.rows.owned[sub.moving // 3]))
    return State(u, u_prev, f, mass, time_step**2 / mass, np.zeros(owned_moving), n_steps, time_step)


def compose(sub: Subdomain, halo: Halo | None) -> tuple[Term, ...]:
    """The terms of a step, in order: forces of each kind of cell, the halo's sum, the reactions, the update."""
    terms: list[Term] = []
    runs, hexahedra, domains = sub.runs, sub.hexahedra, sub.domains
    if runs is not None:

        def voxels(s: State) -> None:
            J = kernels.voxel_forces(s.u, s.f, runs.start, runs.length, runs.scale, runs.coefficient)
            s.smallest_jacobian = min(s.smallest_jacobian, J)

        terms.append(("voxel hexahedra", voxels))
    if hexahedra is not None:

        def general(s: State) -> None:
            J = kernels.hexahedron_forces(s.u, s.f, hexahedra.nodes, hexahedra.geometry, hexahedra.coefficient)
            s.smallest_jacobian = min(s.smallest_jacobian, J)

        terms.append(("hexahedra", general))
    if domains is not None:

        def support_domains(s: State) -> None:
            J = kernels.domain_forces(
                s.u, s.f, domains.nodes, domains.gradient, domains.position, domains.inverse, domains.coefficient,
                domains.members,
            )  # fmt: skip
            s.smallest_jacobian = min(s.smallest_jacobian, J)

        terms.append(("support domains", support_domains))
    if halo is not None:
        terms.append(("halo", lambda s: halo.sum(s.f)))
    owned = sub.rows.owned[sub.moving // 3]
    full, turns = sub.moving_full, sub.moving_turns
    dofs, own_full, share = sub.moving[owned], full[owned], _share_of_load
    if turns is not None:
        ends, own_ends, own_turns = full, own_full, turns[owned]
        full, own_full, share = full.copy(), own_full.copy(), _all

        def motion(s: State) -> None:
            target = _share_of_load(s)
            kernels.follow(full, ends, turns, target)
            kernels.follow(own_full, own_ends, own_turns, target)

        terms.append(("motion", motion))
    if len(dofs):

        def reactions(s: State) -> None:
            s.external_work += kernels.react(
                s.u, s.u_prev, s.f, s.mass, dofs, own_full, share(s), s.reaction, s.time_step
            )

        terms.append(("reactions", reactions))

    def update(s: State) -> None:
        kernels.update(s.u, s.u_prev, s.f, s.mobility, sub.fixed, sub.moving, full, share(s))
        s.u, s.u_prev = s.u_prev, s.u
        s.step += 1

    terms.append(("update", update))
    return tuple(terms)


def _share_of_load(s: State) -> float:
    """Share of the full load at the end of the step."""
    return loading_curve((s.step + 1) / s.n_steps)


def _all(s: State) -> float:
    """Where `motion` has the displacements of the present step."""
    return 1.0


@dataclass(slots=True)
class Survey:
    """Looks at all cells of a rank every few steps: energies, J, and the mass that the step needs for stability.

    The step is stable where each node's mass is at least dt^2 / 4 times the sum of its cells' largest eigenvalues, for
    which the kernels give a bound in the present configuration; `safety` keeps the step that far below. Nodes that are
    prescribed in every direction need no mass.
    """

    sub: Subdomain
    halo: Halo | None  # of one component
    scales_mass: bool
    safety: float
    jacobian: NDArray[np.float64] = field(init=False)  # (n_cells + 1,), the last for lanes without a cell
    required: NDArray[np.float64] = field(init=False)  # (1, n_nodes), kg
    held: NDArray[np.uint32] = field(init=False)  # prescribed dofs
    prescribed: NDArray[np.int64] = field(init=False)  # nodes prescribed in every direction
    added_mass: float = 0.0  # kg, on owned nodes
    added_energy: float = 0.0  # J

    def __post_init__(self) -> None:
        self.jacobian = np.ones(self.sub.n_cells + 1)
        self.required = np.zeros((1, self.sub.n_nodes))
        self.held = np.concatenate([self.sub.fixed, self.sub.moving])
        nodes, directions = np.unique(self.held // 3, return_counts=True)
        self.prescribed = nodes[directions == 3].astype(np.int64)

    def look(self, s: State) -> dict[str, float]:
        """This rank's share of the figures at the present step, for which the forces are in s.f.

        Sums: "external", "strain", "hourglass", "stabilisation", "kinetic", "added" (J), "added_mass" (kg). Extremes:
        "min_jacobian" (of all steps), "step_ratio" (the step over the one that the bound proves stable).
        """
        sub, required, jacobian = self.sub, self.required[0], self.jacobian
        required[:] = 0
        factor = (s.time_step / (2 * self.safety)) ** 2
        strain = hourglass = stabilisation = 0.0
        if (r := sub.runs) is not None:
            strain, hourglass = kernels.voxel_survey(
                s.u, r.start, r.length, r.first_cell, r.scale, r.coefficient, r.gram, required, factor, jacobian
            )
        if (h := sub.hexahedra) is not None:
            more, resisted = kernels.hexahedron_survey(
                s.u, h.nodes, h.cells, h.geometry, h.coefficient, h.gram, h.stiffness, required, factor, jacobian
            )
            strain += more
            hourglass += resisted
        if (d := sub.domains) is not None:
            more, stabilisation = kernels.domain_survey(
                s.u, d.nodes, d.cells, d.gradient, d.position, d.inverse, d.coefficient, d.gram, d.stiffness,
                required, factor, jacobian, d.members,
            )  # fmt: skip
            strain += more
        if self.halo is not None:
            self.halo.sum(self.required)
        required[self.prescribed] = 0
        owned = sub.rows.owned
        kinetic = kernels.kinetic_energy(s.u, s.u_prev, s.f, s.mass, owned, self.held, s.time_step)
        s.smallest_jacobian = min(s.smallest_jacobian, float(jacobian[:-1].min()))
        ratio = self.safety * float(np.sqrt((required / s.mass).max()))
        if self.scales_mass:
            mass, energy = kernels.raise_mass(s.u, s.u_prev, s.mass, s.mobility, required, owned, s.time_step)
            self.added_mass += mass
            self.added_energy += energy
            ratio = min(ratio, self.safety)
        return {
            "external": s.external_work,
            "strain": strain,
            "hourglass": hourglass,
            "stabilisation": stabilisation,
            "kinetic": kinetic,
            "added": self.added_energy,
            "added_mass": self.added_mass,
            "min_jacobian": s.smallest_jacobian,
            "step_ratio": ratio,
        }
