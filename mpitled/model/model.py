"""The discrete model: cells with gradients and volumes, masses and prescribed motion, from a mesh and a deck."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mpitled.laws import Material

#: How remarks begin that are warnings; the others are notes.
WARNING = "warning: "


@dataclass(frozen=True, slots=True)
class Model:
    """All that the time loop and the report need, in SI units and global numbers.

    Nodes are FE nodes first, then EFG nodes; cells are hexahedra first, then support domains.
    """

    points: NDArray[np.float64]  # (n_nodes, 3), m
    n_fe_nodes: int
    node_ids: NDArray[np.int64]  # (n_nodes,), numbers in the file that the nodes came from
    hexahedra: NDArray[np.int64]  # (n_hexahedra, 8), Abaqus/VTK order
    domains: NDArray[np.int64]  # (n_domains, n), nodes of each support domain
    domain_points: NDArray[np.float64]  # (n_domains, 3), integration points, m
    domain_volumes: NDArray[np.float64]  # (n_domains,), m^3
    domain_gradients: NDArray[np.float64]  # (n_domains, n, 3), 1/m
    domain_shapes: NDArray[np.float64]  # (n_domains, n), MLS values at the integration point
    field_domains: NDArray[np.int64]  # (n_efg_nodes,), the support domain that gives the field at an EFG node
    field_shapes: NDArray[np.float64]  # (n_efg_nodes, n), its MLS values there
    material: NDArray[np.int16]  # (n_cells,), index into `materials`
    materials: tuple[Material, ...]
    mass: NDArray[np.float64]  # (n_nodes,), kg
    prescribed_dofs: NDArray[np.int64]  # (n_prescribed,), 3 node + direction, ascending
    prescribed_displacements: NDArray[np.float64]  # (n_prescribed,), m at full load; 0 where fixed
    prescribed_turns: NDArray[np.float64]  # (n_prescribed, 3), how it gets there if not straight, see `loading.turn`
    node_sets: dict[str, NDArray[np.int64]]
    cell_sets: dict[str, NDArray[np.int64]]
    surface_areas: NDArray[np.float64] | None = None  # (n_nodes, 3), m^2, as the mesh has them: for the export
    figures: dict[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()  # what building it skipped, merged, repaired or found odd, a line each

    @property
    def n_nodes(self) -> int:
        return len(self.points)

    @property
    def n_cells(self) -> int:
        return len(self.hexahedra) + len(self.domains)

    @property
    def warnings(self) -> list[str]:
        """Remarks for which a result may not be what it seems, without the word."""
        return [remark.removeprefix(WARNING) for remark in self.remarks if remark.startswith(WARNING)]

    @property
    def notes(self) -> list[str]:
        """The other remarks."""
        return [remark for remark in self.remarks if not remark.startswith(WARNING)]
