"""Conjugate gradients with a two-level preconditioner for large sparse systems with nearly affine smooth solutions."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as linalg
from numpy.typing import NDArray

#: Minimum nodes of an aggregate, and maximum coarse unknowns (four for each aggregate): these are solved directly.
_MIN_NODES, _MAX_UNKNOWNS = 96, 12_000
#: Regularisation of the coarse system as a share of its diagonal: an aggregate may be flat.
_RIDGE = 1e-10


class TwoLevel:
    """A symmetric two-level preconditioner: Jacobi sweeps around a coarse correction.

    The system is a sum of projectors Q, which remove affine fields. It sees smooth fields by their second differences
    only, so its condition grows with the fourth power of the mesh, and conjugate gradients alone take thousands of
    iterations. The coarse fields are affine on aggregates of nodes and smoothed once (smoothed aggregation; Vanek,
    Mandel and Brezina 1996).
    """

    def __init__(self, system: sparse.csr_matrix, points: NDArray[np.float64]) -> None:
        """system (n, n), symmetric and positive semi-definite; points (n, 3): positions of its unknowns."""
        n = len(points)
        diagonal = system.diagonal()
        self.system = system
        self._inverse = (1 / np.where(diagonal > 0, diagonal, 1.0))[:, None]
        self._weight = 4 / 3 / self._largest_eigenvalue()
        pieces = _affine_pieces(points, max(_MIN_NODES, 4 * n // _MAX_UNKNOWNS))
        self.prolongation = (pieces - sparse.diags(self._weight * self._inverse[:, 0]) @ system @ pieces).tocsr()
        coarse = (self.prolongation.T @ system @ self.prolongation).tocsc()
        ridge = _RIDGE * coarse.diagonal()
        self._solve = linalg.splu(
            (coarse + sparse.diags(ridge + (ridge == 0))).tocsc(), permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0, options={"SymmetricMode": True},
        ).solve  # fmt: skip
        affine = np.linalg.qr(np.column_stack([np.ones(n), points - points.mean(axis=0)]))[0]
        # Without constraints affine fields are the null space of the system.
        is_null = np.abs(system @ affine).max() < 1e-9 * diagonal.max()
        self._affine = affine if is_null else np.zeros((n, 0))

    def _largest_eigenvalue(self) -> float:
        """1.1 times the largest eigenvalue of the system scaled by its diagonal, by power iteration."""
        x = np.random.default_rng(0).normal(size=(self.system.shape[0], 1))
        value = 1.0
        for _ in range(12):
            x = self._inverse * (self.system @ x)
            value = float(np.linalg.norm(x)) or 1.0
            x /= value
        return 1.1 * value

    def __call__(self, residual: NDArray[np.float64]) -> NDArray[np.float64]:
        """The approximate solution (n, k) for right-hand sides (n, k)."""
        scale = self._weight * self._inverse
        x = scale * residual
        x += self.prolongation @ self._solve(self.prolongation.T @ (residual - self.system @ x))
        x += scale * (residual - self.system @ x)
        return self.without_affine(x)

    def without_affine(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """x (n, k) without its part in the null space of the system."""
        return np.subtract(x, self._affine @ (self._affine.T @ x), dtype=np.float64)


def _affine_pieces(points: NDArray[np.float64], size: int) -> sparse.csr_matrix:
    """(n, 4 m): 1, x, y, z on each of m aggregates of about `size` nodes; halved repeatedly along x, y, z in turn."""
    n = len(points)
    group = np.zeros(n, np.int64)
    for level in range(max(0, int(np.ceil(np.log2(n / size))))):
        order = np.lexsort((points[:, level % 3], group))
        counts = np.bincount(group)
        first = np.cumsum(counts) - counts
        rank = np.empty(n, np.int64)
        rank[order] = np.arange(n) - np.repeat(first, counts)
        group = 2 * group + (rank >= counts[group] // 2)
    counts = np.maximum(np.bincount(group), 1)
    centre = np.stack([np.bincount(group, x) for x in points.T], axis=1) / counts[:, None]
    offset = points - centre[group]
    spread = np.sqrt(np.bincount(group, (offset**2).sum(axis=1)) / counts)
    offset /= np.where(spread > 0, spread, 1.0)[group, None]
    values = np.column_stack([np.ones(n), offset]).ravel()
    columns = (4 * group[:, None] + np.arange(4)).ravel()
    return sparse.csr_matrix((values, columns, np.arange(0, 4 * n + 1, 4)), shape=(n, 4 * len(counts)))


def solve(
    system: sparse.csr_matrix,
    right: NDArray[np.float64],
    preconditioner: TwoLevel,
    tolerance: NDArray[np.float64],
    max_iterations: int = 1000,
) -> NDArray[np.float64]:
    """Solution (n, k) for right-hand sides (n, k), by conjugate gradients; tolerance (k,): norms of the residuals."""
    x = np.zeros_like(right)
    residual = preconditioner.without_affine(right)
    z = preconditioner(residual)
    direction = z.copy()
    energy = (residual * z).sum(axis=0)
    for _ in range(max_iterations):
        if (np.linalg.norm(residual, axis=0) <= tolerance).all():
            break
        image = system @ direction
        curvature = (direction * image).sum(axis=0)
        step = np.divide(energy, curvature, out=np.zeros_like(energy), where=curvature > 0)
        x += step * direction
        residual -= step * image
        z = preconditioner(residual)
        before, energy = energy, (residual * z).sum(axis=0)
        direction = z + np.divide(energy, before, out=np.zeros_like(energy), where=before > 0) * direction
    return x
