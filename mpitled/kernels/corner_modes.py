"""Corner values of a hexahedron as sums of sign vectors (the Hadamard form), shared by the kernels of hexahedra."""

from __future__ import annotations

from mpitled.kernels.templates import inline


@inline
def corner_modes(u0, u1, u2, u3, u4, u5, u6, u7):  # type: ignore[no-untyped-def]
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
def corner_values(r, s, t, rs, st, rt, rst):  # type: ignore[no-untyped-def]
    """The corner values that are the sums of these signs times r, s, ...: the transpose of `corner_modes`."""
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


@inline
def hourglass_squares(qx, qy, qz):  # type: ignore[no-untyped-def]
    """The sum of the squares of the hourglass modes rs, st, rt, rst in all directions."""
    return (
        (qx[3] * qx[3] + qx[4] * qx[4] + qx[5] * qx[5] + qx[6] * qx[6])
        + (qy[3] * qy[3] + qy[4] * qy[4] + qy[5] * qy[5] + qy[6] * qy[6])
        + (qz[3] * qz[3] + qz[4] * qz[4] + qz[5] * qz[5] + qz[6] * qz[6])
    )
