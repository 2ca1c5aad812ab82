"""Blocks: regular hexahedra or hexahedra fitted to a sphere, with a cloud in the core or everywhere, or without one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mpitled.errors import InputError
from mpitled.mesh import Bools, Floats, Ints, Mesh, check_size, grid_points, hexahedral_mesh, structured_hexahedra
from mpitled.meshing.cloud import build_cloud, near_centre
from mpitled.meshing.o_grid import OGrid, shell_cells, whole_number
from mpitled.meshing.placement import format_position

if TYPE_CHECKING:
    from mpitled import deck

# A centre that is nearer to a face than this share of the block's size lies in the face.
_NEAR = 1e-9


def block_mesh(
    block: deck.Block,
    cloud: deck.Cloud,
    tumour: deck.Tumour | None,
    fitted: deck.Sphere | None = None,
    spheres: Sequence[deck.Sphere] = (),
) -> Mesh:
    """The mesh of a block. The node sets x0, x1, y0, y1, z0, z1 are its faces, and surface is all of them.

    A core cloud replaces about `core_share` of the hexahedra along each side, in the middle or around the fitted
    sphere. With a tumour, a core cloud replaces the hexahedra within `cloud.radius` of the tumour's centre. `spheres`
    divide the cloud into parts. InputError if a tumour has no cloud, or if a tumour or sphere does not fit.
    """
    if tumour is not None and block.cloud == "none":
        raise InputError('block.cloud = "none": a tumour grows in a cloud; set it to "core" or "all"')
    corner, size, shape = np.asarray(block.corner), np.asarray(block.size, float), np.asarray(block.elements, np.int64)
    if block.cloud == "all" and cloud.spacing:
        # The boundary nodes of the replaced elements remain in the cloud, so the elements follow its spacing.
        wanted = np.maximum(np.rint(size / cloud.spacing), 1)
        check_size(float(wanted.prod()), "cloud.spacing")
        shape = wanted.astype(np.int64)
    nx, ny, nz = shape.tolist()
    check_size(float(np.prod(shape, dtype=float)), "block.elements")
    if fitted:
        local, hexahedra, core = _fitted(size, shape, np.asarray(fitted.centre) - corner, fitted, block.core_share)
    else:
        local = grid_points((nx, ny, nz), (size[0], size[1], size[2]))
        hexahedra = structured_hexahedra((nx, ny, nz))
        core = _inner(shape, block.core_share)
    on_face = [local == 0, local == size]
    node_sets = {f"{axis}{end}": np.flatnonzero(on_face[end][:, i]) for i, axis in enumerate("xyz") for end in (0, 1)}
    surface = node_sets["surface"] = np.unique(np.concatenate(list(node_sets.values())))

    if block.cloud == "none":
        return hexahedral_mesh(corner + local, hexahedra, node_sets)
    if block.cloud == "all":
        if not fitted:
            # Nodes move along faces and edges only, so the volume does not change.
            free = ~(on_face[0] | on_face[1])[surface]
            shift = np.random.default_rng([cloud.seed, 2]).uniform(-0.5, 0.5, free.shape) * cloud.irregularity
            local[surface] += np.where(free, shift * size / shape, 0.0)
        core = np.ones(len(hexahedra), bool)
    elif tumour is not None:
        core = near_centre(corner + local, hexahedra, tumour, cloud.radius)
    element_size = float((size.prod() / len(hexahedra)) ** (1 / 3))
    return build_cloud(corner + local, hexahedra, core, node_sets, cloud, tumour, element_size, spheres).mesh


def _inner(shape: Ints, share: float) -> Bools:
    """Hexahedra in the middle of a grid, with equal margins of at least one hexahedron on all sides."""
    margin = np.maximum(np.floor((1 - share) / 2 * shape + 0.5), 1)
    cell = np.indices(tuple(shape[::-1])).reshape(3, -1)[::-1].T
    return ((cell >= margin) & (cell < shape - margin)).all(axis=1)


def _fitted(size: Floats, shape: Ints, centre: Floats, sphere: deck.Sphere, share: float) -> tuple[Floats, Ints, Bools]:
    """Nodes (n, 3), m, in the block [0, size], hexahedra (m, 8), and a mask (m,) of the core.

    The ball is an O-grid. Between ball and faces, the thickness of layers grows with the width of their cells. The core
    ends at `share` of the distances to the faces. If the centre lies in a face, the block and its mirror image are
    meshed, and the mirror image is removed.
    """
    low_face, high_face = (np.abs(centre - end) < _NEAR * size for end in (0, size))
    centre = np.where(low_face, 0.0, np.where(high_face, size, centre))
    low, high = np.where(high_face | ~low_face, 0.0, -size), np.where(high_face, 2 * size, size)
    distances, shape = np.minimum(centre - low, high - centre), np.where(low_face | high_face, 2, 1) * shape
    if (distances <= sphere.radius).any():
        raise InputError(
            f"block.fitted: the sphere {sphere.name} around {format_position(np.asarray(sphere.centre))} does not lie "
            "in the block, with its centre inside or in a face; move it or make it smaller"
        )
    width = np.pi / 2 * sphere.radius / shape.mean()
    o_grid = OGrid(tuple(shape), sphere.radius, width)
    inner, outer = sphere.radius * o_grid.points, low + (o_grid.cube + 1) / 2 * (high - low) - centre
    start = inner[o_grid.surface]
    ratio = ((high - low) / shape).mean() / width
    growth = max(np.log(ratio), _NEAR)
    n = whole_number(np.linalg.norm(outer - start, axis=1).mean() / width * growth / np.expm1(growth))
    along = np.expm1(growth * np.arange(1, n + 1) / n)[:, None, None] / np.expm1(growth)
    layers = (1 - along) * start + along * outer
    nodes = np.concatenate([o_grid.surface, len(inner) + np.arange(n * len(start))]).reshape(n + 1, -1)
    points = np.concatenate([inner, layers.reshape(-1, 3)])
    hexahedra = np.concatenate([o_grid.cells, shell_cells(nodes, o_grid.faces)])

    core = (np.abs(points[hexahedra].mean(axis=1)) <= share * distances).all(axis=1)
    core[-len(o_grid.faces) :] = False
    points = points + centre
    for face in (np.zeros(3), size):
        points = np.where(np.abs(points - face) < _NEAR * size, face, points)
    middle = points[hexahedra].mean(axis=1)
    kept = ((middle > 0) & (middle < size)).all(axis=1)
    used, cells = np.unique(hexahedra[kept], return_inverse=True)
    return points[used], cells.reshape(-1, 8), core[kept]
