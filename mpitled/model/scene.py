"""The mesh of a deck, and names of its sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mpitled.deck import Deck, Sphere
from mpitled.errors import InputError
from mpitled.mesh import Mesh
from mpitled.meshing import block, labels, phantoms
from mpitled.meshing.placement import in_sphere

#: Node set of the surface of the tumour's seed.
TUMOUR = "tumour"
#: Node sets of the outer surface.
OUTER = ("skull", "surface")


def read_mesh(deck: Deck) -> Mesh:
    """The mesh of a deck's geometry section, with cell sets for its spheres. InputError if it cannot be meshed."""
    try:
        mesh = _geometry(deck)
    except InputError as error:
        if deck.mesh:  # the message names the mesh file
            raise
        raise InputError(f"{deck.path}: {error}") from None
    if not deck.spheres:
        return mesh
    midpoints = centroids(mesh)
    cell_sets = dict(mesh.cell_sets)
    meshed = _meshed_spheres(deck)
    for sphere in deck.spheres:
        origin = f"{deck.path}: sphere.{sphere.name}"
        if sphere.name in cell_sets:
            raise InputError(f"{origin}: there is a cell set of that name already; give it another")
        inside = in_sphere(midpoints, sphere)
        for part in mesh.parts if sphere in meshed else ():
            inside[len(mesh.hexahedra) + part.integration_points] = sphere.name in part.spheres
        if not inside.any():
            raise InputError(f"{origin}: no cell has its middle in it; move or enlarge it, or make the cells smaller")
        cell_sets[sphere.name] = np.flatnonzero(inside)
    return replace(mesh, cell_sets=cell_sets)


def members(mesh: Mesh, name: str) -> NDArray[np.int64]:
    """Nodes of a set; none if there is no such set."""
    return mesh.node_sets.get(name, np.empty(0, np.int64))


def centroids(mesh: Mesh) -> NDArray[np.float64]:
    """Midpoints of hexahedra and positions of integration points, (n_cells, 3), m."""
    # The middle of one diagonal: the corners of all cells would be the largest array while a model is built.
    of_hexahedra = (mesh.points[mesh.hexahedra[:, 0]] + mesh.points[mesh.hexahedra[:, 6]]) / 2
    return np.concatenate([of_hexahedra, mesh.integration_points])


def _meshed_spheres(deck: Deck) -> list[Sphere]:
    """The spheres with a separate material: the mesh follows their surfaces."""
    filled = {name for section in deck.materials for name in section.cells if len(deck.materials) > 1}
    return [sphere for sphere in deck.spheres if sphere.name in filled]


def _geometry(deck: Deck) -> Mesh:
    spheres = _meshed_spheres(deck)
    if deck.labels:
        return labels.mesh_labels(deck.labels, deck.cloud, deck.tumour, spheres)
    if deck.block:
        fitted = next((sphere for sphere in deck.spheres if sphere.name == deck.block.fitted), None)
        return block.block_mesh(deck.block, deck.cloud, deck.tumour, fitted, spheres)
    if deck.cylinder:
        return phantoms.cylinder_mesh(deck.cylinder, deck.cloud, deck.tumour, spheres)
    if deck.ellipsoid:
        return phantoms.ellipsoid_mesh(deck.ellipsoid, deck.cloud, deck.tumour, spheres)
    assert deck.mesh is not None  # load_deck guarantees exactly one geometry section
    from mpitled.readers import meshes

    seed_volume = 4 / 3 * np.pi * deck.tumour.seed_radius**3 if deck.tumour else 0.0
    return meshes.read_mesh(deck.mesh, seed_volume)
