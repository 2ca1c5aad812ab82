"""What kernels compute of 3x3 tensors: nine numbers, or nine vectors of numbers, row by row."""

from __future__ import annotations

from mpitled.kernels.lanes import load, load_each, store
from mpitled.kernels.templates import N_COEFFICIENTS, inline, inline_template, law_energy, law_tangent_bound


@inline
def cofactor(a, b, c, d, e, f, g, h, i):  # type: ignore[no-untyped-def]
    """Cofactor K = J F^-T of the tensor with these rows, and its determinant J."""
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


@inline
def deformation(H):  # type: ignore[no-untyped-def]
    """F = H + I, its cofactor K, and J = det F, from the displacement gradient H."""
    F = (H[0] + 1, H[1], H[2], H[3], H[4] + 1, H[5], H[6], H[7], H[8] + 1)
    k = cofactor(F[0], F[1], F[2], F[3], F[4], F[5], F[6], F[7], F[8])
    return F, k[:9], k[9]


@inline
def cell_bound(a, b, K, gram):  # type: ignore[no-untyped-def]
    """Bound of the largest eigenvalue of a cell's tangent: a |B K^T|^2 + b |B|^2 (Frobenius norms).

    a, b: `Law.tangent_bound`, times the cell's volume; gram: B^T B (xx, xy, xz, yy, yz, zz), 1/m^2.
    """
    g0, g1, g2, g3, g4, g5 = gram
    material = (
        g0 * (K[0] * K[0] + K[3] * K[3] + K[6] * K[6])
        + g3 * (K[1] * K[1] + K[4] * K[4] + K[7] * K[7])
        + g5 * (K[2] * K[2] + K[5] * K[5] + K[8] * K[8])
        + (
            g1 * (K[0] * K[1] + K[3] * K[4] + K[6] * K[7])
            + g2 * (K[0] * K[2] + K[3] * K[5] + K[6] * K[8])
            + g4 * (K[1] * K[2] + K[4] * K[5] + K[7] * K[8])
        )
        * 2
    )
    return a * material + b * (g0 + g3 + g5)


@inline_template
def check_batch(H, coefficient, gram, stiffness, w, value):  # type: ignore[no-untyped-def]
    """J, strain energy and eigenvalue bound of the lanes of a batch from w on, into value (3, lanes).

    stiffness (lanes,), N/m: the largest eigenvalue of what the cell has beside its tangent.
    """
    F, K, J = deformation(H)
    c = load_each(coefficient, N_COEFFICIENTS, w)
    a, b = law_tangent_bound(F, K, J, c)
    store(value[0], w, J)
    store(value[1], w, law_energy(H, F, K, J, c))
    store(value[2], w, cell_bound(a, b, K, load_each(gram, 6, w)) + load(stiffness, w))
