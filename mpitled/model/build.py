"""The paper's preprocessor (4.1): from a deck to the discrete model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpitled.cells import hexahedra
from mpitled.cells import support_domains as support
from mpitled.deck import Deck, Sphere
from mpitled.errors import InputError
from mpitled.laws import Material
from mpitled.mesh import Constraint, Mesh, Part, named_set
from mpitled.meshing import block, checks, labels, phantoms
from mpitled.meshing.cloud import in_millimetres, in_sphere, length, looks_like_metres
from mpitled.model import Model
from mpitled.model.loading import growth, sphere_radius, turn
from mpitled.model.mapping import carry_over

#: The node set of a seed's surface, which the meshers make where there is a tumour.
TUMOUR = "tumour"
#: Node sets of the outer surface: no constant stress is in balance there without the tractions.
OUTER = ("skull", "surface")
#: Radius of a tumour over its seed's up to which clouds are known to complete, and a little (jobs/studies/README.md).
GREATEST_GROWTH = 8.0
#: Young's modulus of the tissue around a tumour below which it is more likely one in kPa or MPa, Pa.
SOFTEST = 50.0
#: Poisson's ratio up to which results are known (jobs/studies/README.md).
LEAST_COMPRESSIBLE = 0.499
#: A seed's radius below which it is more likely one in metres, m, and its share of a tumour that is most of it.
SMALLEST_SEED, LARGEST_SEED = 5e-5, 0.5


def read_mesh(deck: Deck) -> Mesh:
    """The mesh of a deck's one geometry section, with the cell sets of its spheres."""
    try:
        mesh = _geometry(deck)
    except InputError as error:
        if deck.mesh:  # what is wrong is in other files
            raise
        raise InputError(f"{deck.path}: {error}") from None
    if not deck.spheres:
        return mesh
    middles = _middles(mesh)
    cell_sets = dict(mesh.cell_sets)
    apart = _bounding(deck)
    for sphere in deck.spheres:
        origin = f"{deck.path}: sphere.{sphere.name}"
        if sphere.name in cell_sets:
            raise InputError(f"{origin}: there is a cell set of that name already; give it another")
        inside = in_sphere(middles, sphere)
        for part in mesh.parts if sphere in apart else ():
            inside[len(mesh.hexahedra) + part.integration_points] = sphere.name in part.spheres
        if not inside.any():
            raise InputError(f"{origin}: no cell has its middle in it; move or enlarge it, or make the cells smaller")
        cell_sets[sphere.name] = np.flatnonzero(inside)
    return replace(mesh, cell_sets=cell_sets)


def _bounding(deck: Deck) -> list[Sphere]:
    """The spheres whose cells are of another material than those around them."""
    filled = {name for section in deck.materials for name in section.cells if len(deck.materials) > 1}
    return [sphere for sphere in deck.spheres if sphere.name in filled]


def _geometry(deck: Deck) -> Mesh:
    spheres = _bounding(deck)
    if deck.labels:
        return labels.mesh_labels(deck.labels, deck.cloud, deck.tumour, spheres)
    if deck.block:
        fitted = next((sphere for sphere in deck.spheres if sphere.name == deck.block.fitted), None)
        return block.block_mesh(deck.block, deck.cloud, deck.tumour, fitted, spheres)
    if deck.cylinder:
        return phantoms.cylinder_mesh(deck.cylinder, deck.cloud, deck.tumour, spheres)
    if deck.ellipsoid:
        return phantoms.ellipsoid_mesh(deck.ellipsoid, deck.cloud, deck.tumour, spheres)
    assert deck.mesh is not None  # load_deck sees to exactly one geometry
    from mpitled.readers import meshes

    seed_volume = 4 / 3 * np.pi * deck.tumour.seed_radius**3 if deck.tumour else 0.0
    return meshes.read_mesh(deck.mesh, seed_volume)


def build(deck: Deck) -> Model:
    """The model of a deck. InputError if the mesh and the deck do not fit each other."""
    return discretise(deck, read_mesh(deck))


def discretise(deck: Deck, mesh: Mesh) -> Model:
    """The model of a deck whose mesh is read; see `build`."""
    options = deck.support
    material, materials = _materials(deck, mesh)
    at, volumes, n_hexahedra = mesh.integration_points, mesh.integration_volumes, len(mesh.hexahedra)
    domains, found = _domains(deck, mesh, material)
    # Only now: repair can take a node from its last domain. FE nodes stay, for they have mass from hexahedra.
    orphans = np.setdiff1d(np.arange(mesh.n_fe_nodes, mesh.n_nodes), domains)
    mesh, domains = _without(orphans, mesh, domains)
    uncoupled = np.setdiff1d(_members(mesh, "interface"), domains)
    if len(uncoupled):
        raise InputError(
            f"{deck.path}: support.max_fe_nodes = {options.max_fe_nodes}: leaves {len(uncoupled)} interface nodes in "
            "no support domain, so that hexahedra and cloud would come apart there; raise it"
        )
    n_fe_nodes, points = mesh.n_fe_nodes, mesh.points
    shapes, gradients, condition = support.moving_least_squares(points[domains], at, options.basis, options.weight)
    field_domains, field_shapes = support.field_at_nodes(points, n_fe_nodes, at, domains, options.basis, options.weight)
    (dofs, displacements, turns, _), replaced = prescribe(deck, mesh)
    _check_growth(deck, mesh, dofs, displacements)

    fe_gradients, fe_volumes = hexahedra.geometry(points, mesh.hexahedra, deck.hexahedra.gradient)
    figures = dict(mesh.figures)
    if options.consistency and len(domains):
        fe_balance = hexahedra.nodal_sum(mesh.hexahedra, fe_volumes[:, None, None] * fe_gradients, len(points))
        gradients, of_correction = _consistent(mesh, domains, gradients, fe_balance, dofs // 3)
        figures |= of_correction

    lam, mu, density = (np.array([getattr(m, name) for m in materials])[material] for name in ("lam", "mu", "density"))
    cell_mass = density * np.concatenate([hexahedra.volumes(points, mesh.hexahedra), volumes])
    mass = _shared(mesh.hexahedra, domains, cell_mass, len(points))
    stiffness = (lam + 2 * mu) * np.concatenate(
        [fe_volumes * (fe_gradients**2).sum((1, 2)), volumes * (gradients**2).sum((1, 2))]
    )
    stiffness[:n_hexahedra] *= 1 + deck.hexahedra.hourglass  # k gamma^T gamma = R (lambda + 2 mu) V (B:B) on a box
    stiffness[n_hexahedra:] *= 1 + options.stabilisation / 8
    each = np.concatenate([8 * stiffness[:n_hexahedra], options.nodes * stiffness[n_hexahedra:]])
    critical = 2 * np.sqrt(mass / _shared(mesh.hexahedra, domains, each, len(points)))
    loose = np.setdiff1d(np.arange(len(points)), dofs // 3)
    critical = critical[loose] if len(loose) else critical
    # Next to a seed the cloud is fine: a few heavier nodes there cost less than its short step everywhere.
    in_cloud = np.isin(loose, domains) if len(loose) else np.zeros(len(points), bool)
    figures |= found | {
        "critical_step_typical_s": float(np.median(critical if in_cloud.all() else critical[~in_cloud])),
        "mass_kg": float(cell_mass.sum()),
        "volume_m3": float(fe_volumes.sum() + volumes.sum()),
        "cloud_parts": len(mesh.parts),
        "orphans_removed": len(orphans),
        "worst_condition": float(condition.max()) if len(condition) else 1.0,
    }
    return Model(
        points=points,
        n_fe_nodes=n_fe_nodes,
        node_ids=mesh.node_ids,
        hexahedra=mesh.hexahedra,
        domains=domains,
        domain_points=at,
        domain_volumes=volumes,
        domain_gradients=gradients,
        domain_shapes=shapes,
        field_domains=field_domains,
        field_shapes=field_shapes,
        material=material,
        materials=materials,
        mass=mass,
        prescribed_dofs=dofs,
        prescribed_displacements=displacements,
        prescribed_turns=turns,
        node_sets=mesh.node_sets,
        cell_sets=mesh.cell_sets,
        surface_areas=mesh.surface_areas,
        figures=figures,
        remarks=(
            *mesh.remarks,
            *replaced,
            *checks.scene_remarks(points, mesh.hexahedra, domains, n_fe_nodes, dofs),
            *_slips(deck, mesh, material, materials),
            *_unheld(mesh, dofs),
            *(_growth_remarks(deck) if len(domains) else ()),
        ),
    )


def _check_growth(deck: Deck, mesh: Mesh, dofs: NDArray[np.int64], displacements: NDArray[np.float64]) -> None:
    """InputError if the grown sphere reaches beyond nodes of the outer surface that are fixed: none can make room."""
    if deck.tumour is None:
        return
    nodes, directions = np.unique(dofs[displacements == 0] // 3, return_counts=True)
    outer = np.concatenate([_members(mesh, name) for name in OUTER])
    fixed = np.setdiff1d(np.intersect1d(nodes[directions == 3], outer), _members(mesh, TUMOUR))
    distances = np.linalg.norm(mesh.points[fixed] - np.asarray(deck.tumour.centre), axis=1)
    radius, room = sphere_radius(deck.tumour.volume), float(distances.min(initial=np.inf))
    if radius > room:
        raise InputError(
            f"{deck.path}: tumour.volume = {1e9 * deck.tumour.volume:.10g}: its sphere of {length(radius)} radius "
            f"reaches beyond the outer surface, which is fixed {length(room)} from tumour.centre; lower it"
        )


def _slips(deck: Deck, mesh: Mesh, material: NDArray[np.int16], materials: tuple[Material, ...]) -> Iterator[str]:
    """Warnings of figures that are possible, but look like slips of the unit: of materials, and of a tumour."""
    told = set()
    for section in deck.materials:
        name, solid = f"material.{section.name}", section.material
        modulus, ratio = solid.youngs_modulus, solid.poissons_ratio
        if not 1 <= modulus <= 1e12:
            told.add(section.name)
            yield f"warning: {name}.youngs_modulus = {modulus:.10g}: is it in Pa? Brain tissue has about 3000"
        if ratio > LEAST_COMPRESSIBLE + 1e-9:
            yield (
                f"warning: {name}.poissons_ratio = {ratio:.10g}: results are known up to "
                f"{LEAST_COMPRESSIBLE:g}; take 0.49, or {LEAST_COMPRESSIBLE:g} at most"
            )
        if not 100 <= section.density <= 25000:
            yield f"warning: {name}.density = {section.density:.10g}: is it in kg/m3? Tissue has about 1000"
    if deck.tumour is None:
        return
    centre = np.asarray(deck.tumour.centre)
    if said := looks_like_metres(centre, mesh.points.min(axis=0), mesh.points.max(axis=0)):
        yield f"warning: tumour.centre = {in_millimetres(centre)}: {said}"
    grows_in = materials[material[((_middles(mesh) - centre) ** 2).sum(axis=1).argmin()]]
    if grows_in.youngs_modulus < SOFTEST and grows_in.name not in told:
        what = f"material.{grows_in.name}.youngs_modulus = {grows_in.youngs_modulus:.10g}"
        yield f"warning: {what}: is softer than any tissue that a tumour grows in; moduli are in Pa"


def _middles(mesh: Mesh) -> NDArray[np.float64]:
    """Places (n_cells, 3), m, in the middle of hexahedra, and the integration points."""
    # Of a diagonal: corners of all would be the largest array of the building.
    of_hexahedra = (mesh.points[mesh.hexahedra[:, 0]] + mesh.points[mesh.hexahedra[:, 6]]) / 2
    return np.concatenate([of_hexahedra, mesh.integration_points])


def _unheld(mesh: Mesh, dofs: NDArray[np.int64]) -> Iterator[str]:
    """A warning of a tumour that nothing is held against, though its own nodes keep the body in place."""
    seed = _members(mesh, TUMOUR)
    names = [name for name in OUTER if name in mesh.node_sets]
    if len(seed) and names and not len(np.setdiff1d(dofs // 3, seed)):
        yield (
            "warning: no node but the tumour's is held, so that the whole body gives way to it; add [[fixed]] with "
            f'nodes = "{names[0]}"'
        )


def _growth_remarks(deck: Deck) -> Iterator[str]:
    """Warnings of a tumour that a cloud is not known to take."""
    if deck.tumour is None:
        return
    radius, seed = sphere_radius(deck.tumour.volume), deck.tumour.seed_radius
    if seed < SMALLEST_SEED:
        yield f"warning: tumour.seed_radius = {1e3 * seed:.10g}: is in mm; does it look like metres?"
    if (share := (seed / radius) ** 3) > LARGEST_SEED:
        yield (
            f"warning: tumour.seed_radius = {1e3 * seed:.10g}: {share:.0%} of tumour.volume is there at the start and "
            "moves nothing, and only the rest is grown; make it smaller"
        )
    grows = f"warning: the tumour grows to a radius of {length(radius)}"
    if radius > GREATEST_GROWTH * seed:
        times = f"{radius / seed:.3g} times its seed's"
        yield f"{grows}, {times}, where cells may turn inside out; enlarge tumour.seed_radius"
    if radius > deck.cloud.radius and not deck.mesh:
        yield f"{grows}, beyond the cloud's {length(deck.cloud.radius)}; enlarge cloud.radius"


def _domains(deck: Deck, mesh: Mesh, material: NDArray[np.int16]) -> tuple[NDArray[np.int64], dict[str, float]]:
    """Nodes (n_integration, n) of the support domains, and figures of how they were found.

    A domain takes its nodes from its own part of the cloud, and from hexahedra of its own material: a fit across the
    interface would smear the kink that displacements have there (Belytschko, Krysl and Krongauz 1996; Cordes and Moran
    1996). A part with too few nodes takes of all.
    """
    options, at, n_hexahedra = deck.support, mesh.integration_points, len(mesh.hexahedra)
    limits, wanted = _limits(deck, mesh)
    of_parts = []
    names = ("domains_limited", "memberships_added", "domains_repaired", "domains_across")
    figures: dict[str, float] = dict.fromkeys(names, 0)
    for part in _parts(mesh):
        own = np.unique(material[n_hexahedra + part.integration_points])
        held = np.zeros(mesh.n_nodes, bool)
        held[part.nodes] = True
        may = held.copy()
        may[mesh.hexahedra[np.isin(material[:n_hexahedra], own)]] = True
        for nodes in (np.flatnonzero(may), np.arange(mesh.n_nodes)):
            points, places = mesh.points[nodes], at[part.integration_points]
            some = [(members[nodes], most) for members, most in limits]
            try:
                found = support.find_domains(
                    points, places, options.nodes, some, (wanted & held)[nodes], options.min_domains
                )
                repaired = support.repair(points, places, found.domains, options.basis, options.weight, some)
                break
            except InputError as error:
                if len(nodes) == mesh.n_nodes:
                    raise InputError(f"{deck.path}: {error}") from None
        of_parts.append((part.integration_points, nodes[found.domains]))
        across = not may[nodes].all()
        counts = (found.limited, found.added, repaired, across * len(places))
        figures = {name: before + count for (name, before), count in zip(figures.items(), counts, strict=True)}
    domains = np.empty((len(at), options.nodes), np.int64)
    for points_of_part, own_domains in of_parts:
        domains[points_of_part] = own_domains
    return domains, figures


def _parts(mesh: Mesh) -> tuple[Part, ...]:
    """The parts of the cloud; one that may take all nodes where nobody knows of which material they are."""
    points = np.arange(len(mesh.integration_points))
    if mesh.parts or not len(points):
        return mesh.parts
    nodes = np.arange(mesh.n_nodes)
    if mesh.surface_areas is not None:  # the cloud is known
        nodes = np.union1d(nodes[mesh.n_fe_nodes :], _members(mesh, "interface"))
    return (Part((), points, nodes, np.zeros((len(nodes), 3))),)


def _consistent(
    mesh: Mesh,
    domains: NDArray[np.int64],
    gradients: NDArray[np.float64],
    fe_balance: NDArray[np.float64],
    prescribed: NDArray[np.int64],
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """Gradients with which constant stress is in balance in each part of the cloud, and the worst part's figures.

    In each and not in the whole only: the stress jumps from part to part. What is the same on both sides, the traction,
    is in balance where each part's gradients sum to the interface's areas. fe_balance is the hexahedra's sum of V B.
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


def _limits(deck: Deck, mesh: Mesh) -> tuple[list[support.Limit], NDArray[np.bool_]]:
    """What a support domain may not hold too much of, and the nodes that have to be in enough of them.

    A domain of nodes on the seed's surface alone would see them move as one, and expand by (R / r0)^3 when they grow:
    half of a domain's nodes may be there. FE nodes of the interface have to be in domains as EFG nodes have, or the
    two parts are not coupled there (paper, 5.2).
    """
    fe = np.arange(mesh.n_nodes) < mesh.n_fe_nodes
    seed = np.zeros(mesh.n_nodes, bool)
    seed[_members(mesh, TUMOUR)] = True
    wanted = ~fe
    wanted[_members(mesh, "interface")] = True
    return [(fe, deck.support.max_fe_nodes), (seed, deck.support.nodes // 2)], wanted


def _surface(
    mesh: Mesh, fe_balance: NDArray[np.float64], prescribed: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Nodes at which the surface's share of a constant stress is known, and that share (n_nodes, 3), m^2.

    It is what hexahedra alone leave (fe_balance) at nodes that have all of theirs, and nothing inside the cloud. On the
    cloud's boundary the mesher knows it; where a file does not say, nodes that are outer or prescribed are left out.
    The seed's surface is curved between its nodes: its share is only known roughly.
    """
    known = np.ones(mesh.n_nodes, bool)
    whole = np.arange(mesh.n_nodes) < mesh.n_fe_nodes
    whole[_members(mesh, "interface")] = False
    surface = np.where(whole[:, None], fe_balance, 0.0)
    if mesh.surface_areas is not None:
        surface[~whole] = mesh.surface_areas[~whole]
    else:
        known[prescribed] = False
        for name in OUTER:
            known[_members(mesh, name)] = False
        known |= whole
    known[_members(mesh, TUMOUR)] = False
    return known, surface


def _members(mesh: Mesh, name: str) -> NDArray[np.int64]:
    """Nodes of a set; none if there is no such set."""
    return mesh.node_sets.get(name, np.empty(0, np.int64))


def _shared(
    cells: NDArray[np.int64], domains: NDArray[np.int64], values: NDArray[np.float64], n_nodes: int
) -> NDArray[np.float64]:
    """(n_nodes,): each cell's value (n_cells,), shared equally by its nodes (mass: eq. 4.17 and 4.18)."""
    n = len(cells)
    return hexahedra.nodal_mass(cells, values[:n], n_nodes) + hexahedra.nodal_mass(domains, values[n:], n_nodes)


def _materials(deck: Deck, mesh: Mesh) -> tuple[NDArray[np.int16], tuple[Material, ...]]:
    """Material of each cell, and the materials: those that the deck names first, then those of the mesh's own file.

    "all" fills what no other set of the deck claims; what the deck leaves over is of the file's materials, of which
    the others are none of the model's. Ventricles of which the deck says that there are none need no material, and may
    have one.
    """
    absent = {name for name in labels.VENTRICLES if deck.labels and not getattr(deck.labels, name)}
    claims = [(name, section.material) for section in deck.materials for name in section.cells if name not in absent]
    materials = list(dict.fromkeys(material for _, material in claims))
    chosen = np.full(mesh.n_cells, -1, np.int16)

    def fill(name: str, material: Material, origin: str, open_cells: NDArray[np.bool_]) -> None:
        cells = np.arange(mesh.n_cells) if name == "all" else named_set(mesh.cell_sets, name, origin)
        cells = cells[open_cells[cells]]
        taken = chosen[cells] >= 0
        if taken.any():
            twice = materials[chosen[cells].max()].name
            raise InputError(
                f"{origin}: {np.count_nonzero(taken)} cells of '{name}' are of material '{twice}' already; take them "
                "out of one of the two"
            )
        chosen[cells] = materials.index(material)

    for name, material in sorted(claims, key=lambda claim: claim[0] == "all"):
        open_cells = chosen < 0 if name == "all" else np.ones(mesh.n_cells, bool)
        fill(name, material, f"{deck.path}: material.{material.name}.cells", open_cells)
    left = chosen < 0
    of_file = [(name, material) for name, material in mesh.materials.items() if left[mesh.cell_sets[name]].any()]
    materials += [material for material in dict.fromkeys(m for _, m in of_file) if material not in materials]
    for name, material in of_file:
        fill(name, material, f"{deck.path}: mesh: section of material {material.name}", left)
    if (chosen < 0).any():
        cell = int(np.argmax(chosen < 0))
        sets = [name for name, members in mesh.cell_sets.items() if cell in members]
        raise InputError(
            f"{deck.path}: material: {np.count_nonzero(chosen < 0)} cells have none, the first in "
            f"{' and '.join(sets) or 'no set'}; name their set in a material's cells"
        )
    return chosen, tuple(materials)


def _without(orphans: NDArray[np.int64], mesh: Mesh, domains: NDArray[np.int64]) -> tuple[Mesh, NDArray[np.int64]]:
    """The mesh and the domains without nodes that no domain has: they would have no mass (4.1.7)."""
    if len(orphans) == 0:
        return mesh, domains
    keep = np.ones(mesh.n_nodes, bool)
    keep[orphans] = False
    number = np.cumsum(keep) - 1
    sets = {name: number[nodes[keep[nodes]]] for name, nodes in mesh.node_sets.items()}
    constraints = []
    for given in mesh.constraints:
        there = keep[mesh.node_sets[given.node_set]]
        values = tuple(v[there] if isinstance(v, np.ndarray) else v for v in given.displacement)
        if there.any():
            constraints.append(replace(given, displacement=values))
    parts = []
    for part in mesh.parts:
        there = keep[part.nodes]
        parts.append(replace(part, nodes=number[part.nodes[there]], areas=part.areas[there]))
    remark = f"{len(orphans)} EFG nodes that are in no support domain removed"
    kept = replace(
        mesh,
        points=mesh.points[keep],
        node_ids=mesh.node_ids[keep],
        node_sets=sets,
        constraints=tuple(constraints),
        surface_areas=None if mesh.surface_areas is None else mesh.surface_areas[keep],
        parts=tuple(parts),
        remarks=(*mesh.remarks, remark),
    )
    return kept, number[domains]


class Prescribed(NamedTuple):
    """What is held or moved, and where it is said."""

    dofs: NDArray[np.int64]  # (n,), 3 node + direction, ascending
    displacements: NDArray[np.float64]  # (n,), m at full load
    turns: NDArray[np.float64]  # (n, 3), see `loading.turn`
    origins: NDArray[np.object_]  # (n,), file and line or key


def prescribe(deck: Deck, mesh: Mesh) -> tuple[Prescribed, list[str]]:
    """What deck and mesh prescribe, and remarks on what the deck replaces of what its mesh files prescribe.

    InputError if the deck asks a dof to be in two places, or its files do, or nothing at all is prescribed.
    """
    of_deck = _motions(mesh, deck.constraints())
    if deck.tumour:
        origin = f"{deck.path}: tumour"
        nodes = named_set(mesh.node_sets, TUMOUR, origin)
        moved = growth(mesh.points[nodes], np.array(deck.tumour.centre), deck.tumour.seed_radius, deck.tumour.volume)
        of_deck.extend((3 * nodes + i, moved[:, i], np.zeros((len(nodes), 3)), origin) for i in range(3))
    of_files = _motions(mesh, mesh.constraints)
    if not of_deck and not of_files:
        raise InputError(f"{deck.path}: nothing is fixed, displaced or grows; add [[fixed]], [[displaced]] or [tumour]")
    own, given = (_without_clashes(mesh, motions) for motions in (of_deck, of_files))
    _, mine, other = np.intersect1d(own.dofs, given.dofs, assume_unique=True, return_indices=True)
    changed = own.displacements[mine] != given.displacements[other]
    replaced: dict[tuple[str, str], set[int]] = {}
    for at, instead in zip(mine[changed], other[changed], strict=True):
        key, file = own.origins[at].removesuffix(".nodes"), given.origins[instead].partition(": line ")[0]
        replaced.setdefault((key, file), set()).add(int(own.dofs[at]) // 3)
    remarks = [
        f"{key} replaces what {file} prescribes at {len(nodes)} nodes" for (key, file), nodes in replaced.items()
    ]
    left = np.ones(len(given.dofs), bool)
    left[other] = False
    both = [np.concatenate([one, more[left]]) for one, more in zip(own, given, strict=True)]
    order = np.argsort(both[0])
    return Prescribed(*(values[order] for values in both)), remarks


#: Dofs (n,), their displacements (n,) and turns (n, 3), and where that is said.
_Motion = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], str]


def _motions(mesh: Mesh, constraints: Iterable[Constraint]) -> list[_Motion]:
    """Each constraint's motion, direction by direction."""
    found: list[_Motion] = []
    for constraint in constraints:
        nodes = named_set(mesh.node_sets, constraint.node_set, constraint.origin)
        turned, arcs = np.zeros((len(nodes), 3)), np.zeros((len(nodes), 3, 3))
        if constraint.rotation:
            turned, arcs = turn(mesh.points[nodes], constraint.rotation)
        if constraint.field:
            where = constraint.origin.removesuffix("nodes") + "field"
            turned = turned + carry_over(constraint.field, constraint.field_metre, mesh.points[nodes], where)
        for direction, displacement in zip(constraint.directions, constraint.displacement, strict=True):
            moved = displacement + turned[:, direction]
            found.append((3 * nodes + direction, moved, arcs[:, direction], constraint.origin))
    return found


def _without_clashes(mesh: Mesh, motions: list[_Motion]) -> Prescribed:
    """All motions together, each dof once; InputError if one is to be in two places."""
    origins = np.array([origin for *_, origin in motions], object)
    every = np.concatenate([np.empty(0, np.int64), *(dofs for dofs, *_ in motions)])
    at = np.concatenate([np.empty(0), *(moved for _, moved, *_ in motions)])
    turning = np.concatenate([np.empty((0, 3)), *(turns for _, _, turns, _ in motions)])
    source = np.repeat(np.arange(len(motions)), [len(dofs) for dofs, *_ in motions])
    order = np.lexsort((at, every))
    every, at, source, turning = every[order], at[order], source[order], turning[order]
    clash = np.flatnonzero((np.diff(every) == 0) & (np.diff(at) != 0))
    if len(clash):
        first = clash[0]
        node = every[first] // 3
        raise InputError(
            f"{origins[source[first + 1]]}: node {mesh.node_ids[node]} is moved by {at[first + 1] * 1e3:g} mm in "
            f"{'xyz'[every[first] % 3]}, and by {at[first] * 1e3:g} mm through {origins[source[first]]}; "
            f"take it out of one of the two ({len(clash)} such)"
        )
    keep = np.append(True, np.diff(every) > 0)[: len(every)]
    return Prescribed(every[keep], at[keep], turning[keep], origins[source[keep]])
