"""Kernels of hexahedra: boxes in runs along grid lines, and cells of any shape, gathered."""

from __future__ import annotations

import numpy as np
from numba import uint64 as U

from mpitled.kernels.lanes import (
    BATCH,
    first_of,
    gather,
    last,
    load,
    prefetch,
    scatter,
    shift,
    smaller,
    smallest,
    spread,
    store,
    width,
)  # fmt: skip
from mpitled.kernels.stress import batch_survey, energy_and_bound, first_piola, inline, kernel

_BATCH = np.uint64(BATCH)


@inline
def _modes(u0, u1, u2, u3, u4, u5, u6, u7):  # type: ignore[no-untyped-def]
    """The sums r, s, t, rs, st, rt, rst of corner values with those signs, by butterflies of additions."""
    m0 = u1 - u0
    m1 = u2 - u3
    m2 = u5 - u4
    m3 = u6 - u7
    p0 = u0 + u1
    p1 = u3 + u2
    p2 = u4 + u5
    p3 = u7 + u6
    below = m0 + m1
    above = m2 + m3
    dm = m1 - m0
    dn = m3 - m2
    dp = p1 - p0
    dq = p3 - p2
    return below + above, dp + dq, (p2 + p3) - (p0 + p1), dm + dn, dq - dp, above - below, dn - dm


@inline
def _corners(r, s, t, rs, st, rt, rst):  # type: ignore[no-untyped-def]
    """The corner values that are the sums of these signs times r, s, ...: the transpose of `_modes`."""
    plus = s + t
    e0 = st - plus
    e1 = (s - t) - st
    e2 = (t - s) - st
    e3 = st + plus
    a = r - rt
    b = r + rt
    c = rs - rst
    d = rs + rst
    o0 = a - c
    o1 = a + c
    o2 = b - d
    o3 = b + d
    return e0 - o0, e0 + o0, e1 + o1, e1 - o1, e2 - o2, e2 + o2, e3 + o3, e3 - o3


# ---------------------------------------------------------------- voxel hexahedra, in runs along a grid line


@inline
def _box_modes(uc, i0, i1, i2, i3):  # type: ignore[no-untyped-def]
    """`_modes` of consecutive boxes that have their corners on four grid lines, from these nodes on."""
    one = U(1)
    return _modes(
        load(uc, i0), load(uc, i0 + one), load(uc, i1 + one), load(uc, i1),
        load(uc, i2), load(uc, i2 + one), load(uc, i3 + one), load(uc, i3),
    )  # fmt: skip


@inline
def _add_line(fc, node, near, far, before):  # type: ignore[no-untyped-def]
    """Add forces to the nodes of a grid line: each is the near node of one box and the far one of the box before."""
    store(fc, node, load(fc, node) + (near + shift(before, far)))


@inline
def _add_box_forces(fc, i0, i1, i2, i3, r, s, t, modes, k, before):  # type: ignore[no-untyped-def]
    """Add the forces of boxes in one direction; those at their far nodes, which the next boxes have to know.

    r, s, t: the stress's part; modes: of u; before: what this made for the boxes before.
    """
    c = _corners(r, s, t, k * modes[3], k * modes[4], k * modes[5], k * modes[6])
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


@kernel
def voxel_forces(u, f, line, length, along, scale, coefficient):  # type: ignore[no-untyped-def]
    """Add the nodal forces of runs of equal boxes to f; the smallest J among them.

    line (4, n_runs) and length (n_runs,), uint64: a run's cell w lies between the nodes line + w and line + w + 1 of
    four grid lines along the axis `along` (n_runs,). Axes are counted from that one, in turn: so are the corners, of
    which 0, 3, 4 and 7 come first on the lines. scale (3, n_runs), 1/m: the gradient of a sign vector, 1 / (4 edge).
    coefficient (3, n_runs), J: mu V, lambda V, and in N/m the hourglass stiffness k of eq. 4.22
    (R (lambda + 2 mu) V (B:B) / 8).

    On a box gamma^T u = H^T u, for x^T H = 0 (eq. 4.20). The last vector of a run has lanes without a cell, whose nodes
    are those that come behind: they have no stiffness, and add nothing there.
    """
    one = u.dtype.type(1)
    zeros = spread(u.dtype.type(0), u[0])
    ones = spread(one, u[0])
    least = spread(u.dtype.type(np.inf), u[0])
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
            mu = first_of(n - w, spread(coefficient[0, run], u[0]), zeros)
            k = first_of(n - w, spread(coefficient[2, run], u[0]), zeros)
            mx = _box_modes(u[x], i0, i1, i2, i3)
            my = _box_modes(u[y], i0, i1, i2, i3)
            mz = _box_modes(u[z], i0, i1, i2, i3)
            p = first_piola(_box_gradient(mx, my, mz, g0, g1, g2), mu, coefficient[1, run], one, n - w)
            least = smaller(least, first_of(n - w, p[9], ones))
            bx = _add_box_forces(f[x], i0, i1, i2, i3, p[0] * g0, p[1] * g1, p[2] * g2, mx, k, bx)
            by = _add_box_forces(f[y], i0, i1, i2, i3, p[3] * g0, p[4] * g1, p[5] * g2, my, k, by)
            bz = _add_box_forces(f[z], i0, i1, i2, i3, p[6] * g0, p[7] * g1, p[8] * g2, mz, k, bz)
        for c, before in ((x, bx), (y, by), (z, bz)):
            f[c, line[0, run] + end] += last(before[0])
            f[c, line[1, run] + end] += last(before[1])
            f[c, line[2, run] + end] += last(before[2])
            f[c, line[3, run] + end] += last(before[3])
    return smallest(least)


@kernel
def voxel_survey(u, line, length, along, first_cell, scale, coefficient, gram, required, factor, jacobian):  # type: ignore[no-untyped-def]
    """Strain energy and hourglass energy (J); writes each cell's J into jacobian (n_cells + 1,).

    Adds to required (n_nodes,), kg, the mass that each cell asks of its nodes: factor (s^2) times the bound of its
    largest eigenvalue. first_cell (n_runs,): a run's cell w is first_cell + w. gram (3, n_runs), 1/m^2: the diagonal
    of B^T B.
    """
    one = u.dtype.type(1)
    zero = u.dtype.type(0)
    eight = u.dtype.type(8)
    lanes = width(u[0])
    value = np.empty((4, lanes), u.dtype)
    strain = 0.0
    hourglass = 0.0
    for run in range(U(length.size)):
        n = length[run]
        x = along[run]
        y = (x + U(1)) % U(3)
        z = (x + U(2)) % U(3)
        mu = coefficient[0, run]
        k = coefficient[2, run]
        b0 = gram[0, run]
        b1 = gram[1, run]
        b2 = gram[2, run]
        for w in range(U(0), n, lanes):
            i0 = line[0, run] + w
            i1 = line[1, run] + w
            i2 = line[2, run] + w
            i3 = line[3, run] + w
            mx = _box_modes(u[x], i0, i1, i2, i3)
            my = _box_modes(u[y], i0, i1, i2, i3)
            mz = _box_modes(u[z], i0, i1, i2, i3)
            grad = _box_gradient(mx, my, mz, scale[0, run], scale[1, run], scale[2, run])
            r = energy_and_bound(grad, mu, coefficient[1, run], (b0, zero, zero, b1, zero, b2), one)
            store(value[0], U(0), r[0])
            store(value[1], U(0), r[1])
            store(value[2], U(0), r[2] + eight * k)
            store(value[3], U(0), _squares(mx, my, mz))
            for i in range(min(n - w, lanes)):
                J = value[0, i]
                jacobian[first_cell[run] + w + i] = J
                strain += value[1, i] - mu * np.log(J)
                hourglass += k * value[3, i]
                asked = factor * value[2, i]
                for first in (i0, i1, i2, i3):
                    required[first + i] += asked
                    required[first + i + U(1)] += asked
    return strain, 0.5 * hourglass


@inline
def _squares(qx, qy, qz):  # type: ignore[no-untyped-def]
    """The sum of the squares of the hourglass modes rs, st, rt, rst in all directions."""
    return (
        (qx[3] * qx[3] + qx[4] * qx[4] + qx[5] * qx[5] + qx[6] * qx[6])
        + (qy[3] * qy[3] + qy[4] * qy[4] + qy[5] * qy[5] + qy[6] * qy[6])
        + (qz[3] * qz[3] + qz[4] * qz[4] + qz[5] * qz[5] + qz[6] * qz[6])
    )


# ---------------------------------------------------------------- general hexahedra, gathered


@inline
def _corner_values(uc, nodes, w, in_row):  # type: ignore[no-untyped-def]
    """A component at the corners of some lanes of a batch. in_row: None, or each corner's nodes follow each other."""
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
    """Add forces to the nodes of a row: the near ones of its cells, and the far ones, each the near one of the next."""
    first = U(node)
    none = spread(fc.dtype.type(0), fc)
    store(fc, first, load(fc, first) + (near + shift(none, far)))
    fc[first + width(fc)] += last(far)


@inline
def _add_corner_values(fc, nodes, w, in_row, c):  # type: ignore[no-untyped-def]
    """The transpose of `_corner_values`: add c to them."""
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

    nodes (8, lanes) and g (30, lanes) of a batch, see `hexahedron_forces`; w: the first of its lanes.
    """
    v = _corner_values(uc, nodes, w, in_row)
    r, s, t, rs, st, rt, rst = _modes(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7])
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
    c = _corners(
        px * load(g[0], w) + py * load(g[1], w) + pz * load(g[2], w),
        px * load(g[3], w) + py * load(g[4], w) + pz * load(g[5], w),
        px * load(g[6], w) + py * load(g[7], w) + pz * load(g[8], w),
        rs + (px * load(g[9], w) + py * load(g[10], w) + pz * load(g[11], w)),
        st + (px * load(g[12], w) + py * load(g[13], w) + pz * load(g[14], w)),
        rt + (px * load(g[15], w) + py * load(g[16], w) + pz * load(g[17], w)),
        rst,
    )
    _add_corner_values(fc, nodes, w, in_row, c)


@inline
def _add_forces(u, f, nodes, g, coefficient, w, in_row, one):  # type: ignore[no-untyped-def]
    """Add the forces of some lanes of a batch; their J."""
    mx = _hexahedron_modes(u[0], nodes, g, w, in_row)
    my = _hexahedron_modes(u[1], nodes, g, w, in_row)
    mz = _hexahedron_modes(u[2], nodes, g, w, in_row)
    mu = load(coefficient[0], w)
    lam = load(coefficient[1], w)
    k = load(coefficient[2], w)
    p = first_piola(mx[:3] + my[:3] + mz[:3], mu, lam, one, None)
    _add_hexahedron_forces(f[0], nodes, g, w, in_row, p[0], p[1], p[2], mx, k)
    _add_hexahedron_forces(f[1], nodes, g, w, in_row, p[3], p[4], p[5], my, k)
    _add_hexahedron_forces(f[2], nodes, g, w, in_row, p[6], p[7], p[8], mz, k)
    return p[9]


@kernel
def hexahedron_forces(u, f, nodes, in_row, geometry, coefficient):  # type: ignore[no-untyped-def]
    """Add the nodal forces of hexahedra of any shape to f; the smallest J among them.

    nodes (n_batches, 8, lanes) uint32. in_row (n_batches, vectors in a batch): whether the nodes of each corner follow
    each other in the vector, and those of corners 1, 2, 5, 6 those of 0, 3, 4, 7: then nothing is gathered. geometry
    (n_batches, 30, lanes): the mean gradient of the sign vectors r, s, t, rs, st, rt in x, y, z (1/m; that of rst is
    zero), then x^T H (m) of rs, st, rt, rst. coefficient (n_batches, 3, lanes): mu V, lambda V (J), hourglass stiffness
    k (N/m); zero in lanes that only fill the last batch.
    """
    one = u.dtype.type(1)
    least = spread(u.dtype.type(np.inf), u[0])
    last_batch = U(nodes.shape[0] - 1)
    for batch in range(U(nodes.shape[0])):
        at = nodes[batch]
        g = geometry[batch]
        prefetch(geometry[min(batch + U(1), last_batch)])
        for w in range(U(0), _BATCH, width(u[0])):
            # In either way straight on: vectors stay in registers.
            if in_row[batch, w // width(u[0])]:
                J = _add_forces(u, f, at, g, coefficient[batch], w, True, one)
            else:
                J = _add_forces(u, f, at, g, coefficient[batch], w, None, one)
            least = smaller(least, J)
    return smallest(least)


@kernel
def hexahedron_survey(u, nodes, cells, geometry, coefficient, gram, stiffness, required, factor, jacobian):  # type: ignore[no-untyped-def]
    """As `voxel_survey`, of hexahedra of any shape.

    cells (n_batches, lanes): the cell of each lane, n_cells where it only fills the last batch. gram (n_batches, 6,
    lanes), 1/m^2: B^T B (xx, xy, xz, yy, yz, zz). stiffness (n_batches, lanes), N/m: the largest eigenvalue of the
    hourglass stiffness.
    """
    one = u.dtype.type(1)
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
            batch_survey(mx[:3] + my[:3] + mz[:3], coefficient[batch], gram[batch], stiffness[batch], w, value, one)
            store(value[3], w, _squares(mx, my, mz))
        for w in range(_BATCH):
            jacobian[cells[batch, w]] = value[0, w]
            strain += value[1, w] - coefficient[batch, 0, w] * np.log(value[0, w])
            hourglass += coefficient[batch, 2, w] * value[3, w]
            for a in range(8):
                required[at[a, w]] += factor * value[2, w]
    return strain, 0.5 * hourglass
