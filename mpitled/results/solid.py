"""The deformed body as PyVista meshes, in mm, for cuts and for views in three dimensions.

The cloud is drawn as the Delaunay tetrahedra of its nodes: support domains overlap and have no shape of their own.
This module and its importers need the extra `pictures`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyvista
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, cKDTree

from mpitled import store
from mpitled.meshing.faces import FACES, boundary_faces, interface_faces
from mpitled.results.final_state import VENTRICLES, FinalState

#: Tetrahedra farther from each integration point than this multiple of the cube root of the point's volume are in a
#: hollow of the cloud, and are not drawn.
_MAX_DISTANCE = 1.5
#: Name of an array of all meshes: magnitude of the displacement at the nodes.
SIZE = "displacement (mm)"

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Solid:
    """Meshes of the undeformed body; each has all nodes of the model as points, with their displacements."""

    hexahedra: pyvista.UnstructuredGrid  # with the cell array "material"
    cloud: pyvista.UnstructuredGrid  # tetrahedra, with the cell array "material"
    faces: pyvista.PolyData  # all faces of the hexahedra, each once
    interface: pyvista.PolyData  # faces between hexahedra and cloud
    walls: dict[str, pyvista.PolyData]  # side -> faces around the ventricle
    tumour: pyvista.PolyData  # triangles around the tumour
    surface: pyvista.PolyData  # faces of the body's outer surface, normals outwards
    sides: dict[int, tuple[str, str]]  # axis -> letters of the body's sides at its low and its high end, where known

    @property
    def points(self) -> NDArray[np.float64]:
        """Nodes (n_nodes, 3), mm, undeformed."""
        return np.asarray(self.hexahedra.points)

    @property
    def displacement(self) -> NDArray[np.float64]:
        """Displacements of the nodes (n_nodes, 3), mm."""
        return np.asarray(self.hexahedra.point_data["displacement"])


def solid_of(state: FinalState) -> Solid:
    """The meshes of the model and the displacements of a state."""
    model, displacement = state.model, 1e3 * state.shown_displacement
    points, cells, seed = 1e3 * model.points, model.hexahedra, state.seed
    interface = model.node_sets.get("interface", np.empty(0, np.int64))
    of_hexahedra, of_domains = (model.of_kind(kind).material for kind in ("hexahedra", "support domains"))

    def faces(nodes: Any) -> pyvista.PolyData:
        return with_displacement(pyvista.PolyData.from_regular_faces(points, nodes), displacement)

    def grid(kind: pyvista.CellType, nodes: Indices, material: NDArray[Any]) -> pyvista.UnstructuredGrid:
        cells = {kind: nodes} if len(nodes) else {pyvista.CellType.VERTEX: nodes[:, :1]}
        mesh = pyvista.UnstructuredGrid(cells, points)
        mesh.cell_data["material"] = material
        return with_displacement(mesh, displacement)

    tetrahedra = _tetrahedra(state, points, interface)
    nearest = cKDTree(1e3 * model.domain_points).query(points[tetrahedra].mean(axis=1))[1] if len(tetrahedra) else []
    end_of_cloud = faces(interface_faces(model.points, cells, interface, model.domain_points))
    all_faces = cells[:, FACES].reshape(-1, 4)
    walls = {side: faces(boundary_faces(cells[rows])) for side, rows in state.ventricles.items()}
    return Solid(
        hexahedra=grid(pyvista.CellType.HEXAHEDRON, cells, of_hexahedra),
        cloud=grid(pyvista.CellType.TETRA, tetrahedra, of_domains[nearest]),
        faces=faces(all_faces[np.unique(np.sort(all_faces, axis=1), axis=0, return_index=True)[1]]),
        interface=end_of_cloud,
        walls=walls,
        tumour=faces(seed[ConvexHull(points[seed]).simplices] if len(seed) else np.empty((0, 3), np.int64)),
        surface=faces(_surface(state, tetrahedra, interface, end_of_cloud)),
        sides=_sides(state, walls),
    )


def with_displacement(mesh: Any, displacement: NDArray[np.float64]) -> Any:
    """Set the displacements (n_nodes, 3), mm, of a mesh, and return the mesh."""
    mesh.point_data["displacement"] = displacement
    mesh.point_data[SIZE] = np.linalg.norm(displacement, axis=1)
    return mesh


def deformed(mesh: Any, share: float) -> Any:
    """The mesh with a share of its displacements."""
    return mesh.warp_by_vector("displacement", factor=share) if share else mesh


def _sides(state: FinalState, walls: dict[str, pyvista.PolyData]) -> dict[int, tuple[str, str]]:
    """Letters at the ends of axes. Those of a label image are right, front and up; ventricles give those of x."""
    if "labels" in state.metadata.get("deck", {}):
        return {0: ("L", "R"), 1: ("P", "A")}
    if len(walls) < 2:
        return {}
    left, right = (state.model.points[state.model.hexahedra[state.ventricles[side]], 0].mean() for side in VENTRICLES)
    return {0: ("L", "R") if left < right else ("R", "L")}


def _tetrahedra(state: FinalState, points: NDArray[np.float64], interface: Indices) -> Indices:
    """Delaunay tetrahedra (n, 4) of the cloud's nodes, except in the tumour and in hollows; positive volumes."""
    model = state.model
    if len(model.domains) == 0:
        return np.empty((0, 4), np.int64)
    nodes = np.union1d(model.domains, interface)
    tetrahedra = nodes[Delaunay(points[nodes]).simplices]
    distance, nearest = cKDTree(1e3 * model.domain_points).query(points[tetrahedra].mean(axis=1))
    filled = distance < _MAX_DISTANCE * 1e3 * np.cbrt(model.domain_volumes[nearest])
    tetrahedra = tetrahedra[filled & ~np.isin(tetrahedra, state.seed).all(axis=1)]
    edges = points[tetrahedra[:, 1:]] - points[tetrahedra[:, :1]]
    negative = np.linalg.det(edges) < 0
    tetrahedra[negative, :2] = tetrahedra[negative, 1::-1]
    return np.asarray(tetrahedra, np.int64)


def _surface(state: FinalState, tetrahedra: Indices, interface: Indices, end_of_cloud: pyvista.PolyData) -> Indices:
    """Faces (n, 4) of the outer surface, anticlockwise seen from outside; triangles have the last node twice.

    Faces of hexahedra on the interface or the tumour are omitted. The cloud has outer faces unless the interface is
    closed. Outer faces of the cloud with a node of a hexahedron are omitted: they may extend into the hexahedra.
    """
    model = state.model
    inside = np.zeros(model.n_nodes, bool)
    inside[interface] = inside[state.seed] = True
    faces = boundary_faces(model.hexahedra)
    faces = faces[~inside[faces].all(axis=1)]
    if not len(tetrahedra) or (end_of_cloud.n_cells and end_of_cloud.n_open_edges == 0):
        return faces
    triangles = tetrahedra[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True, return_counts=True)
    triangles = triangles[first[count == 1]]
    inside[: model.n_fe_nodes] = True
    triangles = triangles[~inside[triangles].any(axis=1)]
    return np.concatenate([faces, triangles[:, [0, 1, 2, 2]]])


def frame_grid(result: store.Result, frame: int) -> pyvista.UnstructuredGrid:
    """A frame of a result as one mesh: see `mpitled.interface.RunResult.to_pyvista`."""
    hexahedra = result.hexahedra
    integration_points = result.point_data("node_id") < 0
    vertices = np.setdiff1d(np.arange(len(integration_points)), hexahedra)
    cells = {pyvista.CellType.HEXAHEDRON: hexahedra, pyvista.CellType.VERTEX: vertices[:, None]}
    grid = pyvista.UnstructuredGrid({kind: nodes for kind, nodes in cells.items() if len(nodes)}, result.points)
    grid.point_data["displacement"] = result.point_data("displacement", frame)
    arrays = [(name, result.cell_data(name, frame), np.nan) for name in result.names("Cell")]
    arrays += [("material", result.cell_data("material"), -1), ("kind", result.cell_data("kind"), store.EFG_NODE)]
    for name, values, at_nodes in arrays:
        # Integration points are the last cells of the file, in the order of their points.
        at_points = np.full((len(integration_points), *values.shape[1:]), at_nodes, values.dtype)
        at_points[integration_points] = values[len(values) - np.count_nonzero(integration_points) :]
        grid.cell_data[name] = np.concatenate([values[: len(hexahedra)], at_points[vertices]])
    return grid
