"""Hexahedra that are equal boxes in rows along a grid line, as in meshes of voxels: packing and kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import uint64 as U
from numpy.typing import NDArray

from mpitled.cells.hexahedra import hourglass_modulus
from mpitled.cells.packing import Forces, LocalCells, in_precision
from mpitled.kernels.corner_modes import corner_modes, corner_values, hourglass_squares
from mpitled.kernels.lanes import (
    broadcast,
    broadcast_each,
    last,
    load,
    minimum,
    select_first,
    shift,
    smallest,
    store,
    width,
)
from mpitled.kernels.templates import (
    N_COEFFICIENTS,
    compile_for,
    inline,
    law_energy,
    law_stress,
    law_tangent_bound,
)
from mpitled.kernels.tensors import cell_bound, deformation
from mpitled.laws import Law
from mpitled.mesh import CORNERS

#: Boxes in a row shorter than this are gathered: a run keeps a whole vector of lanes busy.
SHORTEST_RUN = 4
#: Edges of a box agree this well relative to their length: the round-off of coordinates far from the origin.
BOX_TOLERANCE = 1e-11
#: Hexahedra at a time when runs are sought, so that the temporary arrays stay small.
_CHUNK = 1 << 16

# Corners on the four lines along each axis, (3, 4, 2): near and far. Lines and axes are in turn from that axis.
_CORNER_NUMBER = {tuple(corner): number for number, corner in enumerate(CORNERS.tolist())}
LINES: NDArray[np.int64] = np.array([
    [[_CORNER_NUMBER[tuple(np.roll((end, s, t), axis).tolist())] for end in (-1, 1)] for t in (-1, 1) for s in (-1, 1)]
    for axis in range(3)
])  # fmt: skip


@dataclass(frozen=True, slots=True)
class VoxelRuns:
    """Equal boxes of one law whose nodes follow each other along a grid line (`PackedCells`)."""

    name: ClassVar[str] = "voxel hexahedra"

    law: type[Law]
    line: NDArray[np.uint64]  # (4, n_runs)
    length: NDArray[np.uint64]  # (n_runs,)
    along: NDArray[np.uint64]  # (n_runs,)
    first_cell: NDArray[np.uint64]  # (n_runs,)
    scale: NDArray[np.floating]  # (3, n_runs), 1/m
    coefficient: NDArray[np.floating]  # (n_coefficients + 1, n_runs)
    gram: NDArray[np.floating]  # (3, n_runs), 1/m^2
    n_cells: int
    n_border: int

    def __len__(self) -> int:
        return len(self.length)

    def forces(self, part: slice) -> Forces:
        """See `PackedCells.forces`."""
        kernel = compile_for(forces_template, self.law)
        arrays = [
            np.ascontiguousarray(a[..., part])
            for a in (self.line, self.length, self.along, self.scale, self.coefficient)
        ]
        return lambda u, f: kernel(u, f, *arrays)

    def check(
        self,
        u: NDArray[np.floating],
        required: NDArray[np.float64],
        factor: float,
        jacobian: NDArray[np.float32],
        tensor: NDArray[np.float64] | None,
    ) -> dict[str, float]:
        """See `PackedCells.check`; hexahedra ask for scalar masses."""
        strain, hourglass = compile_for(check_template, self.law)(
            u, self.line, self.length, self.along, self.first_cell, self.scale, self.coefficient, self.gram, required,
            factor, jacobian,
        )  # fmt: skip
        return {"strain": strain, "hourglass": hourglass}


def pack(cells: LocalCells, hourglass: float) -> tuple[list[VoxelRuns], NDArray[np.int64]]:
    """The runs of each law in hexahedra, and the hexahedra (k,) that are in none. hourglass: R_hg of eq. 4.22."""
    found = find_runs(cells.points, cells.nodes, cells.material)
    # So many nodes before each are shared.
    before = np.concatenate([[0], np.cumsum(cells.shared)])
    at_border = (before[found.near + found.length[:, None] + 1] > before[found.near]).any(axis=1)
    packed = []
    laws = [type(cells.materials[m].law) for m in cells.material[found.first]]
    for law in dict.fromkeys(laws):
        of_law = np.flatnonzero([other is law for other in laws])
        order = of_law[np.argsort(~at_border[of_law], kind="stable")]
        first, length, axis, near = (a[order] for a in (found.first, found.length, found.along, found.near))
        # Axes in turn from that of the run.
        edge = np.take_along_axis(found.edges[order], (axis[:, None] + np.arange(3)) % 3, axis=1).T
        volume = edge.prod(axis=0)
        gram = 1 / (2 * edge**2)
        k = hourglass * hourglass_modulus(*cells.moduli(first)) * volume * gram.sum(axis=0) / 8
        runs = VoxelRuns(
            law=law,
            line=np.ascontiguousarray(near.T, dtype=np.uint64),
            length=length.astype(np.uint64),
            along=axis.astype(np.uint64),
            first_cell=(cells.first + first).astype(np.uint64),
            scale=1 / (4 * edge),
            coefficient=np.concatenate([cells.coefficients(law, first) * volume, k[None]]),
            gram=gram,
            n_cells=int(length.sum()),
            n_border=int(np.count_nonzero(at_border[of_law])),
        )
        packed.append(in_precision(runs, cells.precision))
    return packed, np.flatnonzero(~found.in_runs)


def _boxes(points: NDArray[np.float64], cells: NDArray[np.integer]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Which hexahedra are boxes along the axes, and the edges (n, 3) of the boxes that they would be."""
    if len(cells) == 0:
        return np.zeros(0, bool), np.zeros((0, 3))
    edges = points[cells[:, 6]] - points[cells[:, 0]]
    tolerance = BOX_TOLERANCE * np.abs(edges).max(axis=1)
    box = np.all(edges > 0, axis=1)
    for corner in range(1, 8):
        offset = points[cells[:, corner]] - points[cells[:, 0]]
        box &= np.abs(offset - (CORNERS[corner] + 1) / 2 * edges).max(axis=1) <= tolerance
    return box, edges


def axis_of_rows(cells: NDArray[np.integer]) -> NDArray[np.int8]:
    """The axis along which each hexahedron's far nodes follow the near ones by number, or -1."""
    along = np.full(len(cells), -1, np.int8)
    for axis, lines in enumerate(LINES):
        along[(cells[:, lines[:, 1]].astype(np.int64) - cells[:, lines[:, 0]] == 1).all(axis=1)] = axis
    return along


@dataclass(frozen=True, slots=True)
class Runs:
    """Rows of equal boxes whose nodes follow each other, of hexahedra (n, 8)."""

    in_runs: NDArray[np.bool_]  # (n,)
    first: NDArray[np.int64]  # (n_runs,), their first cells
    length: NDArray[np.int64]
    along: NDArray[np.int64]  # the axis
    near: NDArray[np.int64]  # (n_runs, 4), the first cells' near nodes
    edges: NDArray[np.float64]  # (n_runs, 3), m


def find_runs(points: NDArray[np.float64], cells: NDArray[np.integer], material: NDArray[np.int16]) -> Runs:
    """Block by block, so that what is known of each cell takes no memory."""
    n = len(cells)
    good, breaks = np.zeros(n, bool), [np.zeros(min(n, 1), np.int64)]
    for start in range(0, n, _CHUNK):
        some = cells[max(0, start - 1) : start + _CHUNK]  # and the cell before, which the first may follow
        box, edges = _boxes(points, some)
        box &= axis_of_rows(some) >= 0
        follows = (some[1:].astype(np.int64) - some[:-1] == 1).all(axis=1) & box[1:] & box[:-1]
        of = material[max(0, start - 1) : start + _CHUNK]
        follows &= of[1:] == of[:-1]
        follows &= (np.abs(edges[1:] - edges[:-1]) <= BOX_TOLERANCE * edges[1:]).all(axis=1)
        breaks.append(max(0, start - 1) + 1 + np.flatnonzero(~follows))
        good[max(0, start - 1) : start + _CHUNK] = box
    first = np.concatenate(breaks)
    length = np.diff([*first, n]) if n else np.zeros(0, np.int64)
    runs = good[first] & (length >= SHORTEST_RUN)
    in_runs = np.repeat(runs, length)
    first, length = first[runs], length[runs]
    along = axis_of_rows(cells[first]).astype(np.int64)
    near = np.take_along_axis(cells[first], LINES[along, :, 0], axis=1).astype(np.int64)
    return Runs(in_runs, first, length, along, near, _boxes(points, cells[first])[1])


# ---------------------------------------------------------------- kernels


@inline
def _box_modes(uc, i0, i1, i2, i3):  # type: ignore[no-untyped-def]
    """`corner_modes` of consecutive boxes with corners on four grid lines that begin at these nodes."""
    one = U(1)
    return corner_modes(
        load(uc, i0), load(uc, i0 + one), load(uc, i1 + one), load(uc, i1),
        load(uc, i2), load(uc, i2 + one), load(uc, i3 + one), load(uc, i3),
    )  # fmt: skip


@inline
def _add_line(fc, node, near, far, before):  # type: ignore[no-untyped-def]
    """Add forces to the nodes of a grid line; each is the near node of one box and the far node of the previous box."""
    store(fc, node, load(fc, node) + (near + shift(before, far)))


@inline
def _add_box_forces(fc, i0, i1, i2, i3, r, s, t, modes, k, before):  # type: ignore[no-untyped-def]
    """Add the forces of boxes in one direction; returns the forces at their far nodes, for the next boxes.

    r, s, t: the part of the stress; modes: of u; before: what this function returned for the previous boxes.
    """
    c = corner_values(r, s, t, k * modes[3], k * modes[4], k * modes[5], k * modes[6])
    _add_line(fc, i0, c[0], c[1], before[0])
    _add_line(fc, i1, c[3], c[2], before[1])
    _add_line(fc, i2, c[4], c[5], before[2])
    _add_line(fc, i3, c[7], c[6], before[3])
    return c[1], c[2], c[5], c[6]


@inline
def _box_gradient(mx, my, mz, g0, g1, g2):  # type: ignore[no-untyped-def]
    """grad u of boxes from the modes of u."""
    return (
        mx[0] * g0, mx[1] * g1, mx[2] * g2,
        my[0] * g0, my[1] * g1, my[2] * g2,
        mz[0] * g0, mz[1] * g1, mz[2] * g2,
    )  # fmt: skip


def forces_template(u, f, line, length, along, scale, coefficient):  # type: ignore[no-untyped-def]
    """Add the nodal forces of runs of equal boxes to f; returns the smallest J of these cells.

    line (4, n_runs) and length (n_runs,), uint64: cell w of a run lies between the nodes line + w and line + w + 1 of
    four grid lines along the axis `along` (n_runs,). Axes and corners are numbered cyclically from it; corners 0,
    3, 4 and 7 are the near ends on the lines. scale (3, n_runs), 1/m: the gradient of a sign vector, 1 / (4 edge).
    coefficient (n + 1, n_runs): the law's n coefficients times V, J, and the hourglass stiffness k of eq. 4.22, N/m
    (R (lambda + 2 mu) V (B:B) / 8).

    On a box x^T H = 0, and so gamma^T u = H^T u (eq. 4.20). The last vector of a run has lanes without a cell. These
    lanes read the nodes behind the run; they have no stiffness and add no force.
    """
    zeros = broadcast(u.dtype.type(0), u[0])
    ones = broadcast(u.dtype.type(1), u[0])
    least = broadcast(u.dtype.type(np.inf), u[0])
    lanes = width(u[0])
    for run in range(U(length.size)):
        n = length[run]
        x = along[run]
        y = (x + U(1)) % U(3)
        z = (x + U(2)) % U(3)
        g0 = scale[0, run]
        g1 = scale[1, run]
        g2 = scale[2, run]
        end = (n + lanes - U(1)) // lanes * lanes
        # Forces at the far nodes of the boxes before, by axis.
        bx = (zeros, zeros, zeros, zeros)
        by = (zeros, zeros, zeros, zeros)
        bz = (zeros, zeros, zeros, zeros)
        for w in range(U(0), end, lanes):
            i0 = line[0, run] + w
            i1 = line[1, run] + w
            i2 = line[2, run] + w
            i3 = line[3, run] + w
            c = broadcast_each(coefficient, N_COEFFICIENTS, run, n - w, u[0])
            k = select_first(n - w, broadcast(coefficient[N_COEFFICIENTS, run], u[0]), zeros)
            mx = _box_modes(u[x], i0, i1, i2, i3)
            my = _box_modes(u[y], i0, i1, i2, i3)
            mz = _box_modes(u[z], i0, i1, i2, i3)
            F, K, J = deformation(_box_gradient(mx, my, mz, g0, g1, g2))
            # In lanes without a cell the coefficients are 0, and J is 1 so that the stress is 0, too.
            J = select_first(n - w, J, ones)
            p = law_stress(F, K, J, c)
            least = minimum(least, J)
            bx = _add_box_forces(f[x], i0, i1, i2, i3, p[0] * g0, p[1] * g1, p[2] * g2, mx, k, bx)
            by = _add_box_forces(f[y], i0, i1, i2, i3, p[3] * g0, p[4] * g1, p[5] * g2, my, k, by)
            bz = _add_box_forces(f[z], i0, i1, i2, i3, p[6] * g0, p[7] * g1, p[8] * g2, mz, k, bz)
        for c, before in ((x, bx), (y, by), (z, bz)):
            f[c, line[0, run] + end] += last(before[0])
            f[c, line[1, run] + end] += last(before[1])
            f[c, line[2, run] + end] += last(before[2])
            f[c, line[3, run] + end] += last(before[3])
    return smallest(least)


def check_template(u, line, length, along, first_cell, scale, coefficient, gram, required, factor, jacobian):  # type: ignore[no-untyped-def]
    """Strain energy and hourglass energy (J); writes each cell's J into jacobian (n_cells + 1,).

    Adds to required (n_nodes,), kg, the mass that each cell asks of its nodes: factor (s^2) times the bound of its
    largest eigenvalue. first_cell (n_runs,): a run's cell w is first_cell + w. gram (3, n_runs), 1/m^2: the diagonal
    of B^T B.
    """
    zero = u.dtype.type(0)
    lanes = width(u[0])
    value = np.empty((4, lanes), u.dtype)
    strain = 0.0
    hourglass = 0.0
    for run in range(U(length.size)):
        n = length[run]
        x = along[run]
        y = (x + U(1)) % U(3)
        z = (x + U(2)) % U(3)
        c = broadcast_each(coefficient, N_COEFFICIENTS, run, lanes, u[0])
        k = coefficient[N_COEFFICIENTS, run]
        g = (gram[0, run], zero, zero, gram[1, run], zero, gram[2, run])
        for w in range(U(0), n, lanes):
            i0 = line[0, run] + w
            i1 = line[1, run] + w
            i2 = line[2, run] + w
            i3 = line[3, run] + w
            mx = _box_modes(u[x], i0, i1, i2, i3)
            my = _box_modes(u[y], i0, i1, i2, i3)
            mz = _box_modes(u[z], i0, i1, i2, i3)
            H = _box_gradient(mx, my, mz, scale[0, run], scale[1, run], scale[2, run])
            F, K, J = deformation(H)
            a, b = law_tangent_bound(F, K, J, c)
            store(value[0], U(0), J)
            store(value[1], U(0), law_energy(H, F, K, J, c))
            # The four hourglass vectors are orthogonal, and each has the square 8.
            store(value[2], U(0), cell_bound(a, b, K, g) + k * 8)
            store(value[3], U(0), hourglass_squares(mx, my, mz))
            for i in range(min(n - w, lanes)):
                jacobian[first_cell[run] + w + i] = value[0, i]
                strain += value[1, i]
                hourglass += k * value[3, i]
                asked = factor * value[2, i]
                for first in (i0, i1, i2, i3):
                    required[first + i] += asked
                    required[first + i + U(1)] += asked
    return strain, 0.5 * hourglass
