"""The meshless part: dropped hexahedra become an irregular, graded cloud of EFG nodes and integration points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpitled import resources
from mpitled.cells.hexahedra import geometry, nodal_sum
from mpitled.errors import InputError
from mpitled.mesh import CORNERS, Mesh, Part, numbered_mesh

if TYPE_CHECKING:
    from mpitled import deck

#: The six faces of a hexahedron in the Abaqus/VTK order, seen from outside anticlockwise.
FACES = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
#: No two nodes are nearer than this share of the local spacing, two interface nodes excepted.
CLOSEST = 0.6
# Dart throwing at 0.83 of the spacing s ends with one node per s^3 (measured: 0.97 to 1.01).
_DART = 0.83
_CHUNK = 1 << 15  # places at once, so that the temporaries stay small
_CANDIDATES = 24  # places per node that darts, Lloyd sweeps and shifts choose from
_SWEEPS = 3  # of Lloyd; more change nothing, because nodes move from candidate to candidate
_SAMPLES = 8  # points per direction in a cell that the seed's surface cuts
_ROUNDS = 24  # of dart throwing, roughly
# Memory that each node and integration point takes while the cloud is filled, at the least (measured: 3,000 to 6,000).
_BYTES = 2000
_COARSER = "ask for fewer"
# Growth of the spacing from faces between parts, a metre. With 0.1 a soft sphere is 1.3 to 1.5 times as far off.
_AWAY = 0.05
_SLIVER = 0.5  # a cut cell with a smaller share outside the seed is merged into its neighbour
_GAUSS = CORNERS / np.sqrt(3.0)  # exact to degree 3 in each coordinate: volume and first moments of trilinear cells


@dataclass(frozen=True, slots=True)
class Spacing:
    """Distance between EFG nodes: from the seed's surface outwards it grows by `growth` a metre, up to `largest`.

    With a surface spacing of `growth` times the seed's radius that is `growth` times the distance to the centre; a
    finer surface shifts the line down, so that spacings do not jump. Without a seed it is `largest` everywhere.
    """

    largest: float  # m
    growth: float = 0.0
    centre: NDArray[np.float64] | None = None  # m, None without a seed
    radius: float = 0.0  # of the seed, m
    at_surface: float = 0.0  # m
    # Middles (n, 3), m, of faces between parts, and their sizes (n,), m: next to them spacings are no larger.
    faces: tuple[cKDTree, NDArray[np.float64]] | None = None

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance (n,) of points (n, 3) to the seed's centre, m; infinite without a seed."""
        if self.centre is None:
            return np.full(len(points), np.inf)
        return np.linalg.norm(points - self.centre, axis=1)

    def at_distance(self, distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Spacing (n,) at distances (n,) to the seed's centre, m."""
        if self.centre is None:
            return np.full(len(distance), self.largest)
        return np.minimum(self.largest, self.at_surface + self.growth * np.maximum(distance - self.radius, 0.0))

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Spacing (n,) at points (n, 3), m."""
        spacing = self.at_distance(self.distance(points))
        if self.faces is None:
            return spacing
        tree, sizes = self.faces
        away, nearest = tree.query(points)
        return np.minimum(spacing, sizes[nearest] + _AWAY * away)


@dataclass(frozen=True, slots=True)
class Filling:
    """Hexahedra that remain and the cloud in place of the dropped ones; FE nodes first, then EFG nodes."""

    points: NDArray[np.float64]  # (n_nodes, 3), m
    n_fe_nodes: int
    hexahedra: NDArray[np.int64]  # (n_hexahedra, 8), the rows that were not dropped, renumbered
    new_numbers: NDArray[np.int64]  # (n_points_given,), node number now; -1 if gone
    integration_points: NDArray[np.float64]  # (n_integration, 3), m
    integration_volumes: NDArray[np.float64]  # (n_integration,), m^3
    interface: NDArray[np.int64]  # FE nodes on the void's boundary, ascending
    seed_nodes: NDArray[np.int64]  # EFG nodes on the seed's surface, ascending
    surface_areas: NDArray[np.float64]  # (n_nodes, 3), m^2: see `Mesh`
    parts: tuple[Part, ...]  # see `Mesh`
    spacing: Spacing
    figures: dict[str, float]

    def renumber(self, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of the given mesh's nodes that are left, by their numbers now, ascending."""
        new = self.new_numbers[nodes]
        return np.unique(new[new >= 0])


def fill_void(
    points: NDArray[np.float64],
    hexahedra: NDArray[np.int64],
    dropped: NDArray[np.bool_],
    cloud: deck.Cloud,
    tumour: deck.Tumour | None,
    element_size: float,
    spheres: Sequence[deck.Sphere] = (),
) -> Filling:
    """Replaces the dropped (n_hexahedra,) of hexahedra (n, 8) with nodes `points` (n, 3), m, by a cloud.

    Hexahedra may have any shape: integration cells are cut through their trilinear maps, so that the volumes sum
    to the void's (less the seed's) exactly. Nodes on the outer surface that no hexahedron uses any more become
    EFG nodes; so a cloud without hexahedra ends on the given surface. So do nodes of faces between hexahedra inside and
    outside one of the spheres, where the cloud has two parts; next to them it is as fine as they are. `element_size`
    (m) is the largest spacing unless the deck gives one. The same arguments give the same bits.

    Raises InputError if nothing is dropped, if no node fits in, or if the seed does not lie inside the void.
    """
    if not dropped.any():
        if tumour is not None:
            _check_inside(points, boundary_faces(hexahedra), tumour)
        key = "cloud.radius" if tumour is not None else "core_share"
        raise InputError(f"cloud: no hexahedron is replaced by it; enlarge {key}")
    corners = points[hexahedra[dropped]]
    boundary = boundary_faces(hexahedra[dropped])
    seed, spacing = _seed(cloud, tumour, element_size)
    if tumour is not None:
        try:
            _check_room(points[boundary], tumour, element_size, cloud.radius)
        except InputError as error:
            hint = looks_like_metres(np.asarray(tumour.centre, float), points.min(axis=0), points.max(axis=0))
            raise InputError(f"{error}; {hint}" if hint else str(error)) from None

    void = float(volumes_and_centroids(corners)[0].sum())
    _check_size(corners, void, spacing, cloud.points_per_spacing)
    in_fe = np.zeros(len(points), bool)
    in_fe[hexahedra[~dropped]] = True
    within, of_part = _parts(corners.mean(axis=1), spheres)
    pieces = [hexahedra[dropped][of_part == p] for p in range(len(within))]
    faces = [boundary] if len(pieces) == 1 else [boundary_faces(piece) for piece in pieces]
    on_boundary = np.zeros(len(points), bool)
    on_boundary[np.concatenate(faces)] = True
    kept = np.concatenate([np.flatnonzero(in_fe), np.flatnonzero(on_boundary & ~in_fe)])
    new_numbers = np.full(len(points), -1)
    new_numbers[kept] = np.arange(len(kept))

    if len(faces) > 1:
        spacing = _finer(spacing, points, faces)
    occupied = np.concatenate([points[on_boundary], seed])
    for_nodes, for_cells = (np.random.default_rng([cloud.seed, stream]) for stream in (0, 1))
    inner = [scatter(points[piece], spacing, occupied, cloud.irregularity, for_nodes) for piece in pieces]
    cells = [cut(points[piece], spacing, cloud.points_per_spacing, for_cells) for piece in pieces]
    volumes, centroids = volumes_and_centroids(np.concatenate(cells))
    of_point = np.repeat(np.arange(len(cells)), [*map(len, cells)])
    figures = {"void_volume_m3": void, "seed_volume_m3": 0.0}
    if tumour is not None:
        volumes, centroids, sampled, left = _outside(np.concatenate(cells), volumes, centroids, spacing)
        of_point = of_point[left]
        figures["seed_volume_m3"] = _ball(spacing.radius)
        figures["integration_volume_before_rescaling_m3"] = sampled

    # The mean gradients' sum over all hexahedra of a node is the outer surface's share of it.
    areas = _areas(points, hexahedra, on_boundary)
    new_areas = np.zeros((len(kept) + len(seed) + sum(map(len, inner)), 3))
    new_areas[: len(kept)] = areas[kept]
    # The seed's nodes are of the parts that they touch.
    ends = np.cumsum([len(kept) + len(seed), *map(len, inner)])
    touched = of_point[cKDTree(centroids).query(seed, k=[1, 2, 3, 4])[1]]
    parts = []
    for p in np.unique(of_point):
        hull = np.unique(faces[p])
        of_seed = len(kept) + np.flatnonzero((touched == p).any(axis=1))
        nodes = np.concatenate([new_numbers[hull], of_seed, np.arange(ends[p], ends[p + 1])])
        of_hull = np.zeros((len(nodes), 3))
        if len(pieces) > 1:
            of_hull[: len(hull)] = _areas(points, pieces[p], on_boundary)[hull]
        order = np.argsort(nodes)
        parts.append(Part(within[p], np.flatnonzero(of_point == p), nodes[order], of_hull[order]))

    n_efg = np.count_nonzero(on_boundary & ~in_fe) + len(seed) + sum(map(len, inner))
    if n_efg == 0:
        raise InputError(
            "cloud: no node fits into the hexahedra that it replaces; replace more, or lower cloud.spacing"
        )
    figures["integration_points_per_efg_node"] = float(len(volumes) / n_efg)
    return Filling(
        points=np.concatenate([points[kept], seed, *inner]),
        n_fe_nodes=int(in_fe.sum()),
        hexahedra=new_numbers[hexahedra[~dropped]],
        new_numbers=new_numbers,
        integration_points=centroids,
        integration_volumes=volumes,
        interface=new_numbers[on_boundary & in_fe],
        seed_nodes=np.arange(len(kept), len(kept) + len(seed)),
        surface_areas=new_areas,
        parts=tuple(parts),
        spacing=spacing,
        figures=figures,
    )


def with_cloud(
    points: NDArray[np.float64],
    hexahedra: NDArray[np.int64],
    dropped: NDArray[np.bool_],
    node_sets: dict[str, NDArray[np.int64]],
    cloud: deck.Cloud,
    tumour: deck.Tumour | None,
    element_size: float,
    spheres: Sequence[deck.Sphere] = (),
) -> Mesh:
    """The mesh with a cloud in place of the dropped hexahedra (see `fill_void`), with sets interface and tumour."""
    filling = fill_void(points, hexahedra, dropped, cloud, tumour, element_size, spheres)
    node_sets = {name: filling.renumber(nodes) for name, nodes in node_sets.items()} | {"interface": filling.interface}
    if tumour is not None:
        node_sets["tumour"] = filling.seed_nodes
    mesh = numbered_mesh(
        filling.points,
        filling.n_fe_nodes,
        filling.hexahedra,
        filling.integration_points,
        filling.integration_volumes,
        node_sets,
        filling.figures,
        filling.surface_areas,
    )
    return replace(mesh, parts=filling.parts)


def in_sphere(places: NDArray[np.float64], sphere: deck.Sphere) -> NDArray[np.bool_]:
    """Which of places (n, 3), m, lie in it."""
    return np.asarray(np.linalg.norm(places - np.asarray(sphere.centre), axis=1) <= sphere.radius)


def _parts(
    middles: NDArray[np.float64], spheres: Sequence[deck.Sphere]
) -> tuple[list[tuple[str, ...]], NDArray[np.int64]]:
    """Names of the spheres in which the parts of the cloud lie, and the part (n,) of hexahedra with middles (n, 3)."""
    inside = np.zeros((len(middles), len(spheres)), bool)
    for i, sphere in enumerate(spheres):
        inside[:, i] = in_sphere(middles, sphere)
    kinds, of_part = np.unique(inside, axis=0, return_inverse=True)
    names = [tuple(s.name for s, held in zip(spheres, kind, strict=True) if held) for kind in kinds]
    return names, of_part.ravel()


def _finer(spacing: Spacing, points: NDArray[np.float64], faces: list[NDArray[np.int64]]) -> Spacing:
    """The spacing, but next to faces between parts, each with its `faces` (n, 4), no coarser than these are."""
    every = np.concatenate(faces)
    _, first, count = np.unique(np.sort(every, axis=1), axis=0, return_index=True, return_counts=True)
    if not (count > 1).any():
        return spacing
    corners = points[every[first[count > 1]]]
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]) / 2
    sizes = np.linalg.norm(normals, axis=1) ** 0.5
    return replace(spacing, faces=(cKDTree(corners.mean(axis=1)), sizes))


def _areas(points: NDArray[np.float64], hexahedra: NDArray[np.int64], at: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Integral of N_a n over the surface of hexahedra, (n_points, 3) in m^2, at the chosen nodes, 0 elsewhere."""
    around = hexahedra[at[hexahedra].any(axis=1)]
    gradients, weights = geometry(points, around)
    areas = nodal_sum(around, weights[:, None, None] * gradients, len(points))
    areas[~at] = 0.0
    return areas


def boundary_faces(hexahedra: NDArray[np.int64]) -> NDArray[np.int64]:
    """Faces (n, 4) that belong to one hexahedron only, anticlockwise seen from outside."""
    faces = hexahedra[:, FACES].reshape(-1, 4)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]


def interface_faces(
    points: NDArray[np.float64],
    hexahedra: NDArray[np.int64],
    interface: NDArray[np.int64],
    integration_points: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Faces (n, 4) between hexahedra and cloud, anticlockwise seen from the cloud.

    They are faces of one hexahedron alone whose four nodes are of the interface. A face on the outer surface may be
    such a one too, where the cloud lies all around its hexahedron: but then no cloud lies just beyond it.
    """
    of_interface = np.zeros(len(points), bool)
    of_interface[interface] = True
    # Both hexahedra of a face with interface nodes are among these.
    faces = boundary_faces(hexahedra[of_interface[hexahedra].any(axis=1)])
    faces = faces[of_interface[faces].all(axis=1)]
    if len(faces) == 0 or len(integration_points) == 0:
        return faces[:0]
    corners = points[faces]
    centres = corners.mean(axis=1)
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    # A third of a face's size beyond it (the normal's length is twice the area).
    beyond = centres + normals / np.linalg.norm(normals, axis=1, keepdims=True) ** 0.5 / 4
    nearest = integration_points[cKDTree(integration_points).query(beyond)[1]]
    return faces[((nearest - centres) * normals).sum(axis=1) > 0]


def on_sphere(n: int) -> NDArray[np.float64]:
    """Unit vectors (n, 3) of the Fibonacci lattice, whose points have equal areas (Gonzalez 2010)."""
    i = np.arange(n) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / n), np.pi * (1 + 5**0.5) * i
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)


def subdivide(cells: NDArray[np.float64], cuts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Corners (sum of products of cuts, 8, 3) of hexahedra (n, 8, 3) cut in `cuts` (n, 3) parts along their axes.

    A part of a trilinear cell is the trilinear cell of its own corners, so that nothing is lost by cutting.
    """
    n_parts = cuts.prod(axis=1)
    parent = np.repeat(np.arange(len(cells)), n_parts)
    part = np.arange(len(parent)) - np.repeat(np.cumsum(n_parts) - n_parts, n_parts)
    k = cuts[parent]
    place = np.stack([part % k[:, 0], part // k[:, 0] % k[:, 1], part // (k[:, 0] * k[:, 1])], axis=1)
    parents = cells[parent]
    corners = [_trilinear(parents, 2 * (place + (corner + 1) / 2) / k - 1) for corner in CORNERS]
    return np.stack(corners, axis=1)


def volumes_and_centroids(cells: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Volumes (n,), m^3, and centroids (n, 3), m, of trilinear hexahedra with corners (n, 8, 3), exact to round-off."""
    volumes, moments = np.zeros(len(cells)), np.zeros((len(cells), 3))
    for point in _GAUSS:
        slopes = [CORNERS[:, i] * np.delete(1 + CORNERS * point, i, axis=1).prod(axis=1) / 8 for i in range(3)]
        r, s, t = (_weighted(slope, cells) for slope in slopes)
        weight = (r * np.cross(s, t)).sum(axis=1)
        volumes += weight
        moments += weight[:, None] * _trilinear(cells, np.broadcast_to(point, (len(cells), 3)))
    return volumes, moments / volumes[:, None]


def cut(
    cells: NDArray[np.float64], spacing: Spacing, per_spacing: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Parts (m, 8, 3) of hexahedra (n, 8, 3) about `per_spacing` times smaller than the spacing of nodes there.

    Hexahedra over which the spacing changes much are halved first. A hexahedron is then cut in k or k + 1 parts
    along each axis, k + 1 along as many axes, chosen at random, as the wanted number of parts asks in the mean.
    """
    done = []
    while len(cells):
        centres = cells.mean(axis=1)
        reach = np.linalg.norm(cells - centres[:, None], axis=2).max(axis=1)
        distance = spacing.distance(centres)
        ratio = _edges(cells) * per_spacing / spacing(centres)[:, None]
        uneven = spacing.at_distance(distance + reach) > 1.6 * spacing.at_distance(distance - reach)
        halve = uneven & (ratio.max(axis=1) > 1.5)
        done.append(subdivide(cells[~halve], _cuts(ratio[~halve], rng)))
        cells = subdivide(cells[halve], np.where(ratio[halve] > 1.5, 2, 1))
    return np.concatenate(done)


def scatter(
    cells: NDArray[np.float64],
    spacing: Spacing,
    occupied: NDArray[np.float64],
    irregularity: float,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Irregular nodes (n, 3), one per cubed spacing, in hexahedra (m, 8, 3) around the `occupied` places (k, 3).

    Dart throwing for places that are nowhere too near and leave no hole, Lloyd sweeps that even them out, then a random
    shift by up to `irregularity` spacings. All of it chooses among random candidates inside the hexahedra and
    outside the seed, so that no node can leave the void, whatever its shape.
    """
    candidates = _candidates(cells, spacing, rng)
    local = spacing(candidates)
    nodes = _throw_darts(candidates, _DART * local, occupied, rng)
    for _ in range(_SWEEPS):
        nodes = _lloyd(candidates, local, nodes, occupied)
    nodes = _separate(candidates, CLOSEST * local, nodes, occupied)
    return candidates[np.sort(_shift(candidates, local, nodes, occupied, irregularity, rng))]


def _seed(cloud: deck.Cloud, tumour: deck.Tumour | None, element_size: float) -> tuple[NDArray[np.float64], Spacing]:
    """Nodes on the seed's surface and the spacing around it."""
    largest = cloud.spacing or element_size
    if tumour is None:
        return np.empty((0, 3)), Spacing(largest)
    radius, centre = tumour.seed_radius, np.asarray(tumour.centre, float)
    # One node per squared spacing; the surface is never coarser than the cloud next to it would be.
    coarsest = min(cloud.growth * radius, largest)
    wanted = max(tumour.surface_nodes, np.ceil(4 * np.pi * (radius / coarsest) ** 2) if coarsest else np.inf)
    resources.check_memory(
        _BYTES * wanted, f"cloud.growth, tumour.surface_nodes: ask for {wanted:.3g} nodes on the seed, which", _COARSER
    )
    n = int(wanted)
    at_surface = np.sqrt(4 * np.pi * radius**2 / n)
    return centre + radius * on_sphere(n), Spacing(largest, cloud.growth, centre, radius, float(at_surface))


def _check_size(corners: NDArray[np.float64], void: float, spacing: Spacing, per_spacing: float) -> None:
    """InputError if nodes and integration points for cells (n, 8, 3) of that volume (m^3) are too many for the memory.

    No more nodes fit than into a ball of that volume around the seed, where they are densest. Cells that are flat are
    cut along their edges only, into more parts than their volume asks for.
    """
    if spacing.centre is None:
        nodes = void / spacing.largest**3
    else:
        reach = np.cbrt(spacing.radius**3 + void * 3 / (4 * np.pi))
        r = np.geomspace(spacing.radius, reach, 1000)
        density = 4 * np.pi * r**2 / spacing.at_distance(r) ** 3
        nodes = float(((density[1:] + density[:-1]) / 2 * np.diff(r)).sum())
    cuts = _edges(corners) * max(per_spacing, 1.0) / spacing(corners.mean(axis=1))[:, None]
    needed = max(nodes * (1 + per_spacing**3), float(np.maximum(cuts, 1).prod(axis=1).sum()))
    what = f"cloud: makes about {needed:.3g} nodes and integration points, which"
    resources.check_memory(_BYTES * needed, what, f"{_COARSER} by spacing, growth or points_per_spacing")


def _ball(radius: float) -> float:
    return 4 / 3 * np.pi * radius**3


def in_millimetres(place: NDArray[np.float64]) -> str:
    """A place (3,), m, as the user wrote it in the deck."""
    return "(" + ", ".join(f"{1e3 * x:g}" for x in place) + ") mm"


def looks_like_metres(place: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]) -> str:
    """What to say of a place (3,), m, whose figures, taken as metres, would lie between low and high (3,), m; or ""."""
    meant = 1e3 * place
    if not 0 < np.abs(place).max() < 1e-3 or not ((low <= meant) & (meant <= high)).all():
        return ""
    return f"it looks like metres: in mm it is {in_millimetres(meant).removesuffix(' mm')}"


def length(metres: float) -> str:
    """A length for people to read: in mm, to a hundredth at the best."""
    return f"{round(1e3 * metres, 2):.3g} mm"


def _check_room(boundary: NDArray[np.float64], tumour: deck.Tumour, element_size: float, radius: float) -> None:
    """The seed lies inside the void's boundary (n, 4, 3), with an element's size of cloud around it.

    radius: cloud.radius; hexahedra with their middles within it are replaced, where there are any that can be.
    """
    inside, room = _place(boundary, tumour)
    where = f"tumour.centre = {in_millimetres(np.asarray(tumour.centre, float))}"
    if not inside:
        raise InputError(f"{where}: is not inside the cloud, but {length(room)} from it; move it")
    needed = tumour.seed_radius + element_size
    if room < needed:
        # Next to the boundary is a hexahedron whose middle is not within the radius; or there is none, or it must stay.
        remedy = "enlarge cloud.radius"
        if room + element_size < radius:
            remedy = "the outer surface or a ventricle is too near, whatever cloud.radius: move it away from there"
        raise InputError(
            f"{where}: is {length(room)} from the cloud's boundary, but the seed and an element's size of cloud "
            f"around it need {length(needed)}; {remedy}, or make the hexahedra smaller"
        )


def _check_inside(points: NDArray[np.float64], faces: NDArray[np.int64], tumour: deck.Tumour) -> None:
    """The tumour's centre lies inside the body with faces (n, 4)."""
    inside, room = _place(points[faces], tumour)
    if not inside:
        centre, low, high = np.asarray(tumour.centre, float), points.min(axis=0), points.max(axis=0)
        hint = looks_like_metres(centre, low, high)
        raise InputError(
            f"tumour.centre = {in_millimetres(centre)}: is outside the body, {length(room)} from it; move it inside "
            f"(from {in_millimetres(low)} to {in_millimetres(high)})" + (f"; {hint}" if hint else "")
        )


def _place(boundary: NDArray[np.float64], tumour: deck.Tumour) -> tuple[bool, float]:
    """Whether the tumour's centre lies inside a closed surface (n, 4, 3), and how far from it, m."""
    quads = boundary - np.asarray(tumour.centre, float)
    # Solid angles of a closed surface sum to 4 pi for a point inside, to 0 outside (van Oosterom and Strackee 1983).
    a, b, c = np.moveaxis(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    denominator = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    solid_angle = 2 * np.arctan2((a * np.cross(b, c)).sum(1), denominator).sum()
    s = np.linspace(0, 1, 9)
    weights = np.stack(
        [np.outer(1 - s, 1 - s), np.outer(s, 1 - s), np.outer(s, s), np.outer(1 - s, s)], axis=-1
    ).reshape(-1, 4)
    room = min(np.linalg.norm(quads.transpose(0, 2, 1) @ w, axis=1).min() for w in weights)
    return bool(solid_angle >= 2 * np.pi), float(room)


def _trilinear(cells: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 3) of hexahedra (n, 8, 3) at places (n, 3) in [-1, 1]^3 (paper, eq. 4.4)."""
    return _weighted((1 + CORNERS * places[:, None, :]).prod(axis=2) / 8, cells)


def _weighted(weights: NDArray[np.float64], cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums (n, 3) of the corners of hexahedra (n, 8, 3) by weights (n, 8), or (8,) for all alike.

    Corner by corner and not as a product of matrices, whose last bit a BLAS does not promise: it would decide where
    nodes lie.
    """
    total = weights[..., 0, None] * cells[:, 0]
    for corner in range(1, 8):
        total += weights[..., corner, None] * cells[:, corner]
    return np.asarray(total)


def _edges(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths (n, 3) of hexahedra (n, 8, 3) along their three axes, through the centre."""
    return np.linalg.norm(np.stack([_weighted(axis, cells) for axis in CORNERS.T / 4], axis=1), axis=2)


def _cuts(ratio: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.int64]:
    """Numbers of parts (n, 3) along the axes, whose product is that of the ratios (n, 3) in the mean."""
    low = np.maximum(np.floor(ratio), 1).astype(np.int64)
    # Axes in the order of what they lack; the noise lets chance choose between equals.
    lack = (ratio / low) * rng.uniform(1, 1.001, ratio.shape)
    rank = np.argsort(np.argsort(-lack, axis=1), axis=1)
    steps = np.stack([(low + (rank < m)).prod(axis=1) for m in range(4)], axis=1)
    wanted = np.clip(np.maximum(ratio, 1).prod(axis=1), steps[:, 0], steps[:, 3])
    m = np.minimum((steps <= wanted[:, None]).sum(axis=1) - 1, 2)
    below, above = np.take_along_axis(steps, np.stack([m, m + 1], axis=1), axis=1).T
    m = m + (rng.random(len(m)) < (wanted - below) / (above - below))
    return low + (rank < m[:, None])


def _outside(
    cells: NDArray[np.float64], volumes: NDArray[np.float64], centroids: NDArray[np.float64], spacing: Spacing
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, NDArray[np.int64]]:
    """Volumes and centroids of what lies outside the seed of cells (n, 8, 3), their sum before it is made exact, and
    which cells they are of.

    Cells that the sphere cuts are sampled. Slivers are merged into the nearest point. The sampling error of the
    sum is spread over the cut cells.
    """
    middle = cells.mean(axis=1)
    reach = np.linalg.norm(cells - middle[:, None], axis=2).max(axis=1)
    cut_cells = np.flatnonzero(spacing.distance(middle) < spacing.radius + reach)
    places = 2 * (np.indices((_SAMPLES,) * 3).reshape(3, -1).T + 0.5) / _SAMPLES - 1
    shapes = (1 + CORNERS * places[:, None, :]).prod(axis=2) / 8
    samples = np.stack([_weighted(shape, cells[cut_cells]) for shape in shapes], axis=1)
    out = spacing.distance(samples.reshape(-1, 3)).reshape(len(cut_cells), -1) >= spacing.radius
    share = out.mean(axis=1)
    partial = (share > 0) & (share < 1)
    total = volumes.copy()
    volumes, centroids = volumes.copy(), centroids.copy()
    volumes[cut_cells] *= share
    moved = cut_cells[partial]
    inside = np.where(out[partial][:, :, None], samples[partial], 0.0).sum(axis=1)
    centroids[moved] = inside / out[partial].sum(axis=1)[:, None]

    target = total.sum() - _ball(spacing.radius)
    sampled = volumes.sum()
    volumes[moved] *= 1 + (target - sampled) / volumes[moved].sum()

    sliver = (volumes > 0) & (volumes < _SLIVER * total)
    kept = np.flatnonzero((volumes > 0) & ~sliver)
    into = kept[cKDTree(centroids[kept]).query(centroids[sliver])[1]]
    moments = centroids * volumes[:, None]
    np.add.at(moments, into, moments[sliver])
    np.add.at(volumes, into, volumes[sliver])
    centroids = moments[kept] / volumes[kept, None]
    # The centroid of a thin, curved shell may lie a little inside the sphere.
    assert spacing.centre is not None
    stretch = np.maximum(1.0, spacing.radius / spacing.distance(centroids))
    centroids += (stretch - 1)[:, None] * (centroids - spacing.centre)
    return volumes[kept], centroids, float(sampled), kept


def _candidates(cells: NDArray[np.float64], spacing: Spacing, rng: np.random.Generator) -> NDArray[np.float64]:
    """Random places (n, 3) outside the seed, about _CANDIDATES per cubed spacing."""
    parts = cut(cells, spacing, 1.0, rng)
    volumes, centroids = volumes_and_centroids(parts)
    wanted = _CANDIDATES * volumes / spacing(centroids) ** 3
    parent = np.repeat(np.arange(len(parts)), np.floor(wanted + rng.random(len(parts))).astype(np.int64))
    places = np.empty((len(parent), 3))
    for first in range(0, len(parent), _CHUNK):
        rows = slice(first, min(first + _CHUNK, len(parent)))
        places[rows] = _trilinear(parts[parent[rows]], rng.uniform(-1, 1, (rows.stop - first, 3)))
    return places[spacing.distance(places) > spacing.radius]


def _throw_darts(
    candidates: NDArray[np.float64],
    apart: NDArray[np.float64],
    occupied: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Candidates none of which is nearer to another or to an occupied place than its `apart`, and no more fit in.

    Poisson-disc sampling (Cook 1986), in rounds of many darts at once.
    """
    alive = rng.permutation(np.flatnonzero(_clear(candidates, apart, occupied)))
    chosen = []
    while len(alive):
        darts = alive[: max(len(alive) // _ROUNDS, min(len(alive), 256))]
        darts = _separate(candidates, apart, darts, np.empty((0, 3)))
        chosen.append(darts)
        alive = alive[_clear(candidates[alive], apart[alive], candidates[darts])]
    return np.concatenate(chosen) if chosen else alive


def _separate(
    candidates: NDArray[np.float64],
    apart: NDArray[np.float64],
    nodes: NDArray[np.int64],
    occupied: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Nodes less those too near to an occupied place or to a node before them."""
    nodes = nodes[_clear(candidates[nodes], apart[nodes], occupied)]
    while len(nodes) > 1:
        distance, neighbour = cKDTree(candidates[nodes]).query(candidates[nodes], k=2)
        late = (distance[:, 1] < apart[nodes]) & (neighbour[:, 1] < np.arange(len(nodes)))
        early = (distance[:, 1] < apart[nodes]) & ~late
        # Of a pair it is the later that goes, also where only the earlier one's distance is too small.
        late[neighbour[early, 1]] = True
        if not late.any():
            break
        nodes = nodes[~late]
    return nodes


def _lloyd(
    candidates: NDArray[np.float64],
    local: NDArray[np.float64],
    nodes: NDArray[np.int64],
    occupied: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Each node moves to the candidate of its Voronoi cell next to the cell's centroid (Lloyd 1982)."""
    owner = cKDTree(np.concatenate([candidates[nodes], occupied])).query(candidates)[1]
    mine = owner < len(nodes)
    owner, members = owner[mine], np.flatnonzero(mine)
    # Candidates lie with density 1/spacing^3; cells grow as the spacing where the density is 1/spacing^5 (Gersho 1979).
    weight = local[members] ** -2
    total = np.bincount(owner, weight, len(nodes))
    moments = [np.bincount(owner, weight * candidates[members, i], len(nodes)) for i in range(3)]
    centroids = np.stack(moments, axis=1) / total[:, None]
    offset = ((candidates[members] - centroids[owner]) ** 2).sum(axis=1)
    order = np.lexsort((offset, owner))
    first = np.searchsorted(owner[order], np.arange(len(nodes)))
    return members[order[first]]


def _shift(
    candidates: NDArray[np.float64],
    local: NDArray[np.float64],
    nodes: NDArray[np.int64],
    occupied: NDArray[np.float64],
    irregularity: float,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Nodes moved at random by up to `irregularity` spacings, but for those that would come too near to another."""
    direction = rng.normal(size=(len(nodes), 3))
    length = irregularity * local[nodes] * rng.random(len(nodes)) ** (1 / 3) / np.linalg.norm(direction, axis=1)
    wanted = candidates[nodes] + length[:, None] * direction
    shifted = cKDTree(candidates).query(wanted)[1]
    while True:
        places = np.concatenate([candidates[shifted], occupied])
        distance, neighbour = cKDTree(places).query(places[: len(nodes)], k=2)
        near = distance[:, 1] < CLOSEST * local[shifted]
        back = np.zeros(len(places), bool)
        back[: len(nodes)] = near
        back[neighbour[near, 1]] = True
        back = back[: len(nodes)] & (shifted != nodes)
        if not back.any():
            return shifted
        shifted = np.where(back, nodes, shifted)


def _clear(points: NDArray[np.float64], apart: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of points (n, 3) have none of the others (m, 3) nearer than their own `apart` (n,)."""
    if len(others) == 0 or len(points) == 0:
        return np.ones(len(points), bool)
    return np.asarray(cKDTree(others).query(points, distance_upper_bound=apart.max())[0]) >= apart
