"""The graph of cells for METIS: edges join neighbouring cells, and weights measure their shared nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

#: Fewest shared nodes that join a mesh-free cell and another cell: the nodes of a hexahedron's face. Two mesh-free
#: cells need half of their nodes if that is more, because in a dense cloud hundreds of cells share some node.
SHARED = 4

#: Number of nearest mesh-free cells that a mesh-free cell is joined to: the number of a hexahedron's faces.
NEAREST = 6

#: Weight of an edge across a face of two hexahedra. Other weights are relative to this weight.
FACE_WEIGHT = 64


@dataclass(frozen=True, slots=True)
class Block:
    """Cells of one kind. Cells are numbered block after block."""

    nodes: NDArray[np.int64]  # (n, k), global nodes of each cell
    faces: NDArray[np.int64] | None = None  # (n_faces, nodes per face), local nodes; None: a mesh-free kind
    points: NDArray[np.float64] | None = None  # (n, 3), integration points of mesh-free cells


@dataclass(frozen=True, slots=True)
class CellGraph:
    """Undirected graph of cells in compressed rows, the format of METIS.

    Cell i has the neighbours adjncy[xadj[i]:xadj[i + 1]]. Each edge is in the rows of both cells. There are no loops.
    """

    xadj: NDArray[np.int64]  # (n_cells + 1,)
    adjncy: NDArray[np.int64]  # (2 n_edges,)
    edge_weights: NDArray[np.int64] | None  # (2 n_edges,), at least 1; None: all equal

    @property
    def n_cells(self) -> int:
        return len(self.xadj) - 1


def connectivity(blocks: Sequence[Block]) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Nodes of the cells in compressed rows, (offsets (n_cells + 1,), nodes), and the number of nodes of the mesh."""
    flat = [np.ascontiguousarray(block.nodes, dtype=np.int64).ravel() for block in blocks if block.nodes.size]
    nodes = flat[0] if len(flat) == 1 else np.concatenate([np.empty(0, np.int64), *flat])
    sizes = [np.full(len(block.nodes), block.nodes.shape[1]) for block in blocks]
    offsets = np.concatenate([[0], *sizes]).astype(np.int64, copy=False)
    return np.cumsum(offsets, out=offsets), nodes, 1 + int(nodes.max(initial=-1))


def cell_graph(blocks: Sequence[Block]) -> CellGraph:
    """The graph of the cells of all blocks.

    Edges join cells with a common face. They join a mesh-free cell to the `NEAREST` mesh-free cells and to all cells
    that share enough nodes with it (see `SHARED`). Single edges join components of the graph that have common nodes, so
    that the graph is connected where the mesh is connected. Time and memory are linear in the number of cells.

    The weight of an edge is the sum of 1 / (d - 1) over the shared nodes, where d is the number of cells at the node
    (clique model of a net: Lengauer, Combinatorial Algorithms for Integrated Circuit Layout, 1990). With these weights,
    few cut edges mean few halo nodes. A dense cloud has many more edges per node than hexahedra have: with equal
    weights, cuts would avoid the cloud.
    """
    offsets, nodes, n_nodes = connectivity(blocks)
    n_cells = len(offsets) - 1
    across = _face_neighbours(offsets, nodes, *_face_tables(blocks), n_nodes)
    pairs = np.empty((0, 2), dtype=np.int64)
    if any(block.faces is None and len(block.nodes) for block in blocks):
        pairs = _meshfree_pairs(blocks, offsets, nodes, n_nodes)
    tree = _forest(across, pairs, n_cells)
    n_components = int(np.count_nonzero(tree == np.arange(n_cells)))
    if n_components > 1:
        start, touching = _cells_of_nodes(offsets, nodes, n_nodes)
        bridges = np.empty((n_components - 1, 2), dtype=np.int64)
        n_bridges = _bridges(tree, start, touching, bridges)
        pairs = np.concatenate([pairs, bridges[:n_bridges]])
    if len(pairs):
        weights = _weights(offsets, nodes, pairs, np.bincount(nodes, minlength=n_nodes))
        return CellGraph(*_compressed_rows(across, pairs, weights, n_cells))
    xadj = np.concatenate([[0], np.cumsum(np.count_nonzero(across >= 0, axis=1))])
    return CellGraph(xadj, across[across >= 0], None)


def _face_tables(blocks: Sequence[Block]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First cell of each block, (n_blocks + 1,); faces of the blocks, (n_blocks, n_faces, nodes), padded with -1."""
    shapes = [block.faces.shape for block in blocks if block.faces is not None]
    tables = np.full((len(blocks), *np.max([(0, 1), *shapes], axis=0)), -1, np.int64)
    for table, block in zip(tables, blocks, strict=True):
        if block.faces is not None:
            table[: block.faces.shape[0], : block.faces.shape[1]] = block.faces
    return np.cumsum([0, *(len(block.nodes) for block in blocks)]), tables


def _meshfree_pairs(
    blocks: Sequence[Block], offsets: NDArray[np.int64], nodes: NDArray[np.int64], n_nodes: int
) -> NDArray[np.int64]:
    """The edges of mesh-free cells, (n, 2) cells, lower cell first, sorted, without repetition.

    The key of a pair is one number: the lower cell times the number of cells, plus the higher cell.
    """
    n_cells = len(offsets) - 1
    meshfree = np.concatenate([np.full(len(block.nodes), block.faces is None) for block in blocks])
    points = np.concatenate([block.points for block in blocks if block.points is not None])
    near = _nearest_keys(points, np.flatnonzero(meshfree), n_cells)
    start, touching = _cells_of_nodes(offsets, nodes, n_nodes)
    n_sharing = _sharing_keys(meshfree, offsets, nodes, start, touching, near[:0])
    keys = np.empty(len(near) + n_sharing, dtype=np.int64)
    keys[: len(near)] = near
    _sharing_keys(meshfree, offsets, nodes, start, touching, keys[len(near) :])
    del near, start, touching  # a third of the peak memory
    keys.sort()  # np.unique needs ten times the time and four times the memory
    keys = keys[np.concatenate([[True], keys[1:] != keys[:-1]])[: len(keys)]]
    pairs = np.empty((len(keys), 2), dtype=np.int64)
    np.divmod(keys, n_cells, out=(pairs[:, 0], pairs[:, 1]))
    return pairs


def _nearest_keys(points: NDArray[np.float64], cells: NDArray[np.int64], n_cells: int) -> NDArray[np.int64]:
    """Keys of pairs of a mesh-free cell and its `NEAREST` mesh-free cells; points (n, 3) of ascending cells (n,)."""
    k = min(NEAREST + 1, len(points))
    near = cKDTree(points, balanced_tree=False).query(points, k=np.arange(1, k + 1))[1]
    # The nearest point is the point itself, or a coincident point.
    own, near = cells[:, None], cells[near]
    return (np.minimum(own, near) * n_cells + np.maximum(own, near))[near != own]


@njit(cache=True)
def _sorted_face(nodes, first, corners, face):  # type: ignore[no-untyped-def]
    """Fills `face` with the nodes of a face, ascending, then with -1."""
    for i in range(len(corners)):
        face[i] = -1
        if corners[i] >= 0:
            node, j = nodes[first + corners[i]], i
            while j > 0 and face[j - 1] > node:
                face[j] = face[j - 1]
                j -= 1
            face[j] = node


@njit(cache=True)
def _equal(a, b):  # type: ignore[no-untyped-def]
    """Whether two arrays have the same entries; np.all would allocate an array."""
    same = True
    for i in range(len(a)):
        same &= a[i] == b[i]
    return same


@njit(cache=True)
def _face_neighbours(offsets, nodes, first_cells, tables, n_nodes):  # type: ignore[no-untyped-def]
    """The neighbour across each face, (n_cells, n_faces), or -1; a row has no repetition.

    A hash table with the lowest node as key holds the faces; a bucket has about a dozen faces. If three cells have the
    same face (a faulty mesh), two cells are joined.
    """
    n, n_faces = len(offsets) - 1, tables.shape[1]
    face, candidate = np.empty(tables.shape[2], np.int64), np.empty(tables.shape[2], np.int64)
    block_of = np.empty(n, np.uint8)
    start = np.zeros(n_nodes + 1, np.int64)
    for b in range(len(tables)):
        for c in range(first_cells[b], first_cells[b + 1]):
            block_of[c] = b
            for f in range(n_faces):
                if tables[b, f, 0] >= 0:
                    _sorted_face(nodes, offsets[c], tables[b, f], face)
                    start[face[0] + 1] += 1
    start = np.cumsum(start)
    free = start[:-1].copy()
    bucket = np.empty(start[-1], np.int64)
    across = np.full((n, n_faces), -1)
    for c in range(n):
        for f in range(n_faces):
            if tables[block_of[c], f, 0] < 0:
                continue
            _sorted_face(nodes, offsets[c], tables[block_of[c], f], face)
            for i in range(start[face[0]], free[face[0]]):
                other, g = divmod(bucket[i], n_faces)
                if across[other, g] < 0:
                    _sorted_face(nodes, offsets[other], tables[block_of[other], g], candidate)
                    if _equal(candidate, face):
                        if other != c and not np.any(across[c] == other):
                            across[c, f], across[other, g] = other, c
                        break
            else:
                bucket[free[face[0]]] = n_faces * c + f
                free[face[0]] += 1
    return across


@njit(cache=True)
def _cells_of_nodes(offsets, nodes, n_nodes):  # type: ignore[no-untyped-def]
    """The cells that touch each node, ascending, in compressed rows (start, cells)."""
    start = np.zeros(n_nodes + 1, np.int64)
    for node in nodes:
        start[node + 1] += 1
    start = np.cumsum(start)
    free = start[:-1].copy()
    cells = np.empty(start[-1], np.int64)
    for c in range(len(offsets) - 1):
        for node in nodes[offsets[c] : offsets[c + 1]]:
            cells[free[node]] = c
            free[node] += 1
    return start, cells


@njit(cache=True)
def _sharing_keys(meshfree, offsets, nodes, start, cells, keys):  # type: ignore[no-untyped-def]
    """The number of pairs of a mesh-free cell and a solid or lower mesh-free cell that share enough nodes.

    Fills `keys` with the keys of these pairs unless `keys` is empty.
    """
    n_cells = len(offsets) - 1
    solid = np.flatnonzero(~meshfree)
    last_solid = solid[-1] if len(solid) else -1
    common = np.zeros(n_cells, np.int32)
    n = 0
    for d in np.flatnonzero(meshfree):
        for node in nodes[offsets[d] : offsets[d + 1]]:
            for c in cells[start[node] : start[node + 1]]:
                if c >= d:
                    if c > last_solid:
                        break
                    if meshfree[c]:
                        continue
                common[c] += 1
                fewest = min(offsets[c + 1] - offsets[c], offsets[d + 1] - offsets[d])
                if common[c] == (max(SHARED, fewest // 2) if meshfree[c] else SHARED):
                    if len(keys):
                        keys[n] = min(c, d) * n_cells + max(c, d)
                    n += 1
        for node in nodes[offsets[d] : offsets[d + 1]]:
            for c in cells[start[node] : start[node + 1]]:
                common[c] = 0
    return n


@njit(cache=True)
def _root(tree, cell):  # type: ignore[no-untyped-def]
    """The root of a cell's tree, with path halving (Tarjan)."""
    while tree[cell] != cell:
        tree[cell] = tree[tree[cell]]
        cell = tree[cell]
    return cell


@njit(cache=True)
def _forest(across, pairs, n_cells):  # type: ignore[no-untyped-def]
    """Parents (n_cells,) of a union-find forest with one tree for each connected component of the graph."""
    tree = np.arange(n_cells)
    for c in range(len(across)):
        for neighbour in across[c]:
            if neighbour >= 0:
                tree[_root(tree, neighbour)] = _root(tree, c)
    for i in range(len(pairs)):
        tree[_root(tree, pairs[i, 1])] = _root(tree, pairs[i, 0])
    return tree


@njit(cache=True)
def _bridges(tree, start, cells, bridges):  # type: ignore[no-untyped-def]
    """Fills `bridges` with pairs of cells of different components with a common node; returns the number of pairs."""
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
def _weights(offsets, nodes, pairs, n_touching):  # type: ignore[no-untyped-def]
    """The weight of each pair, at least 1; see `cell_graph`."""
    # A node inside a block of hexahedra has 8 cells; a face has 4 nodes.
    unit = FACE_WEIGHT / (4 / 7)
    weights = np.empty(len(pairs), np.int64)
    for i in range(len(pairs)):
        a, b = pairs[i]
        weight = 0.0
        for node in nodes[offsets[a] : offsets[a + 1]]:
            for other in nodes[offsets[b] : offsets[b + 1]]:
                if node == other:
                    weight += unit / (n_touching[node] - 1)
                    break
        weights[i] = max(1, round(weight))
    return weights


@njit(cache=True)
def _compressed_rows(across, pairs, pair_weights, n_cells):  # type: ignore[no-untyped-def]
    """The graph (xadj, adjncy, weights) of neighbours across faces and of pairs."""
    xadj = np.zeros(n_cells + 1, np.int64)
    for c in range(len(across)):
        for neighbour in across[c]:
            xadj[c + 1] += neighbour >= 0
    for i in range(len(pairs)):
        xadj[pairs[i, 0] + 1] += 1
        xadj[pairs[i, 1] + 1] += 1
    xadj = np.cumsum(xadj)
    free = xadj[:-1].copy()
    adjncy = np.empty(xadj[-1], np.int64)
    weights = np.empty(xadj[-1], np.int64)
    for c in range(len(across)):
        for neighbour in across[c]:
            if neighbour >= 0:
                adjncy[free[c]], weights[free[c]] = neighbour, FACE_WEIGHT
                free[c] += 1
    for i in range(len(pairs)):
        a, b = pairs[i]
        adjncy[free[a]], weights[free[a]] = b, pair_weights[i]
        adjncy[free[b]], weights[free[b]] = a, pair_weights[i]
        free[a] += 1
        free[b] += 1
    return xadj, adjncy, weights
