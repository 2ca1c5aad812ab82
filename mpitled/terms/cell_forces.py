"""Internal forces of the cells, one term for each packed block of cells; their energies and stability bounds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from mpitled.cells.hexahedron_batches import HexahedronBatches
from mpitled.cells.packing import PackedCells
from mpitled.cells.support_domain_batches import SupportDomainBatches
from mpitled.cells.voxel_runs import SHORTEST_RUN, VoxelRuns
from mpitled.terms.state import State
from mpitled.terms.term import Scene, Side, StabilityBound, Term, energy


class CellForces(Term):
    """Forces of some of the cells of a block."""

    figures = (
        energy("strain", Side.STORED, always=True),
        energy("hourglass", Side.STORED, always=True),
        energy("stabilisation", Side.STORED, always=True),
    )

    def __init__(self, block: PackedCells, part: slice) -> None:
        self.name = block.name
        self._block, self._forces = block, block.forces(part)

    def apply(self, s: State) -> None:
        """Add the forces."""
        jacobian = self._forces(s.u_cells, s.f)
        if jacobian < s.smallest_jacobian:
            s.smallest_jacobian = jacobian


class BorderCells(CellForces):
    """Cells with shared nodes: their forces travel to other ranks while the interior cells are computed.

    A rank that is delayed for a moment does not delay its neighbours.
    """

    @classmethod
    def from_scene(cls, scene: Scene) -> Iterator[Term]:
        """One term for each block with cells at the border, on several ranks."""
        if scene.halo is not None:
            for block in scene.sub.packed:
                if block.n_border:
                    yield cls(block, slice(block.n_border))

    @classmethod
    def left_out(cls, scene: Scene, present: bool) -> Iterable[str]:
        """Nothing: see `InteriorCells`."""
        return ()


class InteriorCells(CellForces):
    """All other cells; checks the whole block."""

    @classmethod
    def from_scene(cls, scene: Scene) -> Iterator[Term]:
        """One term for each block."""
        for block in scene.sub.packed:
            yield cls(block, slice(None) if scene.halo is None else slice(block.n_border, None))

    @classmethod
    def left_out(cls, scene: Scene, present: bool) -> Iterator[str]:
        """Kinds of cells that the rank does not have."""
        sub = scene.sub
        kinds = {block.name for block in sub.packed}
        if sub.rows.n_own_hexahedra == 0:
            yield f"{VoxelRuns.name}, {HexahedronBatches.name}: no hexahedra"
        elif VoxelRuns.name not in kinds:
            yield f"{VoxelRuns.name}: no {SHORTEST_RUN} equal boxes in a row"
        elif HexahedronBatches.name not in kinds:
            yield f"{HexahedronBatches.name}: all are boxes, {SHORTEST_RUN} or more in a row"
        domains = [block for block in sub.packed if isinstance(block, SupportDomainBatches)]
        if not domains:
            yield f"{SupportDomainBatches.name}: no cloud"
        elif domains[0].position is None:
            yield "stabilisation of support domains: support.stabilisation = 0"

    def check(self, s: State, bound: StabilityBound) -> Mapping[str, float]:
        """Energies, J and bounds of all cells of the block."""
        return self._block.check(s.u_cells, bound.required, bound.factor, bound.jacobian, bound.tensor)
