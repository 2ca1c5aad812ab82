"""A block of equal hexahedra, with a cloud of EFG nodes as its core, instead of all of it, or not at all."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mpitled.cloud import with_cloud
from mpitled.errors import InputError
from mpitled.mesh import Mesh, grid_points, hexahedral_mesh, structured_hexahedra

if TYPE_CHECKING:
    from mpitled import deck


def block_mesh(block: deck.Block, cloud: deck.Cloud, tumour: deck.Tumour | None) -> Mesh:
    """The mesh of a block with its faces as node sets x0, x1, y0, y1, z0, z1 and, together, surface.

    A core cloud takes about `core_share` of the hexahedra along each side, in the middle, or, with a tumour,
    those within `cloud.radius` of its centre. Raises InputError for a tumour without a cloud or without room.
    """
    if tumour is not None and block.cloud == "none":
        raise InputError('block.cloud = "none": a tumour grows in a cloud; set it to "core" or "all"')
    size, shape = np.asarray(block.size, float), np.asarray(block.elements, np.int64)
    if block.cloud == "all" and cloud.spacing:
        # The cloud has its boundary nodes from the elements that it replaces: they follow its spacing.
        shape = np.maximum(np.rint(size / cloud.spacing), 1).astype(np.int64)
    nx, ny, nz = (int(n) for n in shape)
    points = np.asarray(block.corner) + grid_points((nx, ny, nz), (size[0], size[1], size[2]))
    hexahedra = structured_hexahedra((nx, ny, nz))
    index = np.indices((nz + 1, ny + 1, nx + 1)).reshape(3, -1)[::-1].T
    node_sets = {
        f"{axis}{end}": np.flatnonzero(index[:, i] == end * shape[i]) for i, axis in enumerate("xyz") for end in (0, 1)
    }
    surface = node_sets["surface"] = np.unique(np.concatenate(list(node_sets.values())))

    if block.cloud == "none":
        return hexahedral_mesh(points, hexahedra, node_sets)
    if block.cloud == "all":
        # Along faces and edges only: no node leaves a face, no corner moves, and the volume stays.
        free = (index[surface] > 0) & (index[surface] < shape)
        shift = np.random.default_rng([cloud.seed, 2]).uniform(-0.5, 0.5, free.shape) * cloud.irregularity
        points[surface] += np.where(free, shift * size / shape, 0.0)
        dropped = np.ones(len(hexahedra), bool)
    elif tumour is None:
        # Equal margins of whole hexahedra on both sides, at least one.
        margin = np.maximum(np.floor((1 - block.core_share) / 2 * shape + 0.5), 1)
        cell = np.indices((nz, ny, nx)).reshape(3, -1)[::-1].T
        dropped = ((cell >= margin) & (cell < shape - margin)).all(axis=1)
    else:
        middle = points[hexahedra].mean(axis=1)
        dropped = np.linalg.norm(middle - np.asarray(tumour.centre), axis=1) <= cloud.radius
    return with_cloud(points, hexahedra, dropped, node_sets, cloud, tumour, float((size / shape).prod() ** (1 / 3)))
