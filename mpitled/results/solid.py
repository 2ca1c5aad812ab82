"""The body as it is drawn, in mm: a piecewise linear solid, and what planes cut out of it.

Each hexahedron is twelve tetrahedra around its centre, whose faces neighbours share; the cloud is the Delaunay
tetrahedra of its nodes (its support domains overlap and have no shape of their own).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, cKDTree

from mpitled.meshing.faces import boundary_faces, interface_faces
from mpitled.model import Model

#: A place of the cloud has an integration point this near, in cube roots of that point's volume; a hollow has none.
_REACH = 1.5

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Solid:
    """What is drawn, with the displacement of each vertex."""

    points: NDArray[np.float64]  # (n, 3), mm, undeformed: nodes, then the hexahedra's centres
    displacement: NDArray[np.float64]  # (n, 3), mm
    hexahedra: NDArray[np.int64]  # (m, 8)
    centres: NDArray[np.int64]  # (m,), vertex in the middle of each hexahedron
    cloud: NDArray[np.int64]  # (k, 4), tetrahedra
    interface: NDArray[np.int64]  # (k, 3), triangles between hexahedra and cloud
    walls: dict[str, NDArray[np.int64]]  # ventricle -> triangles (k, 3) around it
    sides: dict[int, tuple[str, str]]  # axis -> letters of the body's sides at its low and its high end, where known
    tumour: NDArray[np.int64]  # (k, 3), triangles around it
    surface: NDArray[np.int64]  # (k, 3), triangles of the body's outer surface


def solid_of(model: Model, displacement: NDArray[np.float64], *, anatomical: bool = False) -> Solid:
    """The solid of a model whose nodes have these displacements (n_nodes, 3), m.

    anatomical: x runs to the right, y to the front and z up, as in the world of an image of labels.
    """
    points, n, none = 1e3 * model.points, model.n_nodes, np.empty(0, np.int64)
    cells = model.hexahedra
    walls = {}
    for name in ("left_ventricle", "right_ventricle"):
        ventricle = model.cell_sets.get(name, none)
        ventricle = ventricle[ventricle < len(cells)]
        if len(ventricle):
            walls[name] = triangles_of(boundary_faces(cells[ventricle]))
    seed, interface = (model.node_sets.get(name, none) for name in ("tumour", "interface"))
    cloud = _cloud(model, points, seed, interface)
    between = triangles_of(interface_faces(model.points, cells, interface, model.domain_points))
    return Solid(
        points=_with_centres(points, cells),
        displacement=_with_centres(1e3 * displacement, cells),
        hexahedra=cells,
        centres=np.arange(n, n + len(cells)),
        cloud=cloud,
        interface=between,
        walls=walls,
        sides=_sides(points, walls, anatomical),
        tumour=seed[ConvexHull(points[seed]).simplices] if len(seed) else np.empty((0, 3), np.int64),
        surface=_surface(model, cloud, seed, interface, between),
    )


def _sides(points: Points, walls: dict[str, NDArray[np.int64]], anatomical: bool) -> dict[int, tuple[str, str]]:
    """Letters at the ends of axes: of the world of images, or left and right alone from where the ventricles lie."""
    if anatomical:
        return {0: ("L", "R"), 1: ("P", "A")}
    if len(walls) < 2:
        return {}
    left, right = (points[walls[f"{side}_ventricle"], 0].mean() for side in ("left", "right"))
    return {0: ("L", "R") if left < right else ("R", "L")}


def displaced(solid: Solid, displacement: NDArray[np.float64]) -> Solid:
    """The same with other displacements (n_nodes, 3), m, of its nodes."""
    return replace(solid, displacement=_with_centres(1e3 * displacement, solid.hexahedra))


def _with_centres(values: NDArray[np.float64], hexahedra: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.concatenate([values, values[hexahedra].mean(axis=1)])


def _cloud(
    model: Model, points: NDArray[np.float64], seed: NDArray[np.int64], interface: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Delaunay tetrahedra (n, 4) of the nodes in support domains, without those in the tumour or where no cloud is."""
    if len(model.domains) == 0:
        return np.empty((0, 4), np.int64)
    nodes = np.union1d(model.domains, interface)
    tetrahedra = nodes[Delaunay(points[nodes]).simplices]
    distance, nearest = cKDTree(1e3 * model.domain_points).query(points[tetrahedra].mean(axis=1))
    filled = distance < _REACH * 1e3 * np.cbrt(model.domain_volumes[nearest])
    return tetrahedra[filled & ~np.isin(tetrahedra, seed).all(axis=1)]


def _surface(
    model: Model,
    cloud: NDArray[np.int64],
    seed: NDArray[np.int64],
    interface: NDArray[np.int64],
    between: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Triangles (n, 3) of hexahedra and of the cloud that are of one cell alone, without interface and tumour.

    Anticlockwise seen from outside. Tetrahedra next to the interface may end short of it or reach into hexahedra, of
    which support domains take nodes: their triangles there are left out too, and all of the cloud if the triangles
    `between` it and hexahedra are closed, for then it lies inside.
    """
    inside = np.zeros(model.n_nodes, bool)
    inside[interface] = inside[seed] = True
    faces = boundary_faces(model.hexahedra)
    of_hexahedra = triangles_of(faces[~inside[faces].all(axis=1)])
    if _is_closed(between):
        return of_hexahedra
    # Each tetrahedron without one of its corners in turn, which lies behind the others.
    behind = np.concatenate([np.roll(cloud, -k, axis=1) for k in range(4)])
    _, first, count = np.unique(np.sort(behind[:, 1:], axis=1), axis=0, return_index=True, return_counts=True)
    behind = behind[first[count == 1]]
    last, a, b, c = np.moveaxis(model.points[behind], 1, 0)
    inwards = (np.cross(b - a, c - a) * (last - a)).sum(axis=1) > 0
    behind[inwards, 1:3] = behind[inwards, 2:0:-1]
    of_cloud = behind[:, 1:]
    inside[: model.n_fe_nodes] = True
    return np.concatenate([of_hexahedra, of_cloud[~inside[of_cloud].any(axis=1)]])


def _is_closed(triangles: NDArray[np.int64]) -> bool:
    """Whether triangles (n, 3) are the whole boundary of something: as many of them on both sides of every edge."""
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    return len(triangles) > 0 and bool((count % 2 == 0).all())


def triangles_of(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Two triangles (2 n, 3) of each face (n, 4), cut from its lowest node on, so that neighbours cut alike."""
    turned = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(4)) % 4, axis=1)
    return np.concatenate([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]])


# --- cuts ----------------------------------------------------------------------------------------------------------


def _crossed(height: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """The cells (n, k) that have vertices on both sides of the plane height = 0."""
    above = height[cells] >= 0
    return cells[above.any(axis=1) & ~above.all(axis=1)]


def _on_edges(vertices: Points, height: NDArray[np.float64], a: NDArray[np.int64], b: NDArray[np.int64]) -> Points:
    """Where the edges from a (n,) to b (n,) cross the plane: rows of `vertices`, interpolated."""
    t = (height[a] / (height[a] - height[b]))[:, None]
    return (1 - t) * vertices[a] + t * vertices[b]


def cut_tetrahedra(vertices: Points, height: NDArray[np.float64], tetrahedra: NDArray[np.int64]) -> Points:
    """Triangles (n, 3, k) in which the plane height = 0 cuts tetrahedra (m, 4) of vertices (n_vertices, k)."""
    cells = _crossed(height, tetrahedra)
    above = height[cells] >= 0
    cells = np.take_along_axis(cells, np.argsort(above, axis=1, kind="stable"), axis=1)
    n_above = above.sum(axis=1)
    pieces = []
    for n, triangles in (
        (1, [[(3, 0), (3, 1), (3, 2)]]),
        (3, [[(0, 1), (0, 2), (0, 3)]]),
        (2, [[(0, 2), (0, 3), (1, 3)], [(0, 2), (1, 3), (1, 2)]]),
    ):
        some = cells[n_above == n]
        for edges in triangles:
            pieces.append(np.stack([_on_edges(vertices, height, some[:, a], some[:, b]) for a, b in edges], axis=1))
    return np.concatenate(pieces)


def cut_triangles(vertices: Points, height: NDArray[np.float64], triangles: NDArray[np.int64]) -> Points:
    """Segments (n, 2, k) in which the plane height = 0 cuts triangles (m, 3) of vertices (n_vertices, k)."""
    cells = _crossed(height, triangles)
    above = height[cells] >= 0
    alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), above.argmin(axis=1))
    cells = np.take_along_axis(cells, (alone[:, None] + np.arange(3)) % 3, axis=1)
    return np.stack([_on_edges(vertices, height, cells[:, 0], cells[:, i]) for i in (1, 2)], axis=1)
