"""A block of hexahedra, equal or fitted to a sphere, with a cloud of EFG nodes as its core, for all of it, or none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mpitled.errors import InputError
from mpitled.mesh import Mesh, check_size, grid_points, hexahedral_mesh, structured_hexahedra
from mpitled.meshing.cloud import in_millimetres, with_cloud
from mpitled.meshing.o_grid import Onion, number

if TYPE_CHECKING:
    from mpitled import deck

# A sphere's centre this near to a face, as a share of the block's size, lies in it.
_NEAR = 1e-9


def block_mesh(
    block: deck.Block,
    cloud: deck.Cloud,
    tumour: deck.Tumour | None,
    fitted: deck.Sphere | None = None,
    spheres: Sequence[deck.Sphere] = (),
) -> Mesh:
    """The mesh of a block with its faces as node sets x0, x1, y0, y1, z0, z1 and, together, surface.

    A core cloud takes about `core_share` of the hexahedra along each side, in the middle or, where they are fitted to a
    sphere, around it; with a tumour, those within `cloud.radius` of its centre. `spheres` divide the cloud in parts.
    Raises InputError for a tumour without a cloud, or for a tumour or sphere without room.
    """
    if tumour is not None and block.cloud == "none":
        raise InputError('block.cloud = "none": a tumour grows in a cloud; set it to "core" or "all"')
    corner, size, shape = np.asarray(block.corner), np.asarray(block.size, float), np.asarray(block.elements, np.int64)
    if block.cloud == "all" and cloud.spacing:
        # The cloud has its boundary nodes from the elements that it replaces: they follow its spacing.
        wanted = np.maximum(np.rint(size / cloud.spacing), 1)
        check_size(float(wanted.prod()), "cloud.spacing")
        shape = wanted.astype(np.int64)
    check_size(float(np.prod(shape, dtype=float)), "block.elements")
    if fitted:
        places, hexahedra, core = _fitted(size, shape, np.asarray(fitted.centre) - corner, fitted, block.core_share)
    else:
        places = grid_points((int(shape[0]), int(shape[1]), int(shape[2])), (size[0], size[1], size[2]))
        hexahedra = structured_hexahedra((int(shape[0]), int(shape[1]), int(shape[2])))
        core = _inner(shape, block.core_share)
    on_face = [places == 0, places == size]
    node_sets = {f"{axis}{end}": np.flatnonzero(on_face[end][:, i]) for i, axis in enumerate("xyz") for end in (0, 1)}
    surface = node_sets["surface"] = np.unique(np.concatenate(list(node_sets.values())))

    if block.cloud == "none":
        return hexahedral_mesh(corner + places, hexahedra, node_sets)
    if block.cloud == "all":
        if not fitted:
            # Along faces and edges only: no node leaves a face, no corner moves, and the volume stays.
            free = ~(on_face[0] | on_face[1])[surface]
            shift = np.random.default_rng([cloud.seed, 2]).uniform(-0.5, 0.5, free.shape) * cloud.irregularity
            places[surface] += np.where(free, shift * size / shape, 0.0)
        dropped = np.ones(len(hexahedra), bool)
    elif tumour is None:
        dropped = core
    else:
        middle = corner + places[hexahedra].mean(axis=1)
        dropped = np.linalg.norm(middle - np.asarray(tumour.centre), axis=1) <= cloud.radius
    element_size = float((size.prod() / len(hexahedra)) ** (1 / 3))
    return with_cloud(corner + places, hexahedra, dropped, node_sets, cloud, tumour, element_size, spheres)


def _inner(shape: NDArray[np.int64], share: float) -> NDArray[np.bool_]:
    """The hexahedra of a grid in its middle: equal margins of whole hexahedra on both sides, at least one."""
    margin = np.maximum(np.floor((1 - share) / 2 * shape + 0.5), 1)
    cell = np.indices(tuple(shape[::-1])).reshape(3, -1)[::-1].T
    return ((cell >= margin) & (cell < shape - margin)).all(axis=1)


def _fitted(
    size: NDArray[np.float64],
    shape: NDArray[np.int64],
    centre: NDArray[np.float64],
    sphere: deck.Sphere,
    share: float,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Nodes (n, 3) in the block [0, size], hexahedra (m, 8), and which lie within that share of the ways to the faces.

    A ball (see `Onion`), and layers from it to the faces which widen with the distance as cells do. If the centre lies
    in a face, the mesh is that part of the one of the block with its mirror image.
    """
    low_face, high_face = (np.abs(centre - end) < _NEAR * size for end in (0, size))
    centre = np.where(low_face, 0.0, np.where(high_face, size, centre))
    low, high = np.where(high_face | ~low_face, 0.0, -size), np.where(high_face, 2 * size, size)
    ways, whole = np.minimum(centre - low, high - centre), np.where(low_face | high_face, 2, 1) * shape
    if (ways <= sphere.radius).any():
        raise InputError(
            f"block.fitted: the sphere {sphere.name} around {in_millimetres(np.asarray(sphere.centre))} does not lie "
            "in the block, with its centre inside or in a face; move it or make it smaller"
        )
    width = np.pi / 2 * sphere.radius / whole.mean()
    onion = Onion(tuple(whole), sphere.radius, width)
    inner, outer = sphere.radius * onion.points, low + (onion.cube + 1) / 2 * (high - low) - centre
    start = inner[onion.surface]
    ratio = ((high - low) / whole).mean() / width
    growth = max(np.log(ratio), _NEAR)
    n = number(np.linalg.norm(outer - start, axis=1).mean() / width * growth / np.expm1(growth))
    along = np.expm1(growth * np.arange(1, n + 1) / n)[:, None, None] / np.expm1(growth)
    layers = (1 - along) * start + along * outer
    nodes = np.concatenate([onion.surface, len(inner) + np.arange(n * len(start))]).reshape(n + 1, -1)
    around = np.concatenate([nodes[:-1][:, onion.faces], nodes[1:][:, onion.faces]], axis=2).reshape(-1, 8)
    places, hexahedra = np.concatenate([inner, layers.reshape(-1, 3)]), np.concatenate([onion.cells, around])

    core = (np.abs(places[hexahedra].mean(axis=1)) <= share * ways).all(axis=1)
    core[-len(onion.faces) :] = False
    places = places + centre
    for face in (np.zeros(3), size):
        places = np.where(np.abs(places - face) < _NEAR * size, face, places)
    middle = places[hexahedra].mean(axis=1)
    kept = ((middle > 0) & (middle < size)).all(axis=1)
    used, cells = np.unique(hexahedra[kept], return_inverse=True)
    return places[used], cells.reshape(-1, 8), core[kept]
