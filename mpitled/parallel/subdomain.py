"""One rank's part of the model in local numbers, packed as the kernels want it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled.cells import hexahedra
from mpitled.cells import support_domains as support
from mpitled.cells.kind import KINDS
from mpitled.kernels import BATCH_LANES
from mpitled.kernels.lanes import BITS
from mpitled.material import hourglass_modulus
from mpitled.mesh import CORNERS
from mpitled.model import CellBlock, empty_block
from mpitled.store import CHUNK_ROWS, PartRows

#: Boxes in a row shorter than this are gathered: a run keeps a whole vector of lanes busy.
SHORTEST_RUN = 4
#: Edges of a box agree this well relative to their length: the round-off of coordinates far from the origin.
BOX_TOLERANCE = 1e-11
#: What `solver.precision` means for the cells' arithmetic.
PRECISIONS: dict[str, type[np.floating]] = {"double": np.float64, "single": np.float32}

# Corners on the four lines along each axis, (3, 4, 2): near and far. Lines and axes are in turn from that axis.
_NUMBER = {tuple(corner): number for number, corner in enumerate(CORNERS.tolist())}
_LINES: NDArray[np.int64] = np.array([
    [[_NUMBER[tuple(np.roll((end, s, t), axis).tolist())] for end in (-1, 1)] for t in (-1, 1) for s in (-1, 1)]
    for axis in range(3)
])  # fmt: skip


@dataclass(frozen=True, slots=True)
class VoxelRuns:
    """Equal boxes whose nodes follow each other along a grid line; arguments of `kernels.voxel_forces`."""

    line: NDArray[np.uint64]  # (4, n_runs)
    length: NDArray[np.uint64]  # (n_runs,)
    along: NDArray[np.uint64]  # (n_runs,)
    first_cell: NDArray[np.uint64]  # (n_runs,)
    scale: NDArray[np.floating]  # (3, n_runs), 1/m
    coefficient: NDArray[np.floating]  # (3, n_runs)
    gram: NDArray[np.floating]  # (3, n_runs), 1/m^2
    border: int  # so many of them, the first, have nodes that other ranks share


@dataclass(frozen=True, slots=True)
class HexahedronBatches:
    """Hexahedra of any shape in lanes; arguments of `kernels.hexahedron_forces`."""

    nodes: NDArray[np.uint32]  # (n_batches, 8, lanes)
    in_row: NDArray[np.bool_]  # (n_batches, vectors in a batch)
    cells: NDArray[np.uint32]  # (n_batches, lanes)
    geometry: NDArray[np.floating]  # (n_batches, 30, lanes)
    coefficient: NDArray[np.floating]  # (n_batches, 3, lanes)
    gram: NDArray[np.floating]  # (n_batches, 6, lanes), 1/m^2
    stiffness: NDArray[np.floating]  # (n_batches, lanes), N/m
    border: int  # as in `VoxelRuns`, of batches


@dataclass(frozen=True, slots=True)
class DomainBatches:
    """Support domains in lanes; arguments of `kernels.domain_forces`."""

    nodes: NDArray[np.uint32]  # (n_batches, n, lanes)
    cells: NDArray[np.uint32]  # (n_batches, lanes)
    gradient: NDArray[np.floating]  # (n_batches, 3 n, lanes), 1/m
    position: NDArray[np.floating] | None  # (n_batches, 3 n, lanes), m; None without stabilisation
    inverse: NDArray[np.floating] | None  # (n_batches, 6, lanes), 1/m^2
    coefficient: NDArray[np.floating]  # (n_batches, 3, lanes)
    gram: NDArray[np.floating]  # (n_batches, 6, lanes), 1/m^2
    stiffness: NDArray[np.floating]  # (n_batches, lanes), N/m
    border: int  # as in `VoxelRuns`, of batches


@dataclass(frozen=True, slots=True)
class Subdomain:
    """The part of the model on one rank, in local numbers and SI units.

    A cell is on exactly one rank. A node is on every rank with a cell that touches it; all of these ranks move it
    identically, and its owner alone writes it and counts it in sums. Local cells are numbered block after block. The
    cells of all blocks of a kind are packed together.
    """

    rows: PartRows
    domain_nodes: NDArray[np.uint32]  # (n_domains, n)
    domain_shapes: NDArray[np.float64]  # (n_domains, n), at their integration points
    field_domains: NDArray[np.uint32]  # (n_field_nodes, n), nodes of the domain that gives the field at an EFG node
    n_nodes: int
    n_cells: int
    runs: VoxelRuns | None
    hexahedra: HexahedronBatches | None
    domains: DomainBatches | None
    fixed: NDArray[np.uint32]  # dofs (3 node + direction) that stay where they are
    moving: NDArray[np.uint32]  # dofs that follow the loading curve
    moving_full: NDArray[np.float64]  # (len(moving),), m at full load
    moving_turns: NDArray[np.float64] | None  # (len(moving), 3), see `loading.rotation_path`; None: all straight
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
        for block in rows.blocks:
            for first, nodes in block.chunks("nodes"):
                cells = rows.local(nodes)
                near = moves[cells].any(axis=1)
                if near.any():
                    if block.kind.geometry:
                        gradients = block.gradients(points, cells[near], 0)
                    else:
                        gradients = block.gradients(points, cells, first)[near]
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

    points, solid, cloud = rows.read("points"), _Cells(rows, "hexahedra"), _Cells(rows, "support domains")
    lame = np.array([[m.mu, m.lam] for m in rows.materials]).T  # (2, n_materials)
    cells = np.empty((len(solid), 8), np.uint32)
    for start, nodes in solid.chunks("nodes"):
        cells[start : start + len(nodes)] = local(nodes)
    of_solid, of_cloud = solid.read("material"), cloud.read("material")
    found = _find_runs(points, cells, of_solid, solid.starts)
    general = np.flatnonzero(~found.in_runs)
    domains, field_block = local(cloud.read("nodes")), [b for b in rows.blocks if b.name == rows.field_block]
    giving = [local(block.read("nodes"))[rows.field_domains] for block in field_block] or [domains]
    shared = np.zeros(len(rows.nodes), bool)
    shared[local(rows.shared)] = True
    dofs = 3 * local(rows.prescribed_dofs // 3) + (rows.prescribed_dofs % 3).astype(np.uint32)
    turns = rows.rotation_paths.any(axis=1)
    moves = (rows.prescribed_displacements != 0) | turns
    return Subdomain(
        rows=rows,
        domain_nodes=domains,
        domain_shapes=cloud.read("shapes"),
        field_domains=giving[0],
        n_nodes=len(rows.nodes),
        n_cells=rows.n_own_cells,
        runs=_in(precision, _voxel_runs(found, lame[:, of_solid[found.first]], hourglass, shared, solid.numbers)),
        hexahedra=_in(
            precision,
            _hexahedron_batches(
                points,
                cells,
                general,
                lame[:, of_solid[general]],
                rows.n_own_cells,
                hourglass,
                rule,
                precision,
                shared,
                solid.numbers(general),
            ),
        ),
        domains=_in(
            precision,
            _domain_batches(rows, cloud, points, domains, lame[:, of_cloud], stabilisation, shared),
        ),
        fixed=dofs[~moves],
        moving=dofs[moves],
        moving_full=rows.prescribed_displacements[moves],
        moving_turns=rows.rotation_paths[moves] if turns.any() else None,
        shared=tuple(
            (int(rank), local(rows.shared[first:last]))
            for rank, first, last in zip(
                rows.neighbours, rows.shared_offsets[:-1], rows.shared_offsets[1:], strict=True
            )
        ),
        precision=precision,
    )


class _Cells:
    """The own cells of all blocks of a kind, one after another."""

    def __init__(self, rows: PartRows, kind: str) -> None:
        self.kind, self.blocks = kind, rows.of_kind(kind)
        blocks = self.blocks
        self.starts = np.cumsum([0, *(block.n_own for block in blocks)])  # (n_blocks + 1,), the first row of each block
        # A block's cells are consecutive in the local numbers.
        self._shift = np.array([block.first_own for block in blocks], np.int64) - self.starts[:-1]

    def __len__(self) -> int:
        return int(self.starts[-1])

    def numbers(self, rows: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """Local cell numbers of rows; of all rows if there is no argument."""
        if rows is None:
            return np.arange(len(self)) + np.repeat(self._shift, np.diff(self.starts))
        return rows + self._shift[np.searchsorted(self.starts, rows, side="right") - 1] if len(rows) else rows

    def read(self, name: str) -> NDArray[Any]:
        """A column of all these cells. Blocks of different numbers of nodes per cell cannot be packed together."""
        if not self.blocks:
            empty = empty_block(KINDS[self.kind])
            return empty.columns[name] if name in empty.columns else np.asarray(getattr(empty, name))
        return np.concatenate([block.read(name) for block in self.blocks])

    def chunks(self, name: str) -> Iterator[tuple[int, NDArray[Any]]]:
        """A column in pieces, each with its first row."""
        for start, block in zip(self.starts.tolist(), self.blocks, strict=False):
            for first, values in block.chunks(name):
                yield start + first, values


def cell_costs(points: NDArray[np.float64], blocks: Sequence[CellBlock]) -> NDArray[np.float64]:
    """Cost (n_cells,) of each cell of a model in a step, relative to a box in a voxel run."""
    costs = [np.full(len(block), block.kind.node_cost * block.nodes.shape[1]) for block in blocks]
    for block, of_block in zip(blocks, costs, strict=True):
        if block.kind.name == "hexahedra":
            of_block[_find_runs(points, block.nodes, np.zeros(len(block), np.int16)).in_runs] = 1.0
    return np.concatenate(costs)


def _in(precision: type[np.floating], cells: Any) -> Any:
    """Packed cells, or None, with their numbers that are not indices in this precision."""
    if cells is None:
        return None
    arrays = {f.name: getattr(cells, f.name) for f in fields(cells)}
    real = {
        name: a.astype(precision, copy=False)
        for name, a in arrays.items()
        if isinstance(a, np.ndarray) and a.dtype.kind == "f"
    }
    return replace(cells, **real)


def _boxes(points: NDArray[np.float64], cells: NDArray[np.integer]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Which hexahedra are boxes along the axes, and the edges (n, 3) of the boxes that they would be."""
    if len(cells) == 0:
        return np.zeros(0, bool), np.zeros((0, 3))
    edges = points[cells[:, 6]] - points[cells[:, 0]]
    tolerance = BOX_TOLERANCE * np.abs(edges).max(axis=1)
    box = np.all(edges > 0, axis=1)
    for corner in range(1, 8):
        offset = points[cells[:, corner]] - points[cells[:, 0]]
        box &= np.abs(offset - (CORNERS[corner] + 1) / 2 * edges).max(axis=1) <= tolerance
    return box, edges


def _along(cells: NDArray[np.integer]) -> NDArray[np.int8]:
    """The axis along which each hexahedron's far nodes follow the near ones by number, or -1."""
    along = np.full(len(cells), -1, np.int8)
    for axis, lines in enumerate(_LINES):
        along[(cells[:, lines[:, 1]].astype(np.int64) - cells[:, lines[:, 0]] == 1).all(axis=1)] = axis
    return along


@dataclass(frozen=True, slots=True)
class _Runs:
    """Rows of equal boxes whose nodes follow each other, of hexahedra (n, 8)."""

    in_runs: NDArray[np.bool_]  # (n,)
    first: NDArray[np.int64]  # (n_runs,), their first cells
    length: NDArray[np.int64]
    along: NDArray[np.int64]  # the axis
    near: NDArray[np.int64]  # (n_runs, 4), the first cells' near nodes
    edges: NDArray[np.float64]  # (n_runs, 3), m


def _find_runs(
    points: NDArray[np.float64],
    cells: NDArray[np.integer],
    material: NDArray[np.int16],
    starts: NDArray[np.int64] | None = None,
) -> _Runs:
    """In pieces, so that temporary arrays stay small. A run ends where a block of the model does (starts)."""
    n = len(cells)
    good, breaks = np.zeros(n, bool), [np.zeros(min(n, 1), np.int64)]
    ends = np.empty(0, np.int64) if starts is None else starts[1:-1]
    for start in range(0, n, CHUNK_ROWS):
        some = cells[max(0, start - 1) : start + CHUNK_ROWS]  # and the cell before, which the first may follow
        box, edges = _boxes(points, some)
        box &= _along(some) >= 0
        follows = (some[1:].astype(np.int64) - some[:-1] == 1).all(axis=1) & box[1:] & box[:-1]
        of = material[max(0, start - 1) : start + CHUNK_ROWS]
        follows &= of[1:] == of[:-1]
        follows &= (np.abs(edges[1:] - edges[:-1]) <= BOX_TOLERANCE * edges[1:]).all(axis=1)
        breaks.append(max(0, start - 1) + 1 + np.flatnonzero(~follows))
        good[max(0, start - 1) : start + CHUNK_ROWS] = box
    first = np.unique(np.concatenate([*breaks, ends[ends < n]])) if len(ends) else np.concatenate(breaks)
    length = np.diff([*first, n]) if n else np.zeros(0, np.int64)
    runs = good[first] & (length >= SHORTEST_RUN)
    in_runs = np.repeat(runs, length)
    first, length = first[runs], length[runs]
    along = _along(cells[first]).astype(np.int64)
    near = np.take_along_axis(cells[first], _LINES[along, :, 0], axis=1).astype(np.int64)
    return _Runs(in_runs, first, length, along, near, _boxes(points, cells[first])[1])


def _voxel_runs(
    found: _Runs,
    lame: NDArray[np.float64],
    hourglass: float,
    shared: NDArray[np.bool_],
    numbers: Callable[[NDArray[np.int64]], NDArray[np.int64]],
) -> VoxelRuns | None:
    if len(found.first) == 0:
        return None
    before = np.concatenate([[0], np.cumsum(shared)])  # so many nodes before each are shared
    at_border = (before[found.near + found.length[:, None] + 1] > before[found.near]).any(axis=1)
    order = np.argsort(~at_border, kind="stable")
    first, length, axis, near = (a[order] for a in (found.first, found.length, found.along, found.near))
    # Axes in turn from that of the run.
    edge = np.take_along_axis(found.edges[order], (axis[:, None] + np.arange(3)) % 3, axis=1).T
    volume = edge.prod(axis=0)
    gram = 1 / (2 * edge**2)
    mu, lam = lame[:, order]
    return VoxelRuns(
        line=np.ascontiguousarray(near.T, dtype=np.uint64),
        length=length.astype(np.uint64),
        along=axis.astype(np.uint64),
        first_cell=numbers(first).astype(np.uint64),
        scale=1 / (4 * edge),
        coefficient=np.stack(
            [mu * volume, lam * volume, hourglass * hourglass_modulus(lam, mu) * volume * gram.sum(axis=0) / 8]
        ),
        gram=gram,
        border=int(np.count_nonzero(at_border)),
    )


def _hexahedron_batches(
    points: NDArray[np.float64],
    cells: NDArray[np.uint32],
    chosen: NDArray[np.int64],
    lame: NDArray[np.float64],
    n_cells: int,
    hourglass: float,
    rule: str,
    precision: type[np.floating],
    shared: NDArray[np.bool_],
    numbers: NDArray[np.int64],
) -> HexahedronBatches | None:
    if len(chosen) == 0:
        return None
    nodes = _turned(cells[chosen])
    gradient_modes, x_modes, volumes = hexahedra.hadamard(points, nodes, rule)
    gradients, _ = hexahedra.geometry(points, nodes, rule)
    gamma = hexahedra.hourglass_vectors(points, nodes, gradients)
    mu, lam = lame
    k = hexahedra.hourglass_stiffness(gradients, volumes, hourglass_modulus(lam, mu), hourglass)
    geometry = np.concatenate([gradient_modes.reshape(-1, 18) / 8, x_modes.reshape(-1, 12)], axis=1)
    lanes = _lanes(nodes)
    return _border_first(
        HexahedronBatches,
        shared,
        nodes=lanes,
        in_row=_in_row(lanes, BITS // 8 // precision().itemsize),
        cells=_lanes(numbers[:, None].astype(np.uint32), n_cells)[:, 0],
        geometry=_lanes(geometry),
        coefficient=_lanes(np.stack([mu * volumes, lam * volumes, k], axis=1), 0),
        gram=_lanes(_symmetric(np.einsum("eai,eaj->eij", gradients, gradients))),
        stiffness=_lanes((k * np.linalg.eigvalsh(np.einsum("eam,ean->emn", gamma, gamma))[:, -1])[:, None], 0)[:, 0],
    )


def _turned(nodes: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Hexahedra (n, 8) whose far nodes follow the near ones along some axis, turned so that it is their first."""
    along = _along(nodes)
    order = np.empty((3, 8), np.int64)
    order[:, [[0, 1], [3, 2], [4, 5], [7, 6]]] = _LINES
    return np.take_along_axis(nodes, order[np.maximum(along, 0)], axis=1)


def _in_row(nodes: NDArray[np.uint32], width: int) -> NDArray[np.bool_]:
    """In which vectors of so many lanes each corner's nodes follow each other, and the far ones the near ones.

    nodes (n_batches, 8, lanes) -> (n_batches, vectors in a batch).
    """
    vectors = nodes.reshape(*nodes.shape[:2], -1, width).astype(np.int64)
    far = vectors[:, [1, 2, 5, 6]] - vectors[:, [0, 3, 4, 7]]
    return np.asarray((np.diff(vectors, axis=3) == 1).all(axis=(1, 3)) & (far == 1).all(axis=(1, 3)))


def _domain_batches(
    rows: PartRows,
    cloud: _Cells,
    points: NDArray[np.float64],
    nodes: NDArray[np.uint32],
    lame: NDArray[np.float64],
    stabilisation: float,
    shared: NDArray[np.bool_],
) -> DomainBatches | None:
    if len(nodes) == 0:
        return None
    position, inverse = support.linear_projector(points[nodes])
    mu, lam = lame
    volume, gradients = cloud.read("volumes"), cloud.read("gradients")
    kappa = support.stabilisation_stiffness(inverse, volume, lam + 2 * mu, stabilisation)
    gram = np.einsum("gai,gaj->gij", gradients, gradients)
    numbers = cloud.numbers().astype(np.uint32)
    stabilised = stabilisation > 0
    return _border_first(
        DomainBatches,
        shared,
        nodes=_lanes(nodes),
        cells=_lanes(numbers[:, None], rows.n_own_cells)[:, 0],
        gradient=_lanes(gradients),
        position=_lanes(position) if stabilised else None,
        inverse=_lanes(_symmetric(inverse)) if stabilised else None,
        coefficient=_lanes(np.stack([mu * volume, lam * volume, kappa], axis=1), 0),
        gram=_lanes(_symmetric(gram)),
        stiffness=_lanes(kappa[:, None], 0)[:, 0],  # Q is a projector: its largest eigenvalue is one
    )


def _border_first(kind: Any, shared: NDArray[np.bool_], **arrays: NDArray[Any] | None) -> Any:
    """Batches of a kind from arrays of them, those with shared nodes before the others."""
    at_border = shared[arrays["nodes"]].any(axis=(1, 2))
    if not at_border.all() and at_border.any():
        order = np.argsort(~at_border, kind="stable")
        arrays = {name: None if array is None else array[order] for name, array in arrays.items()}
    return kind(**arrays, border=int(np.count_nonzero(at_border)))


def _symmetric(tensors: NDArray[np.float64]) -> NDArray[np.float64]:
    """xx, xy, xz, yy, yz, zz (n, 6) of symmetric tensors (n, 3, 3)."""
    return tensors.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]


def _lanes(values, fill=None):  # type: ignore[no-untyped-def]
    """(n, ...) -> (n_batches, numbers of a cell, lanes); lanes left over repeat the last cell, or hold `fill`."""
    flat = values.reshape(len(values), -1)
    missing = -len(flat) % BATCH_LANES
    if missing:
        last = flat[-1:] if fill is None else np.full_like(flat[-1:], fill)
        flat = np.concatenate([flat, np.repeat(last, missing, axis=0)])
    return np.ascontiguousarray(flat.reshape(-1, BATCH_LANES, flat.shape[1]).transpose(0, 2, 1))
