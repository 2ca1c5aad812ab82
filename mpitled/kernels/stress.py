"""What all cells have in common: stress, energy and stiffness from grad u, of single numbers or of whole vectors."""

from __future__ import annotations

from typing import Any

from numba import njit

from mpitled.kernels.lanes import FAST, first_of, load, magnitude, root, store

#: Decorators of what kernels call, and of kernels.
inline: Any = njit(fastmath=FAST, error_model="numpy", cache=True, forceinline=True)
kernel: Any = njit(fastmath=FAST, error_model="numpy", cache=True, nogil=True)


@inline
def cofactor(a, b, c, d, e, f, g, h, i):  # type: ignore[no-untyped-def]
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


@inline
def first_piola(grad, mu, lam, one, n):  # type: ignore[no-untyped-def]
    """P = mu X + (lambda (J - 1) - mu / J) K (design of `material.first_piola`), and J, from grad u.

    Where n is given, only the first n lanes are cells; in the others mu is 0 and so is P, for any J, also for none.
    """
    a, b, c, d, e, f, g, h, i = grad
    a = a + one
    e = e + one
    i = i + one
    k0, k1, k2, k3, k4, k5, k6, k7, k8, J = cofactor(a, b, c, d, e, f, g, h, i)
    q = lam * (J - one) - mu / J
    if n is not None:
        q = first_of(n, q, mu)
    return (
        mu * a + q * k0, mu * b + q * k1, mu * c + q * k2,
        mu * d + q * k3, mu * e + q * k4, mu * f + q * k5,
        mu * g + q * k6, mu * h + q * k7, mu * i + q * k8,
        J,
    )  # fmt: skip


@inline
def energy_and_bound(grad, mu, lam, gram, one):  # type: ignore[no-untyped-def]
    """J, the elastic energy but for its -mu ln J, and a bound of the tangent's largest eigenvalue, from grad u.

    The bound is (lambda + mu / J^2) |B K^T|^2 + (mu + |q| sqrt(2) |X|) |B|^2, q = lambda (J - 1) - mu / J, Frobenius
    norms, with B^T B = gram (xx, xy, xz, yy, yz, zz): the material part's rank-one term, and the initial-stress term.
    mu and lam carry the cell's volume.
    """
    a, b, c, d, e, f, g, h, i = grad
    g0, g1, g2, g3, g4, g5 = gram
    energy = (a + e + i) * (one + one) + (a * a + b * b + c * c + d * d + e * e + f * f + g * g + h * h + i * i)
    a = a + one
    e = e + one
    i = i + one
    k0, k1, k2, k3, k4, k5, k6, k7, k8, J = cofactor(a, b, c, d, e, f, g, h, i)
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
    bound = (lam + mu / (J * J)) * bk + (mu + magnitude(q) * root((one + one) * square)) * (g0 + g3 + g5)
    return J, half * (mu * energy + lam * (J - one) * (J - one)), bound


@inline
def batch_survey(grad, coefficient, gram, stiffness, w, value, one):  # type: ignore[no-untyped-def]
    """J, strain energy but for its logarithm and eigenvalue bound of some lanes of a batch, into value (3, lanes)."""
    g = (load(gram[0], w), load(gram[1], w), load(gram[2], w), load(gram[3], w), load(gram[4], w), load(gram[5], w))
    r = energy_and_bound(grad, load(coefficient[0], w), load(coefficient[1], w), g, one)
    store(value[0], w, r[0])
    store(value[1], w, r[1])
    store(value[2], w, r[2] + load(stiffness, w))
