"""Nodes of the support domains: nearest-node search with limits, repair of singular fits, removal of orphans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpitled import resources
from mpitled.cells.support_domains import moving_least_squares, worst_condition
from mpitled.deck import Deck
from mpitled.errors import InputError
from mpitled.mesh import Mesh, Part
from mpitled.model.scene import TUMOUR, members

_CHUNK = 1 << 14  # domains computed at once; bounds the temporary memory

#: Mask (n_nodes,), and the maximum number of its nodes in a domain.
Limit = tuple[NDArray[np.bool_], int]


@dataclass(frozen=True, slots=True)
class FoundDomains:
    """Nodes of the support domains, and counts of the search."""

    domains: NDArray[np.int64]  # (n_domains, n)
    limited: int  # domains that do not hold their n nearest nodes because of a limit
    added: int  # memberships added to bring each wanted node into enough domains


# --- the domains of a mesh ------------------------------------------------------------------------------------------


def domains_of_mesh(deck: Deck, mesh: Mesh, material: NDArray[np.int16]) -> tuple[NDArray[np.int64], dict[str, int]]:
    """Nodes (n_integration, k) of the support domains, and figures of the search, see `ModelFigures`.

    A domain takes its nodes from its own part of the cloud and from hexahedra of its own material. A fit across the
    interface would smear the kink of the displacement (Belytschko, Krysl and Krongauz 1996; Cordes and Moran 1996).
    Domains of a part with too few nodes take their nodes from the whole mesh. InputError if no fit is possible.
    """
    options, at, n_hexahedra = deck.support, mesh.integration_points, len(mesh.hexahedra)
    limits, coupled = _limits(deck, mesh)
    names = ("domains_limited", "memberships_added", "domains_repaired", "domains_across")
    figures = dict.fromkeys(names, 0)
    of_parts = []
    for part in _parts(mesh):
        materials = np.unique(material[n_hexahedra + part.integration_points])
        in_part = np.zeros(mesh.n_nodes, bool)
        in_part[part.nodes] = True
        allowed = in_part.copy()
        allowed[mesh.hexahedra[np.isin(material[:n_hexahedra], materials)]] = True
        for nodes in (np.flatnonzero(allowed), np.arange(mesh.n_nodes)):
            points, centres = mesh.points[nodes], at[part.integration_points]
            local_limits = [(mask[nodes], maximum) for mask, maximum in limits]
            wanted = (coupled & in_part)[nodes]
            try:
                found = find_domains(points, centres, options.nodes, local_limits, wanted, options.min_domains)
                repaired = repair(points, centres, found.domains, options.basis, options.weight, local_limits)
                break
            except InputError as error:
                if len(nodes) == mesh.n_nodes:
                    raise InputError(f"{deck.path}: {error}") from None
        of_parts.append((part.integration_points, nodes[found.domains]))
        across = 0 if allowed[nodes].all() else len(centres)
        counts = (found.limited, found.added, repaired, across)
        figures = {name: before + count for (name, before), count in zip(figures.items(), counts, strict=True)}
    domains = np.empty((len(at), options.nodes), np.int64)  # allocated last, because `find_domains` checks the memory
    for rows, domains_of_part in of_parts:
        domains[rows] = domains_of_part
    return domains, figures


def _parts(mesh: Mesh) -> tuple[Part, ...]:
    """The parts of the cloud; a single part if the mesh does not have them."""
    points = np.arange(len(mesh.integration_points))
    if mesh.parts or not len(points):
        return mesh.parts
    nodes = np.arange(mesh.n_nodes)
    if mesh.surface_areas is not None:  # the nodes of the cloud are known
        nodes = np.union1d(nodes[mesh.n_fe_nodes :], members(mesh, "interface"))
    return (Part((), points, nodes, np.zeros((len(nodes), 3))),)


def _limits(deck: Deck, mesh: Mesh) -> tuple[list[Limit], NDArray[np.bool_]]:
    """Limits of the nodes in a support domain, and the nodes that must be in enough domains.

    At most half of a domain's nodes may lie on the seed's surface: a domain with these nodes only would expand by
    (R / r0)^3 when the tumour grows. FE nodes of the interface must be in domains, as EFG nodes must. Otherwise
    hexahedra and cloud are not coupled there (paper, 5.2).
    """
    fe = np.arange(mesh.n_nodes) < mesh.n_fe_nodes
    seed = np.zeros(mesh.n_nodes, bool)
    seed[members(mesh, TUMOUR)] = True
    coupled = ~fe
    coupled[members(mesh, "interface")] = True
    return [(fe, deck.support.max_fe_nodes), (seed, deck.support.nodes // 2)], coupled


def without_orphans(deck: Deck, mesh: Mesh, domains: NDArray[np.int64]) -> tuple[Mesh, NDArray[np.int64], int]:
    """The mesh and the domains without EFG nodes that are in no domain, and the number of these nodes.

    These nodes have no mass (4.1.7). InputError if a node of the interface is in no domain.
    """
    # After the repair, which can remove a node from its only domain. FE nodes have mass from hexahedra.
    orphans = np.setdiff1d(np.arange(mesh.n_fe_nodes, mesh.n_nodes), domains)
    if len(orphans):
        mesh, domains = _without_nodes(orphans, mesh, domains)
    uncoupled = np.setdiff1d(members(mesh, "interface"), domains)
    if len(uncoupled):
        raise InputError(
            f"{deck.path}: support.max_fe_nodes = {deck.support.max_fe_nodes}: leaves {len(uncoupled)} interface nodes "
            "in no support domain, so that hexahedra and cloud would come apart there; raise it"
        )
    return mesh, domains, len(orphans)


def _without_nodes(nodes: NDArray[np.int64], mesh: Mesh, domains: NDArray[np.int64]) -> tuple[Mesh, NDArray[np.int64]]:
    """The mesh without these EFG nodes, and the domains in the new numbers."""
    keep = np.ones(mesh.n_nodes, bool)
    keep[nodes] = False
    number = np.cumsum(keep) - 1
    constraints = []
    for constraint in mesh.constraints:
        kept = keep[mesh.node_sets[constraint.node_set]]
        values = tuple(v[kept] if isinstance(v, np.ndarray) else v for v in constraint.displacement)
        if kept.any():
            constraints.append(replace(constraint, displacement=values))
    parts = []
    for part in mesh.parts:
        kept = keep[part.nodes]
        parts.append(replace(part, nodes=number[part.nodes[kept]], areas=part.areas[kept]))
    kept_mesh = replace(
        mesh,
        points=mesh.points[keep],
        node_ids=mesh.node_ids[keep],
        node_sets={name: number[old[keep[old]]] for name, old in mesh.node_sets.items()},
        constraints=tuple(constraints),
        surface_areas=None if mesh.surface_areas is None else mesh.surface_areas[keep],
        parts=tuple(parts),
        remarks=(*mesh.remarks, f"{len(nodes)} EFG nodes that are in no support domain removed"),
    )
    return kept_mesh, number[domains]


# --- search and repair ----------------------------------------------------------------------------------------------


def find_domains(
    points: NDArray[np.float64],
    at: NDArray[np.float64],
    n: int,
    limits: Sequence[Limit] = (),
    wanted: NDArray[np.bool_] | None = None,
    min_domains: int = 3,
) -> FoundDomains:
    """The n nodes nearest to each integration point, subject to the limits.

    points (n_nodes, 3) and at (n_domains, 3), m. The limit on FE nodes prevents a domain inside one hexahedron: nothing
    would control its other modes (paper, 5.3). A node in few domains is light and unstable (4.1.7). So a `wanted` node
    (n_nodes,) in fewer than `min_domains` domains replaces, in the domains nearest to it, the farthest node that is in
    enough other domains. InputError if there are too few nodes.
    """
    if len(at) and n > len(points):
        raise InputError(f"support.nodes = {n}: is more than the {len(points)} nodes that there are; lower it")
    # Index, value and gradient of each node of each domain, and temporaries of the same size.
    resources.check_memory(80.0 * len(at) * n, f"support.nodes = {n}: in each of {len(at)} domains", "lower it")
    domains = np.empty((len(at), n), np.int64)
    limited = 0
    tree = cKDTree(points)
    for first in range(0, len(at), _CHUNK):
        rows = np.arange(first, min(first + _CHUNK, len(at)))
        n_candidates = n + max(8, n // 2)
        while len(rows):
            n_candidates = min(n_candidates, len(points))
            nearest = _nearest(tree, at[rows], n_candidates)
            chosen = np.ones(nearest.shape, bool)
            for mask, maximum in limits:
                chosen &= ~mask[nearest] | (np.cumsum(mask[nearest], axis=1) <= maximum)
            chosen &= np.cumsum(chosen, axis=1) <= n
            full = chosen.sum(axis=1) == n
            domains[rows[full]] = nearest[full][chosen[full]].reshape(-1, n)
            limited += int(np.count_nonzero(~chosen[full][:, :n].all(axis=1)))
            rows = rows[~full]
            if len(rows) and n_candidates == len(points):
                raise InputError(
                    f"support.nodes = {n}: a domain finds only {chosen[~full].sum(axis=1).min()} of the {len(points)} "
                    "nodes; lower support.nodes, refine the cloud or raise support.max_fe_nodes"
                )
            n_candidates *= 2
    if wanted is None:
        wanted = np.ones(len(points), bool)
    counts = np.bincount(domains.ravel(), minlength=len(points))
    masks = np.array([mask for mask, _ in limits]).reshape(len(limits), len(points))
    maxima = np.array([maximum for _, maximum in limits], np.int64)
    added = 0
    # The second pass helps nodes that are still in no domain: the replaced node stays in one domain or more.
    for target in (min_domains, min(min_domains, 1)):
        poor = np.flatnonzero(wanted & (counts < target))
        if len(poor) and len(at):
            near = _nearest(cKDTree(at), points[poor], min(8 * min_domains, len(at)))
            added += _add_memberships(domains, counts, points, at, poor, near, wanted, masks, maxima, target)
    return FoundDomains(domains, limited, added)


def _nearest(tree: cKDTree, at: NDArray[np.float64], k: int) -> NDArray[np.int64]:
    """The k nearest points (n, k), ordered by distance; points at equal distances are ordered by number."""
    distance, index = tree.query(at, k)
    distance, index = distance.reshape(len(at), k), index.reshape(len(at), k)
    return np.take_along_axis(index, np.lexsort((index, distance), axis=1), 1)


@njit(cache=True)
def _add_memberships(domains, counts, points, at, poor, near, wanted, masks, maxima, target):  # type: ignore[no-untyped-def]
    """Put each poor node into the nearest domains, in place of the farthest node that is in enough other domains."""
    added = 0
    n = domains.shape[1]
    for p in range(poor.size):
        node = poor[p]
        for g in near[p]:
            if counts[node] >= target:
                break
            column = -1
            farthest = -1.0
            for a in range(n):
                other = domains[g, a]
                if other == node:
                    column = -1
                    break
                replaceable = not wanted[other] or counts[other] > target
                for k in range(maxima.size):
                    if masks[k, node] and not masks[k, other]:
                        limited = 0
                        for b in range(n):
                            limited += masks[k, domains[g, b]]
                        replaceable = replaceable and limited < maxima[k]
                d = points[other] - at[g]
                distance = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
                if replaceable and distance > farthest:
                    farthest = distance
                    column = a
            if column >= 0:
                counts[domains[g, column]] -= 1
                domains[g, column] = node
                counts[node] += 1
                added += 1
    return added


def repair(
    points: NDArray[np.float64],
    at: NDArray[np.float64],
    domains: NDArray[np.int64],
    basis: int,
    weight: str,
    limits: Sequence[Limit] = (),
) -> int:
    """Exchange nodes of domains with a singular or badly conditioned moment matrix; returns the number of such domains.

    The farthest nodes are exchanged one after the other, each for the nearest further node that repairs the domain, or
    else for the node that improves the condition most. `domains` is changed in place. InputError if no near node helps.
    """
    limit = worst_condition(basis)
    bad = np.flatnonzero(moving_least_squares(points[domains], at, basis, weight)[2] > limit)
    if not len(bad):
        return 0
    n = domains.shape[1]
    candidates = _nearest(cKDTree(points), at[bad], min(4 * n + 16, len(points)))
    for g, near in zip(bad, candidates, strict=True):
        domain = domains[g][np.argsort(((points[domains[g]] - at[g]) ** 2).sum(axis=1), kind="stable")]
        best = np.inf
        for column in range(n - 1, -1, -1):
            rest = np.delete(domain, column)
            allowed = ~np.isin(near, domain)
            for mask, maximum in limits:
                allowed &= ~mask[near] | (np.count_nonzero(mask[rest]) < maximum)
            further = near[allowed]
            if not len(further):
                continue
            trials = np.repeat(domain[None], len(further), axis=0)
            trials[:, column] = further
            condition = moving_least_squares(points[trials], np.repeat(at[g][None], len(further), 0), basis, weight)[2]
            good = condition <= limit
            chosen = int(np.argmax(good)) if good.any() else int(condition.argmin())
            domain, best = trials[chosen], condition[chosen]
            if best <= limit:
                break
        if best > limit:
            x, y, z = at[g] * 1e3
            lower = ", or support.basis = 4" if basis > 4 else ""
            raise InputError(
                f"support.basis = {basis}: the nodes around ({x:.2f}, {y:.2f}, {z:.2f}) mm lie in a plane or do not "
                f"span the basis; add nodes there, set support.nodes higher{lower}"
            )
        domains[g] = domain
    return len(bad)
