"""How the cells of each kind are packed for their kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mpitled.cells import hexahedron_batches, support_domain_batches, voxel_runs
from mpitled.cells.kind import HEXAHEDRA, SUPPORT_DOMAINS
from mpitled.cells.packing import LocalCells, PackedCells


@dataclass(frozen=True, slots=True)
class CellOptions:
    """Options of the deck on which the forces of cells depend."""

    hourglass: float  # R_hg of eq. 4.22
    stabilisation: float  # share s of the stabilisation of support domains; 0: the paper's own
    rule: str = "mean"  # gradient of hexahedra: "mean", or "centre" as in eq. 4.6


def _pack_hexahedra(cells: LocalCells, options: CellOptions) -> list[PackedCells]:
    runs, others = voxel_runs.pack(cells, options.hourglass)
    return [*runs, *hexahedron_batches.pack(cells, others, options.hourglass, options.rule)]


def _pack_support_domains(cells: LocalCells, options: CellOptions) -> list[PackedCells]:
    return [*support_domain_batches.pack(cells, options.stabilisation)]


#: By the name of the kind. A new kind is registered here, too.
PACKERS: dict[str, Callable[[LocalCells, CellOptions], list[PackedCells]]] = {
    HEXAHEDRA.name: _pack_hexahedra,
    SUPPORT_DOMAINS.name: _pack_support_domains,
}
