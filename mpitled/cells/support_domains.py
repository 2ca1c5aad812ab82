"""Support domains: their nodes, moving least squares, and the correction that brings constant stress in balance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpitled import resources
from mpitled.cells.hexahedra import nodal_sum
from mpitled.cells.preconditioner import AffineGrid, solve
from mpitled.errors import InputError

#: Exponents of x, y, z: complete bases of 4, 10 and 20 monomials. The paper's 7 and 11 add cross terms only.
POWERS = np.array([(i, j, d - i - j) for d in range(4) for i in range(d, -1, -1) for j in range(d - i, -1, -1)])
#: A domain flatter than this share of its radius is repaired. The condition of the moment matrix, in coordinates scaled
#: by the radius, grows with the square of that ratio for each degree of the basis.
FLATTEST = 0.05
#: Radius of the quartic weight over the farthest node's distance: no node of the domain is without weight.
QUARTIC_RADIUS = 1.2

#: Constant stress is in balance where what is left of its nodal forces is this share of the largest.
_BALANCED = 1e-15

_CHUNK = 1 << 14  # domains at once, so that the temporaries stay small

#: Nodes (n_nodes,) of which a domain may hold no more than so many.
Limit = tuple[NDArray[np.bool_], int]


@dataclass(frozen=True, slots=True)
class Found:
    """Nodes of the support domains, and how they were arrived at."""

    domains: NDArray[np.int64]  # (n_domains, n)
    limited: int  # domains that hold others than their nearest nodes because of a limit
    added: int  # nodes put into domains so that each wanted node is in enough of them


def find_domains(
    points: NDArray[np.float64],
    at: NDArray[np.float64],
    n: int,
    limits: Sequence[Limit] = (),
    wanted: NDArray[np.bool_] | None = None,
    min_domains: int = 3,
) -> Found:
    """The n nearest of points (n_nodes, 3) to each integration point at (n_domains, 3), as far as the limits let them.

    The limit on FE nodes keeps a domain from lying in one hexahedron, where nothing controls its other modes (paper,
    5.3). A `wanted` node in fewer than `min_domains` (nodes in few domains are light, and fly: 4.1.7) takes, in the
    domains nearest to it, the place of their farthest node that can spare one. n is the same in every domain.
    InputError if there are too few nodes.
    """
    if len(at) and n > len(points):
        raise InputError(f"support.nodes = {n}: is more than the {len(points)} nodes that there are; lower it")
    # Numbers, values and gradients of each node of each domain, and as much again while they are found.
    resources.check_memory(80.0 * len(at) * n, f"support.nodes = {n}: in each of {len(at)} domains", "lower it")
    domains = np.empty((len(at), n), np.int64)
    limited = 0
    tree = cKDTree(points)
    for first in range(0, len(at), _CHUNK):
        rows = np.arange(first, min(first + _CHUNK, len(at)))
        reach = n + max(8, n // 2)
        while len(rows):
            reach = min(reach, len(points))
            nearest = _nearest(tree, at[rows], reach)
            taken = np.ones(nearest.shape, bool)
            for members, most in limits:
                taken &= ~members[nearest] | (np.cumsum(members[nearest], axis=1) <= most)
            taken &= np.cumsum(taken, axis=1) <= n
            full = taken.sum(axis=1) == n
            domains[rows[full]] = nearest[full][taken[full]].reshape(-1, n)
            limited += int(np.count_nonzero(~taken[full][:, :n].all(axis=1)))
            rows = rows[~full]
            if len(rows) and reach == len(points):
                raise InputError(
                    f"support.nodes = {n}: a domain finds only {taken[~full].sum(axis=1).min()} of the {len(points)} "
                    "nodes; lower support.nodes, refine the cloud or raise support.max_fe_nodes"
                )
            reach *= 2
    if wanted is None:
        wanted = np.ones(len(points), bool)
    counts = np.bincount(domains.ravel(), minlength=len(points))
    masks = np.array([mask for mask, _ in limits]).reshape(len(limits), len(points))
    ceilings = np.array([limit for _, limit in limits], np.int64)
    added = 0
    # A node that is still in none takes the place of one that stays in at least one.
    for least in (min_domains, min(min_domains, 1)):
        poor = np.flatnonzero(wanted & (counts < least))
        if len(poor) and len(at):
            near = _nearest(cKDTree(at), points[poor], min(8 * min_domains, len(at)))
            added += _widen(domains, counts, points, at, poor, near, wanted, masks, ceilings, least)
    return Found(domains, limited, added)


def _nearest(tree: cKDTree, at: NDArray[np.float64], k: int) -> NDArray[np.int64]:
    """The k nearest (n, k), in order of distance, and of number where distances are alike."""
    distance, index = tree.query(at, k)
    distance, index = distance.reshape(len(at), k), index.reshape(len(at), k)
    return np.take_along_axis(index, np.lexsort((index, distance), axis=1), 1)


@njit(cache=True)
def _widen(domains, counts, points, at, poor, near, wanted, members, most, min_domains):  # type: ignore[no-untyped-def]
    """Put each poor node into the nearest domains without it, for their farthest node that can spare one."""
    added = 0
    n = domains.shape[1]
    for p in range(poor.size):
        node = poor[p]
        for g in near[p]:
            if counts[node] >= min_domains:
                break
            place = -1
            farthest = -1.0
            for a in range(n):
                other = domains[g, a]
                if other == node:
                    place = -1
                    break
                may = not wanted[other] or counts[other] > min_domains
                for k in range(most.size):
                    if members[k, node] and not members[k, other]:
                        held = 0
                        for b in range(n):
                            held += members[k, domains[g, b]]
                        may = may and held < most[k]
                d = points[other] - at[g]
                distance = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
                if may and distance > farthest:
                    farthest = distance
                    place = a
            if place >= 0:
                counts[domains[g, place]] -= 1
                domains[g, place] = node
                counts[node] += 1
                added += 1
    return added


def worst_condition(basis: int) -> float:
    """Largest accepted condition of the scaled moment matrix: FLATTEST^-2, to the power of the basis's degree."""
    return float(FLATTEST ** (-2.0 * POWERS[basis - 1].sum()))


def moving_least_squares(
    nodes: NDArray[np.float64], at: NDArray[np.float64], basis: int = 4, weight: str = "equal"
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Values (G, n), gradients (G, n, 3) in 1/m, and the condition (G,) of the scaled moment matrix; eq. 4.8-4.16.

    nodes (G, n, 3) and at (G, 3) in m; basis 4, 10 or 20. Equal weights are the paper's choice for small domains; the
    quartic spline is 1 - 6 q^2 + 8 q^3 - 3 q^4, q the distance over QUARTIC_RADIUS times the farthest node's. Gradients
    are those of the polynomial that is fitted at the point (with equal weights the full derivatives, else the diffuse
    ones): exact for the basis. Coordinates are scaled by the domain's radius. A singular matrix has condition inf, and
    its values and gradients mean nothing.
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


def repair(
    points: NDArray[np.float64],
    at: NDArray[np.float64],
    domains: NDArray[np.int64],
    basis: int,
    weight: str,
    limits: Sequence[Limit] = (),
) -> int:
    """Exchange nodes of domains whose moment matrix is singular or badly conditioned; the number of such domains.

    A near-planar domain gives its farthest nodes, one after the other, for the nearest further one that mends it, else
    the one that helps most; `domains` is changed in place. InputError if no node near by can do it.
    """
    worst = worst_condition(basis)
    bad = np.flatnonzero(moving_least_squares(points[domains], at, basis, weight)[2] > worst)
    if not len(bad):
        return 0
    n = domains.shape[1]
    candidates = _nearest(cKDTree(points), at[bad], min(4 * n + 16, len(points)))
    for g, near in zip(bad, candidates, strict=True):
        domain = domains[g][np.argsort(((points[domains[g]] - at[g]) ** 2).sum(axis=1), kind="stable")]
        best = np.inf
        for place in range(n - 1, -1, -1):
            rest = np.delete(domain, place)
            allowed = ~np.isin(near, domain)
            for members, most in limits:
                allowed &= ~members[near] | (np.count_nonzero(members[rest]) < most)
            others = near[allowed]
            if not len(others):
                continue
            trials = np.repeat(domain[None], len(others), axis=0)
            trials[:, place] = others
            condition = moving_least_squares(points[trials], np.repeat(at[g][None], len(others), 0), basis, weight)[2]
            chosen = int(np.argmax(condition <= worst)) if (condition <= worst).any() else int(condition.argmin())
            domain, best = trials[chosen], condition[chosen]
            if best <= worst:
                break
        if best > worst:
            x, y, z = at[g] * 1e3
            lower = ", or support.basis = 4" if basis > 4 else ""
            raise InputError(
                f"support.basis = {basis}: the nodes around ({x:.2f}, {y:.2f}, {z:.2f}) mm lie in a plane or do not "
                f"span the basis; add nodes there, set support.nodes higher{lower}"
            )
        domains[g] = domain
    return len(bad)


def linear_projector(nodes: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions from their mean Xc (G, n, 3), m, and A = (Xc^T Xc)^-1 (G, 3, 3), 1/m^2, of domains (G, n, 3).

    Q v = v - mean v - Xc A Xc^T v takes the affine part from nodal values. It is unweighted and linear, whatever the
    basis and the weights of the gradients: only so is it symmetric, and angular momentum kept.
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


def correct_consistency(
    nodes: NDArray[np.float64],
    domains: NDArray[np.int64],
    gradients: NDArray[np.float64],
    volumes: NDArray[np.float64],
    fe_balance: NDArray[np.float64],
    free: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """Gradients (G, n, 3) with which a constant stress is in balance at the free nodes, and figures of the correction.

    sum_g V_g B_ga + (the hexahedra's sum) = 0 is what integration by parts demands of an inner node; least squares miss
    it, so that the mixed mesh fails the patch test. B_g <- B_g + Q_g L keeps affine fields exact, for Q takes them out,
    and is the least change in the mean square over the volume; L (n_nodes, 3) solves a sparse symmetric system.

    nodes (G, n, 3) are the domains' places; fe_balance (n_nodes, 3) is the hexahedra's sum of V B; free (n_nodes,) are
    nodes of domains where the surface's share, which fe_balance is less, is known.
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
    places = np.zeros((n_nodes, 3))
    places[domains.ravel()] = nodes.reshape(-1, 3)
    grid = AffineGrid(system, places[free])
    L = np.zeros((n_nodes, 3))
    corrected, after = gradients, before
    # Affine L do nothing, so that the system is singular where all is free. Its right-hand side has no part along them
    # but by round-off, which is not to be solved for: refinement ends where it no longer betters.
    while after > _BALANCED:
        tolerance = np.maximum(1e-14 * np.linalg.norm(residual[free], axis=0), _BALANCED * scale)
        L[free] -= solve(system, residual[free], grid, tolerance)
        trial = L[domains]
        trial -= trial.mean(axis=1, keepdims=True)
        trial -= centred @ (inverse @ (np.swapaxes(centred, 1, 2) @ trial))
        trial += gradients
        residual = fe_balance + nodal_sum(domains, volumes[:, None, None] * trial, n_nodes)
        left = float(np.abs(residual[free]).max() / scale)
        if left > 0.5 * after:
            break
        corrected, after = trial, left
    change = float(np.sqrt(((corrected - gradients) ** 2).sum() / (gradients**2).sum()))
    return corrected, figures | {"consistency_after": after, "consistency_change": change}


def _assemble(
    domains: NDArray[np.int64],
    centred: NDArray[np.float64],
    inverse: NDArray[np.float64],
    volumes: NDArray[np.float64],
    n_nodes: int,
) -> sparse.csr_matrix:
    """The sum of V Q of all domains (G, n); centred and inverse as in `linear_projector`.

    Q = 1 - M^T M, where M's four rows are an orthonormal basis of affine fields: no domain's own matrix is held.
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
    whole = np.bincount(domains.ravel(), np.repeat(volumes, n), n_nodes)
    return (sparse.diags(whole) - affine.T @ affine).tocsr()


def field_at_nodes(
    points: NDArray[np.float64],
    n_fe_nodes: int,
    at: NDArray[np.float64],
    domains: NDArray[np.int64],
    basis: int,
    weight: str,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """For each EFG node the support domain with the nearest integration point that holds it, and its values there.

    (n_efg_nodes,) and (n_efg_nodes, n). Displacement parameters of EFG nodes are not the field; this is.
    """
    members = domains.ravel()
    order = np.argsort(((np.repeat(at, domains.shape[1], axis=0) - points[members]) ** 2).sum(axis=1), kind="stable")
    order = order[np.argsort(members[order], kind="stable")]
    held, first = np.unique(members[order], return_index=True)
    giving = (order[first] // domains.shape[1])[held >= n_fe_nodes]
    values, _, _ = moving_least_squares(points[domains[giving]], points[n_fe_nodes:], basis, weight)
    return giving, values
