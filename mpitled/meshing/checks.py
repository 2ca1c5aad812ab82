"""Checks of cells, nodes and constraints before anything is computed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from mpitled.cells import hexahedra
from mpitled.mesh import Bools, Floats, Ints
from mpitled.meshing.faces import FACES

#: Node orders of other programs: top and bottom exchanged (or mirrored), lexicographic, and lexicographic mirrored. A
#: row gives the nodes of such a hexahedron in Abaqus's order.
ORDERS = np.array([[4, 5, 6, 7, 0, 1, 2, 3], [0, 1, 3, 2, 4, 5, 7, 6], [4, 5, 7, 6, 0, 1, 3, 2]])
#: A rigid motion is free if its singular value is below this share of the largest.
_FREE = 1e-6
_NEAR = 16  # a point is tested against this number of cells with the nearest centres


def reordered(points: Floats, cells: Ints, rows: Ints) -> Ints:
    """Hexahedra (len(rows), 8) with nodes in a valid order; -1 in rows without a valid order."""
    result = np.full((len(rows), 8), -1, np.int64)
    for order in ORDERS:
        remaining = np.flatnonzero(result[:, 0] < 0)
        trial = cells[rows[remaining]][:, order]
        valid = hexahedra.scaled_jacobian(points, trial) > 0
        result[remaining[valid]] = trial[valid]
    return result


def coincident(points: Floats, tolerance: float) -> Ints:
    """Nodes (n,), ascending, with an earlier node at the same point or within the tolerance, m."""
    order = np.lexsort(points.T)
    same = (np.diff(points[order], axis=0) == 0).all(axis=1)
    rest = np.sort(order[~np.append(False, same)]) if len(order) else order
    found = [order[1:][same]]
    if tolerance > 0 and len(rest) > 1:
        distance, other = cKDTree(points[rest]).query(points[rest], 2, distance_upper_bound=tolerance)
        near = np.isfinite(distance[:, 1]) & (other[:, 1] < np.arange(len(rest)))
        found.append(rest[near])
    return np.sort(np.concatenate(found))


def repeated(cells: Ints) -> tuple[Ints, Ints]:
    """Rows of cells (n, k) with the same nodes as an earlier row in any order, and these earlier rows."""
    # Equal sums of hashed numbers (Steele et al. 2014) mean equal nodes, with an error probability of 2^-64.
    sums = np.zeros(len(cells), np.uint64)
    for column in cells.T:
        mixed = column.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        sums += mixed ^ (mixed >> np.uint64(27))
    order = np.argsort(sums, kind="stable")
    again = np.flatnonzero(np.diff(sums[order]) == 0) + 1
    return order[again], order[again - 1]


def pieces(cells: Sequence[Ints], n_nodes: int) -> Ints:
    """Number (n_nodes,) of each node's connected piece, from 0; -1 for a node without a cell."""
    parent = np.arange(n_nodes)
    used = np.zeros(n_nodes, bool)
    for block in cells:
        _join(parent, np.ascontiguousarray(block))
        used[block] = True
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
    """Roots of all nodes. A parent's number is at most its node's, so one pass is enough."""
    for node in range(parent.size):
        parent[node] = parent[parent[node]]
    return parent


def free_rigid_modes(points: Floats, dofs: Ints) -> int:
    """Number of rigid motions, of six with small rotations, that the prescribed dofs do not prevent."""
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
    # The eigenvalues are the squared singular values of the constraints on the motions.
    values = np.linalg.eigvalsh(motion.T @ motion)
    return int(np.count_nonzero(values <= _FREE**2 * values[-1]))


def scene_remarks(points: Floats, cells: Ints, domains: Ints, n_fe_nodes: int, dofs: Ints) -> list[str]:
    """Warnings about the model: separate pieces, free rigid motion, support domains with FE nodes only."""
    piece = pieces([cells, domains], len(points))
    n_pieces = int(piece.max(initial=-1)) + 1
    remarks = []
    if n_pieces > 1:
        sizes = np.sort(np.bincount(piece[piece >= 0]))[::-1]
        remarks.append(
            f"warning: the mesh is in {n_pieces} pieces that share no node, of {', '.join(map(str, sizes[:4]))}"
            f"{' ...' if n_pieces > 4 else ''} nodes"
        )
    order = np.argsort(piece[dofs // 3], kind="stable")
    bounds = np.searchsorted(piece[dofs // 3][order], np.arange(n_pieces + 1))
    nodes = np.argsort(piece, kind="stable")
    node_bounds = np.searchsorted(piece[nodes], np.arange(n_pieces + 1))
    loose = 0
    for i in range(min(n_pieces, 1000)):
        piece_nodes = nodes[node_bounds[i] : node_bounds[i + 1]]
        piece_dofs = np.sort(dofs[order[bounds[i] : bounds[i + 1]]])
        local = 3 * np.searchsorted(piece_nodes, piece_dofs // 3) + piece_dofs % 3
        free = free_rigid_modes(points[piece_nodes], local)
        if free and not loose:
            where = "the mesh" if n_pieces == 1 else f"a piece of {len(piece_nodes)} nodes"
            remarks.append(
                f"warning: {where} can move as a rigid body ({free} of 6 motions); fix more directions of it"
            )
        loose += free > 0
    if loose > 1:
        remarks[-1] += f"; so can {loose - 1} more pieces"
    if n_fe_only := np.count_nonzero((domains < n_fe_nodes).all(axis=1)):
        remarks.append(
            f"warning: {n_fe_only} support domains have FE nodes only; lower support.max_fe_nodes or refine the cloud"
        )
    return remarks


def inside(points: Floats, corners: Floats) -> Bools:
    """Mask (n,) of points (n, 3) inside one of the hexahedra with corners (m, 8, 3), with plane faces.

    Corners may coincide, as in a tetrahedron. A point in the plane of a face is outside both neighbours, because the
    planes are moved inwards by a millionth of the cell's size.
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
        for a, b, c, d in FACES:
            normal = np.cross(x[:, c] - x[:, a], x[:, d] - x[:, b])
            length = np.linalg.norm(normal, axis=1)
            away = ((points - x[:, [a, b, c, d]].mean(axis=1)) * normal).sum(axis=1)
            within &= (length <= 1e-12 * size**2) | (away < -1e-6 * size * length)
        found |= within
    return found


def enclosed_volume(points: Floats, faces: Ints) -> float | None:
    """Volume, m^3, inside quadrilaterals (n, 4), anticlockwise seen from outside; None if they are not closed."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    if not len(faces) or (np.unique(edges, axis=0, return_counts=True)[1] % 2).any():
        return None
    x = points[faces] - points[faces].mean(axis=(0, 1))
    # The volume under a bilinear surface is the mean of the two triangulations.
    volume = 0.0
    for a, b, c in ((0, 1, 2), (0, 2, 3), (0, 1, 3), (1, 2, 3)):
        volume += float((x[:, a] * np.cross(x[:, b], x[:, c])).sum()) / 12
    return volume
