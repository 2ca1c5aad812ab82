"""Solves large sparse systems whose smooth solutions are nearly affine, with a coarse grid of affine pieces."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as linalg
from numpy.typing import NDArray

#: Nodes of an aggregate at least, and coarse unknowns (four an aggregate) at most: those are solved for directly.
SMALLEST, MOST = 96, 12_000
#: Regularises the coarse system, where aggregates are flat, as a share of its diagonal.
_RIDGE = 1e-10


class AffineGrid:
    """A symmetric two-level preconditioner: Jacobi sweeps around a coarse correction.

    A system that takes affine parts out of nodal values (the sum of projectors Q) sees smooth fields only by their
    second differences, so that its condition grows with the fourth power of the mesh, and conjugate gradients take
    thousands of iterations. Here nodes are put together in aggregates on which the coarse fields are affine, smoothed
    once (smoothed aggregation; Vanek, Mandel and Brezina 1996).
    """

    def __init__(self, system: sparse.csr_matrix, points: NDArray[np.float64]) -> None:
        """system (n, n), symmetric and positive semi-definite; points (n, 3): where its unknowns are."""
        n = len(points)
        diagonal = system.diagonal()
        self.system = system
        self._inverse = (1 / np.where(diagonal > 0, diagonal, 1.0))[:, None]
        self._weight = 4 / 3 / self._largest_eigenvalue()
        pieces = _affine_pieces(points, max(SMALLEST, 4 * n // MOST))
        self.prolongation = (pieces - sparse.diags(self._weight * self._inverse[:, 0]) @ system @ pieces).tocsr()
        coarse = (self.prolongation.T @ system @ self.prolongation).tocsc()
        ridge = _RIDGE * coarse.diagonal()
        self._solve = linalg.splu(
            (coarse + sparse.diags(ridge + (ridge == 0))).tocsc(), permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0, options={"SymmetricMode": True},
        ).solve  # fmt: skip
        affine = np.linalg.qr(np.column_stack([np.ones(n), points - points.mean(axis=0)]))[0]
        # Where nothing is held, affine fields are no business of the system's.
        free = np.abs(system @ affine).max() < 1e-9 * diagonal.max()
        self._affine = affine if free else np.zeros((n, 0))

    def _largest_eigenvalue(self) -> float:
        """Of the system over its diagonal, by power iteration, and a tenth more."""
        x = np.random.default_rng(0).normal(size=(self.system.shape[0], 1))
        value = 1.0
        for _ in range(12):
            x = self._inverse * (self.system @ x)
            value = float(np.linalg.norm(x)) or 1.0
            x /= value
        return 1.1 * value

    def __call__(self, residual: NDArray[np.float64]) -> NDArray[np.float64]:
        """About the solution (n, k) for right-hand sides (n, k)."""
        scale = self._weight * self._inverse
        x = scale * residual
        x += self.prolongation @ self._solve(self.prolongation.T @ (residual - self.system @ x))
        x += scale * (residual - self.system @ x)
        return self.without_affine(x)

    def without_affine(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """x less its part along what the system does not see."""
        return np.subtract(x, self._affine @ (self._affine.T @ x), dtype=np.float64)


def _affine_pieces(points: NDArray[np.float64], size: int) -> sparse.csr_matrix:
    """(n, 4 m): 1, x, y, z of each of m aggregates of about `size` nodes, halves of halves along the axes in turn."""
    n = len(points)
    group = np.zeros(n, np.int64)
    for level in range(max(0, int(np.ceil(np.log2(n / size))))):
        order = np.lexsort((points[:, level % 3], group))
        counts = np.bincount(group)
        first = np.cumsum(counts) - counts
        place = np.empty(n, np.int64)
        place[order] = np.arange(n) - np.repeat(first, counts)
        group = 2 * group + (place >= counts[group] // 2)
    counts = np.maximum(np.bincount(group), 1)
    centre = np.stack([np.bincount(group, x) for x in points.T], axis=1) / counts[:, None]
    offset = points - centre[group]
    spread = np.sqrt(np.bincount(group, (offset**2).sum(axis=1)) / counts)
    offset /= np.where(spread > 0, spread, 1.0)[group, None]
    values = np.column_stack([np.ones(n), offset]).ravel()
    columns = (4 * group[:, None] + np.arange(4)).ravel()
    return sparse.csr_matrix((values, columns, np.arange(0, 4 * n + 1, 4)), shape=(n, 4 * len(counts)))


def solve(
    system: sparse.csr_matrix, right: NDArray[np.float64], grid: AffineGrid, tolerance: float, most: int = 1000
) -> NDArray[np.float64]:
    """Solution (n, k) for the right-hand sides (n, k), each to a residual of tolerance (k,), by conjugate gradients."""
    x = np.zeros_like(right)
    residual = grid.without_affine(right)
    z = grid(residual)
    direction = z.copy()
    energy = (residual * z).sum(axis=0)
    for _ in range(most):
        if (np.linalg.norm(residual, axis=0) <= tolerance).all():
            break
        image = system @ direction
        curvature = (direction * image).sum(axis=0)
        step = np.divide(energy, curvature, out=np.zeros_like(energy), where=curvature > 0)
        x += step * direction
        residual -= step * image
        z = grid(residual)
        before, energy = energy, (residual * z).sum(axis=0)
        direction = z + np.divide(energy, before, out=np.zeros_like(energy), where=before > 0) * direction
    return x
