"""What can be wrong with cells, nodes and constraints, found before anything is computed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpitled.cells import hexahedra

#: Orders in which programs number a hexahedron's nodes that are not Abaqus's: top and bottom exchanged (or mirrored),
#: along x, then y, then z, and that one mirrored. Nodes in such an order are taken in the order given here.
ORDERS = np.array([[4, 5, 6, 7, 0, 1, 2, 3], [0, 1, 3, 2, 4, 5, 7, 6], [4, 5, 7, 6, 0, 1, 3, 2]])
#: Singular values of the prescribed part of rigid motions below this share of the largest are none.
_FREE = 1e-6
_NEAR = 16  # cells by centre among which one that holds a point is looked for


def reordered(points: NDArray[np.float64], cells: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Hexahedra (len(rows), 8) with their nodes in an order that makes them sound; rows of -1 where none does."""
    found = np.full((len(rows), 8), -1, np.int64)
    for order in ORDERS:
        open_rows = np.flatnonzero(found[:, 0] < 0)
        trial = cells[rows[open_rows]][:, order]
        sound = hexahedra.scaled_jacobian(points, trial) > 0
        found[open_rows[sound]] = trial[sound]
    return found


def coincident(points: NDArray[np.float64], tolerance: float) -> NDArray[np.int64]:
    """Nodes (n,) that have another one before them at the same place, or within the tolerance."""
    order = np.lexsort(points.T)
    same = (np.diff(points[order], axis=0) == 0).all(axis=1)
    rest = np.sort(order[~np.append(False, same)]) if len(order) else order
    found = [order[1:][same]]
    if tolerance > 0 and len(rest) > 1:
        distance, other = cKDTree(points[rest]).query(points[rest], 2, distance_upper_bound=tolerance)
        near = np.isfinite(distance[:, 1]) & (other[:, 1] < np.arange(len(rest)))
        found.append(rest[near])
    return np.sort(np.concatenate(found))


def repeated(cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of cells (n, k) that have the same nodes as one before them, in whatever order, and these rows before."""
    # Sums of scrambled numbers (Steele and others 2014) tell sets of nodes apart, but for a chance of 2^-64.
    sums = np.zeros(len(cells), np.uint64)
    for column in cells.T:
        mixed = column.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        sums += mixed ^ (mixed >> np.uint64(27))
    order = np.argsort(sums, kind="stable")
    again = np.flatnonzero(np.diff(sums[order]) == 0) + 1
    return order[again], order[again - 1]


def pieces(cells: Sequence[NDArray[np.int64]], n_nodes: int) -> NDArray[np.int64]:
    """Piece (n_nodes,) of each node, 0, 1, ...; nodes of one cell are of one piece. -1: no cell has it."""
    parent = np.arange(n_nodes)
    used = np.zeros(n_nodes, bool)
    for some in cells:
        _join(parent, np.ascontiguousarray(some))
        used[some] = True
    root = _roots(parent)
    number = np.full(n_nodes, -1)
    number[used] = np.unique(root[used], return_inverse=True)[1]
    return number


@njit(cache=True)
def _join(parent, cells):  # type: ignore[no-untyped-def]
    """Union-find with path halving over nodes (n, k) of cells."""
    for c in range(cells.shape[0]):
        first = cells[c, 0]
        while parent[first] != first:
            parent[first] = parent[parent[first]]
            first = parent[first]
        for a in range(1, cells.shape[1]):
            other = cells[c, a]
            while parent[other] != other:
                parent[other] = parent[parent[other]]
                other = parent[other]
            if other < first:
                parent[first] = other
                first = other
            else:
                parent[other] = first


@njit(cache=True)
def _roots(parent):  # type: ignore[no-untyped-def]
    """A node's parent has no larger number than itself: so one pass is enough."""
    for node in range(parent.size):
        parent[node] = parent[parent[node]]
    return parent


def free_rigid_modes(points: NDArray[np.float64], dofs: NDArray[np.int64]) -> int:
    """How many of the six rigid motions (small rotations) leave all prescribed dofs at rest."""
    if len(dofs) == 0:
        return 6
    node, direction = np.divmod(dofs, 3)
    centred = points[node] - points.mean(axis=0)
    size = np.abs(points - points.mean(axis=0)).max() or 1.0
    motion = np.zeros((len(dofs), 6))
    motion[np.arange(len(dofs)), direction] = 1.0
    for axis in range(3):
        unit = np.eye(3)[axis]
        motion[:, 3 + axis] = np.cross(unit, centred / size)[np.arange(len(dofs)), direction]
    # The eigenvalues of this are the squared singular values of the constraints on the motions.
    values = np.linalg.eigvalsh(motion.T @ motion)
    return int(np.count_nonzero(values <= _FREE**2 * values[-1]))


def scene_remarks(
    points: NDArray[np.float64],
    cells: NDArray[np.int64],
    domains: NDArray[np.int64],
    n_fe_nodes: int,
    dofs: NDArray[np.int64],
) -> list[str]:
    """Warnings about the whole model: separate pieces, free rigid motion, support domains of FE nodes only."""
    piece = pieces([cells, domains], len(points))
    n_pieces = int(piece.max(initial=-1)) + 1
    found = []
    if n_pieces > 1:
        sizes = np.sort(np.bincount(piece[piece >= 0]))[::-1]
        found.append(
            f"warning: the mesh is in {n_pieces} pieces that share no node, of {', '.join(map(str, sizes[:4]))}"
            f"{' ...' if n_pieces > 4 else ''} nodes"
        )
    order = np.argsort(piece[dofs // 3], kind="stable")
    bounds = np.searchsorted(piece[dofs // 3][order], np.arange(n_pieces + 1))
    nodes = np.argsort(piece, kind="stable")
    node_bounds = np.searchsorted(piece[nodes], np.arange(n_pieces + 1))
    loose = 0
    for i in range(min(n_pieces, 1000)):
        own = nodes[node_bounds[i] : node_bounds[i + 1]]
        some = np.sort(dofs[order[bounds[i] : bounds[i + 1]]])
        local = 3 * np.searchsorted(own, some // 3) + some % 3
        free = free_rigid_modes(points[own], local)
        if free and not loose:
            where = "the mesh" if n_pieces == 1 else f"a piece of {len(own)} nodes"
            found.append(f"warning: {where} can move as a rigid body ({free} of 6 motions); fix more directions of it")
        loose += free > 0
    if loose > 1:
        found[-1] += f"; so can {loose - 1} more pieces"
    lonely = np.count_nonzero((domains < n_fe_nodes).all(axis=1))
    if lonely:
        found.append(
            f"warning: {lonely} support domains have FE nodes only; lower support.max_fe_nodes or refine the cloud"
        )
    return found


def inside(points: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (n, 3) lie inside one of the hexahedra with corners (m, 8, 3); faces are taken as planes.

    Corners may coincide, as in a tetrahedron. A point in the plane of a face is in neither neighbour for sure, so
    that the planes are drawn in by a millionth of the cell's size.
    """
    if not len(corners) or not len(points):
        return np.zeros(len(points), bool)
    centres = corners.mean(axis=1)
    near = cKDTree(centres).query(points, min(_NEAR, len(centres)))[1].reshape(len(points), -1)
    found = np.zeros(len(points), bool)
    for column in near.T:
        x = corners[column]
        size = np.linalg.norm(x.max(axis=1) - x.min(axis=1), axis=1)
        within = np.ones(len(points), bool)
        for a, b, c, d in ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)):
            normal = np.cross(x[:, c] - x[:, a], x[:, d] - x[:, b])
            length = np.linalg.norm(normal, axis=1)
            away = ((points - x[:, [a, b, c, d]].mean(axis=1)) * normal).sum(axis=1)
            within &= (length <= 1e-12 * size**2) | (away < -1e-6 * size * length)
        found |= within
    return found


def enclosed_volume(points: NDArray[np.float64], faces: NDArray[np.int64]) -> float | None:
    """Volume (m^3) within a closed surface of quadrilaterals (n, 4) that look outwards; None if it is not closed."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    if not len(faces) or (np.unique(edges, axis=0, return_counts=True)[1] % 2).any():
        return None
    x = points[faces] - points[faces].mean(axis=(0, 1))
    # The mean of both ways to cut a quadrilateral in two is the volume under its bilinear surface.
    volume = 0.0
    for a, b, c in ((0, 1, 2), (0, 2, 3), (0, 1, 3), (1, 2, 3)):
        volume += float((x[:, a] * np.cross(x[:, b], x[:, c])).sum()) / 12
    return volume
