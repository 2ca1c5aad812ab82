"""Mathematics of a support domain: moving least squares, the linear projector, the stabilisation and the field."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Exponents of x, y, z: complete bases of 4, 10 and 20 monomials. The paper's 7 and 11 add cross terms only.
POWERS = np.array([(i, j, d - i - j) for d in range(4) for i in range(d, -1, -1) for j in range(d - i, -1, -1)])
#: A domain flatter than this share of its radius is repaired. The condition of the moment matrix, in coordinates scaled
#: by the radius, grows with the inverse square of the share for each degree of the basis.
FLATTEST = 0.05
#: Radius of the quartic weight over the farthest node's distance: each node of the domain has a weight above zero.
QUARTIC_RADIUS = 1.2

_CHUNK = 1 << 14  # domains computed at once; bounds the temporary memory


def worst_condition(basis: int) -> float:
    """Largest accepted condition of the scaled moment matrix: FLATTEST^-2, to the power of the basis's degree."""
    return float(FLATTEST ** (-2.0 * POWERS[basis - 1].sum()))


def moving_least_squares(
    nodes: NDArray[np.float64], at: NDArray[np.float64], basis: int = 4, weight: str = "equal"
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Values (G, n), gradients (G, n, 3) in 1/m, and the condition (G,) of the scaled moment matrix; eq. 4.8-4.16.

    nodes (G, n, 3) and at (G, 3) in m; basis 4, 10 or 20. Equal weights are the paper's choice for small domains; the
    quartic spline is 1 - 6 q^2 + 8 q^3 - 3 q^4, with q the distance over QUARTIC_RADIUS times the farthest node's.
    Gradients are derivatives of the polynomial fitted at the point: full derivatives with equal weights, diffuse
    derivatives with the quartic weight. They are exact for the basis. Coordinates are scaled by the domain's radius.
    The condition of a singular matrix is inf, and its values and gradients are meaningless.
    """
    values, gradients = np.empty(nodes.shape[:2]), np.empty(nodes.shape)
    condition = np.empty(len(nodes))
    powers = POWERS[:basis]
    for first in range(0, len(nodes), _CHUNK):
        rows = slice(first, first + _CHUNK)
        offset = nodes[rows] - at[rows, None]
        distance = np.linalg.norm(offset, axis=2)
        radius = distance.max(axis=1)
        P = np.prod((offset / radius[:, None, None])[:, :, None, :] ** powers, axis=3)
        q = distance / (QUARTIC_RADIUS * radius[:, None])
        w = 1 - 6 * q**2 + 8 * q**3 - 3 * q**4 if weight == "quartic" else np.ones_like(q)
        weighted = np.swapaxes(w[:, :, None] * P, 1, 2)
        moments = weighted @ P
        eigenvalues = np.linalg.eigvalsh(moments)
        singular = eigenvalues[:, 0] <= eigenvalues[:, -1] * np.finfo(float).eps * basis
        condition[rows] = np.where(singular, np.inf, eigenvalues[:, -1] / np.where(singular, 1, eigenvalues[:, 0]))
        moments[singular] += np.eye(basis)
        fit = np.linalg.solve(moments, weighted)
        # One Newton-Schulz step, and fit P = I to round-off times the condition's root.
        fit += (np.eye(basis) - fit @ P) @ fit
        values[rows] = fit[:, 0]
        gradients[rows] = np.swapaxes(fit[:, 1:4], 1, 2) / radius[:, None, None]
    return values, gradients, condition


def linear_projector(nodes: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions from their mean Xc (G, n, 3), m, and A = (Xc^T Xc)^-1 (G, 3, 3), 1/m^2, of domains (G, n, 3).

    Q v = v - mean v - Xc A Xc^T v removes the affine part of nodal values. Q is unweighted and linear for every basis
    and weight of the gradients, so that it is symmetric and conserves angular momentum.
    """
    centred = nodes - nodes.mean(axis=1, keepdims=True)
    return centred, np.linalg.inv(np.swapaxes(centred, 1, 2) @ centred)


def stabilisation_stiffness(
    inverse: NDArray[np.float64], volume: NDArray[np.float64], p_wave_modulus: NDArray[np.float64], stabilisation: float
) -> NDArray[np.float64]:
    """kappa = s (lambda + 2 mu) V (B:B) / 8, (G,) in N/m; the stabilising force is kappa Q u.

    B are the linear gradients Xc A of `linear_projector`, before any correction, so that B:B is the trace of A.
    """
    return stabilisation * p_wave_modulus * volume * np.trace(inverse, axis1=1, axis2=2) / 8


def field_at_nodes(
    points: NDArray[np.float64],
    n_fe_nodes: int,
    at: NDArray[np.float64],
    domains: NDArray[np.int64],
    basis: int,
    weight: str,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Support domain (n_efg_nodes,) that interpolates the field at each EFG node, and its MLS values (n_efg_nodes, n).

    It is the domain with the nearest integration point among the domains of the node. Displacement parameters of EFG
    nodes are not the displacement field, because MLS does not interpolate.
    """
    members = domains.ravel()
    order = np.argsort(((np.repeat(at, domains.shape[1], axis=0) - points[members]) ** 2).sum(axis=1), kind="stable")
    order = order[np.argsort(members[order], kind="stable")]
    nodes, first = np.unique(members[order], return_index=True)
    nearest = (order[first] // domains.shape[1])[nodes >= n_fe_nodes]
    values, _, _ = moving_least_squares(points[domains[nearest]], points[n_fe_nodes:], basis, weight)
    return nearest, values
