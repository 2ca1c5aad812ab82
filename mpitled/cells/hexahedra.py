"""One-point hexahedra: gradients, volumes, hourglass modes, masses and quality of cells of any shape.

The eight corner values of a field are sums of eight sign vectors: 1, r, s, t, rs, st, rt, rst of the corners. All but
the constant one are called modes here, in that order. The position's own modes x_r, x_s, ... are 3-vectors, one per
cell. A hexahedron is a trilinear map of them, so that its volume and gradients are triple products of modes, exactly.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mpitled.mesh import CORNERS

_r, _s, _t = CORNERS.T.astype(float)
#: The modes that a gradient has: r, s, t, rs, st, rt, one per row.
GRADIENT_MODES: NDArray[np.float64] = np.stack([_r, _s, _t, _r * _s, _s * _t, _r * _t])
#: The hourglass modes rs, st, rt, rst, one per row: H^T of the paper's eq. 4.19.
HOURGLASS_MODES: NDArray[np.float64] = np.stack([_r * _s, _s * _t, _r * _t, _r * _s * _t])
#: A hexahedron with less than this share of its longest edge cubed is flat: an aspect of 1000 in two directions.
FLAT = 1e-6

#: lambda + 2 mu at nu = 0.495, in shear moduli.
HOURGLASS_LIMIT = 102.0

_CHUNK = 1 << 13  # cells at once, so that the temporaries stay small
# Neighbours of each corner along r, s and t.
_ALONG = np.array([[1, 3, 4], [0, 2, 5], [3, 1, 6], [2, 0, 7], [5, 7, 0], [4, 6, 1], [7, 5, 2], [6, 4, 3]])
_EDGES = np.array([(a, b) for a in range(8) for b in _ALONG[a] if a < b])


def geometry(
    points: NDArray[np.float64], hexahedra: NDArray[np.integer], rule: str = "mean"
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradients B (n, 8, 3), 1/m, and volumes (n,), m^3, of hexahedra (n, 8) with nodes `points` (n_nodes, 3), m.

    grad u = u_a B_a. "mean" is B averaged over the exact volume (Flanagan and Belytschko 1981), "centre" is the
    paper's (4.4)-(4.6), with its volume 8 det J; that one fails the patch test on distorted cells. On
    parallelepipeds the two are one.
    """
    coefficients, _, volume = hadamard(points, hexahedra, rule)
    return np.matmul(GRADIENT_MODES.T / 8, coefficients), volume


def hadamard(
    points: NDArray[np.float64], hexahedra: NDArray[np.integer], rule: str = "mean"
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """What fast kernels need of `geometry`, in modes: C (n, 6, 3), 1/m; x^T H (n, 4, 3), m; volumes (n,), m^3.

    B = 1/8 [r s t rs st rt] C, so that grad u = 1/8 C^T [r s t rs st rt]^T u. V C_m is the derivative of the volume
    by x_m. B has no part along rst: that would be an integral of det(grad rst, grad a, grad b) over the reference
    cube, even in all three coordinates only for a = b, where the determinant is zero.
    """
    coefficients, x_hourglass = np.empty((len(hexahedra), 6, 3)), np.empty((len(hexahedra), 4, 3))
    volume = np.empty(len(hexahedra))
    for chunk in _chunks(len(hexahedra)):
        x = points[hexahedra[chunk]]
        modes = np.matmul(GRADIENT_MODES / 8, x).transpose(1, 0, 2)
        volume[chunk], derivative = _mean(modes) if rule == "mean" else _centre(modes)
        coefficients[chunk] = (derivative / volume[chunk, None]).transpose(1, 0, 2)
        x_hourglass[chunk] = np.matmul(HOURGLASS_MODES, x)
    return coefficients, x_hourglass, volume


def volumes(points: NDArray[np.float64], hexahedra: NDArray[np.integer]) -> NDArray[np.float64]:
    """Exact volumes (n,), m^3, of the trilinear hexahedra: those of the masses, whatever the rule for gradients."""
    volume = np.empty(len(hexahedra))
    for chunk in _chunks(len(hexahedra)):
        volume[chunk] = _mean(np.matmul(GRADIENT_MODES / 8, points[hexahedra[chunk]]).transpose(1, 0, 2))[0]
    return volume


def hourglass_vectors(
    points: NDArray[np.float64], hexahedra: NDArray[np.integer], gradients: NDArray[np.float64]
) -> NDArray[np.float64]:
    """gamma = H - B (x^T H), (n, 8, 4): the modes less their affine part (paper, eq. 4.20)."""
    x_hourglass = np.matmul(HOURGLASS_MODES, points[hexahedra])
    return np.subtract(HOURGLASS_MODES.T, np.matmul(gradients, x_hourglass.transpose(0, 2, 1)), dtype=np.float64)


def hourglass_stiffness(
    gradients: NDArray[np.float64],
    volume: NDArray[np.float64],
    p_wave_modulus: NDArray[np.float64] | float,
    resistance: float,
) -> NDArray[np.float64]:
    """k = R_hg (lambda + 2 mu) V (B:B) / 8, (n,) in N/m; the hourglass force is k gamma gamma^T u.

    Eq. 4.22 prints its factors in shapes that do not fit each other; this is what they must mean.
    """
    return resistance * p_wave_modulus * volume * np.einsum("eai,eai->e", gradients, gradients) / 8


def hourglass_modulus(lam: NDArray[np.float64], mu: NDArray[np.float64]) -> NDArray[np.float64]:
    """What hourglass control (eq. 4.22) is a share of, Pa: lambda + 2 mu, at most that of nu = 0.495.

    Hourglass modes keep the volume to first order: towards nu = 0.5 a share of lambda would lock them. At nu = 0.499
    without the limit the largest error of a stretched cylinder doubles; with that of nu = 0.49 a fine mesh of a
    compressed one gives way at the platens' edges. The modes of support domains have to hold against pressure, which
    such a limit lets tumours grow through: they are stabilised with the whole lambda + 2 mu.
    """
    return np.minimum(lam + 2 * mu, HOURGLASS_LIMIT * mu)


def nodal_mass(cells: NDArray[np.integer], cell_mass: NDArray[np.float64], n_nodes: int) -> NDArray[np.float64]:
    """Masses of nodes (n_nodes,), kg: each cell's (n,), shared equally by its nodes (n, k).

    Eq. 4.17 for hexahedra, with the exact volume in place of 8 det J (or the total would not be exact), and eq.
    4.18 for support domains.
    """
    share = np.repeat(cell_mass / cells.shape[1], cells.shape[1])
    return np.bincount(cells.ravel(), share, n_nodes).astype(np.float64, copy=False)


def nodal_sum(cells: NDArray[np.int64], values: NDArray[np.float64], n_nodes: int) -> NDArray[np.float64]:
    """Sum (n_nodes, 3) of the values (n_cells, n, 3) of cells at their nodes."""
    flat = cells.ravel()
    return np.stack([np.bincount(flat, values[..., i].ravel(), n_nodes) for i in range(3)], axis=1)


def corner_jacobians(points: NDArray[np.float64], hexahedra: NDArray[np.integer]) -> NDArray[np.float64]:
    """Determinants (n, 8), m^3, of the map from [-1, 1]^3 at the corners: negative where a cell is turned over."""
    x = points[hexahedra]
    return _triple(*_corner_edges(x)) / 8


def scaled_jacobian(points: NDArray[np.float64], hexahedra: NDArray[np.integer]) -> NDArray[np.float64]:
    """Scaled Jacobian (n,): 1 for a box, 0 or less if a corner is flat or inverted, also where edges have no length.

    The smallest, over the corners and the centre, of det / product of edge lengths (Verdict library, SAND2007-1751).
    """
    worst = np.empty(len(hexahedra))
    for chunk in _chunks(len(hexahedra)):
        x = points[hexahedra[chunk]]
        edges = _corner_edges(x)
        axes = np.matmul(GRADIENT_MODES[:3], x)
        edges = [np.concatenate([edges[i], axes[:, i, None]], axis=1) for i in range(3)]
        lengths = np.prod([np.linalg.norm(edge, axis=2) for edge in edges], axis=0)
        jacobians = _triple(*edges)
        worst[chunk] = np.divide(jacobians, lengths, out=np.zeros_like(lengths), where=lengths > 0).min(axis=1)
    return worst


def aspect(points: NDArray[np.float64], hexahedra: NDArray[np.integer]) -> NDArray[np.float64]:
    """Longest edge over shortest (n,); infinite where an edge has no length."""
    ratio = np.empty(len(hexahedra))
    for chunk in _chunks(len(hexahedra)):
        lengths = _edge_lengths(points[hexahedra[chunk]])
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio[chunk] = np.nan_to_num(lengths.max(axis=1) / lengths.min(axis=1), nan=np.inf, posinf=np.inf)
    return ratio


def check(points: NDArray[np.float64], hexahedra: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Hexahedra that cannot be computed with, and those that can but should not: rows, ascending.

    Unusable are those whose volume or whose determinant at the centre is negative or FLAT. Poor are others with a
    corner that is flat or turned over.
    """
    usable, sound = np.empty(len(hexahedra), bool), np.empty(len(hexahedra), bool)
    for chunk in _chunks(len(hexahedra)):
        x = points[hexahedra[chunk]]
        modes = np.matmul(GRADIENT_MODES / 8, x).transpose(1, 0, 2)
        least = FLAT * _edge_lengths(x).max(axis=1) ** 3
        usable[chunk] = (_mean(modes)[0] > least) & (_centre(modes)[0] > least)
        sound[chunk] = (_triple(*_corner_edges(x)) > least[:, None]).all(axis=1)
    return np.flatnonzero(~usable), np.flatnonzero(usable & ~sound)


def _chunks(n: int) -> Iterator[slice]:
    return (slice(first, min(first + _CHUNK, n)) for first in range(0, n, _CHUNK))


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """np.cross, which takes three times as long."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _triple(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
    return (a * _cross(b, c)).sum(axis=-1)


def _mean(modes: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Volume (n,) and its derivatives (6, n, 3) by the modes (6, n, 3) of the positions.

    The integral of det(grad f, grad g, grad h) over the reference cube is 8 for the modes (r, s, t), 8/3 for
    (r, rs, rt), (s, st, rs), (t, rt, st), and 0 for all other triples.
    """
    r, s, t, rs, st, rt = modes
    derivative = np.stack(
        [
            3 * _cross(s, t) + _cross(rs, rt),
            3 * _cross(t, r) + _cross(st, rs),
            3 * _cross(r, s) + _cross(rt, st),
            _cross(rt, r) + _cross(s, st),
            _cross(rs, s) + _cross(t, rt),
            _cross(r, rs) + _cross(st, t),
        ]
    ) * (8 / 3)
    # The volume is of degree three in the modes (Euler's theorem on homogeneous functions).
    return np.einsum("mei,mei->e", modes, derivative) / 3, derivative


def _centre(modes: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """8 det J at the centre (n,) and its derivatives (6, n, 3) by the modes (paper, eq. 4.5, 4.6)."""
    r, s, t = modes[:3]
    derivative = np.zeros_like(modes)
    derivative[:3] = 8 * np.stack([_cross(s, t), _cross(t, r), _cross(r, s)])
    return np.einsum("ei,ei->e", r, derivative[0]), derivative


def _corner_edges(x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Edges (n, 8, 3) at the corners of cells (n, 8, 3) along r, s and t."""
    return [(x[:, _ALONG[:, i]] - x) * -CORNERS[:, i, None] for i in range(3)]


def _edge_lengths(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.norm(x[:, _EDGES[:, 1]] - x[:, _EDGES[:, 0]], axis=2)
