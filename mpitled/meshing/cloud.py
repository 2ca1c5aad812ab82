"""The meshless part: hexahedra are replaced by an irregular, graded cloud of EFG nodes and integration points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from mpitled import resources
from mpitled.cells.hexahedra import geometry, nodal_sum
from mpitled.errors import InputError
from mpitled.mesh import Bools, Floats, Ints, Mesh, Part, numbered_mesh
from mpitled.meshing import placement
from mpitled.meshing.faces import boundary_faces
from mpitled.meshing.integration_cells import cut, edge_lengths, outside_seed, volumes_and_centroids
from mpitled.meshing.scatter import fibonacci_sphere, scatter
from mpitled.meshing.spacing import Spacing

if TYPE_CHECKING:
    from mpitled import deck

# Lower bound of the memory per node and integration point while the cloud is built (measured: 3,000 to 6,000).
_BYTES = 2000
_REMEDY = "ask for fewer"


class CloudMesh(NamedTuple):
    """The mixed mesh of remaining hexahedra and cloud, and the spacing of the cloud's nodes."""

    mesh: Mesh
    spacing: Spacing


def build_cloud(
    points: Floats,
    hexahedra: Ints,
    replaced: Bools,
    node_sets: dict[str, Ints],
    cloud: deck.Cloud,
    tumour: deck.Tumour | None,
    element_size: float,
    spheres: Sequence[deck.Sphere] = (),
) -> CloudMesh:
    """Replace hexahedra by a cloud; `replaced` (n_hexahedra,) is a mask of `hexahedra` (n_hexahedra, 8).

    `points` (n, 3), m, are nodes of the hexahedra, which may have any shape. Integration cells are cut through
    trilinear maps, so the volumes sum exactly to the void's volume less the seed's. Nodes of the void's surface remain:
    those without a remaining hexahedron become EFG nodes. The spheres divide the cloud into parts. Nodes of faces
    between two parts become EFG nodes, and the cloud is as fine as these faces. `element_size` (m) is the largest
    spacing unless the deck gives one. Equal arguments give bit-identical results. The mesh has the given node sets
    without removed nodes, the set interface and, with a tumour, the set tumour: the seed's surface.

    InputError if nothing is replaced, if no node fits, or if the seed does not lie inside the void.
    """
    if not replaced.any():
        if tumour is not None:
            placement.check_inside(points, hexahedra, tumour)
        key = "cloud.radius" if tumour is not None else "core_share"
        raise InputError(f"cloud: no hexahedron is replaced by it; enlarge {key}")
    void, remaining = hexahedra[replaced], hexahedra[~replaced]
    boundary = boundary_faces(void)
    seed, spacing = _seed(cloud, tumour, element_size)
    if tumour is not None:
        placement.check_seed_fits(points, boundary, tumour, element_size, cloud.radius)
    void_volume = float(volumes_and_centroids(points[void])[0].sum())
    _check_memory(points[void], void_volume, spacing, cloud.points_per_spacing)

    names, part_of_cell = _split(points[void].mean(axis=1), spheres)
    pieces = [void[part_of_cell == p] for p in range(len(names))]
    faces = [boundary] if len(pieces) == 1 else [boundary_faces(piece) for piece in pieces]
    if len(faces) > 1:
        spacing = spacing.refined(points, faces)
    in_fe, on_boundary = np.zeros(len(points), bool), np.zeros(len(points), bool)
    in_fe[remaining] = True
    on_boundary[np.concatenate(faces)] = True
    kept = np.concatenate([np.flatnonzero(in_fe), np.flatnonzero(on_boundary & ~in_fe)])
    new_numbers = np.full(len(points), -1)
    new_numbers[kept] = np.arange(len(kept))

    occupied = np.concatenate([points[on_boundary], seed])
    node_rng, cell_rng = (np.random.default_rng([cloud.seed, stream]) for stream in (0, 1))
    inner = [scatter(points[piece], spacing, occupied, cloud.irregularity, node_rng) for piece in pieces]
    new_points = np.concatenate([points[kept], seed, *inner])
    n_fe_nodes = int(in_fe.sum())
    if len(new_points) == n_fe_nodes:
        raise InputError(
            "cloud: no node fits into the hexahedra that it replaces; replace more, or lower cloud.spacing"
        )

    corners = [points[piece] for piece in pieces]
    volumes, centroids, part_of_point, figures = _integrate(corners, spacing, cloud.points_per_spacing, cell_rng)
    figures["integration_points_per_efg_node"] = float(len(volumes) / (len(new_points) - n_fe_nodes))

    # Sums of V B over all hexahedra of a node are integrals of N_a n over the outer surface.
    areas = np.zeros((len(new_points), 3))
    areas[: len(kept)] = _surface_areas(points, hexahedra, on_boundary)[kept]
    seed_nodes = len(kept) + np.arange(len(seed))
    # A seed node belongs to the parts of the nearest integration points.
    touched = part_of_point[cKDTree(centroids).query(seed, k=[1, 2, 3, 4])[1]]
    ends = np.cumsum([len(kept) + len(seed), *map(len, inner)])
    parts = []
    for p in np.unique(part_of_point):
        hull = np.unique(faces[p])
        nodes = [new_numbers[hull], seed_nodes[(touched == p).any(axis=1)], np.arange(ends[p], ends[p + 1])]
        # A single part has no faces to other parts.
        hull_areas = _surface_areas(points, pieces[p], on_boundary)[hull] if len(pieces) > 1 else np.zeros((0, 3))
        parts.append(_part(names[p], np.flatnonzero(part_of_point == p), np.concatenate(nodes), hull_areas))
    node_sets = {name: np.sort(new_numbers[nodes]) for name, nodes in node_sets.items()}
    node_sets = {name: nodes[nodes >= 0] for name, nodes in node_sets.items()}
    node_sets["interface"] = new_numbers[on_boundary & in_fe]
    if tumour is not None:
        node_sets["tumour"] = seed_nodes
    mesh = numbered_mesh(
        points=new_points,
        n_fe_nodes=n_fe_nodes,
        hexahedra=new_numbers[remaining],
        integration_points=centroids,
        integration_volumes=volumes,
        node_sets=node_sets,
        figures={"void_volume_m3": void_volume, "seed_volume_m3": spacing.seed_volume, **figures},
        surface_areas=areas,
        parts=tuple(parts),
    )
    return CloudMesh(mesh, spacing)


def near_centre(points: Floats, hexahedra: Ints, tumour: deck.Tumour, radius: float) -> Bools:
    """Mask (n,) of hexahedra (n, 8) with their centre within the radius, m, of the tumour's centre."""
    distance = np.linalg.norm(points[hexahedra].mean(axis=1) - np.asarray(tumour.centre), axis=1)
    return np.asarray(distance <= radius)


def _seed(cloud: deck.Cloud, tumour: deck.Tumour | None, element_size: float) -> tuple[Floats, Spacing]:
    """Nodes (n, 3), m, on the seed's surface, and the spacing around the seed."""
    largest = cloud.spacing or element_size
    if tumour is None:
        return np.empty((0, 3)), Spacing(largest)
    radius, centre = tumour.seed_radius, np.asarray(tumour.centre, float)
    # One node per squared spacing; the surface must not be coarser than the cloud next to it.
    coarsest = min(cloud.growth * radius, largest)
    wanted = max(tumour.surface_nodes, np.ceil(4 * np.pi * (radius / coarsest) ** 2) if coarsest else np.inf)
    request = f"cloud.growth, tumour.surface_nodes: ask for {wanted:.3g} nodes on the seed, which"
    resources.check_memory(_BYTES * wanted, request, _REMEDY)
    n = int(wanted)
    at_surface = np.sqrt(4 * np.pi * radius**2 / n)
    return centre + radius * fibonacci_sphere(n), Spacing(largest, cloud.growth, centre, radius, float(at_surface))


def _check_memory(cells: Floats, volume: float, spacing: Spacing, per_spacing: float) -> None:
    """InputError if the nodes and integration points of cells (n, 8, 3) with that volume, m^3, exceed the memory."""
    # A flat cell is cut at least once along each edge, so it has more parts than its volume requires.
    cuts = edge_lengths(cells) * max(per_spacing, 1.0) / spacing(cells.mean(axis=1))[:, None]
    by_volume = spacing.n_nodes(volume) * (1 + per_spacing**3)
    n = max(by_volume, float(np.maximum(cuts, 1).prod(axis=1).sum()))
    request = f"cloud: makes about {n:.3g} nodes and integration points, which"
    resources.check_memory(_BYTES * n, request, f"{_REMEDY} by spacing, growth or points_per_spacing")


def _split(centres: Floats, spheres: Sequence[deck.Sphere]) -> tuple[list[tuple[str, ...]], Ints]:
    """Names of the spheres around each part of the cloud, and the part (n,) of hexahedra with centres (n, 3)."""
    inside = np.zeros((len(centres), len(spheres)), bool)
    for i, sphere in enumerate(spheres):
        inside[:, i] = placement.in_sphere(centres, sphere)
    kinds, part = np.unique(inside, axis=0, return_inverse=True)
    names = [tuple(s.name for s, is_in in zip(spheres, kind, strict=True) if is_in) for kind in kinds]
    return names, part.ravel()


def _integrate(
    pieces: list[Floats], spacing: Spacing, per_spacing: float, rng: np.random.Generator
) -> tuple[Floats, Floats, Ints, dict[str, float]]:
    """Volumes, points and parts of the integration cells in each part's hexahedra (n, 8, 3), and figures."""
    parts = [cut(piece, spacing, per_spacing, rng) for piece in pieces]
    cells = np.concatenate(parts)
    part_of_point = np.repeat(np.arange(len(parts)), [*map(len, parts)])
    volumes, centroids = volumes_and_centroids(cells)
    if spacing.centre is None:
        return volumes, centroids, part_of_point, {}
    volumes, centroids, rows, sampled = outside_seed(cells, volumes, centroids, spacing)
    return volumes, centroids, part_of_point[rows], {"integration_volume_before_rescaling_m3": sampled}


def _part(spheres: tuple[str, ...], integration_points: Ints, nodes: Ints, areas: Floats) -> Part:
    """A part of the cloud with its nodes in ascending order; `areas` belong to the first nodes, others have none."""
    areas = np.concatenate([areas, np.zeros((len(nodes) - len(areas), 3))])
    order = np.argsort(nodes)
    return Part(spheres, integration_points, nodes[order], areas[order])


def _surface_areas(points: Floats, hexahedra: Ints, at: Bools) -> Floats:
    """Integral of N_a n over the surface of hexahedra, (n_points, 3), m^2, at nodes of the mask `at`; 0 elsewhere."""
    around = hexahedra[at[hexahedra].any(axis=1)]
    gradients, weights = geometry(points, around)
    areas = nodal_sum(around, weights[:, None, None] * gradients, len(points))
    areas[~at] = 0.0
    return areas
