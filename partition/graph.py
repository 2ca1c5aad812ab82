"""The graph of cells that METIS cuts: which cells are neighbours, and how many nodes they share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

#: Faces of a hexahedron in the Abaqus/VTK node order.
FACES = np.array([[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])

#: Cells with so many nodes in common are neighbours, as two hexahedra at a face are. Joining all cells with any
#: node in common would make a clique of every node's cells: hundreds of edges a cell in a dense cloud.
SHARED = 4

#: Nearest support domains that a support domain is joined to: as many as a hexahedron has faces.
NEAREST = 6


@dataclass(frozen=True, slots=True)
class CellGraph:
    """Undirected graph of cells (hexahedra first, then support domains) in compressed rows, as METIS takes it.

    Cell i has the neighbours adjncy[xadj[i]:xadj[i + 1]]; each edge is in both rows; no cell is its own neighbour.
    """

    xadj: NDArray[np.int64]  # (n_cells + 1,)
    adjncy: NDArray[np.int64]  # (2 n_edges,)
    shared: NDArray[np.int64] | None  # (2 n_edges,), weight: nodes that both cells touch, at least 1; None: all alike
    n_hexahedra: int
    connected: bool  # in one piece

    @property
    def n_cells(self) -> int:
        return len(self.xadj) - 1


def cell_graph(
    hexahedra: NDArray[np.int64], domains: NDArray[np.int64], domain_points: NDArray[np.float64]
) -> CellGraph:
    """The graph of hexahedra (n, 8), support domains (m, k) by their nodes, and their integration points (m, 3).

    Hexahedra are joined by faces; a support domain to the `NEAREST` domains around it and to all cells that share at
    least `SHARED` nodes with it. Where that leaves pieces of the mesh that still have nodes in common, single edges
    join them, so the graph is in one piece where the mesh is. Time and memory grow linearly with the cells.
    """
    hexahedra = np.ascontiguousarray(hexahedra, dtype=np.int64).reshape(-1, 8)
    domains = np.ascontiguousarray(domains, dtype=np.int64)
    n_hexahedra, n_cells = len(hexahedra), len(hexahedra) + len(domains)
    n_nodes = 1 + max(int(hexahedra.max(initial=-1)), int(domains.max(initial=-1)))
    mates = _face_mates(hexahedra, n_nodes)
    pairs = np.empty((0, 2), dtype=np.int64)
    if len(domains):
        start, touching = _cells_of_nodes(hexahedra, domains, n_nodes)
        near = _nearest_pairs(domain_points) + n_hexahedra
        n_sharing = _sharing_pairs(domains, n_hexahedra, start, touching, pairs)
        sharing = np.empty((n_sharing, 2), dtype=np.int64)
        _sharing_pairs(domains, n_hexahedra, start, touching, sharing)
        pairs = _unique_pairs(np.concatenate([near, sharing]), n_cells)
    tree = _forest(mates, pairs, n_cells)
    n_pieces = int(np.count_nonzero(tree == np.arange(n_cells)))
    if n_pieces > 1:
        bridges = np.empty((n_pieces - 1, 2), dtype=np.int64)
        start, touching = _cells_of_nodes(hexahedra, domains, n_nodes)
        n_bridges = _bridges(tree, start, touching, bridges)
        pairs = np.concatenate([pairs, bridges[:n_bridges]])
        n_pieces -= n_bridges
    if len(pairs):
        xadj, adjncy, shared = _compressed_rows(mates, pairs, _shared_nodes(hexahedra, domains, pairs), n_cells)
    else:
        xadj = np.concatenate([[0], np.cumsum(np.count_nonzero(mates >= 0, axis=1))])
        adjncy, shared = mates[mates >= 0], None
    return CellGraph(xadj, adjncy, shared, n_hexahedra, connected=n_pieces <= 1)


@njit(cache=True)
def _sorted_face(hexahedra, cell, face):  # type: ignore[no-untyped-def]
    """The four nodes of a face, ascending."""
    a, b, c, d = FACES[face]
    a, b, c, d = hexahedra[cell, a], hexahedra[cell, b], hexahedra[cell, c], hexahedra[cell, d]
    a, b, c, d = min(a, b), max(a, b), min(c, d), max(c, d)
    low, high = max(a, c), min(b, d)
    return min(a, c), min(low, high), max(low, high), max(b, d)


@njit(cache=True)
def _face_mates(hexahedra, n_nodes):  # type: ignore[no-untyped-def]
    """The hexahedron behind each face, (n, 6), or -1; each hexahedron once in a row.

    Faces are put into buckets by their lowest node: only faces of one bucket can be alike, and it holds a dozen or so.
    Of three hexahedra at one face (a faulty mesh) two are joined.
    """
    n = len(hexahedra)
    start = np.zeros(n_nodes + 1, np.int64)
    for c in range(n):
        for f in range(6):
            start[_sorted_face(hexahedra, c, f)[0] + 1] += 1
    start = np.cumsum(start)
    free = start[:-1].copy()
    bucket = np.empty(6 * n, np.int64)
    mates = np.full((n, 6), -1)
    for c in range(n):
        for f in range(6):
            face = _sorted_face(hexahedra, c, f)
            for i in range(start[face[0]], free[face[0]]):
                other, g = divmod(bucket[i], 6)
                if mates[other, g] < 0 and _sorted_face(hexahedra, other, g) == face:
                    if other != c and not np.any(mates[c] == other):
                        mates[c, f], mates[other, g] = other, c
                    break
            else:
                bucket[free[face[0]]] = 6 * c + f
                free[face[0]] += 1
    return mates


@njit(cache=True)
def _cells_of_nodes(hexahedra, domains, n_nodes):  # type: ignore[no-untyped-def]
    """The cells that touch each node, ascending, in compressed rows (start, cells)."""
    start = np.zeros(n_nodes + 1, np.int64)
    for kind in (hexahedra, domains):
        for node in kind.flat:
            start[node + 1] += 1
    start = np.cumsum(start)
    free = start[:-1].copy()
    cells = np.empty(start[-1], np.int64)
    first = 0
    for kind in (hexahedra, domains):
        for c in range(len(kind)):
            for node in kind[c]:
                cells[free[node]] = first + c
                free[node] += 1
        first += len(kind)
    return start, cells


def _nearest_pairs(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Pairs (n, 2) of a point and each of the `NEAREST` points around it."""
    k = min(NEAREST + 1, len(points))
    found = cKDTree(points, balanced_tree=False).query(points, k=np.arange(1, k + 1))[1]
    pairs = np.stack([np.repeat(np.arange(len(points)), k), found.ravel()], axis=1)
    return pairs[pairs[:, 0] != pairs[:, 1]]


@njit(cache=True)
def _sharing_pairs(domains, n_hexahedra, start, cells, pairs):  # type: ignore[no-untyped-def]
    """Fills `pairs` with each domain and the lower cells that share `SHARED` nodes with it, or only counts them if empty."""
    common = np.zeros(n_hexahedra + len(domains), np.int32)
    n = 0
    for d in range(len(domains)):
        for node in domains[d]:
            for c in cells[start[node] : start[node + 1]]:
                if c >= n_hexahedra + d:
                    break
                common[c] += 1
                if common[c] == SHARED:
                    if len(pairs):
                        pairs[n, 0], pairs[n, 1] = c, n_hexahedra + d
                    n += 1
        for node in domains[d]:
            for c in cells[start[node] : start[node + 1]]:
                common[c] = 0
    return n


def _unique_pairs(pairs: NDArray[np.int64], n_cells: int) -> NDArray[np.int64]:
    """The pairs (n, 2) in order, lower cell first, each once."""
    keys = np.unique(pairs.min(axis=1) * n_cells + pairs.max(axis=1))
    return np.stack(np.divmod(keys, n_cells), axis=1)


@njit(cache=True)
def _root(tree, cell):  # type: ignore[no-untyped-def]
    """The cell that stands for the piece of this one; shortens the way for the next (Tarjan's path halving)."""
    while tree[cell] != cell:
        tree[cell] = tree[tree[cell]]
        cell = tree[cell]
    return cell


@njit(cache=True)
def _forest(mates, pairs, n_cells):  # type: ignore[no-untyped-def]
    """Parents (n_cells,) of a union-find forest: one tree for each piece of the graph, the root its own parent."""
    tree = np.arange(n_cells)
    for c in range(len(mates)):
        for mate in mates[c]:
            if mate >= 0:
                tree[_root(tree, mate)] = _root(tree, c)
    for i in range(len(pairs)):
        tree[_root(tree, pairs[i, 1])] = _root(tree, pairs[i, 0])
    return tree


@njit(cache=True)
def _bridges(tree, start, cells, bridges):  # type: ignore[no-untyped-def]
    """Fills `bridges` with pairs of cells that have a node, but no way through the graph, in common; their number."""
    n = 0
    for node in range(len(start) - 1):
        for i in range(start[node] + 1, start[node + 1]):
            a, b = _root(tree, cells[i - 1]), _root(tree, cells[i])
            if a != b:
                tree[b] = a
                bridges[n, 0], bridges[n, 1] = cells[i - 1], cells[i]
                n += 1
    return n


@njit(cache=True)
def _shared_nodes(hexahedra, domains, pairs):  # type: ignore[no-untyped-def]
    """The number of nodes that both cells of each pair touch, at least 1."""
    shared = np.zeros(len(pairs), np.int64)
    n = len(hexahedra)
    for i in range(len(pairs)):
        a, b = pairs[i]
        for node in hexahedra[a] if a < n else domains[a - n]:
            for other in hexahedra[b] if b < n else domains[b - n]:
                if node == other:
                    shared[i] += 1
                    break
        shared[i] = max(shared[i], 1)
    return shared


@njit(cache=True)
def _compressed_rows(mates, pairs, shared, n_cells):  # type: ignore[no-untyped-def]
    """The rows (xadj, adjncy, weights) of hexahedra at faces, which share 4 nodes, and of the other pairs."""
    xadj = np.zeros(n_cells + 1, np.int64)
    for c in range(len(mates)):
        for mate in mates[c]:
            xadj[c + 1] += mate >= 0
    for i in range(len(pairs)):
        xadj[pairs[i, 0] + 1] += 1
        xadj[pairs[i, 1] + 1] += 1
    xadj = np.cumsum(xadj)
    free = xadj[:-1].copy()
    adjncy = np.empty(xadj[-1], np.int64)
    weights = np.empty(xadj[-1], np.int64)
    for c in range(len(mates)):
        for mate in mates[c]:
            if mate >= 0:
                adjncy[free[c]], weights[free[c]] = mate, 4
                free[c] += 1
    for i in range(len(pairs)):
        a, b = pairs[i]
        adjncy[free[a]], weights[free[a]] = b, shared[i]
        adjncy[free[b]], weights[free[b]] = a, shared[i]
        free[a] += 1
        free[b] += 1
    return xadj, adjncy, weights
