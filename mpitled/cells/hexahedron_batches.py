"""Hexahedra of any shape, gathered in lanes: packing and kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import uint64 as U
from numpy.typing import NDArray

from mpitled.cells import hexahedra
from mpitled.cells.packing import Forces, LocalCells, border_first, in_lanes, in_precision, symmetric
from mpitled.cells.voxel_runs import LINES, axis_of_rows
from mpitled.kernels.corner_modes import corner_modes, corner_values, hourglass_squares
from mpitled.kernels.lanes import (
    BATCH,
    BITS,
    broadcast,
    gather,
    last,
    load,
    load_each,
    minimum,
    prefetch,
    scatter,
    shift,
    smallest,
    store,
    width,
)
from mpitled.kernels.templates import N_COEFFICIENTS, compile_for, inline, inline_template, law_stress
from mpitled.kernels.tensors import check_batch, deformation
from mpitled.laws import Law

_BATCH = np.uint64(BATCH)


@dataclass(frozen=True, slots=True)
class HexahedronBatches:
    """Hexahedra of any shape and one law in lanes (`PackedCells`)."""

    name: ClassVar[str] = "hexahedra"

    law: type[Law]
    nodes: NDArray[np.uint32]  # (n_batches, 8, lanes)
    in_row: NDArray[np.bool_]  # (n_batches, vectors in a batch)
    cells: NDArray[np.uint32]  # (n_batches, lanes)
    geometry: NDArray[np.floating]  # (n_batches, 30, lanes)
    coefficient: NDArray[np.floating]  # (n_batches, n_coefficients + 1, lanes)
    gram: NDArray[np.floating]  # (n_batches, 6, lanes), 1/m^2
    stiffness: NDArray[np.floating]  # (n_batches, lanes), N/m
    n_cells: int
    n_border: int

    def __len__(self) -> int:
        return len(self.nodes)

    def forces(self, part: slice) -> Forces:
        """See `PackedCells.forces`."""
        kernel = compile_for(forces_template, self.law)
        arrays = [a[part] for a in (self.nodes, self.in_row, self.geometry, self.coefficient)]
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
            u, self.nodes, self.cells, self.geometry, self.coefficient, self.gram, self.stiffness, required, factor,
            jacobian,
        )  # fmt: skip
        return {"strain": strain, "hourglass": hourglass}


def pack(cells: LocalCells, chosen: NDArray[np.int64], hourglass: float, rule: str) -> list[HexahedronBatches]:
    """The chosen hexahedra (k,) in batches of one law each; hourglass: R_hg of eq. 4.22; rule: of the gradient."""
    packed = []
    in_choice = np.zeros(len(cells.nodes), bool)
    in_choice[chosen] = True
    for law, rows in cells.by_law():
        rows = rows[in_choice[rows]]
        if not len(rows):
            continue
        nodes = _turned(cells.nodes[rows])
        gradient_modes, x_modes, volumes = hexahedra.hadamard(cells.points, nodes, rule)
        gradients, _ = hexahedra.geometry(cells.points, nodes, rule)
        gamma = hexahedra.hourglass_vectors(cells.points, nodes, gradients)
        modulus = hexahedra.hourglass_modulus(*cells.moduli(rows))
        k = hexahedra.hourglass_stiffness(gradients, volumes, modulus, hourglass)
        geometry = np.concatenate([gradient_modes.reshape(-1, 18) / 8, x_modes.reshape(-1, 12)], axis=1)
        coefficient = np.concatenate([cells.coefficients(law, rows) * volumes, k[None]]).T
        lanes = in_lanes(nodes)
        arrays = border_first(
            cells.shared,
            nodes=lanes,
            in_row=_in_row(lanes, BITS // 8 // cells.precision().itemsize),
            cells=in_lanes((cells.first + rows)[:, None].astype(np.uint32), cells.n_rank_cells)[:, 0],
            geometry=in_lanes(geometry),
            coefficient=in_lanes(coefficient, 0),
            gram=in_lanes(symmetric(np.einsum("eai,eaj->eij", gradients, gradients))),
            stiffness=in_lanes((k * np.linalg.eigvalsh(np.einsum("eam,ean->emn", gamma, gamma))[:, -1])[:, None], 0)[
                :, 0
            ],
        )
        packed.append(in_precision(HexahedronBatches(law=law, n_cells=len(rows), **arrays), cells.precision))
    return packed


def _turned(nodes: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Hexahedra (n, 8) whose far nodes follow the near ones along some axis, turned so that it is their first."""
    along = axis_of_rows(nodes)
    order = np.empty((3, 8), np.int64)
    order[:, [[0, 1], [3, 2], [4, 5], [7, 6]]] = LINES
    return np.take_along_axis(nodes, order[np.maximum(along, 0)], axis=1)


def _in_row(nodes: NDArray[np.uint32], width: int) -> NDArray[np.bool_]:
    """In which vectors of so many lanes each corner's nodes follow each other, and the far ones the near ones.

    nodes (n_batches, 8, lanes) -> (n_batches, vectors in a batch).
    """
    vectors = nodes.reshape(*nodes.shape[:2], -1, width).astype(np.int64)
    far = vectors[:, [1, 2, 5, 6]] - vectors[:, [0, 3, 4, 7]]
    return np.asarray((np.diff(vectors, axis=3) == 1).all(axis=(1, 3)) & (far == 1).all(axis=(1, 3)))


# ---------------------------------------------------------------- kernels


@inline
def _corner_values(uc, nodes, w, in_row):  # type: ignore[no-untyped-def]
    """A component at the corners of the lanes of a batch from w on.

    in_row: None, or the nodes of each corner are consecutive.
    """
    if in_row is not None:
        return (
            load(uc, U(nodes[0, w])), load(uc, U(nodes[1, w])), load(uc, U(nodes[2, w])), load(uc, U(nodes[3, w])),
            load(uc, U(nodes[4, w])), load(uc, U(nodes[5, w])), load(uc, U(nodes[6, w])), load(uc, U(nodes[7, w])),
        )  # fmt: skip
    return (
        gather(uc, nodes[0], w), gather(uc, nodes[1], w), gather(uc, nodes[2], w), gather(uc, nodes[3], w),
        gather(uc, nodes[4], w), gather(uc, nodes[5], w), gather(uc, nodes[6], w), gather(uc, nodes[7], w),
    )  # fmt: skip


@inline
def _add_row(fc, node, near, far):  # type: ignore[no-untyped-def]
    """Add forces to the nodes of a row of cells; the far node of a cell is the near node of the next cell."""
    first = U(node)
    none = broadcast(fc.dtype.type(0), fc)
    store(fc, first, load(fc, first) + (near + shift(none, far)))
    fc[first + width(fc)] += last(far)


@inline
def _add_corner_values(fc, nodes, w, in_row, c):  # type: ignore[no-untyped-def]
    """The transpose of `_corner_values`: add c at the corners."""
    if in_row is not None:
        _add_row(fc, nodes[0, w], c[0], c[1])
        _add_row(fc, nodes[3, w], c[3], c[2])
        _add_row(fc, nodes[4, w], c[4], c[5])
        _add_row(fc, nodes[7, w], c[7], c[6])
    else:
        scatter(fc, nodes[0], w, c[0])
        scatter(fc, nodes[1], w, c[1])
        scatter(fc, nodes[2], w, c[2])
        scatter(fc, nodes[3], w, c[3])
        scatter(fc, nodes[4], w, c[4])
        scatter(fc, nodes[5], w, c[5])
        scatter(fc, nodes[6], w, c[6])
        scatter(fc, nodes[7], w, c[7])


@inline
def _hexahedron_modes(uc, nodes, g, w, in_row):  # type: ignore[no-untyped-def]
    """grad u in one direction, with the mean gradient, and gamma^T u = H^T u - (x^T H)^T grad u (eq. 4.21) behind it.

    nodes (8, lanes) and g (30, lanes) of a batch, see `forces_template`; w: the first of its lanes.
    """
    v = _corner_values(uc, nodes, w, in_row)
    r, s, t, rs, st, rt, rst = corner_modes(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7])
    x = (
        (r * load(g[0], w) + s * load(g[3], w) + t * load(g[6], w))
        + (rs * load(g[9], w) + st * load(g[12], w) + rt * load(g[15], w))
    )  # fmt: skip
    y = (
        (r * load(g[1], w) + s * load(g[4], w) + t * load(g[7], w))
        + (rs * load(g[10], w) + st * load(g[13], w) + rt * load(g[16], w))
    )  # fmt: skip
    z = (
        (r * load(g[2], w) + s * load(g[5], w) + t * load(g[8], w))
        + (rs * load(g[11], w) + st * load(g[14], w) + rt * load(g[17], w))
    )  # fmt: skip
    return (
        x, y, z,
        rs - (x * load(g[18], w) + y * load(g[19], w) + z * load(g[20], w)),
        st - (x * load(g[21], w) + y * load(g[22], w) + z * load(g[23], w)),
        rt - (x * load(g[24], w) + y * load(g[25], w) + z * load(g[26], w)),
        rst - (x * load(g[27], w) + y * load(g[28], w) + z * load(g[29], w)),
    )  # fmt: skip


@inline
def _add_hexahedron_forces(fc, nodes, g, w, in_row, px, py, pz, modes, k):  # type: ignore[no-untyped-def]
    """Add the forces in one direction: of a row of P, and of the modes of u."""
    rs = k * modes[3]
    st = k * modes[4]
    rt = k * modes[5]
    rst = k * modes[6]
    # gamma = H - B (x^T H): its second part acts as a stress
    px = px - (rs * load(g[18], w) + st * load(g[21], w) + rt * load(g[24], w) + rst * load(g[27], w))
    py = py - (rs * load(g[19], w) + st * load(g[22], w) + rt * load(g[25], w) + rst * load(g[28], w))
    pz = pz - (rs * load(g[20], w) + st * load(g[23], w) + rt * load(g[26], w) + rst * load(g[29], w))
    c = corner_values(
        px * load(g[0], w) + py * load(g[1], w) + pz * load(g[2], w),
        px * load(g[3], w) + py * load(g[4], w) + pz * load(g[5], w),
        px * load(g[6], w) + py * load(g[7], w) + pz * load(g[8], w),
        rs + (px * load(g[9], w) + py * load(g[10], w) + pz * load(g[11], w)),
        st + (px * load(g[12], w) + py * load(g[13], w) + pz * load(g[14], w)),
        rt + (px * load(g[15], w) + py * load(g[16], w) + pz * load(g[17], w)),
        rst,
    )
    _add_corner_values(fc, nodes, w, in_row, c)


@inline_template
def _add_forces(u, f, nodes, g, coefficient, w, in_row):  # type: ignore[no-untyped-def]
    """Add the forces of the lanes of a batch from w on; returns their J."""
    mx = _hexahedron_modes(u[0], nodes, g, w, in_row)
    my = _hexahedron_modes(u[1], nodes, g, w, in_row)
    mz = _hexahedron_modes(u[2], nodes, g, w, in_row)
    k = load(coefficient[N_COEFFICIENTS], w)
    F, K, J = deformation(mx[:3] + my[:3] + mz[:3])
    p = law_stress(F, K, J, load_each(coefficient, N_COEFFICIENTS, w))
    _add_hexahedron_forces(f[0], nodes, g, w, in_row, p[0], p[1], p[2], mx, k)
    _add_hexahedron_forces(f[1], nodes, g, w, in_row, p[3], p[4], p[5], my, k)
    _add_hexahedron_forces(f[2], nodes, g, w, in_row, p[6], p[7], p[8], mz, k)
    return J


def forces_template(u, f, nodes, in_row, geometry, coefficient):  # type: ignore[no-untyped-def]
    """Add the nodal forces of hexahedra of any shape to f; returns the smallest J of these cells.

    nodes (n_batches, 8, lanes) uint32. in_row (n_batches, vectors in a batch): whether the nodes of each corner follow
    each other in the vector, and those of corners 1, 2, 5, 6 those of 0, 3, 4, 7: then nothing is gathered. geometry
    (n_batches, 30, lanes): the mean gradient of the sign vectors r, s, t, rs, st, rt in x, y, z (1/m; that of rst is
    zero), then x^T H (m) of rs, st, rt, rst. coefficient (n_batches, n + 1, lanes): the law's n coefficients times V,
    J, then the hourglass stiffness k (N/m); zero in lanes that only fill the last batch.
    """
    least = broadcast(u.dtype.type(np.inf), u[0])
    last_batch = U(nodes.shape[0] - 1)
    for batch in range(U(nodes.shape[0])):
        at = nodes[batch]
        g = geometry[batch]
        prefetch(geometry[min(batch + U(1), last_batch)])
        for w in range(U(0), _BATCH, width(u[0])):
            # Two branches without a common part: the vectors stay in registers.
            if in_row[batch, w // width(u[0])]:
                J = _add_forces(u, f, at, g, coefficient[batch], w, True)
            else:
                J = _add_forces(u, f, at, g, coefficient[batch], w, None)
            least = minimum(least, J)
    return smallest(least)


def check_template(u, nodes, cells, geometry, coefficient, gram, stiffness, required, factor, jacobian):  # type: ignore[no-untyped-def]
    """As `voxel_runs.check_template`, of hexahedra of any shape.

    cells (n_batches, lanes): the cell of each lane, n_cells where it only fills the last batch. gram (n_batches, 6,
    lanes), 1/m^2: B^T B (xx, xy, xz, yy, yz, zz). stiffness (n_batches, lanes), N/m: the largest eigenvalue of the
    hourglass stiffness.
    """
    value = np.empty((4, BATCH), u.dtype)
    strain = 0.0
    hourglass = 0.0
    for batch in range(U(nodes.shape[0])):
        at = nodes[batch]
        g = geometry[batch]
        for w in range(U(0), _BATCH, width(u[0])):
            mx = _hexahedron_modes(u[0], at, g, w, None)
            my = _hexahedron_modes(u[1], at, g, w, None)
            mz = _hexahedron_modes(u[2], at, g, w, None)
            check_batch(mx[:3] + my[:3] + mz[:3], coefficient[batch], gram[batch], stiffness[batch], w, value)
            store(value[3], w, hourglass_squares(mx, my, mz))
        for w in range(_BATCH):
            jacobian[cells[batch, w]] = value[0, w]
            strain += value[1, w]
            hourglass += coefficient[batch, N_COEFFICIENTS, w] * value[3, w]
            for a in range(8):
                required[at[a, w]] += factor * value[2, w]
    return strain, 0.5 * hourglass
