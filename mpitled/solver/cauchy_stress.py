"""The Cauchy stress of a rank's cells, for results: the time loop has no use for it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mpitled.laws import first_piola
from mpitled.store import PartRows

#: Rows and columns of the components as VTK has them: xx, yy, zz, xy, yz, xz.
_ROWS, _COLUMNS = [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]


def cauchy(rows: PartRows, u: NDArray[np.float64], rule: str) -> NDArray[np.float64]:
    """Cauchy stress (n_own_cells, 6), Pa: xx, yy, zz, xy, yz, xz, at displacements u (3, n_nodes), m.

    Hexahedra have the one of their one point, by the rule of their gradient; stabilisation is not in it.
    """
    material = rows.read("material")
    made = np.empty((rows.n_own_cells, 6))
    for first, cells, gradients in _gradients(rows, rule):
        of_block = material[first : first + len(cells)]
        for number in np.unique(of_block):
            own = np.flatnonzero(of_block == number)
            F = np.eye(3) + np.einsum("ian,naj->nij", u[:, cells[own].T], gradients[own])
            P = first_piola(rows.materials[number].law, F)
            stress = P @ F.swapaxes(1, 2) / np.linalg.det(F)[:, None, None]
            made[first + own] = stress[:, _ROWS, _COLUMNS]
    return made


def _gradients(rows: PartRows, rule: str) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.float64]]]:
    """First cell, local nodes (n, k) and gradients (n, k, 3), 1/m, of cells block by block."""
    points = rows.read("points")
    for block in rows.blocks:
        for first, nodes in block.chunks("nodes"):
            cells = rows.local(nodes)
            yield block.first_own + first, cells, block.gradients(points, cells, first, rule)
