"""Phantoms: cylinders and ellipsoids of hexahedra that follow the curved surface, with or without a cloud."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mpitled.errors import InputError
from mpitled.mesh import Bools, Floats, Ints, Mesh, check_size, hexahedral_mesh
from mpitled.meshing.cloud import build_cloud, near_centre
from mpitled.meshing.o_grid import OGrid, graded, on_sphere, shell_cells, whole_number
from mpitled.meshing.placement import format_position

if TYPE_CHECKING:
    from mpitled import deck

# Elements across the core over the ratio of radius to element size: the mean edge is then the element size.
_ACROSS = 1.1
# A layer at the end of the core does not belong to the core, independent of round-off.
_TIE = 1e-9
# Thickness over width of the cells in the shells around a seed.
_THICK = 1.5


def cylinder_mesh(
    cylinder: deck.Cylinder, cloud: deck.Cloud, tumour: deck.Tumour | None, spheres: Sequence[deck.Sphere] = ()
) -> Mesh:
    """The mesh of a cylinder along z from z = 0, an O-grid; its node sets are bottom, top, side and surface (all).

    A core cloud ends at the ring or layer nearest to `core_share` of radius and height. With a tumour, the core cloud
    replaces the hexahedra within `cloud.radius` of the tumour's centre. InputError if a tumour has no cloud or does not
    fit.
    """
    if tumour is not None and cylinder.cloud == "none":
        raise InputError('cylinder.cloud = "none": a tumour grows in a cloud; set it to "core" or "all"')
    size = _element_size(cylinder, cloud)
    check_size((np.pi * (cylinder.radius / size) ** 2 + 1) * (cylinder.height / size + 1), "cylinder.element_size")
    n = 2 * whole_number(_ACROSS * cylinder.radius / (2 * size))
    # In a cloud, surface nodes should be as evenly spaced as inner nodes.
    grading = 1.0 if cylinder.cloud == "all" else cylinder.grading
    o_grid = OGrid((n, n), cylinder.radius, size, grading)
    layers = whole_number(cylinder.height / size)
    flat = cylinder.radius * o_grid.points
    share = graded(layers, grading, both_ends=True)
    z = cylinder.height * share
    points = np.concatenate([np.tile(flat, (layers + 1, 1)), np.repeat(z, len(flat))[:, None]], axis=1)
    level = np.arange(layers)[:, None, None] * len(flat)
    hexahedra = np.concatenate([o_grid.cells + level, o_grid.cells + level + len(flat)], axis=2).reshape(-1, 8)

    nodes = np.arange(len(points)).reshape(layers + 1, -1)
    sides = {"bottom": nodes[0], "top": nodes[-1], "side": nodes[:, o_grid.surface].ravel()}
    node_sets = sides | {"surface": np.unique(np.concatenate(list(sides.values())))}
    inside = np.abs(share[1:] + share[:-1] - 1) < cylinder.core_share - _TIE
    inside[[0, -1]] = False
    core = (inside[:, None] & o_grid.core(cylinder.core_share)).ravel()
    return _filled(cylinder.cloud, core, points, hexahedra, node_sets, cloud, tumour, size, spheres)


def ellipsoid_mesh(
    ellipsoid: deck.Ellipsoid, cloud: deck.Cloud, tumour: deck.Tumour | None, spheres: Sequence[deck.Sphere] = ()
) -> Mesh:
    """The mesh of an ellipsoid around the origin: a cube-like core in shells of an equiangular cubed sphere.

    Let (p, q, r) = (x/a, y/b, z/c) and t = tan(pi/8). The node sets are surface, patch (r > 0, |p| <= t r, |q| <= t r
    on the surface) and fixed (r < 0, |p| <= -r, |q| <= -r on the surface). The numbers of elements are divisible by 4,
    so that patch and fixed end at element edges. A core cloud ends at the shell nearest to `core_share` of the
    semi-axes. With a tumour, the core cloud replaces the hexahedra within `cloud.radius` of the tumour's centre.
    Without a cloud, `cavity` chooses the mesh of the seed. InputError if a tumour does not fit.
    """
    axes, size = np.asarray(ellipsoid.semi_axes), _element_size(ellipsoid, cloud)
    # Estimates of the cells in the core and in the shells around it.
    across = _ACROSS * axes / size + 4
    shells = axes.prod() ** (1 / 3) / size * 2 * (across * np.roll(across, 1)).sum()
    check_size(float(across.prod() + shells) / 4, "ellipsoid.element_size")
    shape = np.array([4 * whole_number(_ACROSS * a / (4 * size)) for a in axes])
    if tumour is not None and ellipsoid.cloud == "none" and ellipsoid.cavity == "fitted":
        check_size((tumour.surface_nodes / 6) ** 1.5, "tumour.surface_nodes")
        shape = np.maximum(shape, 4 * whole_number(np.ceil((tumour.surface_nodes / 6) ** 0.5 / 4)))
    grading = 1.0 if ellipsoid.cloud == "all" else ellipsoid.grading
    o_grid = OGrid(tuple(shape), float(axes.prod() ** (1 / 3)), size, grading, lines=grading)
    node_sets = {
        "surface": o_grid.surface,
        "patch": o_grid.surface[(o_grid.cube[:, 2] == 1) & (np.abs(o_grid.cube[:, :2]) <= 0.5).all(axis=1)],
        "fixed": o_grid.surface[o_grid.cube[:, 2] == -1],
    }
    points = axes * o_grid.points
    if tumour is None or ellipsoid.cloud != "none":
        core = o_grid.core(ellipsoid.core_share)
        return _filled(ellipsoid.cloud, core, points, o_grid.cells, node_sets, cloud, tumour, size, spheres)
    _check_seed_fits(tumour, axes, size)
    if ellipsoid.cavity == "moved":
        return _moved(points, o_grid.cells, node_sets, axes, np.asarray(tumour.centre))
    return _fitted(points[o_grid.surface], o_grid, node_sets, tumour, size)


def _element_size(phantom: deck.Cylinder | deck.Ellipsoid, cloud: deck.Cloud) -> float:
    """The element size, m: the spacing of a cloud that replaces all elements, because their boundary nodes remain."""
    return cloud.spacing if phantom.cloud == "all" and cloud.spacing else phantom.element_size


def _filled(
    cloud_option: str,
    core: Bools,
    points: Floats,
    hexahedra: Ints,
    node_sets: dict[str, Ints],
    cloud: deck.Cloud,
    tumour: deck.Tumour | None,
    element_size: float,
    spheres: Sequence[deck.Sphere],
) -> Mesh:
    """The mesh with the cloud of the deck's option: "none", "core" or "all"."""
    if cloud_option == "none":
        return hexahedral_mesh(points, hexahedra, node_sets)
    if cloud_option == "all":
        core = np.ones(len(hexahedra), bool)
    elif tumour is not None:
        core = near_centre(points, hexahedra, tumour, cloud.radius)
    return build_cloud(points, hexahedra, core, node_sets, cloud, tumour, element_size, spheres).mesh


def _check_seed_fits(tumour: deck.Tumour, axes: Floats, element_size: float) -> None:
    """InputError unless the seed, with an element's size around it, lies inside the ellipsoid."""
    centre, needed = np.asarray(tumour.centre), tumour.seed_radius + element_size
    if needed >= axes.min() or np.linalg.norm(centre / (axes - needed)) > 1:
        raise InputError(
            f"tumour.centre = {format_position(centre)}: the seed and an element's size around it do not fit into the "
            "ellipsoid; move it, or make tumour.seed_radius or ellipsoid.element_size smaller"
        )


def _fitted(outer: Floats, o_grid: OGrid, node_sets: dict[str, Ints], tumour: deck.Tumour, element_size: float) -> Mesh:
    """Shells from the seed's surface (node set tumour) to the ellipsoid's surface nodes `outer` (n, 3).

    The width of cells grows with the distance to the centre. The thickness of a shell is _THICK times the width of its
    cells, because growth makes cells thin and wide, but at most an element's size. Lines are normal to the seed and
    turn evenly towards their nodes on the surface.
    """
    centre, seed = np.asarray(tumour.centre), tumour.seed_radius
    growth = _THICK * np.sqrt(4 * np.pi / len(o_grid.faces))
    reach = np.linalg.norm(outer - centre, axis=1)
    even = max(element_size / growth, seed)  # beyond this distance shells are equally thick
    ends = np.log(np.minimum(reach, even) / seed) / growth + np.maximum(reach - even, 0) / (growth * even)
    n = whole_number(np.ceil(ends.mean()))
    check_size(float(n) * len(o_grid.faces), "ellipsoid.element_size")
    thicknesses = ends * np.arange(n + 1)[:, None] / n  # (shells, lines), distance in multiples of the thickness
    turn = np.log(even / seed) / growth
    radius = np.where(
        thicknesses < turn,
        seed * np.exp(growth * np.minimum(thicknesses, turn)),
        even * (1 + growth * (thicknesses - turn)),
    )
    share = ((radius - seed) / (reach - seed))[..., None]
    direction = (1 - share) * on_sphere(o_grid.cube) + share * ((outer - centre) / reach[:, None])
    points = centre + radius[..., None] * direction / np.linalg.norm(direction, axis=2, keepdims=True)
    points[-1] = outer
    nodes = np.arange(points[..., 0].size).reshape(n + 1, -1)
    hexahedra = shell_cells(nodes, o_grid.faces)
    first = o_grid.surface[0]
    node_sets = {name: nodes[-1][members - first] for name, members in node_sets.items()} | {"tumour": nodes[0]}
    return hexahedral_mesh(points.reshape(-1, 3), hexahedra, node_sets)


def _moved(points: Floats, hexahedra: Ints, node_sets: dict[str, Ints], axes: Floats, centre: Floats) -> Mesh:
    """A mesh that does not follow the seed's surface: one hexahedron is the cavity, and its nodes are the set tumour.

    A shift that is zero on the surface moves the centre of this hexahedron to the tumour's centre.
    """
    middle = points[hexahedra].mean(axis=1)
    hole = int(np.linalg.norm(middle - centre, axis=1).argmin())
    for _ in range(30):  # to round-off: each iteration reduces the error to about a tenth
        fade = 1 - ((points / axes) ** 2).sum(axis=1)
        shift = centre - points[hexahedra[hole]].mean(axis=0)
        points = points + (fade / fade[hexahedra[hole]].mean())[:, None] * shift
    node_sets = node_sets | {"tumour": np.sort(hexahedra[hole])}
    return hexahedral_mesh(points, np.delete(hexahedra, hole, axis=0), node_sets)
