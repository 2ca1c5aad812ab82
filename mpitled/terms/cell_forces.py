"""Internal forces of the cells, one term for each packed block of cells; their energies and stability bounds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.parallel.subdomain import SHORTEST_RUN, DomainBatches, HexahedronBatches, Subdomain, VoxelRuns
from mpitled.terms.state import State
from mpitled.terms.term import Scene, Side, StabilityBound, Term, energy

#: Adds the forces (N) of cells at displacements u to f; returns the smallest J among them.
Forces = Callable[[NDArray[np.floating], NDArray[np.floating]], float]


class PackedCells(Protocol):
    """A block of cells of one kind, packed as its kernels take them; those with shared nodes come first."""

    @property
    def name(self) -> str:
        """Name of the kind."""

    @property
    def n_border(self) -> int:
        """Number of leading batches or runs with nodes that other ranks have too."""

    def forces(self, part: slice) -> Forces:
        """The function that adds the forces of some of the batches or runs."""

    def check(
        self,
        u: NDArray[np.floating],
        required: NDArray[np.float64],
        factor: float,
        jacobian: NDArray[np.float32],
        tensor: NDArray[np.float64] | None,
    ) -> dict[str, float]:
        """Energies (J) by the names of `CellForces.figures`; fills or adds to the arrays of a `StabilityBound`."""


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
            for block in packed_blocks(scene.sub):
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
        for block in packed_blocks(scene.sub):
            yield cls(block, slice(None) if scene.halo is None else slice(block.n_border, None))

    @classmethod
    def left_out(cls, scene: Scene, present: bool) -> Iterator[str]:
        """Kinds of cells that the rank does not have."""
        sub = scene.sub
        if sub.rows.n_own_hexahedra == 0:
            yield f"{_Voxels.name}, {_Hexahedra.name}: no hexahedra"
        elif sub.runs is None:
            yield f"{_Voxels.name}: no {SHORTEST_RUN} equal boxes in a row"
        elif sub.hexahedra is None:
            yield f"{_Hexahedra.name}: all are boxes, {SHORTEST_RUN} or more in a row"
        if sub.domains is None:
            yield f"{_Domains.name}: no cloud"
        elif sub.domains.position is None:
            yield "stabilisation of support domains: support.stabilisation = 0"

    def check(self, s: State, bound: StabilityBound) -> Mapping[str, float]:
        """Energies, J and bounds of all cells of the block."""
        return self._block.check(s.u_cells, bound.required, bound.factor, bound.jacobian, bound.tensor)


# --- the blocks of a subdomain ----------------------------------------------------------------------------------------


def packed_blocks(sub: Subdomain) -> list[PackedCells]:
    """The blocks of cells that a rank has."""
    blocks: list[PackedCells] = []
    if sub.runs is not None:
        blocks.append(_Voxels(sub.runs))
    if sub.hexahedra is not None:
        blocks.append(_Hexahedra(sub.hexahedra))
    if sub.domains is not None:
        blocks.append(_Domains(sub.domains))
    return blocks


class _Block:
    """Adapts packed arrays to `PackedCells`."""

    def __init__(self, arrays: Any) -> None:
        self._arrays, self.n_border = arrays, int(arrays.border)


class _Voxels(_Block):
    name: ClassVar[str] = "voxel hexahedra"
    _arrays: VoxelRuns

    def forces(self, part: slice) -> Forces:
        a = self._arrays
        some = [np.ascontiguousarray(x[..., part]) for x in (a.line, a.length, a.along, a.scale, a.coefficient)]
        return lambda u, f: kernels.voxel_forces(u, f, *some)

    def check(self, u, required, factor, jacobian, tensor):  # type: ignore[no-untyped-def]
        a = self._arrays
        strain, hourglass = kernels.voxel_survey(
            u, a.line, a.length, a.along, a.first_cell, a.scale, a.coefficient, a.gram, required, factor, jacobian
        )
        return {"strain": strain, "hourglass": hourglass}


class _Hexahedra(_Block):
    name: ClassVar[str] = "hexahedra"
    _arrays: HexahedronBatches

    def forces(self, part: slice) -> Forces:
        a = self._arrays
        some = [x[part] for x in (a.nodes, a.in_row, a.geometry, a.coefficient)]
        return lambda u, f: kernels.hexahedron_forces(u, f, *some)

    def check(self, u, required, factor, jacobian, tensor):  # type: ignore[no-untyped-def]
        a = self._arrays
        strain, hourglass = kernels.hexahedron_survey(
            u, a.nodes, a.cells, a.geometry, a.coefficient, a.gram, a.stiffness, required, factor, jacobian
        )
        return {"strain": strain, "hourglass": hourglass}


class _Domains(_Block):
    name: ClassVar[str] = "support domains"
    _arrays: DomainBatches

    def forces(self, part: slice) -> Forces:
        a = self._arrays
        some = [None if x is None else x[part] for x in (a.nodes, a.gradient, a.position, a.inverse, a.coefficient)]
        return lambda u, f: kernels.domain_forces(u, f, *some)

    def check(self, u, required, factor, jacobian, tensor):  # type: ignore[no-untyped-def]
        a = self._arrays
        strain, stabilisation = kernels.domain_survey(
            u, a.nodes, a.cells, a.gradient, a.position, a.inverse, a.coefficient, a.gram, a.stiffness, required,
            factor, jacobian, tensor,
        )  # fmt: skip
        return {"strain": strain, "stabilisation": stabilisation}
