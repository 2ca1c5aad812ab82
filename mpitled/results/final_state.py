"""The final state of a run: its model, and the field at the last frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import store
from mpitled.errors import InputError, damaged
from mpitled.model import Model

MODEL = "model.h5"
VENTRICLES = {"left": "left_ventricle", "right": "right_ventricle"}

_Floats = NDArray[np.float64]


@dataclass(frozen=True)  # without slots, which cached properties exclude
class FinalState:
    """The model and its state at the last frame, in SI units and in the model's order."""

    model: Model
    field: _Floats  # (n_nodes, 3), m, u_h
    displacement: _Floats  # (n_nodes, 3), m, as prescribed or computed: parameters at EFG nodes
    domain_displacement: _Floats  # (n_domains, 3), m, u_h at integration points
    jacobian: _Floats  # (n_cells,)
    time: float  # s
    complete: bool  # whether the run reached its end
    metadata: dict[str, Any]  # recorded at the start of the run
    figures: dict[str, Any]  # recorded at the end; empty if the run was killed

    @property
    def title(self) -> str:
        """Title of the scene, or the program's name."""
        return self.metadata.get("title") or "mpitled"

    @property
    def seed(self) -> NDArray[np.int64]:
        """Nodes (n,) on the surface of the tumour; empty without a tumour."""
        return self.model.node_sets.get("tumour", np.empty(0, np.int64))

    @property
    def centre(self) -> _Floats | None:
        """Centre (3,) of the tumour, m."""
        tumour = self.metadata.get("tumour")
        return np.array(tumour["centre_m"]) if tumour else None

    @property
    def shown_displacement(self) -> _Floats:
        """Displacements for pictures (n_nodes, 3), m: the field, but the prescribed displacement on the tumour."""
        displacement = self.field.copy()
        displacement[self.seed] = self.displacement[self.seed]
        return displacement

    @cached_property
    def volumes(self) -> _Floats:
        """Undeformed volumes of all cells (n_cells,), m^3."""
        return self.model.volumes

    @property
    def hexahedron_volumes(self) -> _Floats:
        """Undeformed volumes of the hexahedra (n_hexahedra,), m^3."""
        return self.volumes[self.model.cells_of("hexahedra")]

    @cached_property
    def cell_displacements(self) -> _Floats:
        """Magnitudes of the displacements at the centres of all cells (n_cells,), m."""
        return np.asarray(np.linalg.norm(self.model.at_cells(self.field, self.domain_displacement), axis=1))

    @cached_property
    def ventricles(self) -> dict[str, NDArray[np.int64]]:
        """Rows (n,) of `Model.hexahedra` in each ventricle of the model, left first."""
        sets = {side: self.model.cell_sets.get(name, np.empty(0, np.int64)) for side, name in VENTRICLES.items()}
        rows = {side: self.model.rows_of("hexahedra", cells) for side, cells in sets.items()}
        return {side: cells for side, cells in rows.items() if len(cells)}

    def cell_centre(self, cell: int) -> _Floats:
        """Undeformed centre (3,) of a cell, m."""
        block, row = self.model.find_cell(cell)
        nodes = self.model.points[block.nodes[row]]
        return np.asarray(block.columns["points"][row] if block.kind.meshfree else nodes.mean(axis=0))

    def cell_kind(self, cell: int) -> str:
        """Name of a cell's kind, such as "hexahedron"."""
        return self.model.find_cell(cell)[0].kind.singular


def read(directory: Path) -> FinalState:
    """Read the last frame and the model of the run in a directory.

    InputError if the directory has no result, or if result and model do not belong together.
    """
    if not directory.is_dir():
        raise InputError(f"{directory}: is not a folder; give the folder that 'mpitled run' wrote")
    with store.open_result(directory) as result, damaged(result.path, "run the deck again"):
        if result.n_frames == 0:
            raise InputError(f"{result.path}: has no frame yet; run the deck again")
        model = store.read_model(directory / MODEL)
        if not np.array_equal(result.node_points, model.points) or len(result.in_cells("J")) != model.n_cells:
            raise InputError(f"{result.path}: does not belong to the model beside it, {MODEL}; run the deck again")
        return FinalState(
            model=model,
            field=result.at_nodes("displacement", -1),
            displacement=result.at_nodes("parameters", -1),
            domain_displacement=result.at_integration_points("displacement", -1),
            jacobian=result.in_cells("J", -1),
            time=float(result.times[-1]),
            complete=result.complete,
            metadata=result.metadata,
            figures=result.figures,
        )
