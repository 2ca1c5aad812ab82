"""Kinds of cells: the facts about each kind that the model, its file, the partition and the result need."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mpitled.cells import hexahedra

#: (gradients (n, k, 3), 1/m; volumes (n,), m^3) from node positions (n_nodes, 3), m; cells (n, k); the gradient rule.
Geometry = Callable[[NDArray[np.float64], NDArray[np.integer], str], tuple[NDArray[np.float64], NDArray[np.float64]]]


@dataclass(frozen=True, slots=True)
class CellKind:
    """One kind of cell.

    A kind with faces is a solid: its gradients and volumes follow from its nodes. A mesh-free kind has no shape: the
    model stores its integration points, volumes, gradients and shape functions, and the result shows each integration
    point as a vertex.
    """

    name: str
    singular: str  # one such cell, in messages
    n_nodes: int | None  # nodes per cell; None: free, the same in all cells of a block
    vtk_type: int  # VTK cell type in the result
    code: int  # cell data "kind" in the result
    node_cost: float  # cost of a step per node of a cell, relative to a box in a voxel run
    faces: NDArray[np.int64] | None = None  # (n_faces, nodes per face), local nodes; None: joined by shared nodes
    #: Columns of float64 that the model stores for each cell, with their shapes; "n" is the number of nodes per cell.
    columns: Mapping[str, tuple[int | str, ...]] = field(default_factory=dict)
    geometry: Geometry | None = None  # None: columns "gradients" and "volumes"
    exact_volumes: Callable[[NDArray[np.float64], NDArray[np.integer]], NDArray[np.float64]] | None = None

    @property
    def meshfree(self) -> bool:
        return self.faces is None


HEXAHEDRA = CellKind(
    name="hexahedra",
    singular="hexahedron",
    n_nodes=8,
    vtk_type=12,
    code=0,
    node_cost=0.475,  # dynamic relaxation, double precision: 3.8 for a hexahedron outside voxel runs
    faces=np.array([[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]),
    geometry=hexahedra.geometry,
    exact_volumes=hexahedra.volumes,
)

SUPPORT_DOMAINS = CellKind(
    name="support domains",
    singular="support domain",
    n_nodes=None,
    vtk_type=1,
    code=2,
    node_cost=0.36,  # dynamic relaxation, double precision; 0.40 in central difference, 0.26 in single precision
    columns={"points": (3,), "volumes": (), "gradients": ("n", 3), "shapes": ("n",)},
)

#: All kinds by name. A new kind is registered here.
KINDS = {kind.name: kind for kind in (HEXAHEDRA, SUPPORT_DOMAINS)}
