"""The graph of cells that METIS cuts: which cells are neighbours, and how many nodes they share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

#: Faces of a hexahedron in the Abaqus/VTK node order.
FACES = np.array([[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])

#: Nodes that a support domain shares with its neighbours: as many as a face has with a hexahedron; with another support
#: domain these, or half of its nodes if that is more. Cells with any node in common are hundreds in a dense cloud.
SHARED = 4

#: Nearest support domains that a support domain is joined to: as many as a hexahedron has faces.
NEAREST = 6

#: Weight of an edge across a face inside a block of hexahedra; the unit of the others.
FACE_WEIGHT = 64


@dataclass(frozen=True, slots=True)
class CellGraph:
    """Undirected graph of cells (hexahedra first, then support domains) in compressed rows, as METIS takes it.

    Cell i has the neighbours adjncy[xadj[i]:xadj[i + 1]]; each edge is in both rows; no cell is its own neighbour.
    """

    xadj: NDArray[np.int64]  # (n_cells + 1,)
    adjncy: NDArray[np.int64]  # (2 n_edges,)
    edge_weights: NDArray[np.int64] | None  # (2 n_edges,), at least 1; None: all alike
    n_hexahedra: int

    @property
    def n_cells(self) -> int:
        return len(self.xadj) - 1


def cell_graph(
    hexahedra: NDArray[np.int64], domains: NDArray[np.int64], domain_points: NDArray[np.float64]
) -> CellGraph:
    """The graph of hexahedra (n, 8), support domains (m, k) by their nodes, and their integration points (m, 3).

    Hexahedra are joined by faces; a support domain to the `NEAREST` domains around it and to all cells that share
    enough nodes with it (see `SHARED`). Where that leaves pieces of the mesh that still have nodes in common, single
    edges join them, so the graph is in one piece where the mesh is. Time and memory grow linearly with the cells.

    An edge weighs the sum of 1 / (d - 1) over the shared nodes, each of d cells (the clique model of a net in Lengauer,
    Combinatorial Algorithms for Integrated Circuit Layout, 1990), so that METIS, which sees edges, makes few halo
    nodes. A dense cloud has many more edges a node than hexahedra have; if all weighed the same, cuts would avoid it.
    """
    hexahedra = np.ascontiguousarray(hexahedra, dtype=np.int64).reshape(-1, 8)
    domains = np.ascontiguousarray(domains, dtype=np.int64)
    n_hexahedra, n_cells = len(hexahedra), len(hexahedra) + len(domains)
    n_nodes = 1 + max(int(hexahedra.max(initial=-1)), int(domains.max(initial=-1)))
    mates = _face_mates(hexahedra, n_nodes)
    pairs = np.empty((0, 2), dtype=np.int64)
    if len(domains):
        pairs = _domain_pairs(hexahedra, domains, domain_points, n_nodes)
    tree = _forest(mates, pairs, n_cells)
    n_pieces = int(np.count_nonzero(tree == np.arange(n_cells)))
    if n_pieces > 1:
        start, touching = _cells_of_nodes(hexahedra, domains, n_nodes)
        bridges = np.empty((n_pieces - 1, 2), dtype=np.int64)
        n_bridges = _bridges(tree, start, touching, bridges)
        pairs = np.concatenate([pairs, bridges[:n_bridges]])
    if len(pairs):
        n_touching = np.bincount(hexahedra.ravel(), minlength=n_nodes) + np.bincount(domains.ravel(), minlength=n_nodes)
        weights = _weights(hexahedra, domains, pairs, n_touching)
        xadj, adjncy, edge_weights = _compressed_rows(mates, pairs, weights, n_cells)
        return CellGraph(xadj, adjncy, edge_weights, n_hexahedra)
    xadj = np.concatenate([[0], np.cumsum(np.count_nonzero(mates >= 0, axis=1))])
    return CellGraph(xadj, mates[mates >= 0], None, n_hexahedra)


def _domain_pairs(
    hexahedra: NDArray[np.int64], domains: NDArray[np.int64], domain_points: NDArray[np.float64], n_nodes: int
) -> NDArray[np.int64]:
    """The edges of support domains, (n, 2) cells, the lower first, in order, each once.

    A pair is sorted as one number, its key: the lower cell times the number of cells, plus the higher.
    """
    n_hexahedra, n_cells = len(hexahedra), len(hexahedra) + len(domains)
    near = _nearest_keys(domain_points, n_hexahedra)
    start, touching = _cells_of_nodes(hexahedra, domains, n_nodes)
    n_sharing = _sharing_keys(domains, n_hexahedra, start, touching, near[:0])
    keys = np.empty(len(near) + n_sharing, dtype=np.int64)
    keys[: len(near)] = near
    _sharing_keys(domains, n_hexahedra, start, touching, keys[len(near) :])
    del near, start, touching  # a third of the peak of memory
    keys.sort()  # np.unique takes ten times as long, and four times the memory
    keys = keys[np.concatenate([[True], keys[1:] != keys[:-1]])[: len(keys)]]
    pairs = np.empty((len(keys), 2), dtype=np.int64)
    np.divmod(keys, n_cells, out=(pairs[:, 0], pairs[:, 1]))
    return pairs


def _nearest_keys(points: NDArray[np.float64], n_hexahedra: int) -> NDArray[np.int64]:
    """Keys of pairs of a support domain and each of the `NEAREST` around it, given their points."""
    k = min(NEAREST + 1, len(points))
    near = cKDTree(points, balanced_tree=False).query(points, k=np.arange(1, k + 1))[1]
    # A point finds itself, but not always first where points coincide.
    own = np.arange(len(points))[:, None]
    keys = (np.minimum(own, near) + n_hexahedra) * (n_hexahedra + len(points)) + np.maximum(own, near) + n_hexahedra
    return keys[near != own]


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


@njit(cache=True)
def _sharing_keys(domains, n_hexahedra, start, cells, keys):  # type: ignore[no-untyped-def]
    """The number of pairs of a support domain and a lower cell that share enough nodes.

    Fills `keys` with their keys unless it is empty.
    """
    n_cells = n_hexahedra + len(domains)
    common = np.zeros(n_cells, np.int32)
    n = 0
    for d in range(n_hexahedra, n_cells):
        for node in domains[d - n_hexahedra]:
            for c in cells[start[node] : start[node + 1]]:
                if c >= d:
                    break
                common[c] += 1
                if common[c] == (SHARED if c < n_hexahedra else max(SHARED, domains.shape[1] // 2)):
                    if len(keys):
                        keys[n] = c * n_cells + d
                    n += 1
        for node in domains[d - n_hexahedra]:
            for c in cells[start[node] : start[node + 1]]:
                common[c] = 0
    return n


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
def _weights(hexahedra, domains, pairs, n_touching):  # type: ignore[no-untyped-def]
    """The weight of each pair: nodes that both cells touch, those of few cells weigh more; at least 1."""
    # A node inside a block has 8 hexahedra, and a face 4 nodes.
    unit = FACE_WEIGHT / (4 / 7)
    weights = np.empty(len(pairs), np.int64)
    n = len(hexahedra)
    for i in range(len(pairs)):
        a, b = pairs[i]
        weight = 0.0
        for node in hexahedra[a] if a < n else domains[a - n]:
            for other in hexahedra[b] if b < n else domains[b - n]:
                if node == other:
                    weight += unit / (n_touching[node] - 1)
                    break
        weights[i] = max(1, round(weight))
    return weights


@njit(cache=True)
def _compressed_rows(mates, pairs, pair_weights, n_cells):  # type: ignore[no-untyped-def]
    """The rows (xadj, adjncy, weights) of hexahedra joined by faces and of the other pairs."""
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
                adjncy[free[c]], weights[free[c]] = mate, FACE_WEIGHT
                free[c] += 1
    for i in range(len(pairs)):
        a, b = pairs[i]
        adjncy[free[a]], weights[free[a]] = b, pair_weights[i]
        adjncy[free[b]], weights[free[b]] = a, pair_weights[i]
        free[a] += 1
        free[b] += 1
    return xadj, adjncy, weights
