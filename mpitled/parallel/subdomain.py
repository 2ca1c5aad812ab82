"""One rank's part of the model in local numbers, packed as the kernels want it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mpitled.cells import hexahedra, hexahedron_batches, support_domain_batches, voxel_runs
from mpitled.cells.packing import LocalCells, PackedCells
from mpitled.store import PartRows

#: Costs in a step of relaxation, in those of a box in a run with its node: of a hexahedron that is gathered, and of
#: each node of a support domain. A march asks 0.40 for that, single precision 0.26.
GATHERED_COST = 3.8
DOMAIN_NODE_COST = 0.36
#: What `solver.precision` means for the cells' arithmetic.
PRECISIONS: dict[str, type[np.floating]] = {"double": np.float64, "single": np.float32}


@dataclass(frozen=True, slots=True)
class Subdomain:
    """The part of the model on one rank, in local numbers and SI units.

    A cell lives on exactly one rank. A node lives on every rank whose cells touch it; all of them move it alike, and
    its owner alone writes it and counts it in sums. Local cells are hexahedra first, then support domains.
    """

    rows: PartRows
    domain_nodes: NDArray[np.uint32]  # (n_domains, n)
    domain_shapes: NDArray[np.float64]  # (n_domains, n), at their integration points
    n_nodes: int
    n_cells: int
    packed: tuple[PackedCells, ...]  # the cells as the kernels take them, by kind and law
    fixed: NDArray[np.uint32]  # dofs (3 node + direction) that stay where they are
    moving: NDArray[np.uint32]  # dofs that follow the loading curve
    moving_full: NDArray[np.float64]  # (len(moving),), m at full load
    moving_turns: NDArray[np.float64] | None  # (len(moving), 3), see `loading.turn`; None where all move straight
    shared: tuple[tuple[int, NDArray[np.uint32]], ...]  # (rank, nodes shared with it), ranks ascending
    precision: type[np.floating]  # of the cells' arithmetic

    @property
    def held(self) -> NDArray[np.uint32]:
        """Prescribed dofs, fixed and moving."""
        return np.concatenate([self.fixed, self.moving])

    def free(self) -> NDArray[np.bool_]:
        """(3, n_nodes): whether a dof is free, and not prescribed."""
        free = np.ones((3, self.n_nodes), bool)
        free[self.held % 3, self.held // 3] = False
        return free

    def steepest_load(self) -> float:
        """Largest gradient that the full load's speed, m per load, has in a cell of this rank whose free nodes rest.

        It is by how much of its own size a cell next to moving nodes would be strained, if nothing gave way.
        """
        rows, speed = self.rows, np.zeros((self.n_nodes, 3))
        points = rows.read("points")
        velocity = self.moving_full
        if self.moving_turns is not None:
            angle, arm, across = self.moving_turns.T
            velocity = velocity - ((np.cos(angle) - 1) * arm + np.sin(angle) * across) + angle * across
        speed.reshape(-1)[self.moving] = velocity
        moves: NDArray[np.bool_] = np.any(speed, axis=1)
        steepest = 0.0
        for kind in ("hexahedra", "domains"):
            for first, nodes in rows.blocks(kind):
                cells = rows.local(nodes)
                near = moves[cells].any(axis=1)
                if near.any():
                    if kind == "hexahedra":
                        gradients = hexahedra.geometry(points, cells[near])[0]
                    else:
                        gradients = rows.read("domain_gradients", first, first + len(nodes))[near]
                    found = np.einsum("cai,caj->cij", speed[cells[near]], gradients)
                    steepest = max(steepest, float(np.sqrt((found**2).sum(axis=(1, 2)).max())))
        return steepest


def localise(
    rows: PartRows, hourglass: float, stabilisation: float, rule: str, precision: type[np.floating] = np.float64
) -> Subdomain:
    """Local numbers and packed cells of a part.

    hourglass is R_hg of eq. 4.22, stabilisation the share s of design (0: the paper's own support domains), rule the
    hexahedron's gradient ("mean", or "centre" as in eq. 4.6). Local nodes ascend with the global ones, so that what
    lay along a grid line still does.
    """

    def local(nodes: NDArray[np.int64]) -> NDArray[np.uint32]:
        return rows.local(nodes).astype(np.uint32, copy=False)

    n_hexahedra, points, material = rows.n_own_hexahedra, rows.read("points"), rows.read("material")
    cells = np.empty((n_hexahedra, 8), np.uint32)
    for start, nodes in rows.blocks("hexahedra"):
        cells[start : start + len(nodes)] = local(nodes)
    domains = local(rows.read("domains"))
    shared = np.zeros(len(rows.nodes), bool)
    shared[local(rows.shared)] = True
    dofs = 3 * local(rows.prescribed_dofs // 3) + (rows.prescribed_dofs % 3).astype(np.uint32)
    packing = partial(
        LocalCells, points=points, n_rank_cells=rows.n_own_cells, materials=rows.materials, shared=shared,
        precision=precision,
    )  # fmt: skip
    of_hexahedra = packing(nodes=cells, first=0, material=material[:n_hexahedra], column=rows.read)
    of_domains = packing(
        nodes=domains, first=n_hexahedra, material=material[n_hexahedra:],
        column=lambda name: rows.read(f"domain_{name}"),
    )  # fmt: skip
    runs, gathered = voxel_runs.pack(of_hexahedra, hourglass)
    turns = rows.prescribed_turns.any(axis=1)
    moves = (rows.prescribed_displacements != 0) | turns
    return Subdomain(
        rows=rows,
        domain_nodes=domains,
        domain_shapes=rows.read("domain_shapes"),
        n_nodes=len(rows.nodes),
        n_cells=rows.n_own_cells,
        packed=(
            *runs,
            *hexahedron_batches.pack(of_hexahedra, gathered, hourglass, rule),
            *support_domain_batches.pack(of_domains, stabilisation),
        ),
        fixed=dofs[~moves],
        moving=dofs[moves],
        moving_full=rows.prescribed_displacements[moves],
        moving_turns=rows.prescribed_turns[moves] if turns.any() else None,
        shared=tuple(
            (int(rank), local(rows.shared[first:last]))
            for rank, first, last in zip(
                rows.neighbours, rows.shared_offsets[:-1], rows.shared_offsets[1:], strict=True
            )
        ),
        precision=precision,
    )


def cell_costs(
    points: NDArray[np.float64], hexahedra: NDArray[np.int64], domains: NDArray[np.int64]
) -> NDArray[np.float64]:
    """What each cell of a model costs in a step, (n_cells,): see `GATHERED_COST`."""
    in_runs = voxel_runs.find_runs(points, hexahedra, np.zeros(len(hexahedra), np.int16)).in_runs
    of_domain = DOMAIN_NODE_COST * domains.shape[1]
    return np.concatenate([np.where(in_runs, 1.0, GATHERED_COST), np.full(len(domains), of_domain)])
