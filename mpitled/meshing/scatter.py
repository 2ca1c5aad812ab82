"""Irregular, graded EFG nodes inside hexahedra: dart throwing, Lloyd sweeps and random shifts."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mpitled.mesh import Bools, Floats, Ints
from mpitled.meshing.integration_cells import cut, trilinear, volumes_and_centroids
from mpitled.meshing.spacing import Spacing

#: Smallest distance of two nodes over the local spacing; two interface nodes may be nearer.
CLOSEST = 0.6
# Dart throwing at 0.83 of the spacing s ends with one node per s^3 (measured: 0.97 to 1.01).
_DART = 0.83
_CHUNK = 1 << 15  # candidates computed at once; bounds the temporary memory
_CANDIDATES = 24  # candidates per node
_SWEEPS = 3  # Lloyd sweeps; more sweeps change nothing, because nodes move from candidate to candidate
_ROUNDS = 24  # approximate number of rounds of dart throwing


def scatter(cells: Floats, spacing: Spacing, occupied: Floats, irregularity: float, rng: np.random.Generator) -> Floats:
    """Irregular nodes (n, 3), one per cubed spacing, in hexahedra (m, 8, 3) around the `occupied` points (k, 3).

    Dart throwing finds points with a minimum distance and without holes. Lloyd sweeps make them even. Then each point
    is shifted at random by up to `irregularity` spacings. All steps choose from random candidates inside the hexahedra
    and outside the seed, so no node can leave the void.
    """
    candidates = _candidates(cells, spacing, rng)
    local = spacing(candidates)
    nodes = _throw_darts(candidates, _DART * local, occupied, rng)
    for _ in range(_SWEEPS):
        nodes = _lloyd(candidates, local, nodes, occupied)
    nodes = _separate(candidates, CLOSEST * local, nodes, occupied)
    return candidates[np.sort(_shift(candidates, local, nodes, occupied, irregularity, rng))]


def fibonacci_sphere(n: int) -> Floats:
    """Unit vectors (n, 3) of the Fibonacci lattice, whose points have equal areas (Gonzalez 2010)."""
    i = np.arange(n) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / n), np.pi * (1 + 5**0.5) * i
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)


def _candidates(cells: Floats, spacing: Spacing, rng: np.random.Generator) -> Floats:
    """Random points (n, 3) outside the seed, about _CANDIDATES per cubed spacing."""
    parts = cut(cells, spacing, 1.0, rng)
    volumes, centroids = volumes_and_centroids(parts)
    wanted = _CANDIDATES * volumes / spacing(centroids) ** 3
    parent = np.repeat(np.arange(len(parts)), np.floor(wanted + rng.random(len(parts))).astype(np.int64))
    points = np.empty((len(parent), 3))
    for first in range(0, len(parent), _CHUNK):
        rows = slice(first, min(first + _CHUNK, len(parent)))
        points[rows] = trilinear(parts[parent[rows]], rng.uniform(-1, 1, (rows.stop - first, 3)))
    return points[spacing.distance(points) > spacing.radius]


def _throw_darts(candidates: Floats, min_distance: Floats, occupied: Floats, rng: np.random.Generator) -> Ints:
    """A maximal set of candidates with distances of at least `min_distance` (n,) to each other and occupied points.

    Poisson-disc sampling (Cook 1986), in rounds of many darts.
    """
    alive = rng.permutation(np.flatnonzero(_clear(candidates, min_distance, occupied)))
    chosen = []
    while len(alive):
        darts = alive[: max(len(alive) // _ROUNDS, min(len(alive), 256))]
        darts = _separate(candidates, min_distance, darts, np.empty((0, 3)))
        chosen.append(darts)
        alive = alive[_clear(candidates[alive], min_distance[alive], candidates[darts])]
    return np.concatenate(chosen) if chosen else alive


def _separate(candidates: Floats, min_distance: Floats, nodes: Ints, occupied: Floats) -> Ints:
    """Nodes that are not too near to an occupied point or to an earlier node."""
    nodes = nodes[_clear(candidates[nodes], min_distance[nodes], occupied)]
    while len(nodes) > 1:
        distance, neighbour = cKDTree(candidates[nodes]).query(candidates[nodes], k=2)
        late = (distance[:, 1] < min_distance[nodes]) & (neighbour[:, 1] < np.arange(len(nodes)))
        early = (distance[:, 1] < min_distance[nodes]) & ~late
        # The later node of a pair is removed, also if only the earlier node's minimum distance is violated.
        late[neighbour[early, 1]] = True
        if not late.any():
            break
        nodes = nodes[~late]
    return nodes


def _lloyd(candidates: Floats, local: Floats, nodes: Ints, occupied: Floats) -> Ints:
    """Move each node to the candidate nearest to the centroid of the node's Voronoi cell (Lloyd 1982)."""
    owner = cKDTree(np.concatenate([candidates[nodes], occupied])).query(candidates)[1]
    owned = owner < len(nodes)
    owner, members = owner[owned], np.flatnonzero(owned)
    # Candidates have density 1/spacing^3; cells grow as the spacing where the density is 1/spacing^5 (Gersho 1979).
    weight = local[members] ** -2
    total = np.bincount(owner, weight, len(nodes))
    moments = [np.bincount(owner, weight * candidates[members, i], len(nodes)) for i in range(3)]
    centroids = np.stack(moments, axis=1) / total[:, None]
    offset = ((candidates[members] - centroids[owner]) ** 2).sum(axis=1)
    order = np.lexsort((offset, owner))
    first = np.searchsorted(owner[order], np.arange(len(nodes)))
    return members[order[first]]


def _shift(
    candidates: Floats, local: Floats, nodes: Ints, occupied: Floats, irregularity: float, rng: np.random.Generator
) -> Ints:
    """Move nodes at random by up to `irregularity` spacings, unless a node comes too near to another node."""
    direction = rng.normal(size=(len(nodes), 3))
    length = irregularity * local[nodes] * rng.random(len(nodes)) ** (1 / 3) / np.linalg.norm(direction, axis=1)
    wanted = candidates[nodes] + length[:, None] * direction
    shifted = cKDTree(candidates).query(wanted)[1]
    while True:
        points = np.concatenate([candidates[shifted], occupied])
        distance, neighbour = cKDTree(points).query(points[: len(nodes)], k=2)
        near = distance[:, 1] < CLOSEST * local[shifted]
        back = np.zeros(len(points), bool)
        back[: len(nodes)] = near
        back[neighbour[near, 1]] = True
        back = back[: len(nodes)] & (shifted != nodes)
        if not back.any():
            return shifted
        shifted = np.where(back, nodes, shifted)


def _clear(points: Floats, min_distance: Floats, others: Floats) -> Bools:
    """Mask (n,) of points (n, 3) at a distance of at least `min_distance` (n,) from all `others` (m, 3)."""
    if len(others) == 0 or len(points) == 0:
        return np.ones(len(points), bool)
    distance = cKDTree(others).query(points, distance_upper_bound=min_distance.max())[0]
    return np.asarray(distance) >= min_distance
