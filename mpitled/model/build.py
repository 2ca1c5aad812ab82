"""The paper's preprocessor (4.1): from a deck to the discrete model."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled.cells import support_domains as support
from mpitled.cells.hexahedra import nodal_mass, nodal_sum
from mpitled.cells.kind import HEXAHEDRA, SUPPORT_DOMAINS
from mpitled.deck import Deck
from mpitled.laws import Material
from mpitled.mesh import Mesh
from mpitled.meshing import checks
from mpitled.model import CellBlock, Model, ModelFigures
from mpitled.model import remarks as warnings
from mpitled.model.consistency import consistent_gradients
from mpitled.model.domain_nodes import domains_of_mesh, without_orphans
from mpitled.model.materials import assign_materials
from mpitled.model.prescribed import check_growth, prescribe
from mpitled.model.scene import OUTER, TUMOUR, read_mesh

__all__ = ["OUTER", "TUMOUR", "build", "discretise", "prescribe", "read_mesh"]


def build(deck: Deck) -> Model:
    """The model of a deck. InputError if the mesh and the deck do not fit each other."""
    return discretise(deck, read_mesh(deck))


def discretise(deck: Deck, mesh: Mesh) -> Model:
    """The model of a deck from its mesh; see `build`."""
    material, materials = assign_materials(deck, mesh)
    domains, found = domains_of_mesh(deck, mesh, material)
    mesh, domains, n_orphans = without_orphans(deck, mesh, domains)
    points, at, options = mesh.points, mesh.integration_points, deck.support
    shapes, gradients, condition = support.moving_least_squares(points[domains], at, options.basis, options.weight)
    field_domains, field_shapes = support.field_at_nodes(
        points, mesh.n_fe_nodes, at, domains, options.basis, options.weight
    )
    (dofs, displacements, paths, _), replaced = prescribe(deck, mesh)
    check_growth(deck, mesh, dofs, displacements)

    of_hexahedra, of_domains = np.split(material, [len(mesh.hexahedra)])
    solid = CellBlock(HEXAHEDRA.name, HEXAHEDRA, mesh.hexahedra, of_hexahedra)
    consistency: dict[str, Any] = {}
    if options.consistency and len(domains):
        fe_gradients, fe_volumes = solid.geometry(points, deck.hexahedra.gradient)
        fe_balance = nodal_sum(mesh.hexahedra, fe_volumes[:, None, None] * fe_gradients, len(points))
        gradients, consistency = consistent_gradients(mesh, domains, gradients, fe_balance, dofs // 3)
    columns = {"points": at, "volumes": mesh.integration_volumes, "gradients": gradients, "shapes": shapes}
    cloud = CellBlock(SUPPORT_DOMAINS.name, SUPPORT_DOMAINS, domains, of_domains, columns)
    blocks = tuple(block for block in (solid, cloud) if len(block))

    mass, total_mass = _masses(blocks, materials, points)
    critical, volume = _critical_steps(deck, blocks, materials, points, mass)
    return Model(
        points=points,
        n_fe_nodes=mesh.n_fe_nodes,
        node_ids=mesh.node_ids,
        blocks=blocks,
        field_block=cloud.name if len(cloud) else "",
        field_domains=field_domains,
        field_shapes=field_shapes,
        materials=materials,
        mass=mass,
        prescribed_dofs=dofs,
        prescribed_displacements=displacements,
        rotation_paths=paths,
        node_sets=mesh.node_sets,
        cell_sets=mesh.cell_sets,
        surface_areas=mesh.surface_areas,
        figures=ModelFigures(
            critical_step_typical_s=_typical(critical, dofs // 3, domains),
            mass_kg=total_mass,
            volume_m3=volume,
            cloud_parts=len(mesh.parts),
            orphans_removed=n_orphans,
            worst_condition=float(condition.max()) if len(condition) else 1.0,
            of_mesh=mesh.figures,
            **found,
            **consistency,
        ),
        remarks=(
            *mesh.remarks,
            *replaced,
            *checks.scene_remarks(points, mesh.hexahedra, domains, mesh.n_fe_nodes, dofs),
            *warnings.unit_warnings(deck, mesh, material, materials),
            *warnings.unconstrained_warning(mesh, dofs),
            *(warnings.growth_warnings(deck) if len(domains) else ()),
        ),
    )


def _masses(
    blocks: tuple[CellBlock, ...], materials: tuple[Material, ...], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Masses (n_nodes,) of the nodes, kg (eq. 4.17 and 4.18), and their sum."""
    density = np.array([material.density for material in materials])
    of_cells = [density[block.material] * block.volumes(points) for block in blocks]
    nodal = (nodal_mass(block.nodes, mass, len(points)) for block, mass in zip(blocks, of_cells, strict=True))
    return np.add.reduce([*nodal]), float(np.concatenate(of_cells).sum())


def _critical_steps(
    deck: Deck,
    blocks: tuple[CellBlock, ...],
    materials: tuple[Material, ...],
    points: NDArray[np.float64],
    mass: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Estimates (n_nodes,) of the critical time step of each node, s, and the volume of the body, m^3."""
    modulus = np.array([material.p_wave_modulus for material in materials])
    # k gamma^T gamma = R (lambda + 2 mu) V (B:B) on a box
    control = {HEXAHEDRA.name: 1 + deck.hexahedra.hourglass, SUPPORT_DOMAINS.name: 1 + deck.support.stabilisation / 8}
    stiffness, volume = np.zeros(len(points)), 0.0
    for block in blocks:
        gradients, volumes = block.geometry(points, deck.hexahedra.gradient)
        of_cells = modulus[block.material] * (volumes * (gradients**2).sum((1, 2))) * control[block.kind.name]
        stiffness += nodal_mass(block.nodes, block.nodes.shape[1] * of_cells, len(points))
        volume += float(volumes.sum())
    return 2 * np.sqrt(mass / stiffness), volume


def _typical(critical: NDArray[np.float64], prescribed: NDArray[np.int64], in_domains: NDArray[np.int64]) -> float:
    """Median, s, of the critical steps (n_nodes,) of free nodes, outside the cloud if there are free nodes outside.

    The cloud is fine next to a seed: mass scaling of a few nodes costs less than a short step for the whole model.
    """
    free = np.setdiff1d(np.arange(len(critical)), prescribed)
    if not len(free):
        return float(np.median(critical))
    beyond = np.setdiff1d(free, in_domains)
    return float(np.median(critical[beyond if len(beyond) else free]))
