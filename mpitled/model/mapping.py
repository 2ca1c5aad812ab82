"""Interpolate displacements at scattered points, for example from a registration, to the nodes of a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpitled.errors import InputError
from mpitled.readers import tables

_POINTS = 20  # points in a fit: two for each of the ten monomials
# The spacing at a point is the distance to its sixth neighbour. A node may be this far from its nearest point.
_NEIGHBOUR = 6
_SAME = 1e-6  # a node within this share of the spacing is at the point
# Singular values below this share of the largest count as zero: points on a surface do not determine slopes across it,
# and few points do not determine its curvature.
_FLAT = 1e-4
_CHUNK = 1 << 12  # nodes computed at once; bounds the temporary memory


def carry_over(path: Path, metre: float, nodes: NDArray[np.float64], origin: str) -> NDArray[np.float64]:
    """Displacements (n, 3), m, at nodes (n, 3), m, from a CSV of x, y, z, ux, uy, uz in units of `metre` m.

    A displacement is the value of the quadratic polynomial fitted to the 20 nearest points, weighted by a quartic
    spline of the distance. Errors fall with the cube of the spacing. A node at a point has exactly the point's value.
    InputError if there are too few points, or, beginning with `origin`, if a node is too far from all points.
    """
    rows, first = tables.read_field(path)
    points, values = metre * rows[:, :3], metre * rows[:, 3:]
    if len(points) < _POINTS:
        raise InputError(f"{path}: has {len(points)} points; give at least {_POINTS}")
    tree = cKDTree(points)
    twice = np.flatnonzero(tree.query(points, 2)[0][:, 1] == 0)
    if len(twice):
        raise InputError(f"{path}: line {first + twice[0]}: the same point is given twice; remove one")
    distance, near = tree.query(nodes, _POINTS)
    spacing = tree.query(points, _NEIGHBOUR + 1)[0][:, -1]
    far = np.flatnonzero(distance[:, 0] > spacing[near[:, 0]])
    if len(far):
        node = far[np.argmax(distance[far, 0])]
        where = ", ".join(f"{1e3 * x:.6g}" for x in nodes[node])
        raise InputError(
            f"{origin}: the node at ({where}) mm is {1e3 * distance[node, 0]:.3g} mm from the nearest point of {path}, "
            f"where points are {1e3 * spacing[near[node, 0]]:.3g} mm apart ({len(far)} such); add points there, "
            "remove the nodes from the set, or check the unit"
        )
    result = np.empty_like(nodes)
    for start in range(0, len(nodes), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        result[chunk] = _fitted(nodes[chunk], points[near[chunk]], values[near[chunk]], distance[chunk])
    at_point = distance[:, 0] < _SAME * spacing[near[:, 0]]
    result[at_point] = values[near[at_point, 0]]
    return result


def _fitted(
    nodes: NDArray[np.float64],
    points: NDArray[np.float64],
    values: NDArray[np.float64],
    distance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Values (n, 3) at nodes (n, 3) of polynomials fitted to values (n, k, 3) at points (n, k, 3)."""
    radius = 1.001 * distance[:, -1:]
    x, y, z = ((points - nodes[:, None]) / radius[..., None]).transpose(2, 0, 1)
    terms = np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, y * z, x * z], axis=2)
    q = distance / radius
    root = np.sqrt(1 - 6 * q**2 + 8 * q**3 - 3 * q**4)[..., None]
    # The origin of the coordinates is the node, so the value at the node is the constant term.
    constant = np.linalg.pinv(root * terms, rcond=_FLAT)[:, :1]
    return np.asarray((constant @ (root * values))[:, 0])
