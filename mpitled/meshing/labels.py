"""The mesh of a label image of a head: hexahedra of tissue and ventricles and, around a tumour, the cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from mpitled.errors import InputError
from mpitled.mesh import Floats, Mesh, hexahedral_mesh
from mpitled.meshing.cloud import build_cloud
from mpitled.meshing.head import Grid, Head, voxelise
from mpitled.meshing.label_image import VENTRICLES, Mask, largest_piece, piece_at
from mpitled.meshing.placement import format_length, format_position, unit_hint

if TYPE_CHECKING:
    from mpitled import deck


def mesh_labels(
    labels: deck.Labels, cloud: deck.Cloud, tumour: deck.Tumour | None, spheres: Sequence[deck.Sphere] = ()
) -> Mesh:
    """The mesh of a label image: one face-connected solid of cubes without non-manifold edges or vertices.

    Each label keeps its volume. Each ventricle is one face-connected piece that does not touch the outer surface. With
    a tumour the tissue within `cloud.radius` of its centre becomes a cloud. InputError if the file is no label image,
    if labels are missing, or if the tumour lies outside the tissue.
    """
    head = voxelise(labels)
    points, hexahedra = head.grid.hexahedra(head.solid)
    in_cells = {name: np.flatnonzero(mask[head.solid]) for name, mask in head.parts.items()}
    node_sets = {name: np.unique(hexahedra[cells]) for name, cells in in_cells.items() if name != "tissue"}
    # The solid has no cavities: a node with fewer than eight cubes lies on the outer surface.
    node_sets["skull"] = np.flatnonzero(np.bincount(hexahedra.ravel()) < 8)
    remaining = head.solid
    if tumour is None:
        mesh = hexahedral_mesh(points, hexahedra, node_sets)
    else:
        void = _void(head, cloud.radius, np.asarray(tumour.centre, float), tumour.seed_radius + head.grid.size)
        remaining = head.solid & ~void
        mesh = build_cloud(points, hexahedra, void[head.solid], node_sets, cloud, tumour, head.grid.size, spheres).mesh
    cell_sets = {name: np.flatnonzero(mask[remaining]) for name, mask in head.parts.items()}
    cell_sets["tissue"] = np.append(cell_sets["tissue"], mesh.cell_sets["cloud"])
    cell_sets["all"] = mesh.cell_sets["all"]
    return replace(mesh, cell_sets=cell_sets, remarks=head.remarks, figures=head.figures | mesh.figures)


def _void(head: Head, radius: float, centre: Floats, needed: float) -> Mask:
    """Cubes of tissue within the radius, m, of the tumour's centre, to be replaced by the cloud: one piece.

    Cubes with a node on the skull stay, and the rest of the solid is one piece. InputError if the centre is not in
    tissue, or if a cube that must stay is nearer than `needed`, m.
    """
    key = f"tumour.centre = {format_position(centre)}"
    grid, parts = head.grid, head.parts
    corners = grid.corners(head.solid)
    low, high = corners.min(axis=0), corners.max(axis=0) + grid.size
    hint = unit_hint(centre, low, high)
    cube = grid.index(centre)
    part = next((name for name, mask in parts.items() if cube is not None and mask[cube]), None)
    if cube is None or part != "tissue":
        if part is None:
            hint = hint or _voxel_hint(head, centre)
        position = f"in the {part.replace('_', ' ')}" if part else "outside the brain"
        extent = ", ".join(f"{n} {1e3 * a:.0f} to {1e3 * b:.0f}" for n, a, b in zip("xyz", low, high, strict=True))
        raise InputError(
            f"{key}: lies {position}, {format_length(grid.distance(parts['tissue'], centre))} from the nearest tissue; "
            f"move it into tissue (the head: {extent} mm){hint and f'; {hint}'}"
        )
    replaceable = parts["tissue"] & head.interior
    fixed = {name.replace("_", " "): parts[name] for name in VENTRICLES if name in parts}
    fixed["skull"] = parts["tissue"] & ~head.interior
    distances = {name: grid.distance(mask, centre) for name, mask in fixed.items()}
    nearest = min(distances, key=distances.__getitem__)
    if distances[nearest] < needed:
        raise InputError(
            f"{key}: is {format_length(distances[nearest])} from the {nearest}'s hexahedra, and the seed and an "
            f"element's size of cloud around it need {format_length(needed)}; move it "
            f"({_alternative(grid, replaceable, centre, needed)}), or make the hexahedra smaller{hint and f'; {hint}'}"
        )
    z, y, x = ((grid.origin[i] + grid.size * (np.arange(grid.shape[i]) + 0.5) - centre[i]) ** 2 for i in (2, 1, 0))
    square_distance = z[:, None, None] + y[:, None] + x
    void = replaceable & (square_distance <= radius**2)
    while void[cube]:
        void = piece_at(void, cube)
        rest = head.solid & ~void
        pieces, n = ndimage.label(rest)
        if n == 1:
            return void
        islands = rest & ~largest_piece(rest)
        must_stay = islands & np.isin(pieces, np.unique(pieces[islands & ~replaceable]))
        if not must_stay.any():
            # Islands of tissue join the void.
            return void | islands
        # An island that must stay grows away from the tumour until it touches the rest.
        beyond = square_distance > square_distance[must_stay].mean()
        void &= ~(ndimage.binary_dilation(must_stay) & beyond)
    raise InputError(
        f"{key}: there is no room for a cloud so near to the skull or a ventricle; move it away from there"
        f"{hint and f'; {hint}'}"
    )


def _voxel_hint(head: Head, centre: Floats) -> str:
    """A hint if the deck's numbers for the centre (3,), m, taken as voxel indices, lie in the solid; else ""."""
    meant = head.to_world @ np.append(1e3 * centre, 1.0)
    cube = head.grid.index(meant)
    if cube is None or not head.solid[cube]:
        return ""
    return f"it looks like voxels: in mm it is {format_position(meant).removesuffix(' mm')}"


def _alternative(grid: Grid, replaceable: Mask, centre: Floats, needed: float) -> str:
    """Text with the position nearest to the centre (3,), m, that has only replaceable cubes within `needed`, m."""
    # The transform gives distances between centres of cubes. A corner may be half a diagonal nearer.
    far = grid.size * (ndimage.distance_transform_edt(replaceable) - 3**0.5 / 2)
    centres = grid.origin + grid.size * (np.argwhere(far >= needed)[:, ::-1] + 0.5)
    if not len(centres):
        return "no position in this head has it"
    nearest = centres[((centres - centre) ** 2).sum(axis=1).argmin()]
    return f"the nearest position that has it is {format_position(nearest)}"
