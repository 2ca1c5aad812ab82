"""The discrete model: blocks of cells, masses and prescribed motion, from a mesh and a deck."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mpitled.cells.kind import KINDS, CellKind
from mpitled.laws import Material

#: Prefix of a remark that is a warning; other remarks are notes.
WARNING = "warning: "


@dataclass(frozen=True, slots=True)
class CellBlock:
    """Cells of one kind, under a name."""

    name: str
    kind: CellKind
    nodes: NDArray[np.int64]  # (n, k), global nodes of each cell
    material: NDArray[np.int16]  # (n,), index into the materials of the model
    columns: dict[str, NDArray[np.float64]] = field(default_factory=dict)  # (n, ...), see `CellKind.columns`

    def __len__(self) -> int:
        return len(self.nodes)

    def volumes(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Exact volumes (n,), m^3; points (n_nodes, 3), m, of the model."""
        return self.kind.exact_volumes(points, self.nodes) if self.kind.exact_volumes else self.columns["volumes"]

    def geometry(
        self, points: NDArray[np.float64], rule: str = "mean"
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Gradients (n, k, 3), 1/m, and volumes (n,), m^3, of the one integration point; rule: of hexahedra."""
        if self.kind.geometry:
            return self.kind.geometry(points, self.nodes, rule)
        return self.columns["gradients"], self.columns["volumes"]


def empty_block(kind: CellKind) -> CellBlock:
    """A block without cells, under the name of its kind."""
    k = kind.n_nodes or 0
    columns = {name: np.empty((0, *(k if n == "n" else int(n) for n in row))) for name, row in kind.columns.items()}
    return CellBlock(kind.name, kind, np.empty((0, k), np.int64), np.empty(0, np.int16), columns)


@dataclass(frozen=True, slots=True)
class ModelFigures:
    """Numbers that were counted or measured while the model was built."""

    critical_step_typical_s: float = np.nan  # median of the nodes' critical time steps outside the cloud, if any
    mass_kg: float = np.nan
    volume_m3: float = np.nan
    cloud_parts: int = 0
    orphans_removed: int = 0  # EFG nodes without a support domain
    worst_condition: float = 1.0  # of the moving least squares
    domains_limited: int = 0  # support domains that do not hold their nearest nodes because of a limit
    memberships_added: int = 0  # to bring nodes into enough support domains
    domains_repaired: int = 0  # support domains with a singular or badly conditioned fit
    domains_across: int = 0  # support domains with nodes outside their part of the cloud
    consistency_before: float | None = None  # largest imbalance of a constant stress, relative; None without a cloud
    consistency_after: float | None = None
    consistency_change: float | None = None  # of the gradients, relative
    of_mesh: dict[str, float] = field(default_factory=dict)  # the mesher's own numbers by name

    def flat(self) -> dict[str, float]:
        """All numbers by name, first those of the mesher; None is left out."""
        figures = asdict(self)
        return figures.pop("of_mesh") | {name: value for name, value in figures.items() if value is not None}


@dataclass(frozen=True, slots=True)
class Model:
    """Input of the time loop and the report, in SI units and global numbers.

    Nodes are FE nodes first, then EFG nodes. Cells are numbered block after block.
    """

    points: NDArray[np.float64]  # (n_nodes, 3), m
    n_fe_nodes: int
    node_ids: NDArray[np.int64]  # (n_nodes,), node numbers in the input file
    blocks: tuple[CellBlock, ...]
    field_block: str  # name of the block that interpolates the field at EFG nodes; "" without EFG nodes
    field_domains: NDArray[np.int64]  # (n_efg_nodes,), the cell of that block that gives the field at an EFG node
    field_shapes: NDArray[np.float64]  # (n_efg_nodes, k), its MLS shape functions there
    materials: tuple[Material, ...]
    mass: NDArray[np.float64]  # (n_nodes,), kg
    prescribed_dofs: NDArray[np.int64]  # (n_prescribed,), 3 node + direction, ascending
    prescribed_displacements: NDArray[np.float64]  # (n_prescribed,), m at full load; 0 where fixed
    rotation_paths: NDArray[np.float64]  # (n_prescribed, 3), see `loading.rotation_path`; 0 where the path is straight
    node_sets: dict[str, NDArray[np.int64]]
    cell_sets: dict[str, NDArray[np.int64]]
    surface_areas: NDArray[np.float64] | None = None  # (n_nodes, 3), m^2, as in the mesh: for the export
    figures: ModelFigures = field(default_factory=ModelFigures)
    remarks: tuple[str, ...] = ()  # one line each: skipped, merged, repaired or suspicious input

    @property
    def n_nodes(self) -> int:
        return len(self.points)

    @property
    def n_cells(self) -> int:
        return sum(map(len, self.blocks))

    def block(self, name: str) -> CellBlock:
        """The block of that name, or an empty block of the kind of that name; KeyError if there is neither."""
        found = [block for block in self.blocks if block.name == name]
        return found[0] if found else empty_block(KINDS[name])

    def numbered(self) -> Iterator[tuple[slice, CellBlock]]:
        """The range of cell numbers of each block, and the block."""
        first = 0
        for block in self.blocks:
            yield slice(first, first + len(block)), block
            first += len(block)

    def of_kind(self, kind: str) -> CellBlock:
        """All cells of a kind as one block, in the order of the model."""
        of_kind = [block for block in self.blocks if block.kind.name == kind]
        if len(of_kind) < 2:
            return of_kind[0] if of_kind else empty_block(KINDS[kind])
        columns = {name: np.concatenate([block.columns[name] for block in of_kind]) for name in of_kind[0].columns}
        nodes, material = (np.concatenate([getattr(block, a) for block in of_kind]) for a in ("nodes", "material"))
        return replace(of_kind[0], name=kind, nodes=nodes, material=material, columns=columns)

    def cells_of(self, kind: str) -> NDArray[np.int64]:
        """Numbers, ascending, of the cells of a kind, in the order of `of_kind`."""
        numbers = [np.arange(cells.start, cells.stop) for cells, block in self.numbered() if block.kind.name == kind]
        return np.concatenate([np.empty(0, np.int64), *numbers])

    def rows_of(self, kind: str, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rows of `of_kind` of the cells (ascending) that are of the kind."""
        return np.flatnonzero(np.isin(self.cells_of(kind), cells))

    def find_cell(self, cell: int) -> tuple[CellBlock, int]:
        """The block of a cell, and the cell's row in the block."""
        cells, block = next((cells, block) for cells, block in self.numbered() if cell < cells.stop)
        return block, cell - cells.start

    def at_cells(self, nodal: NDArray[np.float64], at_points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cell values (n_cells, ...): nodal means (n_nodes, ...) in solids, `at_points` in mesh-free cells."""
        values, first = [], 0
        for block in self.blocks:
            if block.kind.meshfree:
                values.append(at_points[first : first + len(block)])
                first += len(block)
            else:
                values.append(nodal[block.nodes].mean(axis=1))
        return np.concatenate(values)

    @property
    def hexahedra(self) -> NDArray[np.int64]:
        """(n_hexahedra, 8), nodes of all hexahedra, in Abaqus/VTK order."""
        return self.of_kind("hexahedra").nodes

    @property
    def domains(self) -> NDArray[np.int64]:
        """(n_domains, k), nodes of all support domains."""
        return self.of_kind("support domains").nodes

    @property
    def domain_points(self) -> NDArray[np.float64]:
        """(n_domains, 3), m, integration points."""
        return self.of_kind("support domains").columns["points"]

    @property
    def domain_volumes(self) -> NDArray[np.float64]:
        """(n_domains,), m^3."""
        return self.of_kind("support domains").columns["volumes"]

    @property
    def domain_gradients(self) -> NDArray[np.float64]:
        """(n_domains, k, 3), 1/m."""
        return self.of_kind("support domains").columns["gradients"]

    @property
    def domain_shapes(self) -> NDArray[np.float64]:
        """(n_domains, k), MLS shape functions at the integration points."""
        return self.of_kind("support domains").columns["shapes"]

    @property
    def material(self) -> NDArray[np.int16]:
        """(n_cells,), index into `materials`."""
        return np.concatenate([np.empty(0, np.int16), *(block.material for block in self.blocks)])

    @property
    def volumes(self) -> NDArray[np.float64]:
        """(n_cells,), m^3."""
        return np.concatenate([np.empty(0), *(block.volumes(self.points) for block in self.blocks)])

    @property
    def warnings(self) -> list[str]:
        """Warnings among the remarks, without their prefix."""
        return [remark.removeprefix(WARNING) for remark in self.remarks if remark.startswith(WARNING)]

    @property
    def notes(self) -> list[str]:
        """Remarks that are no warnings."""
        return [remark for remark in self.remarks if not remark.startswith(WARNING)]
