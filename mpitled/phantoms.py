"""Phantoms: cylinders and ellipsoids of hexahedra that follow the curved surface, with a cloud in their core or not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mpitled.cloud import boundary_faces, in_millimetres, with_cloud
from mpitled.errors import InputError
from mpitled.mesh import Mesh, grid_points, hexahedral_mesh, structured_hexahedra

if TYPE_CHECKING:
    from mpitled import deck

# Half the core's width over the radius, and how far the core's sides bulge towards the circle or sphere: from a search
# for even cells whose worst corner is good (scaled Jacobian 0.85 in a cylinder, 0.71 in a ball; volumes 1 to 6 in it).
_CORE, _BULGE = 0.5, 0.4
# Elements over the core's width for each element's size in the radius, so that the mean edge is the size asked for.
_ACROSS = 1.1
# Thickness over width of the shells around a seed.
_THICK = 1.5


def cylinder_mesh(cylinder: deck.Cylinder, cloud: deck.Cloud, tumour: deck.Tumour | None) -> Mesh:
    """The mesh of a cylinder along z from z = 0, a square core in rings: sets bottom, top, side and, together, surface.

    A core cloud ends at the ring or layer next to `core_share` of radius and height, or, with a tumour, takes the
    hexahedra within `cloud.radius` of its centre. InputError for a tumour without a cloud or without room.
    """
    if tumour is not None and cylinder.cloud == "none":
        raise InputError('cylinder.cloud = "none": a tumour grows in a cloud; set it to "core" or "all"')
    size = _element_size(cylinder, cloud)
    n = 2 * _number(_ACROSS * cylinder.radius / (2 * size))
    onion = _Onion((n, n), cylinder.radius, size)
    layers = _number(cylinder.height / size)
    flat = cylinder.radius * onion.points
    z = np.linspace(0.0, cylinder.height, layers + 1)
    points = np.concatenate([np.tile(flat, (layers + 1, 1)), np.repeat(z, len(flat))[:, None]], axis=1)
    level = np.arange(layers)[:, None, None] * len(flat)
    hexahedra = np.concatenate([onion.cells + level, onion.cells + level + len(flat)], axis=2).reshape(-1, 8)

    nodes = np.arange(len(points)).reshape(layers + 1, -1)
    sides = {"bottom": nodes[0], "top": nodes[-1], "side": nodes[:, onion.surface].ravel()}
    node_sets = sides | {"surface": np.unique(np.concatenate(list(sides.values())))}
    margin = max(np.floor((1 - cylinder.core_share) / 2 * layers + 0.5), 1)
    inside = (np.arange(layers) >= margin) & (np.arange(layers) < layers - margin)
    core = (inside[:, None] & onion.core(cylinder.core_share)).ravel()
    return _filled(cylinder.cloud, core, points, hexahedra, node_sets, cloud, tumour, size)


def ellipsoid_mesh(ellipsoid: deck.Ellipsoid, cloud: deck.Cloud, tumour: deck.Tumour | None) -> Mesh:
    """The mesh of an ellipsoid around the origin: a cube-like core in shells of an equiangular cubed sphere.

    Sets are surface and, where with (p, q, r) = (x/a, y/b, z/c) on it r > 0, |p| <= t r, |q| <= t r, t = tan(pi/8),
    patch; where r < 0, |p| <= -r, |q| <= -r, fixed. The numbers of elements are divisible by 4, so that both end
    with elements. A core cloud ends at the shell next to `core_share` of the semi-axes, or, with a tumour, takes the
    hexahedra within `cloud.radius` of its centre. Without a cloud, `cavity` says how a tumour has its seed.
    InputError for a tumour without room.
    """
    axes, size = np.asarray(ellipsoid.semi_axes), _element_size(ellipsoid, cloud)
    shape = np.array([4 * _number(_ACROSS * a / (4 * size)) for a in axes])
    if tumour is not None and ellipsoid.cloud == "none" and ellipsoid.cavity == "fitted":
        shape = np.maximum(shape, 4 * _number(np.ceil((tumour.surface_nodes / 6) ** 0.5 / 4)))
    onion = _Onion(tuple(shape), float(axes.prod() ** (1 / 3)), size)
    node_sets = {
        "surface": onion.surface,
        "patch": onion.surface[(onion.cube[:, 2] == 1) & (np.abs(onion.cube[:, :2]) <= 0.5).all(axis=1)],
        "fixed": onion.surface[onion.cube[:, 2] == -1],
    }
    points = axes * onion.points
    if tumour is None or ellipsoid.cloud != "none":
        core = onion.core(ellipsoid.core_share)
        return _filled(ellipsoid.cloud, core, points, onion.cells, node_sets, cloud, tumour, size)
    _check_room(tumour, axes, size)
    if ellipsoid.cavity == "moved":
        return _moved(points, onion.cells, node_sets, axes, np.asarray(tumour.centre))
    return _fitted(points[onion.surface], onion, node_sets, tumour, size)


class _Onion:
    """A disc or ball of radius 1 cut in a square or cube-like core and shells around it.

    In the core, straight lines near the middle bend towards the sphere's outwards; between core and sphere, lines are
    straight. Nodes are the core's grid, x fastest, then one shell after the other.
    """

    points: NDArray[np.float64]  # (n_nodes, d)
    cells: NDArray[np.int64]  # (n_cells, 2^d), in VTK's order
    surface: NDArray[np.int64]  # nodes on the sphere, ascending
    cube: NDArray[np.float64]  # (n_surface, d), their places on the cube [-1, 1]^d before it was made round
    faces: NDArray[np.int64]  # (n_faces, 2^(d-1)) rows of `surface`, seen from outside anticlockwise

    def __init__(self, shape: tuple[int, ...], radius: float, element_size: float) -> None:
        """Cells along each axis of the core; the shells are as thick as suits elements of that size (both m)."""
        d = len(shape)
        nx, ny, nz = (*shape, 1)[:3]
        grid, core_cells = (
            grid_points((nx, ny, nz), (2.0, 2.0, 2.0))[:, :d] - 1,
            structured_hexahedra((nx, ny, nz)),
        )
        if d == 2:
            grid, core_cells = grid[: len(grid) // 2], core_cells[:, :4]
        # Whole numbers of cells, so that the faces' places are 1 and the patch's edge 1/2 without round-off.
        grid = np.rint((grid + 1) / 2 * shape) * 2 / shape - 1
        level = np.abs(grid).max(axis=1)
        edge = np.flatnonzero(level == 1)
        self.cube = grid[edge]
        direction = grid / np.where(level > 0, level, 1)[:, None]
        bulge = _BULGE * level[:, None]
        core = _CORE * level[:, None] * ((1 - bulge) * direction + bulge * _on_sphere(direction))
        inner, outer = core[edge], _on_sphere(self.cube)
        thickness = radius * (1 - np.linalg.norm(inner, axis=1).mean())
        self.n_shells = _number(thickness / element_size)
        share = np.arange(1, self.n_shells + 1)[:, None, None] / self.n_shells
        self.points = np.concatenate([core, ((1 - share) * inner + share * outer).reshape(-1, d)])

        row = np.full(len(grid), -1)
        row[edge] = np.arange(len(edge))
        self.faces = row[boundary_faces(core_cells) if d == 3 else _sides(core_cells)]
        # Rows of the core's surface and of each shell.
        nodes = np.concatenate([edge[None], len(grid) + np.arange(self.n_shells * len(edge)).reshape(-1, len(edge))])
        self.surface = nodes[-1]
        bottom, top = nodes[:-1][:, self.faces], nodes[1:][:, self.faces]
        shells = np.concatenate([bottom if d == 3 else bottom[..., ::-1], top], axis=2).reshape(-1, 2**d)
        self.cells = np.concatenate([core_cells, shells])
        middle = np.abs(grid[core_cells].mean(axis=1)).max(axis=1)
        shell = np.repeat((np.arange(self.n_shells) + 0.5) / self.n_shells, len(self.faces))
        self._radius = np.concatenate([_CORE * middle, _CORE + (1 - _CORE) * shell])

    def core(self, share: float) -> NDArray[np.bool_]:
        """Cells (n_cells,) whose middle lies within that share of the radius, never those of the outermost shell."""
        return (self._radius <= share) & (self._radius < 1 - (1 - _CORE) / self.n_shells)


def _on_sphere(cube: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors (n, d) of places (n, d) on the cube's surface, at equal angles for equal distances there.

    Ronchi, Iacono and Paolucci 1996, J. Comput. Phys. 124. Zero vectors stay.
    """
    slopes = np.tan(np.pi / 4 * cube)
    return slopes / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-300)


def _sides(quads: NDArray[np.int64]) -> NDArray[np.int64]:
    """Edges (n, 2) that belong to one of the quadrilaterals (n, 4) only, in their sense of rotation."""
    edges = np.stack([quads, np.roll(quads, -1, axis=1)], axis=2).reshape(-1, 2)
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return edges[np.sort(first[count == 1])]


def _number(wanted: float) -> int:
    return max(1, int(np.floor(wanted + 0.5)))


def _element_size(phantom: deck.Cylinder | deck.Ellipsoid, cloud: deck.Cloud) -> float:
    """Where the cloud replaces all, it has its boundary nodes from the elements: they follow its spacing."""
    return cloud.spacing if phantom.cloud == "all" and cloud.spacing else phantom.element_size


def _filled(
    which: str,
    core: NDArray[np.bool_],
    points: NDArray[np.float64],
    hexahedra: NDArray[np.int64],
    node_sets: dict[str, NDArray[np.int64]],
    cloud: deck.Cloud,
    tumour: deck.Tumour | None,
    element_size: float,
) -> Mesh:
    """The mesh with the cloud that the deck asks for: "none", "core" or "all"."""
    if which == "none":
        return hexahedral_mesh(points, hexahedra, node_sets)
    if which == "all":
        dropped = np.ones(len(hexahedra), bool)
    elif tumour is None:
        dropped = core
    else:
        dropped = np.linalg.norm(points[hexahedra].mean(axis=1) - np.asarray(tumour.centre), axis=1) <= cloud.radius
    return with_cloud(points, hexahedra, dropped, node_sets, cloud, tumour, element_size)


def _check_room(tumour: deck.Tumour, axes: NDArray[np.float64], element_size: float) -> None:
    """The seed lies inside the ellipsoid, with an element's size around it."""
    centre, room = np.asarray(tumour.centre), tumour.seed_radius + element_size
    if room >= axes.min() or np.linalg.norm(centre / (axes - room)) > 1:
        raise InputError(
            f"tumour.centre = {in_millimetres(centre)}: seed and an element's size around it leave the ellipsoid; "
            "move it, or make tumour.seed_radius or ellipsoid.element_size smaller"
        )


def _fitted(
    outer: NDArray[np.float64],
    onion: _Onion,
    node_sets: dict[str, NDArray[np.int64]],
    tumour: deck.Tumour,
    element_size: float,
) -> Mesh:
    """Shells from the seed's surface, set tumour, to the ellipsoid's nodes `outer` (n, 3).

    Shells are _THICK times as thick as cells are wide, which widen with the distance to the centre, but at most an
    element's size: growth makes them thin and wide. Lines leave the seed at right angles and turn evenly towards their
    place on the surface.
    """
    centre, seed = np.asarray(tumour.centre), tumour.seed_radius
    growth = _THICK * np.sqrt(4 * np.pi / len(onion.faces))
    reach = np.linalg.norm(outer - centre, axis=1)
    even = max(element_size / growth, seed)  # from this distance on shells are equally thick
    ends = np.log(np.minimum(reach, even) / seed) / growth + np.maximum(reach - even, 0) / (growth * even)
    n = _number(np.ceil(ends.mean()))
    place = ends * np.arange(n + 1)[:, None] / n  # (shells, lines), in thicknesses
    turn = np.log(even / seed) / growth
    radius = np.where(
        place < turn, seed * np.exp(growth * np.minimum(place, turn)), even * (1 + growth * (place - turn))
    )
    share = ((radius - seed) / (reach - seed))[..., None]
    direction = (1 - share) * _on_sphere(onion.cube) + share * ((outer - centre) / reach[:, None])
    points = centre + radius[..., None] * direction / np.linalg.norm(direction, axis=2, keepdims=True)
    points[-1] = outer
    nodes = np.arange(points[..., 0].size).reshape(n + 1, -1)
    hexahedra = np.concatenate([nodes[:-1][:, onion.faces], nodes[1:][:, onion.faces]], axis=2).reshape(-1, 8)
    first = onion.surface[0]
    node_sets = {name: nodes[-1][members - first] for name, members in node_sets.items()} | {"tumour": nodes[0]}
    return hexahedral_mesh(points.reshape(-1, 3), hexahedra, node_sets)


def _moved(
    points: NDArray[np.float64],
    hexahedra: NDArray[np.int64],
    node_sets: dict[str, NDArray[np.int64]],
    axes: NDArray[np.float64],
    centre: NDArray[np.float64],
) -> Mesh:
    """A mesh that takes no notice of the seed: the hexahedron there is the cavity, its nodes the set tumour.

    The mesh is shifted, less and less towards the surface, so that the hexahedron has its middle in the centre.
    """
    middle = points[hexahedra].mean(axis=1)
    hole = int(np.linalg.norm(middle - centre, axis=1).argmin())
    for _ in range(30):  # to round-off: the error is squared by the elements' size over the ellipsoid's, about a tenth
        fade = 1 - ((points / axes) ** 2).sum(axis=1)
        shift = centre - points[hexahedra[hole]].mean(axis=0)
        points = points + (fade / fade[hexahedra[hole]].mean())[:, None] * shift
    node_sets = node_sets | {"tumour": np.sort(hexahedra[hole])}
    return hexahedral_mesh(points, np.delete(hexahedra, hole, axis=0), node_sets)
