"""The solids of one mesh file: checks, hexahedra, and integration cells of any kind."""

from __future__ import annotations

import numpy as np

from mpitled.cells import hexahedra
from mpitled.errors import InputError
from mpitled.mesh import Bools, Floats, Ints
from mpitled.meshing import checks
from mpitled.meshing.integration_cells import volumes_and_centroids
from mpitled.readers import abaqus, meshfile
from mpitled.readers.meshfile import MeshFile

#: Each solid as a hexahedron with coinciding corners, with exact volume and centroid.
AS_HEXAHEDRON = {
    "hexahedron": [0, 1, 2, 3, 4, 5, 6, 7],
    "wedge": [0, 1, 2, 2, 3, 4, 5, 5],
    "pyramid": [0, 1, 2, 3, 4, 4, 4, 4],
    "tetrahedron": [0, 1, 2, 2, 3, 3, 3, 3],
}


def check_solids(file: MeshFile) -> None:
    """InputError if the file has no nodes, elements but no solids, repeated solids, or unsupported parts."""
    if len(file.points) == 0:
        raise InputError(f"{file.path}: has no nodes; give a mesh")
    if file.cells and not any(block.kind != "other" or abaqus.is_solid(block.type) for block in file.cells):
        kinds = {block.type: block.origin.rpartition(": ")[2] for block, _ in file.blocks()}
        found = meshfile.listed(f"{kind} ({line})" for kind, line in kinds.items())
        raise InputError(f"{file.path}: has no solid elements; its elements are {found}")
    if file.refused:
        more = f" ({len(file.refused) - 1} more such)" if len(file.refused) > 1 else ""
        raise InputError(file.refused[0] + more)
    for kind in meshfile.SOLIDS:
        blocks = list(file.blocks(kind))
        if not blocks:
            continue
        nodes = blocks[0][0].nodes if len(blocks) == 1 else np.concatenate([block.nodes for block, _ in blocks])
        rows = np.concatenate([rows for _, rows in blocks])
        again, before = checks.repeated(nodes)
        if len(again):
            (block, number), (_, first) = (file.element(int(rows[repeat[0]])) for repeat in (again, before))
            raise InputError(
                f"{block.origin}: element {number} has the same nodes as element {first}, and would count twice "
                f"({len(again)} such); take one of the two out"
            )


def check_cloud(file: MeshFile) -> list[str]:
    """Remarks about a file that can only be an EFG file; InputError if a cell is flat."""
    remarks = leave_out_others(file)
    corners, parents = solid_corners(file, file.points)
    if len(corners):
        integration_cells(corners, file, parents)
    if len(repeated := checks.coincident(file.points, 0.0)):
        remarks.append(f"warning: {file.path}: {len(repeated)} nodes lie where another one does")
    return remarks


def leave_out_others(file: MeshFile) -> list[str]:
    """Remarks about shells, beams and similar elements, which are left out.

    A cell set of such elements becomes a node set of the solids. InputError if elements with a section share nodes with
    a solid.
    """
    solid, remarks = has_solid(file), []
    structural, is_other = np.zeros(file.n_cells, bool), np.zeros(file.n_cells, bool)
    for name in file.structural:
        structural[file.cell_sets[name]] = True
    for block, rows in file.blocks("other"):
        is_other[rows] = True
        touching = (solid[block.nodes] & (block.nodes >= 0)).any(axis=1)
        if bad := np.count_nonzero(touching & structural[rows]):
            raise InputError(
                f"{block.origin}: {bad} elements of type {block.type} with a section share nodes with the solid; "
                "they cannot be computed, take them out"
            )
        kind = "without a section" if touching.all() else "not attached to the solid"
        remarks.append(f"{block.origin}: {len(block.ids)} elements of type {block.type}, {kind}, are left out")
    for name, members in file.cell_sets.items():
        if len(members) and is_other[members].all():
            nodes = file.nodes_of(members)
            nodes = nodes[solid[nodes]]
            if len(nodes) and name not in file.node_sets:
                file.node_sets[name] = nodes
    return remarks


def has_solid(file: MeshFile) -> Bools:
    """Mask (n_nodes,) of nodes that belong to a solid."""
    used = np.zeros(len(file.points), bool)
    for block, _ in file.blocks(*meshfile.SOLIDS):
        used[block.nodes] = True
    return used


def read_hexahedra(file: MeshFile, points: Floats, chosen: Bools, repair: bool) -> tuple[Ints, Ints, list[str]]:
    """Hexahedra (n, 8) in rows of `points`, the rows (n,) of their elements in the file, and remarks.

    InputError if there are other solids among the `chosen` elements (mask, n_cells), or inverted or flat hexahedra.
    With `repair`, the nodes of hexahedra are reordered if this makes the hexahedra valid.
    """
    for block, rows in file.blocks("tetrahedron", "wedge", "pyramid"):
        if n := np.count_nonzero(chosen[rows]):
            raise InputError(
                f"{block.origin}: {n} elements of type {block.type} in the FE mesh; only hexahedra can be computed: "
                "mesh with them, or name the set in mesh.dropped"
            )
    blocks = [(rows[chosen[rows]], block.nodes[chosen[rows]]) for block, rows in file.blocks("hexahedron")]
    if not blocks:
        return np.empty((0, 8), np.int64), np.empty(0, np.int64), []
    parents, cells = blocks[0] if len(blocks) == 1 else (np.concatenate(arrays) for arrays in zip(*blocks, strict=True))
    del blocks
    remarks = []
    invalid, poor = hexahedra.check(points, cells)
    if len(invalid):
        reordered = checks.reordered(points, cells, invalid)
        repairable = reordered[:, 0] >= 0
        hint = "correct the mesh"
        if repair:
            cells = cells.copy()
            cells[invalid[repairable]] = reordered[repairable]
            if repairable.any():
                remarks.append(f"{file.path}: nodes of {np.count_nonzero(repairable)} hexahedra put in order")
            invalid = invalid[~repairable]
        elif repairable.any():
            n = np.count_nonzero(repairable)
            hint = f"{n} have their nodes in another order, which mesh.repair = true corrects"
        if len(invalid):
            block, number = file.element(int(parents[invalid[0]]))
            raise InputError(
                f"{block.origin}: {len(invalid)} hexahedra are inverted or flat, the first is element {number}; {hint}"
            )
    if len(poor):
        block, number = file.element(int(parents[poor[0]]))
        remarks.append(
            f"warning: {block.origin}: {len(poor)} hexahedra have a flat or inverted corner, the first is {number}"
        )
    return cells, parents, remarks


def solid_corners(file: MeshFile, points: Floats, chosen: Bools | None = None) -> tuple[Floats, Ints]:
    """Corners (n, 8, 3) of the chosen solids (mask, n_cells) as hexahedra, and the rows (n,) of their elements."""
    corners, parents = [np.empty((0, 8, 3))], [np.empty(0, np.int64)]
    for block, rows in file.blocks(*meshfile.SOLIDS):
        mask = chosen[rows] if chosen is not None else np.ones(len(rows), bool)
        corners.append(points[block.nodes[mask][:, AS_HEXAHEDRON[block.kind]]])
        parents.append(rows[mask])
    return np.concatenate(corners), np.concatenate(parents)


def integration_cells(corners: Floats, file: MeshFile, parents: Ints) -> tuple[Floats, Floats]:
    """Volumes (n,) and centroids (n, 3) of cells (n, 8, 3) with either orientation; InputError if one is flat."""
    with np.errstate(divide="ignore", invalid="ignore"):
        volumes, centroids = volumes_and_centroids(corners)
    volumes = np.abs(volumes)
    bad = np.flatnonzero(~(volumes > 1e-9 * np.median(volumes)))
    if len(bad):
        block, number = file.element(int(parents[bad[0]]))
        raise InputError(
            f"{block.origin}: {len(bad)} integration cells are inverted or flat, the first in element {number}; "
            "correct the mesh"
        )
    return volumes, centroids
