"""Internal forces of the cells, one term for each packed block of cells; their energies and stability bounds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.parallel.subdomain import SHORTEST_RUN, Subdomain
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
        jacobian = self._forces(s.u_cells, s.f)
        if jacobian < s.smallest_jacobian:
            s.smallest_jacobian = jacobian


class BorderCells(CellForces):
    """Cells with shared nodes: their forces travel to other ranks while the interior cells are computed.

    A rank that is delayed for a moment does not delay its neighbours.
    """

    @classmethod
    def from_scene(cls, scene: Scene) -> Iterator[Term]:
        if scene.halo is not None:
            for block in packed_cells(scene.sub):
                if block.n_border:
                    yield cls(block, slice(block.n_border))

    @classmethod
    def left_out(cls, scene: Scene, present: bool) -> Iterable[str]:
        return ()  # see `InteriorCells`


class InteriorCells(CellForces):
    """All other cells; checks the whole block."""

    @classmethod
    def from_scene(cls, scene: Scene) -> Iterator[Term]:
        for block in packed_cells(scene.sub):
            yield cls(block, slice(None) if scene.halo is None else slice(block.n_border, None))

    @classmethod
    def left_out(cls, scene: Scene, present: bool) -> Iterator[str]:
        sub = scene.sub
        if sub.rows.n_own_hexahedra == 0:
            yield f"{VOXELS}, {HEXAHEDRA}: no hexahedra"
        elif sub.runs is None:
            yield f"{VOXELS}: no {SHORTEST_RUN} equal boxes in a row"
        elif sub.hexahedra is None:
            yield f"{HEXAHEDRA}: all are boxes, {SHORTEST_RUN} or more in a row"
        if sub.domains is None:
            yield f"{DOMAINS}: no cloud"
        elif sub.domains.position is None:
            yield "stabilisation of support domains: support.stabilisation = 0"

    def check(self, s: State, bound: StabilityBound) -> Mapping[str, float]:
        return self._block.check(s.u_cells, bound.required, bound.factor, bound.jacobian, bound.tensor)


# --- packed cells of a subdomain --------------------------------------------------------------------------------------


class PackedCells(NamedTuple):
    """A block of cells of one kind, packed as its kernels take them; those with shared nodes come first."""

    name: str  # of the kind
    arrays: Any
    n_border: int  # batches or runs, the first, with nodes that other ranks have too
    kernel: str  # adds forces and returns the smallest J
    check_kernel: str  # returns energies
    energies: tuple[str, ...]  # their lines in the ledger

    def forces(self, part: slice) -> Callable[[NDArray[np.floating], NDArray[np.floating]], float]:
        """The function of u and f that adds the forces of some of the batches or runs; returns the smallest J."""
        first, name = self.name != VOXELS, self.kernel
        some = [
            a if a is None else a[part] if first else np.ascontiguousarray(a[..., part]) for a in self._arguments(name)
        ]
        return lambda u, f: float(getattr(kernels, name)(u, f, *some))

    def check(
        self,
        u: NDArray[np.floating],
        required: NDArray[np.float64],
        factor: float,
        jacobian: NDArray[np.float32],
        tensor: NDArray[np.float64] | None,
    ) -> dict[str, float]:
        """Energies (J) by the names of `CellForces.figures`; adds to the arrays of a `StabilityBound`."""
        more = (tensor,) if self.name == DOMAINS else ()
        arguments = (*self._arguments(self.check_kernel), required, factor, jacobian, *more)
        return dict(zip(self.energies, getattr(kernels, self.check_kernel)(u, *arguments), strict=True))

    def _arguments(self, kernel: str) -> list[NDArray[Any] | None]:
        return [getattr(self.arrays, name) for name in _ARGUMENTS[kernel].split()]


VOXELS, HEXAHEDRA, DOMAINS = "voxel hexahedra", "hexahedra", "support domains"
#: Packed arrays that each kernel takes, in order.
_ARGUMENTS = {
    "voxel_forces": "line length along scale coefficient",
    "voxel_survey": "line length along first_cell scale coefficient gram",
    "hexahedron_forces": "nodes in_row geometry coefficient",
    "hexahedron_survey": "nodes cells geometry coefficient gram stiffness",
    "domain_forces": "nodes gradient position inverse coefficient",
    "domain_survey": "nodes cells gradient position inverse coefficient gram stiffness",
}


def packed_cells(sub: Subdomain) -> Iterator[PackedCells]:
    """The blocks of cells that a rank has."""
    for name, arrays, kernel, line in (
        (VOXELS, sub.runs, "voxel", "hourglass"),
        (HEXAHEDRA, sub.hexahedra, "hexahedron", "hourglass"),
        (DOMAINS, sub.domains, "domain", "stabilisation"),
    ):
        if arrays is not None:
            yield PackedCells(name, arrays, arrays.border, f"{kernel}_forces", f"{kernel}_survey", ("strain", line))
