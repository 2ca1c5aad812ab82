"""Support domains, gathered in lanes: packing and kernels, for any number of nodes, stabilised or the paper's own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import uint64 as U
from numpy.typing import NDArray

from mpitled.cells.packing import Forces, LocalCells, border_first, in_lanes, in_precision, symmetric
from mpitled.cells.support_domains import linear_projector, stabilisation_stiffness
from mpitled.kernels.lanes import BATCH, broadcast, gather, load, load_each, minimum, scatter, smallest, store, width
from mpitled.kernels.templates import (
    N_COEFFICIENTS,
    compile_for,
    inline,
    inline_template,
    law_stress,
    law_tangent_bound,
)
from mpitled.kernels.tensors import check_batch, deformation
from mpitled.laws import Law

_BATCH = np.uint64(BATCH)


@dataclass(frozen=True, slots=True)
class SupportDomainBatches:
    """Support domains of one law in lanes (`PackedCells`)."""

    name: ClassVar[str] = "support domains"

    law: type[Law]
    nodes: NDArray[np.uint32]  # (n_batches, n, lanes)
    cells: NDArray[np.uint32]  # (n_batches, lanes)
    gradient: NDArray[np.floating]  # (n_batches, 3 n, lanes), 1/m
    position: NDArray[np.floating] | None  # (n_batches, 3 n, lanes), m; None without stabilisation
    inverse: NDArray[np.floating] | None  # (n_batches, 6, lanes), 1/m^2
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
        columns = (self.nodes, self.gradient, self.position, self.inverse, self.coefficient)
        arrays = [None if a is None else a[part] for a in columns]
        return lambda u, f: kernel(u, f, *arrays)

    def check(
        self,
        u: NDArray[np.floating],
        required: NDArray[np.float64],
        factor: float,
        jacobian: NDArray[np.float32],
        tensor: NDArray[np.float64] | None,
    ) -> dict[str, float]:
        """See `PackedCells.check`."""
        strain, stabilisation = compile_for(check_template, self.law)(
            u, self.nodes, self.cells, self.gradient, self.position, self.inverse, self.coefficient, self.gram,
            self.stiffness, required, factor, jacobian, tensor,
        )  # fmt: skip
        return {"strain": strain, "stabilisation": stabilisation}


def pack(cells: LocalCells, stabilisation: float) -> list[SupportDomainBatches]:
    """Support domains in batches of one law each; stabilisation is the share s (0: the paper's own domains)."""
    packed = []
    for law, rows in cells.by_law():
        nodes, volume, gradients = cells.nodes[rows], cells.column("volumes")[rows], cells.column("gradients")[rows]
        position, inverse = linear_projector(cells.points[nodes])
        lam, mu = cells.moduli(rows)
        kappa = stabilisation_stiffness(inverse, volume, lam + 2 * mu, stabilisation)
        coefficient = np.concatenate([cells.coefficients(law, rows) * volume, kappa[None]]).T
        arrays = border_first(
            cells.shared,
            nodes=in_lanes(nodes),
            cells=in_lanes((cells.first + rows)[:, None].astype(np.uint32), cells.n_rank_cells)[:, 0],
            gradient=in_lanes(gradients),
            position=in_lanes(position) if stabilisation > 0 else None,
            inverse=in_lanes(symmetric(inverse)) if stabilisation > 0 else None,
            coefficient=in_lanes(coefficient, 0),
            gram=in_lanes(symmetric(np.einsum("gai,gaj->gij", gradients, gradients))),
            # The projector Q has the largest eigenvalue 1.
            stiffness=in_lanes(kappa[:, None], 0)[:, 0],
        )
        packed.append(in_precision(SupportDomainBatches(law=law, n_cells=len(rows), **arrays), cells.precision))
    return packed


# ---------------------------------------------------------------- kernels


@inline
def _add_products(sums, number, x, y, z):  # type: ignore[no-untyped-def]
    return sums[0] + number * x, sums[1] + number * y, sums[2] + number * z


@inline
def _affine(total, sums, inverse, w, share):  # type: ignore[no-untyped-def]
    """Mean and three slopes of the affine part of one component: (X^T X)^-1 X^T u.

    total: sum of u over the nodes; sums: sums of u X_a, with X relative to the mean; inverse (6, lanes): of X^T X.
    """
    x, y, z = sums
    return (
        total * share,
        load(inverse[0], w) * x + load(inverse[1], w) * y + load(inverse[2], w) * z,
        load(inverse[1], w) * x + load(inverse[3], w) * y + load(inverse[4], w) * z,
        load(inverse[2], w) * x + load(inverse[4], w) * y + load(inverse[5], w) * z,
    )


@inline
def _non_affine(number, affine, x, y, z):  # type: ignore[no-untyped-def]
    """A component of a node's displacement minus its affine part: Q u.

    Q is symmetric, which conserves momentum and angular momentum.
    """
    return (number - affine[0]) - (affine[1] * x + affine[2] * y + affine[3] * z)


@inline
def _domain_modes(u, nodes, gradient, position, inverse, w, ue):  # type: ignore[no-untyped-def]
    """grad u (a tuple of 9) of the lanes of a batch from w on, and the affine part of each component of u.

    The affine part is that of the unweighted linear projector of the nodes; it is 0 without `position`. Fills
    ue (3 n, lanes) with the nodal displacements.
    """
    n = U(nodes.shape[0])
    share = u.dtype.type(1) / u.dtype.type(nodes.shape[0])
    zeros = broadcast(u.dtype.type(0), u[0])
    gx = (zeros, zeros, zeros)
    gy = (zeros, zeros, zeros)
    gz = (zeros, zeros, zeros)
    sx = (zeros, zeros, zeros)
    sy = (zeros, zeros, zeros)
    sz = (zeros, zeros, zeros)
    tx = zeros
    ty = zeros
    tz = zeros
    for a in range(n):
        i = U(3) * a
        ux = gather(u[0], nodes[a], w)
        uy = gather(u[1], nodes[a], w)
        uz = gather(u[2], nodes[a], w)
        x = load(gradient[i], w)
        y = load(gradient[i + U(1)], w)
        z = load(gradient[i + U(2)], w)
        gx = _add_products(gx, ux, x, y, z)
        gy = _add_products(gy, uy, x, y, z)
        gz = _add_products(gz, uz, x, y, z)
        if position is not None:
            x = load(position[i], w)
            y = load(position[i + U(1)], w)
            z = load(position[i + U(2)], w)
            sx = _add_products(sx, ux, x, y, z)
            sy = _add_products(sy, uy, x, y, z)
            sz = _add_products(sz, uz, x, y, z)
            tx = tx + ux
            ty = ty + uy
            tz = tz + uz
            store(ue[i], U(0), ux)
            store(ue[i + U(1)], U(0), uy)
            store(ue[i + U(2)], U(0), uz)
    none = (zeros, zeros, zeros, zeros)
    if position is not None:
        return (
            gx + gy + gz, _affine(tx, sx, inverse, w, share), _affine(ty, sy, inverse, w, share),
            _affine(tz, sz, inverse, w, share),
        )  # fmt: skip
    return gx + gy + gz, none, none, none


def forces_template(u, f, nodes, gradient, position, inverse, coefficient):  # type: ignore[no-untyped-def]
    """Add the nodal forces of support domains to f; returns the smallest J of these cells.

    nodes (n_batches, n, lanes) uint32; gradient and position (n_batches, 3 n, lanes), 1/m and m; inverse (n_batches, 6,
    lanes), 1/m^2; coefficient (n_batches, n + 1, lanes): the law's n coefficients times V (J), then the stabilisation
    kappa (N/m). position and inverse are None where there is no stabilisation (the paper's own).
    """
    n = U(nodes.shape[1])
    least = broadcast(u.dtype.type(np.inf), u[0])
    ue = np.empty((3 * nodes.shape[1], width(u[0])), u.dtype)
    for batch in range(U(nodes.shape[0])):
        at = nodes[batch]
        b = gradient[batch]
        X = position[batch] if position is not None else None
        inner = inverse[batch] if inverse is not None else None
        for w in range(U(0), _BATCH, width(u[0])):
            grad, ax, ay, az = _domain_modes(u, at, b, X, inner, w, ue)
            F, K, J = deformation(grad)
            p = law_stress(F, K, J, load_each(coefficient[batch], N_COEFFICIENTS, w))
            least = minimum(least, J)
            for a in range(n):
                i = U(3) * a
                x = load(b[i], w)
                y = load(b[i + U(1)], w)
                z = load(b[i + U(2)], w)
                fx = p[0] * x + p[1] * y + p[2] * z
                fy = p[3] * x + p[4] * y + p[5] * z
                fz = p[6] * x + p[7] * y + p[8] * z
                if position is not None:
                    k = load(coefficient[batch, N_COEFFICIENTS], w)
                    x = load(X[i], w)
                    y = load(X[i + U(1)], w)
                    z = load(X[i + U(2)], w)
                    fx = fx + k * _non_affine(load(ue[i], U(0)), ax, x, y, z)
                    fy = fy + k * _non_affine(load(ue[i + U(1)], U(0)), ay, x, y, z)
                    fz = fz + k * _non_affine(load(ue[i + U(2)], U(0)), az, x, y, z)
                scatter(f[0], at[a], w, fx)
                scatter(f[1], at[a], w, fy)
                scatter(f[2], at[a], w, fz)
    return smallest(least)


@inline
def _cofactor_times(k, x, y, z):  # type: ignore[no-untyped-def]
    """K B_a: the direction of the material stiffness at a node."""
    return k[0] * x + k[1] * y + k[2] * z, k[3] * x + k[4] * y + k[5] * z, k[6] * x + k[7] * y + k[8] * z


@inline
def _norm(v):  # type: ignore[no-untyped-def]
    return np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@inline_template
def _add_tensors(grad, nodes, gradient, coefficient, stiffness, w, tensor, factor, value):  # type: ignore[no-untyped-def]
    """Add the stiffness bounds of the lanes from w on, times factor, to the tensors (6, n_nodes) of their nodes.

    value (6, lanes): scratch.
    """
    n = U(nodes.shape[0])
    tiny = value.dtype.type(1e-30)
    F, K, J = deformation(grad)
    a, b = law_tangent_bound(F, K, J, load_each(coefficient, N_COEFFICIENTS, w))
    sum_material = broadcast(value.dtype.type(0), value[0])
    sum_isotropic = sum_material
    for m in range(n):
        B = (load(gradient[U(3) * m], w), load(gradient[U(3) * m + U(1)], w), load(gradient[U(3) * m + U(2)], w))
        sum_material = sum_material + _norm(_cofactor_times(K, B[0], B[1], B[2]))
        sum_isotropic = sum_isotropic + _norm(B)
    material = factor * a * sum_material
    isotropic = factor * b * sum_isotropic
    for m in range(n):
        B = (load(gradient[U(3) * m], w), load(gradient[U(3) * m + U(1)], w), load(gradient[U(3) * m + U(2)], w))
        G = _cofactor_times(K, B[0], B[1], B[2])
        s = material / (_norm(G) + tiny)
        diagonal = isotropic * _norm(B) + factor * load(stiffness, w)
        store(value[0], U(0), s * G[0] * G[0] + diagonal)
        store(value[1], U(0), s * G[0] * G[1])
        store(value[2], U(0), s * G[0] * G[2])
        store(value[3], U(0), s * G[1] * G[1] + diagonal)
        store(value[4], U(0), s * G[1] * G[2])
        store(value[5], U(0), s * G[2] * G[2] + diagonal)
        for lane in range(width(value[0])):
            for j in range(6):
                tensor[j, nodes[m, w + lane]] += value[j, lane]


def check_template(  # type: ignore[no-untyped-def]
    u,
    nodes,
    cells,
    gradient,
    position,
    inverse,
    coefficient,
    gram,
    stiffness,
    required,
    factor,
    jacobian,
    tensor,
):
    """As `voxel_runs.check_template`, of support domains: strain energy and stabilisation energy.

    Where tensor (6, n_nodes) is given, it receives mass tensors, and required receives nothing. The material stiffness
    of a domain acts in one direction g_a = K B_a at each node: c (sum_a g_a . u_a)^2. By Cauchy's inequality it is at
    most c (sum_b |g_b|) sum_a (g_a . u_a)^2 / |g_a|. The remaining stiffness is bounded likewise with |B_a|. Next
    to a grown tumour the first bound is large across the thin layers and small along them.
    """
    n = U(nodes.shape[1])
    factor = u.dtype.type(factor)
    ue = np.empty((3 * nodes.shape[1], width(u[0])), u.dtype)
    value = np.empty((4, BATCH), u.dtype)
    scratch = np.empty((6, width(u[0])), u.dtype)
    strain = 0.0
    stabilisation = 0.0
    for batch in range(U(nodes.shape[0])):
        at = nodes[batch]
        b = gradient[batch]
        X = position[batch] if position is not None else None
        inner = inverse[batch] if inverse is not None else None
        for w in range(U(0), _BATCH, width(u[0])):
            grad, ax, ay, az = _domain_modes(u, at, b, X, inner, w, ue)
            check_batch(grad, coefficient[batch], gram[batch], stiffness[batch], w, value)
            squares = broadcast(u.dtype.type(0), u[0])
            if position is not None:
                for a in range(n):
                    i = U(3) * a
                    x = load(X[i], w)
                    y = load(X[i + U(1)], w)
                    z = load(X[i + U(2)], w)
                    rx = _non_affine(load(ue[i], U(0)), ax, x, y, z)
                    ry = _non_affine(load(ue[i + U(1)], U(0)), ay, x, y, z)
                    rz = _non_affine(load(ue[i + U(2)], U(0)), az, x, y, z)
                    squares = squares + (rx * rx + ry * ry + rz * rz)
            store(value[3], w, squares)
            if tensor is not None:
                _add_tensors(grad, at, b, coefficient[batch], stiffness[batch], w, tensor, factor, scratch)
        for w in range(_BATCH):
            jacobian[cells[batch, w]] = value[0, w]
            strain += value[1, w]
            stabilisation += coefficient[batch, N_COEFFICIENTS, w] * value[3, w]
            if tensor is None:
                for a in range(n):
                    required[at[a, w]] += factor * value[2, w]
    return strain, 0.5 * stabilisation
