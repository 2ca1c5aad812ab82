"""Phantoms: cylinders and ellipsoids of hexahedra that follow the curved surface, with a cloud in their core or not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mpitled.errors import InputError
from mpitled.mesh import Mesh, check_size, hexahedral_mesh
from mpitled.meshing.cloud import in_millimetres, with_cloud
from mpitled.meshing.o_grid import Onion, graded, number, on_sphere

if TYPE_CHECKING:
    from mpitled import deck

# Elements over the core's width for each element's size in the radius, so that the mean edge is the size asked for.
_ACROSS = 1.1
# A layer or shell whose middle lies at the end of the core but for round-off stays out of it.
_TIE = 1e-9
# Thickness over width of the shells around a seed.
_THICK = 1.5


def cylinder_mesh(
    cylinder: deck.Cylinder, cloud: deck.Cloud, tumour: deck.Tumour | None, spheres: Sequence[deck.Sphere] = ()
) -> Mesh:
    """The mesh of a cylinder along z from z = 0, a square core in rings: sets bottom, top, side and, together, surface.

    A core cloud ends at the ring or layer next to `core_share` of radius and height, or, with a tumour, takes the
    hexahedra within `cloud.radius` of its centre. InputError for a tumour without a cloud or without room.
    """
    if tumour is not None and cylinder.cloud == "none":
        raise InputError('cylinder.cloud = "none": a tumour grows in a cloud; set it to "core" or "all"')
    size = _element_size(cylinder, cloud)
    check_size((np.pi * (cylinder.radius / size) ** 2 + 1) * (cylinder.height / size + 1), "cylinder.element_size")
    n = 2 * number(_ACROSS * cylinder.radius / (2 * size))
    # In a cloud there are no layers, and nodes on its surface should lie as those in it: evenly.
    grading = 1.0 if cylinder.cloud == "all" else cylinder.grading
    onion = Onion((n, n), cylinder.radius, size, grading)
    layers = number(cylinder.height / size)
    flat = cylinder.radius * onion.points
    share = graded(layers, grading, both_ends=True)
    z = cylinder.height * share
    points = np.concatenate([np.tile(flat, (layers + 1, 1)), np.repeat(z, len(flat))[:, None]], axis=1)
    level = np.arange(layers)[:, None, None] * len(flat)
    hexahedra = np.concatenate([onion.cells + level, onion.cells + level + len(flat)], axis=2).reshape(-1, 8)

    nodes = np.arange(len(points)).reshape(layers + 1, -1)
    sides = {"bottom": nodes[0], "top": nodes[-1], "side": nodes[:, onion.surface].ravel()}
    node_sets = sides | {"surface": np.unique(np.concatenate(list(sides.values())))}
    inside = np.abs(share[1:] + share[:-1] - 1) < cylinder.core_share - _TIE
    inside[[0, -1]] = False
    core = (inside[:, None] & onion.core(cylinder.core_share)).ravel()
    return _filled(cylinder.cloud, core, points, hexahedra, node_sets, cloud, tumour, size, spheres)


def ellipsoid_mesh(
    ellipsoid: deck.Ellipsoid, cloud: deck.Cloud, tumour: deck.Tumour | None, spheres: Sequence[deck.Sphere] = ()
) -> Mesh:
    """The mesh of an ellipsoid around the origin: a cube-like core in shells of an equiangular cubed sphere.

    Sets are surface and, where with (p, q, r) = (x/a, y/b, z/c) on it r > 0, |p| <= t r, |q| <= t r, t = tan(pi/8),
    patch; where r < 0, |p| <= -r, |q| <= -r, fixed. The numbers of elements are divisible by 4, so that both end
    with elements. A core cloud ends at the shell next to `core_share` of the semi-axes, or, with a tumour, takes the
    hexahedra within `cloud.radius` of its centre. Without a cloud, `cavity` says how a tumour has its seed.
    InputError for a tumour without room.
    """
    axes, size = np.asarray(ellipsoid.semi_axes), _element_size(ellipsoid, cloud)
    # The core, and the shells around it.
    across = _ACROSS * axes / size + 4
    shells = axes.prod() ** (1 / 3) / size * 2 * (across * np.roll(across, 1)).sum()
    check_size(float(across.prod() + shells) / 4, "ellipsoid.element_size")
    shape = np.array([4 * number(_ACROSS * a / (4 * size)) for a in axes])
    if tumour is not None and ellipsoid.cloud == "none" and ellipsoid.cavity == "fitted":
        check_size((tumour.surface_nodes / 6) ** 1.5, "tumour.surface_nodes")
        shape = np.maximum(shape, 4 * number(np.ceil((tumour.surface_nodes / 6) ** 0.5 / 4)))
    grading = 1.0 if ellipsoid.cloud == "all" else ellipsoid.grading
    onion = Onion(tuple(shape), float(axes.prod() ** (1 / 3)), size, grading, lines=grading)
    node_sets = {
        "surface": onion.surface,
        "patch": onion.surface[(onion.cube[:, 2] == 1) & (np.abs(onion.cube[:, :2]) <= 0.5).all(axis=1)],
        "fixed": onion.surface[onion.cube[:, 2] == -1],
    }
    points = axes * onion.points
    if tumour is None or ellipsoid.cloud != "none":
        core = onion.core(ellipsoid.core_share)
        return _filled(ellipsoid.cloud, core, points, onion.cells, node_sets, cloud, tumour, size, spheres)
    _check_room(tumour, axes, size)
    if ellipsoid.cavity == "moved":
        return _moved(points, onion.cells, node_sets, axes, np.asarray(tumour.centre))
    return _fitted(points[onion.surface], onion, node_sets, tumour, size)


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
    spheres: Sequence[deck.Sphere],
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
    return with_cloud(points, hexahedra, dropped, node_sets, cloud, tumour, element_size, spheres)


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
    onion: Onion,
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
    n = number(np.ceil(ends.mean()))
    check_size(float(n) * len(onion.faces), "ellipsoid.element_size")
    place = ends * np.arange(n + 1)[:, None] / n  # (shells, lines), in thicknesses
    turn = np.log(even / seed) / growth
    radius = np.where(
        place < turn, seed * np.exp(growth * np.minimum(place, turn)), even * (1 + growth * (place - turn))
    )
    share = ((radius - seed) / (reach - seed))[..., None]
    direction = (1 - share) * on_sphere(onion.cube) + share * ((outer - centre) / reach[:, None])
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
