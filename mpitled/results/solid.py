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

#: A tetrahedron of the cloud has an integration point within this many cube roots of that point's volume; a tetrahedron
#: in a hollow of the cloud has none.
_REACH = 1.5
#: Array of all meshes: magnitude of the displacement at the nodes.
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
    """The meshes of a state."""
    model, displacement = state.model, 1e3 * state.shown_displacement
    points, cells, seed = 1e3 * model.points, model.hexahedra, state.seed
    interface = model.node_sets.get("interface", np.empty(0, np.int64))
    of_hexahedra, of_domains = (model.of_kind(kind).material for kind in ("hexahedra", "support domains"))

    def faces(of: Any) -> pyvista.PolyData:
        return with_displacement(pyvista.PolyData.from_regular_faces(points, of), displacement)

    def grid(kind: pyvista.CellType, of: Indices, material: NDArray[Any]) -> pyvista.UnstructuredGrid:
        made = pyvista.UnstructuredGrid({kind: of} if len(of) else {pyvista.CellType.VERTEX: of[:, :1]}, points)
        made.cell_data["material"] = material
        return with_displacement(made, displacement)

    tetrahedra = _tetrahedra(state, points, interface)
    nearest = cKDTree(1e3 * model.domain_points).query(points[tetrahedra].mean(axis=1))[1] if len(tetrahedra) else []
    between = faces(interface_faces(model.points, cells, interface, model.domain_points))
    cloud = grid(pyvista.CellType.TETRA, tetrahedra, of_domains[nearest])
    every = cells[:, FACES].reshape(-1, 4)
    walls = {side: faces(boundary_faces(cells[of])) for side, of in state.ventricles.items()}
    return Solid(
        hexahedra=grid(pyvista.CellType.HEXAHEDRON, cells, of_hexahedra),
        cloud=cloud,
        faces=faces(every[np.unique(np.sort(every, axis=1), axis=0, return_index=True)[1]]),
        interface=between,
        walls=walls,
        tumour=faces(seed[ConvexHull(points[seed]).simplices] if len(seed) else np.empty((0, 3), np.int64)),
        surface=faces(_surface(state, tetrahedra, interface, between)),
        sides=_sides(state, walls),
    )


def with_displacement(mesh: Any, displacement: NDArray[np.float64]) -> Any:
    """The mesh, which now has these displacements (n_nodes, 3), mm."""
    mesh.point_data["displacement"] = displacement
    mesh.point_data[SIZE] = np.linalg.norm(displacement, axis=1)
    return mesh


def deformed(mesh: Any, share: float) -> Any:
    """The mesh with a share of its displacements."""
    return mesh.warp_by_vector("displacement", factor=share) if share else mesh


def _sides(state: FinalState, walls: dict[str, pyvista.PolyData]) -> dict[int, tuple[str, str]]:
    """Letters at the ends of axes: x, y and z of a label image are right, front and up; else ventricles tell x."""
    if "labels" in state.metadata.get("deck", {}):
        return {0: ("L", "R"), 1: ("P", "A")}
    if len(walls) < 2:
        return {}
    left, right = (state.model.points[state.model.hexahedra[state.ventricles[side]], 0].mean() for side in VENTRICLES)
    return {0: ("L", "R") if left < right else ("R", "L")}


def _tetrahedra(state: FinalState, points: NDArray[np.float64], interface: Indices) -> Indices:
    """Delaunay tetrahedra (n, 4) of the cloud's nodes, without those in the tumour and in hollows."""
    model = state.model
    if len(model.domains) == 0:
        return np.empty((0, 4), np.int64)
    nodes = np.union1d(model.domains, interface)
    tetrahedra = nodes[Delaunay(points[nodes]).simplices]
    distance, nearest = cKDTree(1e3 * model.domain_points).query(points[tetrahedra].mean(axis=1))
    filled = distance < _REACH * 1e3 * np.cbrt(model.domain_volumes[nearest])
    tetrahedra = tetrahedra[filled & ~np.isin(tetrahedra, state.seed).all(axis=1)]
    edges = points[tetrahedra[:, 1:]] - points[tetrahedra[:, :1]]
    negative = np.linalg.det(edges) < 0
    tetrahedra[negative, :2] = tetrahedra[negative, 1::-1]
    return np.asarray(tetrahedra, np.int64)


def _surface(state: FinalState, tetrahedra: Indices, interface: Indices, between: pyvista.PolyData) -> Indices:
    """Faces (n, 4) of the outer surface, anticlockwise seen from outside; triangles have their last node twice.

    Faces of the hexahedra on the interface or the tumour do not count. The cloud has outer faces unless its interface
    is closed; of these, faces with a node of a hexahedron may reach into the hexahedra and are left out.
    """
    model = state.model
    inside = np.zeros(model.n_nodes, bool)
    inside[interface] = inside[state.seed] = True
    faces = boundary_faces(model.hexahedra)
    faces = faces[~inside[faces].all(axis=1)]
    if not len(tetrahedra) or (between.n_cells and between.n_open_edges == 0):
        return faces
    triangles = tetrahedra[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True, return_counts=True)
    triangles = triangles[first[count == 1]]
    inside[: model.n_fe_nodes] = True
    triangles = triangles[~inside[triangles].any(axis=1)]
    return np.concatenate([faces, triangles[:, [0, 1, 2, 2]]])


def frame_grid(result: store.Result, frame: int) -> pyvista.UnstructuredGrid:
    """A frame of a result as one mesh: see `mpitled.interface.RunResult.to_pyvista`."""
    hexahedra, numbers = result.hexahedra, result.point_data("node_id")
    rest = np.setdiff1d(np.arange(len(numbers)), hexahedra)
    cells = {pyvista.CellType.HEXAHEDRON: hexahedra, pyvista.CellType.VERTEX: rest[:, None]}
    made = pyvista.UnstructuredGrid({kind: nodes for kind, nodes in cells.items() if len(nodes)}, result.points)
    made.point_data["displacement"] = result.point_data("displacement", frame)
    of_frames = ((name, result.cell_data(name, frame), np.nan) for name in result.names("Cell"))
    for name, values, none in (
        *of_frames,
        ("material", result.cell_data("material"), -1),
        ("kind", result.cell_data("kind"), store.EFG_NODE),
    ):
        # Integration points are the last cells of the file, in the order of their points.
        at_points = np.full((len(numbers), *values.shape[1:]), none, values.dtype)
        at_points[numbers < 0] = values[len(values) - np.count_nonzero(numbers < 0) :]
        made.cell_data[name] = np.concatenate([values[: len(hexahedra)], at_points[rest]])
    return made
