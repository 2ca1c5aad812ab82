"""Correct the gradients of the cloud so that a constant stress is in balance."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from mpitled.cells.hexahedra import nodal_sum
from mpitled.cells.support_domains import linear_projector
from mpitled.mesh import Mesh
from mpitled.model.scene import OUTER, TUMOUR, members
from mpitled.model.two_level import TwoLevel, solve

#: A constant stress is in balance if the imbalance of the nodal forces is below this share of the largest force.
_BALANCED = 1e-15


def consistent_gradients(
    mesh: Mesh,
    domains: NDArray[np.int64],
    gradients: NDArray[np.float64],
    fe_balance: NDArray[np.float64],
    prescribed: NDArray[np.int64],
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """Gradients with which a constant stress is in balance in each part of the cloud, and the worst part's figures.

    The stress jumps from part to part, so each part needs its own balance. The traction is equal on both sides of an
    interface. It is in balance if each part's gradients sum to the areas of the interface. fe_balance (n_nodes, 3),
    m^2, is the sum of V B over the hexahedra; prescribed (n,) are nodes.
    """
    known, surface = _surface(mesh, fe_balance, prescribed)
    volumes = mesh.integration_volumes
    if len(mesh.parts) < 2:
        free = known & (np.bincount(domains.ravel(), minlength=mesh.n_nodes) > 0)
        return correct_consistency(mesh.points[domains], domains, gradients, volumes, fe_balance - surface, free)
    corrected, figures = np.empty_like(gradients), dict[str, float]()
    for part in mesh.parts:
        rows, balance = part.integration_points, np.zeros_like(surface)
        balance[part.nodes] = -part.areas
        nodes = domains[rows]
        free = known & (np.bincount(nodes.ravel(), minlength=mesh.n_nodes) > 0)
        corrected[rows], of_part = correct_consistency(
            mesh.points[nodes], nodes, gradients[rows], volumes[rows], balance, free
        )
        figures = {name: max(value, figures.get(name, 0.0)) for name, value in of_part.items()}
    return corrected, figures


def _surface(
    mesh: Mesh, fe_balance: NDArray[np.float64], prescribed: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Nodes (n_nodes,) with a known surface integral of a constant stress, and the integrals (n_nodes, 3), m^2.

    At nodes of hexahedra only, the integral is fe_balance. Inside the cloud it is zero. On the cloud's boundary the
    mesher knows it. If a mesh file does not give it, outer and prescribed nodes are left out. The seed's surface is
    curved between its nodes, so the integral is not exact there.
    """
    known = np.ones(mesh.n_nodes, bool)
    solid = np.arange(mesh.n_nodes) < mesh.n_fe_nodes
    solid[members(mesh, "interface")] = False
    surface = np.where(solid[:, None], fe_balance, 0.0)
    if mesh.surface_areas is not None:
        surface[~solid] = mesh.surface_areas[~solid]
    else:
        known[prescribed] = False
        for name in OUTER:
            known[members(mesh, name)] = False
        known |= solid
    known[members(mesh, TUMOUR)] = False
    return known, surface


def correct_consistency(
    nodes: NDArray[np.float64],
    domains: NDArray[np.int64],
    gradients: NDArray[np.float64],
    volumes: NDArray[np.float64],
    fe_balance: NDArray[np.float64],
    free: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """Gradients (G, n, 3) with which a constant stress is in balance at the free nodes, and figures of the correction.

    Integration by parts demands sum_g V_g B_ga + fe_balance_a = 0 at an inner node a. Least squares violate it, so the
    mixed mesh fails the patch test. The correction B_g <- B_g + Q_g L keeps affine fields exact: Q removes them. It is
    the smallest change in the mean square over the volume. L (n_nodes, 3) solves a sparse symmetric system.

    nodes (G, n, 3), m, are positions of the domains' nodes. fe_balance (n_nodes, 3), m^2, is the sum of V B over the
    hexahedra less the surface integral. free (n_nodes,) are nodes of domains with a known surface integral.
    """
    n_nodes = len(free)
    residual = fe_balance + nodal_sum(domains, volumes[:, None, None] * gradients, n_nodes)
    scale = nodal_sum(domains, np.abs(volumes[:, None, None] * gradients), n_nodes).max()
    before = float(np.abs(residual[free]).max(initial=0) / scale)
    figures = {"consistency_before": before, "consistency_after": before, "consistency_change": 0.0}
    if before <= _BALANCED:
        return gradients, figures
    centred, inverse = linear_projector(nodes)
    system = _assemble(domains, centred, inverse, volumes, n_nodes)[free][:, free]
    positions = np.zeros((n_nodes, 3))
    positions[domains.ravel()] = nodes.reshape(-1, 3)
    preconditioner = TwoLevel(system, positions[free])
    L = np.zeros((n_nodes, 3))
    corrected, after = gradients, before
    # If all nodes are free, the system is singular: an affine L changes nothing. The affine part of the right-hand side
    # is round-off. Iterative refinement ends when it no longer halves the residual.
    while after > _BALANCED:
        tolerance = np.maximum(1e-14 * np.linalg.norm(residual[free], axis=0), _BALANCED * scale)
        L[free] -= solve(system, residual[free], preconditioner, tolerance)
        trial = L[domains]
        trial -= trial.mean(axis=1, keepdims=True)
        trial -= centred @ (inverse @ (np.swapaxes(centred, 1, 2) @ trial))
        trial += gradients
        residual = fe_balance + nodal_sum(domains, volumes[:, None, None] * trial, n_nodes)
        imbalance = float(np.abs(residual[free]).max() / scale)
        if imbalance > 0.5 * after:
            break
        corrected, after = trial, imbalance
    change = float(np.sqrt(((corrected - gradients) ** 2).sum() / (gradients**2).sum()))
    return corrected, figures | {"consistency_after": after, "consistency_change": change}


def _assemble(
    domains: NDArray[np.int64],
    centred: NDArray[np.float64],
    inverse: NDArray[np.float64],
    volumes: NDArray[np.float64],
    n_nodes: int,
) -> sparse.csr_matrix:
    """The sum of V Q over all domains (G, n); centred and inverse as in `linear_projector`.

    Q = 1 - M^T M. The four rows of M are an orthonormal basis of affine fields, so no matrix of a domain is stored.
    """
    n_domains, n = domains.shape
    rows = np.empty((n_domains, 4, n))
    rows[:, 0] = np.sqrt(volumes / n)[:, None]
    root = np.linalg.cholesky(inverse * volumes[:, None, None])  # V A = root root^T
    np.matmul(np.swapaxes(root, 1, 2), np.swapaxes(centred, 1, 2), out=rows[:, 1:])
    columns = np.repeat(domains.astype(np.int32), 4, axis=0)
    starts = np.arange(0, 4 * n_domains * n + 1, n)
    affine = sparse.csr_matrix((rows.ravel(), columns.ravel(), starts), shape=(4 * n_domains, n_nodes))
    del rows, columns
    diagonal = np.bincount(domains.ravel(), np.repeat(volumes, n), n_nodes)
    return (sparse.diags(diagonal) - affine.T @ affine).tocsr()
