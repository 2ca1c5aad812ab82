"""Displacements known at scattered places, such as a registration's on a surface, carried over to nodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpitled.errors import InputError
from mpitled.readers import tables

# Places that a node's value is fitted to: two for each of the ten monomials.
_PLACES = 20
# Places are as far apart as each is from its sixth neighbour, and a node may be as far from the nearest of them.
_APART = 6
_SAME = 1e-6  # share of that within which a node is at a place
# Singular values below this share of the largest are taken for zero: on a surface the fit says nothing of what is
# beside it, and the curvature in so few places is little.
_FLAT = 1e-4
_CHUNK = 1 << 12  # nodes at once, so that the temporaries stay small


def carry_over(path: Path, metre: float, nodes: NDArray[np.float64], origin: str) -> NDArray[np.float64]:
    """Displacements (n, 3), m, at nodes (n, 3), m, from a CSV of x, y, z, ux, uy, uz in units of `metre` m.

    Each is the value there of the quadratic polynomial that fits the 20 nearest places best, weighted by a quartic
    spline of the distance: errors fall with the cube of the places' distance. A node at a place has its very value.
    InputError, which begins with `origin`, if a node lies beyond the places, or there are too few.
    """
    rows, first = tables.read_field(path)
    places, values = metre * rows[:, :3], metre * rows[:, 3:]
    if len(places) < _PLACES:
        raise InputError(f"{path}: has {len(places)} places; give at least {_PLACES}")
    tree = cKDTree(places)
    twice = np.flatnonzero(tree.query(places, 2)[0][:, 1] == 0)
    if len(twice):
        raise InputError(f"{path}: line {first + twice[0]}: the same place is there twice; take one out")
    distance, near = tree.query(nodes, _PLACES)
    spacing = tree.query(places, _APART + 1)[0][:, -1]
    lost = np.flatnonzero(distance[:, 0] > spacing[near[:, 0]])
    if len(lost):
        node = lost[np.argmax(distance[lost, 0])]
        where = ", ".join(f"{1e3 * x:.6g}" for x in nodes[node])
        raise InputError(
            f"{origin}: the node at ({where}) mm is {1e3 * distance[node, 0]:.3g} mm from the nearest place of {path}, "
            f"where places are {1e3 * spacing[near[node, 0]]:.3g} mm apart ({len(lost)} such); add places there, "
            "take the nodes out of the set, or see to the unit"
        )
    found = np.empty_like(nodes)
    for start in range(0, len(nodes), _CHUNK):
        part = slice(start, start + _CHUNK)
        found[part] = _fitted(nodes[part], places[near[part]], values[near[part]], distance[part])
    at_place = distance[:, 0] < _SAME * spacing[near[:, 0]]
    found[at_place] = values[near[at_place, 0]]
    return found


def _fitted(
    nodes: NDArray[np.float64],
    places: NDArray[np.float64],
    values: NDArray[np.float64],
    distance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Values (n, 3) at nodes (n, 3) of polynomials fitted to values (n, k, 3) at places (n, k, 3)."""
    reach = 1.001 * distance[:, -1:]
    x, y, z = ((places - nodes[:, None]) / reach[..., None]).transpose(2, 0, 1)
    terms = np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, y * z, x * z], axis=2)
    q = distance / reach
    root = np.sqrt(1 - 6 * q**2 + 8 * q**3 - 3 * q**4)[..., None]
    # The polynomial is in coordinates from the node: its value there is its constant.
    constant = np.linalg.pinv(root * terms, rcond=_FLAT)[:, :1]
    return np.asarray((constant @ (root * values))[:, 0])
