"""Support domains of the cloud: their nodes, and gradients with which a constant stress is in balance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mpitled.cells import support_domains as support
from mpitled.deck import Deck
from mpitled.errors import InputError
from mpitled.mesh import Mesh, Part
from mpitled.model.scene import OUTER, TUMOUR, members


def find_domains(deck: Deck, mesh: Mesh, material: NDArray[np.int16]) -> tuple[NDArray[np.int64], dict[str, int]]:
    """Nodes (n_integration, k) of the support domains, and figures of the search, see `ModelFigures`.

    A domain takes its nodes from its own part of the cloud, and from hexahedra of its own material: a fit across the
    interface would smear the kink that displacements have there (Belytschko, Krysl and Krongauz 1996; Cordes and Moran
    1996). Domains of a part with too few nodes take their nodes from the whole mesh. InputError if no fit is possible.
    """
    options, at, n_hexahedra = deck.support, mesh.integration_points, len(mesh.hexahedra)
    limits, coupled = _limits(deck, mesh)
    names = ("domains_limited", "memberships_added", "domains_repaired", "domains_across")
    figures = dict.fromkeys(names, 0)
    of_parts = []
    for part in _parts(mesh):
        own = np.unique(material[n_hexahedra + part.integration_points])
        in_part = np.zeros(mesh.n_nodes, bool)
        in_part[part.nodes] = True
        allowed = in_part.copy()
        allowed[mesh.hexahedra[np.isin(material[:n_hexahedra], own)]] = True
        for nodes in (np.flatnonzero(allowed), np.arange(mesh.n_nodes)):
            points, centres = mesh.points[nodes], at[part.integration_points]
            local_limits = [(of_mesh[nodes], most) for of_mesh, most in limits]
            try:
                found = support.find_domains(
                    points, centres, options.nodes, local_limits, (coupled & in_part)[nodes], options.min_domains
                )
                repaired = support.repair(points, centres, found.domains, options.basis, options.weight, local_limits)
                break
            except InputError as error:
                if len(nodes) == mesh.n_nodes:
                    raise InputError(f"{deck.path}: {error}") from None
        of_parts.append((part.integration_points, nodes[found.domains]))
        across = 0 if allowed[nodes].all() else len(centres)
        counts = (found.limited, found.added, repaired, across)
        figures = {name: before + count for (name, before), count in zip(figures.items(), counts, strict=True)}
    domains = np.empty((len(at), options.nodes), np.int64)  # only now: `support.find_domains` checks the memory
    for points_of_part, own_domains in of_parts:
        domains[points_of_part] = own_domains
    return domains, figures


def without_orphans(deck: Deck, mesh: Mesh, domains: NDArray[np.int64]) -> tuple[Mesh, NDArray[np.int64], int]:
    """The mesh and the domains without EFG nodes that no domain has, and their number: they have no mass (4.1.7).

    InputError if a node of the interface is in no domain.
    """
    # After the repair of domains, which can take a node from its last one. FE nodes have mass from hexahedra.
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


def consistent_gradients(
    mesh: Mesh,
    domains: NDArray[np.int64],
    gradients: NDArray[np.float64],
    fe_balance: NDArray[np.float64],
    prescribed: NDArray[np.int64],
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """Gradients with which a constant stress is in balance in each part of the cloud, and the worst part's figures.

    Balance is needed in each part, not only in the whole, because the stress jumps from part to part. The traction is
    the same on both sides: it is in balance where each part's gradients sum to the areas of the interface. fe_balance
    (n_nodes, 3) is the hexahedra's sum of V B; prescribed are nodes.
    """
    known, surface = _surface(mesh, fe_balance, prescribed)
    volumes = mesh.integration_volumes
    if len(mesh.parts) < 2:
        free = known & (np.bincount(domains.ravel(), minlength=mesh.n_nodes) > 0)
        nodes = mesh.points[domains]
        return support.correct_consistency(nodes, domains, gradients, volumes, fe_balance - surface, free)
    corrected, figures = np.empty_like(gradients), dict[str, float]()
    for part in mesh.parts:
        rows, balance = part.integration_points, np.zeros_like(surface)
        balance[part.nodes] = -part.areas
        own, nodes = domains[rows], mesh.points[domains[rows]]
        free = known & (np.bincount(own.ravel(), minlength=mesh.n_nodes) > 0)
        corrected[rows], found = support.correct_consistency(nodes, own, gradients[rows], volumes[rows], balance, free)
        figures = {name: max(value, figures.get(name, 0.0)) for name, value in found.items()}
    return corrected, figures


def _parts(mesh: Mesh) -> tuple[Part, ...]:
    """The parts of the cloud; one part of all nodes where the mesh does not say which nodes are whose."""
    points = np.arange(len(mesh.integration_points))
    if mesh.parts or not len(points):
        return mesh.parts
    nodes = np.arange(mesh.n_nodes)
    if mesh.surface_areas is not None:  # the nodes of the cloud are known
        nodes = np.union1d(nodes[mesh.n_fe_nodes :], members(mesh, "interface"))
    return (Part((), points, nodes, np.zeros((len(nodes), 3))),)


def _limits(deck: Deck, mesh: Mesh) -> tuple[list[support.Limit], NDArray[np.bool_]]:
    """Nodes of which a support domain may hold only so many, and the nodes that have to be in enough domains.

    A domain of nodes on the seed's surface alone would see these nodes move together, and expand by (R / r0)^3 when
    the tumour grows: at most half of a domain's nodes may lie there. FE nodes of the interface have to be in domains as
    EFG nodes have, or hexahedra and cloud are not coupled there (paper, 5.2).
    """
    fe = np.arange(mesh.n_nodes) < mesh.n_fe_nodes
    seed = np.zeros(mesh.n_nodes, bool)
    seed[members(mesh, TUMOUR)] = True
    coupled = ~fe
    coupled[members(mesh, "interface")] = True
    return [(fe, deck.support.max_fe_nodes), (seed, deck.support.nodes // 2)], coupled


def _surface(
    mesh: Mesh, fe_balance: NDArray[np.float64], prescribed: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Nodes (n_nodes,) at which the surface's share of a constant stress is known, and that share (n_nodes, 3), m^2.

    The share is the hexahedra's sum fe_balance at nodes with hexahedra alone, and zero inside the cloud. On the cloud's
    boundary the mesher knows the share. Where a mesh file does not give it, outer and prescribed nodes are left out.
    The seed's surface is curved between its nodes: its share is only roughly known.
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


def _without_nodes(nodes: NDArray[np.int64], mesh: Mesh, domains: NDArray[np.int64]) -> tuple[Mesh, NDArray[np.int64]]:
    """The mesh without EFG nodes that no domain has, and the domains in its numbers."""
    keep = np.ones(mesh.n_nodes, bool)
    keep[nodes] = False
    number = np.cumsum(keep) - 1
    sets = {name: number[old[keep[old]]] for name, old in mesh.node_sets.items()}
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
    remark = f"{len(nodes)} EFG nodes that are in no support domain removed"
    kept_mesh = replace(
        mesh,
        points=mesh.points[keep],
        node_ids=mesh.node_ids[keep],
        node_sets=sets,
        constraints=tuple(constraints),
        surface_areas=None if mesh.surface_areas is None else mesh.surface_areas[keep],
        parts=tuple(parts),
        remarks=(*mesh.remarks, remark),
    )
    return kept_mesh, number[domains]
