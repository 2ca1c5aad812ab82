"""The compiled kernels of a step: nodal forces, the survey of the cells, the central-difference update, packing.

Nodal arrays are component-major, (3, n_nodes + PADDING). Cells are worked on in lanes, so that the innermost loops
vectorise; every index in them is unsigned, because numba's test for negative indices stops the vectoriser.
Forces are *internal* forces f; the equation of motion is m a = -f at free nodes. All are in SI units, and run in the
precision of the arrays that they are given. Constants are cast (`u.dtype.type`), or float32 would be promoted.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numba import uint64 as U

VOXEL_LANES = 32  # cells of one run that are in flight at once
BATCH_LANES = 16  # cells of one gathered batch
PADDING = VOXEL_LANES  # a short run reads beyond its last node, and never writes there

_ROUND = np.uint64(8)
_VL = np.uint64(VOXEL_LANES)
_BL = np.uint64(BATCH_LANES)
_BLOCK = np.uint64(8)  # nodes of a support domain that are summed in registers
# Fused multiply-adds and free association, but NaN and infinity stay what they are: the watch needs them.
_FAST = {"contract", "nsz", "arcp", "reassoc"}
# Forced, or the process that compiles may call another copy of the function than one that loads from the cache, with
# other bits.
_inline = njit(fastmath=_FAST, error_model="numpy", cache=True, forceinline=True)
_kernel = njit(fastmath=_FAST, error_model="numpy", cache=True, nogil=True)


@_inline
def _cofactor(a, b, c, d, e, f, g, h, i):  # type: ignore[no-untyped-def]
    """Cofactor K = J X^-T of the 3x3 tensor with these rows, and its determinant J."""
    k0 = e * i - f * h
    k1 = f * g - d * i
    k2 = d * h - e * g
    k3 = c * h - b * i
    k4 = a * i - c * g
    k5 = b * g - a * h
    k6 = b * f - c * e
    k7 = c * d - a * f
    k8 = a * e - b * d
    return k0, k1, k2, k3, k4, k5, k6, k7, k8, a * k0 + b * k1 + c * k2


@_inline
def _first_piola(a, b, c, d, e, f, g, h, i, mu, lam, one):  # type: ignore[no-untyped-def]
    """P = mu X + (lambda (J - 1) - mu / J) K (design of `material.first_piola`), and J, from grad u."""
    a += one
    e += one
    i += one
    k0, k1, k2, k3, k4, k5, k6, k7, k8, J = _cofactor(a, b, c, d, e, f, g, h, i)
    q = lam * (J - one) - mu / J
    return (
        mu * a + q * k0, mu * b + q * k1, mu * c + q * k2,
        mu * d + q * k3, mu * e + q * k4, mu * f + q * k5,
        mu * g + q * k6, mu * h + q * k7, mu * i + q * k8,
        J,
    )  # fmt: skip


@_inline
def _energy_and_bound(a, b, c, d, e, f, g, h, i, mu, lam, g0, g1, g2, g3, g4, g5, one):  # type: ignore[no-untyped-def]
    """J, the elastic energy but for its -mu ln J, and a bound of the tangent's largest eigenvalue, from grad u.

    The bound is (lambda + mu / J^2) |B K^T|^2 + (mu + |q| sqrt(2) |X|) |B|^2, q = lambda (J - 1) - mu / J, Frobenius
    norms, with B^T B = g (xx, xy, xz, yy, yz, zz): the material part's rank-one term, and the initial-stress term.
    mu and lam carry the cell's volume.
    """
    energy = (a + e + i) * (one + one) + (a * a + b * b + c * c + d * d + e * e + f * f + g * g + h * h + i * i)
    a += one
    e += one
    i += one
    k0, k1, k2, k3, k4, k5, k6, k7, k8, J = _cofactor(a, b, c, d, e, f, g, h, i)
    square = a * a + b * b + c * c + d * d + e * e + f * f + g * g + h * h + i * i
    bk = (
        g0 * (k0 * k0 + k3 * k3 + k6 * k6)
        + g3 * (k1 * k1 + k4 * k4 + k7 * k7)
        + g5 * (k2 * k2 + k5 * k5 + k8 * k8)
        + (one + one)
        * (g1 * (k0 * k1 + k3 * k4 + k6 * k7) + g2 * (k0 * k2 + k3 * k5 + k6 * k8) + g4 * (k1 * k2 + k4 * k5 + k7 * k8))
    )
    q = lam * (J - one) - mu / J
    half = one / (one + one)
    bound = (lam + mu / (J * J)) * bk + (mu + abs(q) * np.sqrt((one + one) * square)) * (g0 + g3 + g5)
    return J, half * (mu * energy + lam * (J - one) * (J - one)), bound


# ---------------------------------------------------------------- voxel hexahedra, in runs along a grid line


@_inline
def _voxel_modes(u, start, run, lanes, g0, g1, g2, grad, q):  # type: ignore[no-untyped-def]
    """grad u (9, lanes) and the hourglass modes H^T u (12, lanes) of a run, by butterflies of additions.

    On a box gamma^T u = H^T u, for x^T H = 0 (eq. 4.20).
    """
    a0 = start[0, run]
    a1 = start[1, run]
    a2 = start[2, run]
    a3 = start[3, run]
    a4 = start[4, run]
    a5 = start[5, run]
    a6 = start[6, run]
    a7 = start[7, run]
    for c in range(3):
        uc = u[c]
        for w in range(lanes):
            u0 = uc[a0 + w]
            u1 = uc[a1 + w]
            u2 = uc[a2 + w]
            u3 = uc[a3 + w]
            u4 = uc[a4 + w]
            u5 = uc[a5 + w]
            u6 = uc[a6 + w]
            u7 = uc[a7 + w]
            p0 = u0 + u1
            m0 = u1 - u0
            p1 = u3 + u2
            m1 = u2 - u3
            p2 = u4 + u5
            m2 = u5 - u4
            p3 = u7 + u6
            m3 = u6 - u7
            dm = m1 - m0
            dn = m3 - m2
            dp = p1 - p0
            dq = p3 - p2
            grad[3 * c, w] = ((m0 + m1) + (m2 + m3)) * g0
            grad[3 * c + 1, w] = (dp + dq) * g1
            grad[3 * c + 2, w] = ((p2 + p3) - (p0 + p1)) * g2
            q[c, w] = dm + dn
            q[3 + c, w] = dq - dp
            q[6 + c, w] = (m2 - m0) + (m3 - m1)
            q[9 + c, w] = dn - dm


@_kernel
def voxel_forces(u, f, start, length, scale, coefficient):  # type: ignore[no-untyped-def]
    """Add the nodal forces of runs of equal boxes to f; the smallest J among them.

    start (8, n_runs) and length (n_runs,), uint64: a run's cell w has the nodes start + w. scale (3, n_runs), 1/m: the
    gradient of a sign vector, 1 / (4 edge). coefficient (3, n_runs), J: mu V, lambda V, and in N/m the hourglass
    stiffness k of eq. 4.22 (R (lambda + 2 mu) V (B:B) / 8).
    """
    one = u.dtype.type(1)
    grad = np.empty((9, _VL), u.dtype)
    q = np.empty((12, _VL), u.dtype)
    jacobian = np.empty(_VL, u.dtype)
    force = np.empty((8, _VL), u.dtype)
    smallest = u.dtype.type(np.inf)
    for run in range(U(start.shape[1])):
        n = length[run]
        lanes = (n + _ROUND - U(1)) // _ROUND * _ROUND
        g0 = scale[0, run]
        g1 = scale[1, run]
        g2 = scale[2, run]
        mu = coefficient[0, run]
        lam = coefficient[1, run]
        k = coefficient[2, run]
        _voxel_modes(u, start, run, lanes, g0, g1, g2, grad, q)
        for w in range(lanes):
            p = _first_piola(
                grad[0, w], grad[1, w], grad[2, w], grad[3, w], grad[4, w], grad[5, w], grad[6, w], grad[7, w],
                grad[8, w], mu, lam, one,
            )  # fmt: skip
            grad[0, w] = p[0]
            grad[1, w] = p[1]
            grad[2, w] = p[2]
            grad[3, w] = p[3]
            grad[4, w] = p[4]
            grad[5, w] = p[5]
            grad[6, w] = p[6]
            grad[7, w] = p[7]
            grad[8, w] = p[8]
            jacobian[w] = p[9]
        for w in range(n):
            smallest = min(smallest, jacobian[w])
        for c in range(3):
            fc = f[c]
            for w in range(lanes):
                q0 = k * q[c, w]
                q1 = k * q[3 + c, w]
                q2 = k * q[6 + c, w]
                q3 = k * q[9 + c, w]
                r = grad[3 * c, w] * g0
                s = grad[3 * c + 1, w] * g1
                t = grad[3 * c + 2, w] * g2
                e0 = -s - t + q1
                e1 = s - t - q1
                e2 = t - s - q1
                e3 = s + t + q1
                o0 = r - q0 - q2 + q3
                o1 = r + q0 - q2 - q3
                o2 = r - q0 + q2 - q3
                o3 = r + q0 + q2 + q3
                force[0, w] = e0 - o0
                force[1, w] = e0 + o0
                force[2, w] = e1 + o1
                force[3, w] = e1 - o1
                force[4, w] = e2 - o2
                force[5, w] = e2 + o2
                force[6, w] = e3 + o3
                force[7, w] = e3 - o3
            for a in range(8):
                first = start[a, run]
                for w in range(n):
                    fc[first + w] += force[a, w]
    return smallest


@_kernel
def voxel_survey(u, start, length, first_cell, scale, coefficient, gram, required, factor, jacobian):  # type: ignore[no-untyped-def]
    """Strain energy and hourglass energy (J); writes each cell's J into jacobian (n_cells + 1,).

    Adds to required (n_nodes,), kg, the mass that each cell asks of its nodes: factor (s^2) times the bound of its
    largest eigenvalue. first_cell (n_runs,): a run's cell w is first_cell + w. gram (3, n_runs), 1/m^2: the diagonal
    of B^T B.
    """
    one = u.dtype.type(1)
    zero = u.dtype.type(0)
    eight = u.dtype.type(8)
    grad = np.empty((9, _VL), u.dtype)
    q = np.empty((12, _VL), u.dtype)
    value = np.empty((3, _VL), u.dtype)
    strain = 0.0
    hourglass = 0.0
    for run in range(U(start.shape[1])):
        n = length[run]
        mu = coefficient[0, run]
        lam = coefficient[1, run]
        k = coefficient[2, run]
        b0 = gram[0, run]
        b1 = gram[1, run]
        b2 = gram[2, run]
        _voxel_modes(u, start, run, n, scale[0, run], scale[1, run], scale[2, run], grad, q)
        for w in range(n):
            r = _energy_and_bound(
                grad[0, w], grad[1, w], grad[2, w], grad[3, w], grad[4, w], grad[5, w], grad[6, w], grad[7, w],
                grad[8, w], mu, lam, b0, zero, zero, b1, zero, b2, one,
            )  # fmt: skip
            value[0, w] = r[0]
            value[1, w] = r[1]
            value[2, w] = factor * (r[2] + eight * k)
        for w in range(n):
            jacobian[first_cell[run] + w] = value[0, w]
            strain += value[1, w] - mu * np.log(value[0, w])
        for m in range(12):
            for w in range(n):
                hourglass += k * q[m, w] * q[m, w]
        for a in range(8):
            first = start[a, run]
            for w in range(n):
                required[first + w] += value[2, w]
    return strain, 0.5 * hourglass


# ---------------------------------------------------------------- general hexahedra, gathered


@_inline
def _hexahedron_modes(u, nodes, geometry, batch, grad, q):  # type: ignore[no-untyped-def]
    """grad u (9, lanes) with the mean gradient, and gamma^T u (12, lanes) = H^T u - (x^T H)^T grad u (eq. 4.21)."""
    u0 = np.empty((8, _BL), u.dtype)
    for c in range(3):
        uc = u[c]
        for a in range(8):
            for w in range(_BL):
                u0[a, w] = uc[nodes[batch, a, w]]
        for w in range(_BL):
            p0 = u0[0, w] + u0[1, w]
            m0 = u0[1, w] - u0[0, w]
            p1 = u0[3, w] + u0[2, w]
            m1 = u0[2, w] - u0[3, w]
            p2 = u0[4, w] + u0[5, w]
            m2 = u0[5, w] - u0[4, w]
            p3 = u0[7, w] + u0[6, w]
            m3 = u0[6, w] - u0[7, w]
            dm = m1 - m0
            dn = m3 - m2
            dp = p1 - p0
            dq = p3 - p2
            r = (m0 + m1) + (m2 + m3)
            s = dp + dq
            t = (p2 + p3) - (p0 + p1)
            rs = dm + dn
            st = dq - dp
            rt = (m2 - m0) + (m3 - m1)
            g = geometry[batch]
            gx = r * g[0, w] + s * g[3, w] + t * g[6, w] + rs * g[9, w] + st * g[12, w] + rt * g[15, w]
            gy = r * g[1, w] + s * g[4, w] + t * g[7, w] + rs * g[10, w] + st * g[13, w] + rt * g[16, w]
            gz = r * g[2, w] + s * g[5, w] + t * g[8, w] + rs * g[11, w] + st * g[14, w] + rt * g[17, w]
            grad[3 * c, w] = gx
            grad[3 * c + 1, w] = gy
            grad[3 * c + 2, w] = gz
            q[c, w] = rs - (gx * g[18, w] + gy * g[19, w] + gz * g[20, w])
            q[3 + c, w] = st - (gx * g[21, w] + gy * g[22, w] + gz * g[23, w])
            q[6 + c, w] = rt - (gx * g[24, w] + gy * g[25, w] + gz * g[26, w])
            q[9 + c, w] = (dn - dm) - (gx * g[27, w] + gy * g[28, w] + gz * g[29, w])


@_kernel
def hexahedron_forces(u, f, nodes, geometry, coefficient):  # type: ignore[no-untyped-def]
    """Add the nodal forces of hexahedra of any shape to f; the smallest J among them.

    nodes (n_batches, 8, lanes) uint32. geometry (n_batches, 30, lanes): the mean gradient of the sign vectors r, s, t,
    rs, st, rt in x, y, z (1/m; that of rst is zero), then x^T H (m) of rs, st, rt, rst. coefficient (n_batches, 3,
    lanes): mu V, lambda V (J), hourglass stiffness k (N/m); zero in lanes that only fill the last batch.
    """
    one = u.dtype.type(1)
    grad = np.empty((9, _BL), u.dtype)
    q = np.empty((12, _BL), u.dtype)
    force = np.empty((8, _BL), u.dtype)
    jacobian = np.full(_BL, np.inf).astype(u.dtype)
    for batch in range(U(nodes.shape[0])):
        _hexahedron_modes(u, nodes, geometry, batch, grad, q)
        for w in range(_BL):
            p = _first_piola(
                grad[0, w], grad[1, w], grad[2, w], grad[3, w], grad[4, w], grad[5, w], grad[6, w], grad[7, w],
                grad[8, w], coefficient[batch, 0, w], coefficient[batch, 1, w], one,
            )  # fmt: skip
            grad[0, w] = p[0]
            grad[1, w] = p[1]
            grad[2, w] = p[2]
            grad[3, w] = p[3]
            grad[4, w] = p[4]
            grad[5, w] = p[5]
            grad[6, w] = p[6]
            grad[7, w] = p[7]
            grad[8, w] = p[8]
            jacobian[w] = min(jacobian[w], p[9])
        for c in range(3):
            fc = f[c]
            for w in range(_BL):
                g = geometry[batch]
                k = coefficient[batch, 2, w]
                q0 = k * q[c, w]
                q1 = k * q[3 + c, w]
                q2 = k * q[6 + c, w]
                q3 = k * q[9 + c, w]
                # gamma = H - B (x^T H): its second part acts as a stress
                px = grad[3 * c, w] - (g[18, w] * q0 + g[21, w] * q1 + g[24, w] * q2 + g[27, w] * q3)
                py = grad[3 * c + 1, w] - (g[19, w] * q0 + g[22, w] * q1 + g[25, w] * q2 + g[28, w] * q3)
                pz = grad[3 * c + 2, w] - (g[20, w] * q0 + g[23, w] * q1 + g[26, w] * q2 + g[29, w] * q3)
                r = px * g[0, w] + py * g[1, w] + pz * g[2, w]
                s = px * g[3, w] + py * g[4, w] + pz * g[5, w]
                t = px * g[6, w] + py * g[7, w] + pz * g[8, w]
                q0 += px * g[9, w] + py * g[10, w] + pz * g[11, w]
                q1 += px * g[12, w] + py * g[13, w] + pz * g[14, w]
                q2 += px * g[15, w] + py * g[16, w] + pz * g[17, w]
                e0 = -s - t + q1
                e1 = s - t - q1
                e2 = t - s - q1
                e3 = s + t + q1
                o0 = r - q0 - q2 + q3
                o1 = r + q0 - q2 - q3
                o2 = r - q0 + q2 - q3
                o3 = r + q0 + q2 + q3
                force[0, w] = e0 - o0
                force[1, w] = e0 + o0
                force[2, w] = e1 + o1
                force[3, w] = e1 - o1
                force[4, w] = e2 - o2
                force[5, w] = e2 + o2
                force[6, w] = e3 + o3
                force[7, w] = e3 - o3
            for a in range(8):
                for w in range(_BL):
                    fc[nodes[batch, a, w]] += force[a, w]
    return jacobian.min()


@_inline
def _batch_survey(grad, coefficient, gram, stiffness, batch, value, one):  # type: ignore[no-untyped-def]
    """J, strain energy and eigenvalue bound of a batch's lanes (3, lanes) from grad u."""
    for w in range(_BL):
        g = gram[batch]
        r = _energy_and_bound(
            grad[0, w], grad[1, w], grad[2, w], grad[3, w], grad[4, w], grad[5, w], grad[6, w], grad[7, w], grad[8, w],
            coefficient[batch, 0, w], coefficient[batch, 1, w], g[0, w], g[1, w], g[2, w], g[3, w], g[4, w], g[5, w],
            one,
        )  # fmt: skip
        value[0, w] = r[0]
        value[1, w] = r[1]
        value[2, w] = r[2] + stiffness[batch, w]
    for w in range(_BL):
        value[1, w] -= coefficient[batch, 0, w] * np.log(value[0, w])


@_kernel
def hexahedron_survey(u, nodes, cells, geometry, coefficient, gram, stiffness, required, factor, jacobian):  # type: ignore[no-untyped-def]
    """As `voxel_survey`, of hexahedra of any shape.

    cells (n_batches, lanes): the cell of each lane, n_cells where it only fills the last batch. gram (n_batches, 6,
    lanes), 1/m^2: B^T B (xx, xy, xz, yy, yz, zz). stiffness (n_batches, lanes), N/m: the largest eigenvalue of the
    hourglass stiffness.
    """
    one = u.dtype.type(1)
    grad = np.empty((9, _BL), u.dtype)
    q = np.empty((12, _BL), u.dtype)
    value = np.empty((3, _BL), u.dtype)
    strain = 0.0
    hourglass = 0.0
    for batch in range(U(nodes.shape[0])):
        _hexahedron_modes(u, nodes, geometry, batch, grad, q)
        _batch_survey(grad, coefficient, gram, stiffness, batch, value, one)
        for w in range(_BL):
            jacobian[cells[batch, w]] = value[0, w]
            strain += value[1, w]
        for m in range(12):
            for w in range(_BL):
                hourglass += coefficient[batch, 2, w] * q[m, w] * q[m, w]
        for a in range(8):
            for w in range(_BL):
                required[nodes[batch, a, w]] += factor * value[2, w]
    return strain, 0.5 * hourglass


# ---------------------------------------------------------------- support domains, gathered


@njit(fastmath=_FAST, error_model="numpy", inline="always")
def _block_sums(ue, gradient, position, batch, c, w, first):  # type: ignore[no-untyped-def]
    """Sums over a block of a domain's nodes, in one lane: u B_a (3), u and u X_a (3)."""
    zero = ue.dtype.type(0)
    gx = zero
    gy = zero
    gz = zero
    s = zero
    x = zero
    y = zero
    z = zero
    for b in range(_BLOCK):
        a = first + b
        v = ue[3 * a + c, w]
        gx += v * gradient[batch, 3 * a, w]
        gy += v * gradient[batch, 3 * a + 1, w]
        gz += v * gradient[batch, 3 * a + 2, w]
        if position is not None:
            s += v
            x += v * position[batch, 3 * a, w]
            y += v * position[batch, 3 * a + 1, w]
            z += v * position[batch, 3 * a + 2, w]
    return gx, gy, gz, s, x, y, z


@njit(fastmath=_FAST, error_model="numpy", inline="always")
def _domain_modes(u, nodes, gradient, position, inverse, batch, ue, grad, mode):  # type: ignore[no-untyped-def]
    """Nodal displacements (3 n, lanes), grad u (9, lanes) and the affine part (12, lanes) of a batch of domains.

    The affine part of u, by the unweighted linear projector of the domain's nodes, is for each component the mean and
    the three slopes along the positions X from theirs: (X^T X)^-1 X^T u. Without position there is none. Blocks of
    constant length are unrolled into sums in registers, which loops over all n nodes are not when n is large.
    """
    n = U(nodes.shape[1])
    whole = n // _BLOCK * _BLOCK
    zero = u.dtype.type(0)
    share = u.dtype.type(1) / u.dtype.type(nodes.shape[1])
    for a in range(n):
        for w in range(_BL):
            k = U(nodes[batch, a, w])
            ue[3 * a, w] = u[0, k]
            ue[3 * a + 1, w] = u[1, k]
            ue[3 * a + 2, w] = u[2, k]
    if whole == 0:
        grad[:] = zero
        mode[:] = zero
    for c in range(U(3)):
        if whole > 0:
            for w in range(_BL):
                b = _block_sums(ue, gradient, position, batch, c, w, U(0))
                grad[3 * c, w] = b[0]
                grad[3 * c + 1, w] = b[1]
                grad[3 * c + 2, w] = b[2]
                mode[4 * c, w] = b[3]
                mode[4 * c + 1, w] = b[4]
                mode[4 * c + 2, w] = b[5]
                mode[4 * c + 3, w] = b[6]
        for first in range(_BLOCK, whole, _BLOCK):
            for w in range(_BL):
                b = _block_sums(ue, gradient, position, batch, c, w, first)
                grad[3 * c, w] += b[0]
                grad[3 * c + 1, w] += b[1]
                grad[3 * c + 2, w] += b[2]
                mode[4 * c, w] += b[3]
                mode[4 * c + 1, w] += b[4]
                mode[4 * c + 2, w] += b[5]
                mode[4 * c + 3, w] += b[6]
        for a in range(whole, n):
            for w in range(_BL):
                v = ue[3 * a + c, w]
                grad[3 * c, w] += v * gradient[batch, 3 * a, w]
                grad[3 * c + 1, w] += v * gradient[batch, 3 * a + 1, w]
                grad[3 * c + 2, w] += v * gradient[batch, 3 * a + 2, w]
                if position is not None:
                    mode[4 * c, w] += v
                    mode[4 * c + 1, w] += v * position[batch, 3 * a, w]
                    mode[4 * c + 2, w] += v * position[batch, 3 * a + 1, w]
                    mode[4 * c + 3, w] += v * position[batch, 3 * a + 2, w]
        if position is not None:
            for w in range(_BL):
                i = inverse[batch]
                x = mode[4 * c + 1, w]
                y = mode[4 * c + 2, w]
                z = mode[4 * c + 3, w]
                mode[4 * c, w] *= share
                mode[4 * c + 1, w] = i[0, w] * x + i[1, w] * y + i[2, w] * z
                mode[4 * c + 2, w] = i[1, w] * x + i[3, w] * y + i[4, w] * z
                mode[4 * c + 3, w] = i[2, w] * x + i[4, w] * y + i[5, w] * z


@_inline
def _remainder(ue, mode, position, batch, a, c, w):  # type: ignore[no-untyped-def]
    """Displacement of one lane's node a less its affine part: Q u. Q is symmetric: momentum and moment are kept."""
    return (
        ue[3 * a + c, w]
        - mode[4 * c, w]
        - mode[4 * c + 1, w] * position[batch, 3 * a, w]
        - mode[4 * c + 2, w] * position[batch, 3 * a + 1, w]
        - mode[4 * c + 3, w] * position[batch, 3 * a + 2, w]
    )


@_kernel
def domain_forces(u, f, nodes, gradient, position, inverse, coefficient):  # type: ignore[no-untyped-def]
    """Add the nodal forces of support domains to f; the smallest J among them.

    nodes (n_batches, n, lanes) uint32; gradient and position (n_batches, 3 n, lanes), 1/m and m; inverse (n_batches, 6,
    lanes), 1/m^2; coefficient (n_batches, 3, lanes): mu V, lambda V (J), stabilisation kappa (N/m). position and
    inverse are None where there is no stabilisation (the paper's own).
    """
    n = U(nodes.shape[1])
    one = u.dtype.type(1)
    ue = np.empty((3 * nodes.shape[1], _BL), u.dtype)
    grad = np.empty((9, _BL), u.dtype)
    mode = np.empty((12, _BL), u.dtype)
    jacobian = np.full(_BL, np.inf).astype(u.dtype)
    for batch in range(U(nodes.shape[0])):
        _domain_modes(u, nodes, gradient, position, inverse, batch, ue, grad, mode)
        for w in range(_BL):
            p = _first_piola(
                grad[0, w], grad[1, w], grad[2, w], grad[3, w], grad[4, w], grad[5, w], grad[6, w], grad[7, w],
                grad[8, w], coefficient[batch, 0, w], coefficient[batch, 1, w], one,
            )  # fmt: skip
            grad[0, w] = p[0]
            grad[1, w] = p[1]
            grad[2, w] = p[2]
            grad[3, w] = p[3]
            grad[4, w] = p[4]
            grad[5, w] = p[5]
            grad[6, w] = p[6]
            grad[7, w] = p[7]
            grad[8, w] = p[8]
            jacobian[w] = min(jacobian[w], p[9])
        for a in range(n):
            for c in range(U(3)):
                for w in range(_BL):
                    force = (
                        grad[3 * c, w] * gradient[batch, 3 * a, w]
                        + grad[3 * c + 1, w] * gradient[batch, 3 * a + 1, w]
                        + grad[3 * c + 2, w] * gradient[batch, 3 * a + 2, w]
                    )
                    if position is not None:
                        force += coefficient[batch, 2, w] * _remainder(ue, mode, position, batch, a, c, w)
                    ue[3 * a + c, w] = force
            for w in range(_BL):
                k = U(nodes[batch, a, w])
                f[0, k] += ue[3 * a, w]
                f[1, k] += ue[3 * a + 1, w]
                f[2, k] += ue[3 * a + 2, w]
    return jacobian.min()


@_inline
def _domain_tensors(grad, nodes, gradient, coefficient, stiffness, batch, tensor, factor, one, g):  # type: ignore[no-untyped-def]
    """Add the bounds of a batch's stiffness at its nodes, times factor, to tensor (6, n_nodes); g (n, 5): scratch."""
    n = U(nodes.shape[1])
    zero = grad.dtype.type(0)
    tiny = grad.dtype.type(1e-30)
    for w in range(_BL):
        mu = coefficient[batch, 0, w]
        lam = coefficient[batch, 1, w]
        k = _cofactor(
            grad[0, w] + one, grad[1, w], grad[2, w], grad[3, w], grad[4, w] + one, grad[5, w], grad[6, w], grad[7, w],
            grad[8, w] + one,
        )  # fmt: skip
        J = k[9]
        square = (one + one) * (grad[0, w] + grad[4, w] + grad[8, w]) + (one + one + one)
        for i in range(9):
            square += grad[i, w] * grad[i, w]
        sum_g = zero
        sum_b = zero
        for a in range(n):
            bx = gradient[batch, 3 * a, w]
            by = gradient[batch, 3 * a + 1, w]
            bz = gradient[batch, 3 * a + 2, w]
            x = k[0] * bx + k[1] * by + k[2] * bz
            y = k[3] * bx + k[4] * by + k[5] * bz
            z = k[6] * bx + k[7] * by + k[8] * bz
            g[a, 0] = x
            g[a, 1] = y
            g[a, 2] = z
            g[a, 3] = np.sqrt(x * x + y * y + z * z)
            g[a, 4] = np.sqrt(bx * bx + by * by + bz * bz)
            sum_g += g[a, 3]
            sum_b += g[a, 4]
        q = lam * (J - one) - mu / J
        along = factor * (lam + mu / (J * J)) * sum_g
        alike = factor * (mu + abs(q) * np.sqrt((one + one) * square)) * sum_b
        for a in range(n):
            node = nodes[batch, a, w]
            s = along / (g[a, 3] + tiny)
            d = alike * g[a, 4] + factor * stiffness[batch, w]
            tensor[0, node] += s * g[a, 0] * g[a, 0] + d
            tensor[1, node] += s * g[a, 0] * g[a, 1]
            tensor[2, node] += s * g[a, 0] * g[a, 2]
            tensor[3, node] += s * g[a, 1] * g[a, 1] + d
            tensor[4, node] += s * g[a, 1] * g[a, 2]
            tensor[5, node] += s * g[a, 2] * g[a, 2] + d


@_kernel
def domain_survey(  # type: ignore[no-untyped-def]
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
    """As `hexahedron_survey`, of support domains: strain energy and stabilisation energy.

    Where tensor (6, n_nodes) is given, it takes what the domains ask, as tensors, in place of required. A domain's
    material stiffness is that of one direction g_a = K B_a at each node: c (sum_a g_a . u_a)^2. By Cauchy's inequality
    that is at most c (sum_b |g_b|) sum_a (g_a . u_a)^2 / |g_a|; the rest is bounded alike with |B_a|. Next to a grown
    tumour the first is large across the thin layers and small along them.
    """
    n = U(nodes.shape[1])
    one = u.dtype.type(1)
    ue = np.empty((3 * nodes.shape[1], _BL), u.dtype)
    grad = np.empty((9, _BL), u.dtype)
    mode = np.empty((12, _BL), u.dtype)
    value = np.empty((3, _BL), u.dtype)
    g = np.empty((nodes.shape[1], 5), u.dtype)
    strain = 0.0
    stabilisation = 0.0
    for batch in range(U(nodes.shape[0])):
        _domain_modes(u, nodes, gradient, position, inverse, batch, ue, grad, mode)
        _batch_survey(grad, coefficient, gram, stiffness, batch, value, one)
        for w in range(_BL):
            jacobian[cells[batch, w]] = value[0, w]
            strain += value[1, w]
        if position is not None:
            for a in range(n):
                for c in range(U(3)):
                    for w in range(_BL):
                        stabilisation += coefficient[batch, 2, w] * _remainder(ue, mode, position, batch, a, c, w) ** 2
        if tensor is None:
            for a in range(n):
                for w in range(_BL):
                    required[nodes[batch, a, w]] += factor * value[2, w]
        else:
            _domain_tensors(grad, nodes, gradient, coefficient, stiffness, batch, tensor, factor, one, g)
    return strain, 0.5 * stabilisation


# ---------------------------------------------------------------- nodes


@njit(cache=True)
def follow(path, full, turns, amplitude):  # type: ignore[no-untyped-def]
    """Displacements (n,), m, of dofs at that share of the load on the arcs of `loading.turn`; exact at full load."""
    for p in range(path.size):
        angle, arm, across = turns[p, 0], turns[p, 1], turns[p, 2]
        arc = (np.cos(amplitude * angle) - 1) * arm + np.sin(amplitude * angle) * across
        end = (np.cos(angle) - 1) * arm + np.sin(angle) * across
        path[p] = amplitude * (full[p] - end) + arc


@_kernel
def react(u, u_prev, f, mass, dofs, full, amplitude, reaction, time_step):  # type: ignore[no-untyped-def]
    """Work (J) of the reactions at moving dofs over the last step, by the trapezoidal rule; renews the reactions.

    A reaction is f + m a, a being the central difference to the place that the dof is moved to next (4.2.1: the
    displaced nodes take u_max d(t + dt)); where mass is None prescribed dofs have none. dofs, full (n,): 3 node +
    direction and metres at full load.
    """
    work = 0.0
    for p in range(dofs.size):
        node = dofs[p] // 3
        c = dofs[p] % 3
        now = u[c, node]
        before = u_prev[c, node]
        r = f[c, node]
        if mass is not None:
            r += mass[node] * (amplitude * full[p] - 2 * now + before) / (time_step * time_step)
        work += 0.5 * (r + reaction[p]) * (now - before)
        reaction[p] = r
    return work


@_inline
def _prescribe(u, fixed, dofs, full, amplitude, copied):  # type: ignore[no-untyped-def]
    for p in range(fixed.size):
        u[fixed[p] % 3, fixed[p] // 3] = 0
        if copied is not None:
            copied[fixed[p] % 3, fixed[p] // 3] = 0
    for p in range(dofs.size):
        u[dofs[p] % 3, dofs[p] // 3] = amplitude * full[p]
        if copied is not None:
            copied[dofs[p] % 3, dofs[p] // 3] = amplitude * full[p]


@_kernel
def update(u, u_prev, f, mobility, fixed, dofs, full, amplitude, copied):  # type: ignore[no-untyped-def]
    """The central difference (eq. 3.3, with the square on dt that 3.2 lacks), then the prescribed dofs; clears f.

    mobility (n_nodes,) is dt^2 / m, s^2/kg. The new displacements overwrite u_prev: the caller swaps the two.
    fixed (n,) are the dofs that stay, dofs and full (m,) those that move. copied, if given, takes the new displacements
    in its own precision: a slow ramp's accelerations would be lost in displacements of single precision.
    """
    for c in range(3):
        now = u[c]
        before = u_prev[c]
        fc = f[c]
        for n in range(U(mobility.size)):
            after = (now[n] - before[n]) + now[n] - mobility[n] * fc[n]
            before[n] = after
            fc[n] = 0
            if copied is not None:
                copied[c, n] = after
    _prescribe(u_prev, fixed, dofs, full, amplitude, copied)


@_kernel
def relax(u, u_prev, f, mobility, counted, fixed, dofs, full, amplitude, retain, gain, copied):  # type: ignore[no-untyped-def]
    """As `update`, with a mobility tensor at each node (6, n_nodes: xx, xy, xz, yy, yz, zz) and damping.

    u+ = u + retain (u - u_prev) - gain mobility f: with damping c per step, (2 - c) / (2 + c) and 2 / (2 + c).
    Returns the work (J) of the internal forces where counted (3, n_nodes) is 1 and not 0, at free dofs that the rank
    owns: each force times the mean of the steps before and after it.
    """
    half = 0.5
    work = 0.0
    for n in range(U(counted.shape[1])):
        fx = f[0, n]
        fy = f[1, n]
        fz = f[2, n]
        x = u[0, n] + retain * (u[0, n] - u_prev[0, n])
        y = u[1, n] + retain * (u[1, n] - u_prev[1, n])
        z = u[2, n] + retain * (u[2, n] - u_prev[2, n])
        x -= gain * (mobility[0, n] * fx + mobility[1, n] * fy + mobility[2, n] * fz)
        y -= gain * (mobility[1, n] * fx + mobility[3, n] * fy + mobility[4, n] * fz)
        z -= gain * (mobility[2, n] * fx + mobility[4, n] * fy + mobility[5, n] * fz)
        work += half * (
            counted[0, n] * fx * (x - u_prev[0, n])
            + counted[1, n] * fy * (y - u_prev[1, n])
            + counted[2, n] * fz * (z - u_prev[2, n])
        )
        u_prev[0, n] = x
        u_prev[1, n] = y
        u_prev[2, n] = z
        f[0, n] = 0
        f[1, n] = 0
        f[2, n] = 0
        if copied is not None:
            copied[0, n] = x
            copied[1, n] = y
            copied[2, n] = z
    _prescribe(u_prev, fixed, dofs, full, amplitude, copied)
    return work


@njit(cache=True)
def change_step(u, u_prev, f, mobility, ratio):  # type: ignore[no-untyped-def]
    """Rewrites u_prev so that `update` with the new step's mobility takes a step `ratio` times as long as the last.

    That is u+ = u + r (u - u_prev) - (1 + 1 / r) / 2 mobility f, the central difference with a variable step.
    """
    gain = 0.5 * (1 + 1 / ratio)
    for c in range(3):
        for n in range(mobility.size):
            now = u[c, n]
            u_prev[c, n] = now - ratio * (now - u_prev[c, n]) + (gain - 1) * mobility[n] * f[c, n]


@_kernel
def kinetic_energy(u, u_prev, f, mass, mobility, counted, held, time_step):  # type: ignore[no-untyped-def]
    """Kinetic energy (J) of the counted nodes at the middle of the two half steps around u.

    held (n,) are the prescribed dofs: theirs is taken from the last half step, for f does not move them.
    """
    half = u.dtype.type(0.5)
    twice = 0.0
    for c in range(3):
        now = u[c]
        before = u_prev[c]
        fc = f[c]
        for n in range(U(mass.size)):
            v = now[n] - before[n] - half * mobility[n] * fc[n]
            twice += counted[n] * mass[n] * v * v
    for p in range(held.size):
        n = held[p] // 3
        c = held[p] % 3
        v = u[c, n] - u_prev[c, n]
        w = v - half * mobility[n] * f[c, n]
        twice += counted[n] * mass[n] * (v * v - w * w)
    return 0.5 * twice / (time_step * time_step)


@njit(cache=True)
def raise_mass(u, u_prev, mass, mobility, required, counted, time_step):  # type: ignore[no-untyped-def]
    """Raise each node's mass to what is required; added mass (kg, times 3 directions not counted) and energy (J).

    The nodes go on at their speed, so that 1/2 dm v^2 comes into the system: a line of the ledger of its own.
    """
    added = 0.0
    energy = 0.0
    for n in range(required.size):
        dm = required[n] - mass[n]
        if dm > 0:
            mass[n] = required[n]
            mobility[n] = time_step * time_step / required[n]
            if counted[n]:
                added += dm
                for c in range(3):
                    v = (u[c, n] - u_prev[c, n]) / time_step
                    energy += 0.5 * dm * v * v
    return added, energy


@njit(cache=True)
def renew_tensors(mass, required, mobility, free, keep):  # type: ignore[no-untyped-def]
    """mass (6, n) <- required (6, n), mobility (6, n) <- its inverse, of free dofs alone; nothing at prescribed ones.

    free (3, n) is 1 at free dofs and 0 at prescribed ones. A mass that would fall below `keep` of what it was is scaled
    up to that: cells that swing stiffen again before the next survey.
    """
    for n in range(required.shape[1]):
        x = free[0, n]
        y = free[1, n]
        z = free[2, n]
        r = required[:, n]
        xx = r[0] * x
        xy = r[1] * x * y
        xz = r[2] * x * z
        yy = r[3] * y
        yz = r[4] * y * z
        zz = r[5] * z
        trace = xx + yy + zz
        least = keep * (mass[0, n] + mass[3, n] + mass[5, n])
        s = least / trace if 0 < trace < least else 1.0
        mass[0, n] = s * xx
        mass[1, n] = s * xy
        mass[2, n] = s * xz
        mass[3, n] = s * yy
        mass[4, n] = s * yz
        mass[5, n] = s * zz
        # Prescribed dofs take part in the inverse as ones.
        xx = mass[0, n] + 1 - x
        yy = mass[3, n] + 1 - y
        zz = mass[5, n] + 1 - z
        k0, k1, k2, _, k4, k5, _, _, k8, determinant = _cofactor(
            xx, mass[1, n], mass[2, n], mass[1, n], yy, mass[4, n], mass[2, n], mass[4, n], zz
        )
        mobility[0, n] = x * k0 / determinant
        mobility[1, n] = x * y * k1 / determinant
        mobility[2, n] = x * z * k2 / determinant
        mobility[3, n] = y * k4 / determinant
        mobility[4, n] = y * z * k5 / determinant
        mobility[5, n] = z * k8 / determinant


@njit(cache=True)
def watch_relaxation(u, u_prev, f, mass, mobility, counted, u_then, f_then):  # type: ignore[no-untyped-def]
    """What relaxation has to know, of dofs where counted (3, n) is 1; renews u_then and f_then (3, n).

    Kinetic energy; the forces' work in the half step to the present (`relax` counts it with the next step); numerator
    and denominator of Rayleigh's quotient of the change since then, du . df / du . M du; the largest change in the last
    step, m; the largest M^-1 f, m (time counts in steps).
    """
    kinetic = 0.0
    work = 0.0
    numerator = 0.0
    denominator = 0.0
    change = 0.0
    residual = 0.0
    for n in range(counted.shape[1]):
        x = counted[0, n]
        y = counted[1, n]
        z = counted[2, n]
        m = mass[:, n]
        vx = x * (u[0, n] - u_prev[0, n])
        vy = y * (u[1, n] - u_prev[1, n])
        vz = z * (u[2, n] - u_prev[2, n])
        dx = x * (u[0, n] - u_then[0, n])
        dy = y * (u[1, n] - u_then[1, n])
        dz = z * (u[2, n] - u_then[2, n])
        fx = x * f[0, n]
        fy = y * f[1, n]
        fz = z * f[2, n]
        kinetic += 0.5 * (
            m[0] * vx * vx + m[3] * vy * vy + m[5] * vz * vz
            + 2 * (m[1] * vx * vy + m[2] * vx * vz + m[4] * vy * vz)
        )  # fmt: skip
        work += 0.5 * (fx * vx + fy * vy + fz * vz)
        numerator += dx * (fx - f_then[0, n]) + dy * (fy - f_then[1, n]) + dz * (fz - f_then[2, n])
        denominator += (
            m[0] * dx * dx + m[3] * dy * dy + m[5] * dz * dz
            + 2 * (m[1] * dx * dy + m[2] * dx * dz + m[4] * dy * dz)
        )  # fmt: skip
        change = max(change, vx * vx + vy * vy + vz * vz)
        m = mobility[:, n]
        ax = m[0] * fx + m[1] * fy + m[2] * fz
        ay = m[1] * fx + m[3] * fy + m[4] * fz
        az = m[2] * fx + m[4] * fy + m[5] * fz
        residual = max(residual, ax * ax + ay * ay + az * az)
        u_then[0, n] = u[0, n]
        u_then[1, n] = u[1, n]
        u_then[2, n] = u[2, n]
        f_then[0, n] = fx
        f_then[1, n] = fy
        f_then[2, n] = fz
    return kinetic, work, numerator, denominator, np.sqrt(change), np.sqrt(residual)


@_kernel
def pack(values, nodes, buffer):  # type: ignore[no-untyped-def]
    """buffer (k, n) <- values (k, :) at the nodes (n,)."""
    for c in range(values.shape[0]):
        for i in range(U(nodes.size)):
            buffer[c, i] = values[c, nodes[i]]


@_kernel
def clear(values, nodes):  # type: ignore[no-untyped-def]
    """values (k, :) <- 0 at the nodes (n,)."""
    zero = values.dtype.type(0)
    for c in range(values.shape[0]):
        for i in range(U(nodes.size)):
            values[c, nodes[i]] = zero


@_kernel
def unpack(values, nodes, buffer):  # type: ignore[no-untyped-def]
    """values (k, :) += buffer (k, n) at the nodes (n,)."""
    for c in range(values.shape[0]):
        for i in range(U(nodes.size)):
            values[c, nodes[i]] += buffer[c, i]
