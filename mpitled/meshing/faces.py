"""Faces of hexahedra: the boundary of a set of cells, and the interface between hexahedra and cloud."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mpitled.mesh import Floats, Ints

#: The six faces of a hexahedron in the Abaqus/VTK order, anticlockwise seen from outside.
FACES = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])


def unshared(faces: Ints) -> Ints:
    """Rows, ascending, of faces or edges (n, k) that occur once, in any order of their nodes."""
    key = np.sort(faces, axis=1)
    order = np.lexsort(key.T)
    same = (np.diff(key[order], axis=0) == 0).all(axis=1)
    repeated = np.append(False, same) | np.append(same, False)
    return np.sort(order[~repeated[: len(order)]])


def boundary_faces(hexahedra: Ints) -> Ints:
    """Faces (n, 4) that belong to one hexahedron only, anticlockwise seen from outside."""
    faces = hexahedra[:, FACES].reshape(-1, 4)
    return faces[unshared(faces)]


def area_vectors(corners: Floats) -> Floats:
    """Area times normal (n, 3), m^2, of quadrilaterals (n, 4, 3)."""
    return np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]) / 2


def interface_faces(points: Floats, hexahedra: Ints, interface: Ints, integration_points: Floats) -> Ints:
    """Faces (n, 4) between hexahedra and cloud, anticlockwise seen from the cloud.

    They belong to one hexahedron only, and all four nodes are interface nodes. A face on the outer surface of a
    hexahedron within the cloud has both properties too. It is left out because no cloud lies beyond it.
    """
    on_interface = np.zeros(len(points), bool)
    on_interface[interface] = True
    faces = boundary_faces(hexahedra[on_interface[hexahedra].any(axis=1)])
    faces = faces[on_interface[faces].all(axis=1)]
    if len(faces) == 0 or len(integration_points) == 0:
        return faces[:0]
    corners = points[faces]
    centres = corners.mean(axis=1)
    normals = 2 * area_vectors(corners)
    # The probe lies a third of a face's size beyond the face (the normal's length is twice the area).
    beyond = centres + normals / np.linalg.norm(normals, axis=1, keepdims=True) ** 0.5 / 4
    nearest = integration_points[cKDTree(integration_points).query(beyond)[1]]
    return faces[((nearest - centres) * normals).sum(axis=1) > 0]
