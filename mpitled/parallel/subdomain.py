"""The part of the model on one rank in local numbers, with cells packed for the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mpitled.cells import voxel_runs
from mpitled.cells.kind import HEXAHEDRA
from mpitled.cells.packers import PACKERS, CellOptions
from mpitled.cells.packing import LocalCells, PackedCells
from mpitled.model import CellBlock
from mpitled.store import PartBlock, PartRows

#: Floating-point type of the arithmetic of cells for each `solver.precision`.
PRECISIONS: dict[str, type[np.floating]] = {"double": np.float64, "single": np.float32}


@dataclass(frozen=True, slots=True)
class Subdomain:
    """The part of the model on one rank, in local numbers and SI units.

    A cell is on one rank. A node is on every rank with a cell that touches the node; these ranks compute the same
    motion, and only the owner writes the node and adds it to sums. Local cells are numbered block after block.
    """

    rows: PartRows
    #: Nodes (n, k) and shape functions (n, k) at the integration points of each mesh-free block.
    clouds: tuple[tuple[NDArray[np.uint32], NDArray[np.float64]], ...]
    field_domains: NDArray[np.uint32]  # (n_field_nodes, k), nodes of the cell that interpolates at each field node
    n_nodes: int
    n_cells: int
    packed: tuple[PackedCells, ...]  # input of the kernels, by kind and law
    fixed: NDArray[np.uint32]  # dofs (3 node + direction) with displacement 0
    moving: NDArray[np.uint32]  # dofs that follow the loading curve
    moving_full: NDArray[np.float64]  # (len(moving),), displacement at full load, m
    moving_turns: NDArray[np.float64] | None  # (len(moving), 3), see `loading.rotation_path`; None: straight paths only
    shared: tuple[tuple[int, NDArray[np.uint32]], ...]  # (rank, nodes shared with this rank), ascending ranks
    precision: type[np.floating]  # of the arithmetic of cells

    @property
    def held(self) -> NDArray[np.uint32]:
        """Prescribed dofs, fixed and moving."""
        return np.concatenate([self.fixed, self.moving])

    def free(self) -> NDArray[np.bool_]:
        """(3, n_nodes): whether each dof is free."""
        free = np.ones((3, self.n_nodes), bool)
        free[self.held % 3, self.held // 3] = False
        return free

    def steepest_load(self) -> float:
        """Largest velocity gradient of a cell of this rank when free nodes rest; velocity: m per unit of the full load.

        This is the strain of a cell next to moving nodes if its free nodes do not move.
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
        for block in rows.blocks:
            for first, nodes in block.chunks("nodes"):
                cells = rows.local(nodes)
                near = moves[cells].any(axis=1)
                if near.any():
                    if block.kind.geometry:
                        gradients = block.gradients(points, cells[near], 0)
                    else:
                        gradients = block.gradients(points, cells, first)[near]
                    gradient = np.einsum("cai,caj->cij", speed[cells[near]], gradients)
                    steepest = max(steepest, float(np.sqrt((gradient**2).sum(axis=(1, 2)).max())))
        return steepest


def localise(
    rows: PartRows, hourglass: float, stabilisation: float, rule: str, precision: type[np.floating] = np.float64
) -> Subdomain:
    """The subdomain of a part; for the options see `CellOptions`.

    Local numbers of nodes ascend with global numbers, so that nodes along a grid line are consecutive.
    """

    def local(nodes: NDArray[np.int64]) -> NDArray[np.uint32]:
        return rows.local(nodes).astype(np.uint32, copy=False)

    def nodes_of(block: PartBlock) -> NDArray[np.uint32]:
        nodes = np.empty((block.n_own, block.n_nodes), np.uint32)
        for first, chunk in block.chunks("nodes"):
            nodes[first : first + len(chunk)] = local(chunk)
        return nodes

    points, options = rows.read("points"), CellOptions(hourglass, stabilisation, rule)
    shared = np.zeros(len(rows.nodes), bool)
    shared[local(rows.shared)] = True
    packed: list[PackedCells] = []
    clouds, field_domains = [], np.empty((0, 0), np.uint32)
    for block in rows.blocks:
        nodes = nodes_of(block)
        cells = LocalCells(
            points, nodes, block.first_own, rows.n_own_cells, block.read("material"), rows.materials, shared, precision,
            block.read,
        )  # fmt: skip
        packed += PACKERS[block.kind.name](cells, options)
        if block.kind.meshfree:
            clouds.append((nodes, block.read("shapes")))
        if block.name == rows.field_block:
            field_domains = nodes[rows.field_domains]
    dofs = 3 * local(rows.prescribed_dofs // 3) + (rows.prescribed_dofs % 3).astype(np.uint32)
    rotates = rows.rotation_paths.any(axis=1)
    moves = (rows.prescribed_displacements != 0) | rotates
    return Subdomain(
        rows=rows,
        clouds=tuple(clouds),
        field_domains=field_domains,
        n_nodes=len(rows.nodes),
        n_cells=rows.n_own_cells,
        packed=tuple(packed),
        fixed=dofs[~moves],
        moving=dofs[moves],
        moving_full=rows.prescribed_displacements[moves],
        moving_turns=rows.rotation_paths[moves] if rotates.any() else None,
        shared=tuple(
            (int(rank), local(rows.shared[first:last]))
            for rank, (first, last) in zip(rows.neighbours, pairwise(rows.shared_offsets), strict=True)
        ),
        precision=precision,
    )


def cell_costs(points: NDArray[np.float64], blocks: Sequence[CellBlock]) -> NDArray[np.float64]:
    """Cost (n_cells,) of each cell in a step, relative to a box in a voxel run; points: (n_nodes, 3), m."""
    costs = [np.full(len(block), block.kind.node_cost * block.nodes.shape[1]) for block in blocks]
    for block, of_block in zip(blocks, costs, strict=True):
        if block.kind is HEXAHEDRA:
            of_block[voxel_runs.find_runs(points, block.nodes, np.zeros(len(block), np.int16)).in_runs] = 1.0
    return np.concatenate(costs)
