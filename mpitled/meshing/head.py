"""Convert the voxels of a label image to cubes: one manifold solid of the same volume, with its ventricles."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from mpitled import resources
from mpitled.errors import InputError
from mpitled.mesh import CORNERS, Bools, Floats, Ints, check_size
from mpitled.meshing.label_image import VENTRICLES, Image, Mask, largest_piece, read_image, segment, without_cavities

if TYPE_CHECKING:
    from mpitled import deck

_CUBE_BYTES = 60  # upper bound of the memory per cube of the grid while the head is meshed


@dataclass(frozen=True, slots=True)
class Grid:
    """A regular grid of cubes around the solid, with at least one layer of empty cubes."""

    origin: Floats  # (3,), m
    size: float  # m
    shape: tuple[int, int, int]  # (nx, ny, nz)

    def index(self, point: Floats) -> tuple[int, int, int] | None:
        """Index (z, y, x) of the cube around a point (3,), m; None outside the grid."""
        i = np.floor((point - self.origin) / self.size).astype(int)
        if (i < 0).any() or (i >= self.shape).any():
            return None
        return int(i[2]), int(i[1]), int(i[0])

    def corners(self, mask: Mask) -> Floats:
        """Lowest corners (n, 3), m, of the chosen cubes."""
        return np.asarray(self.origin + self.size * np.argwhere(mask)[:, ::-1])

    def distance(self, mask: Mask, point: Floats) -> float:
        """Distance, m, of a point (3,) from the nearest chosen cube; infinite without chosen cubes."""
        low = self.corners(mask)
        gap = np.maximum(np.maximum(low - point, point - low - self.size), 0.0)
        return float(np.linalg.norm(gap, axis=1).min(initial=np.inf))

    def hexahedra(self, mask: Mask) -> tuple[Floats, Ints]:
        """Points (n, 3) and hexahedra (m, 8) of the chosen cubes, both numbered along x, then y, then z."""
        nx, ny, _ = self.shape
        strides = np.array([1, nx + 1, (nx + 1) * (ny + 1)])
        first = np.stack(np.nonzero(mask)[::-1], axis=1) @ strides
        nodes, numbers = np.unique(first[:, None] + ((CORNERS + 1) // 2) @ strides, return_inverse=True)
        index = np.stack([nodes % strides[1], nodes // strides[1] % (ny + 1), nodes // strides[2]], axis=1)
        return self.origin + self.size * index, numbers.reshape(-1, 8).astype(np.int64)


@dataclass(frozen=True, slots=True)
class Head:
    """The parts of a head as cubes of a grid."""

    grid: Grid
    solid: Mask  # all parts
    interior: Mask  # cubes of the solid without a node on its outer surface
    parts: dict[str, Mask]  # tissue and the ventricles
    figures: dict[str, float]  # volumes, in the image and as cubes
    to_world: Floats  # (3, 4), m: from the image's voxel indices (i, j, k, 1) to the world
    remarks: tuple[str, ...]


def voxelise(labels: deck.Labels) -> Head:
    """The cubes of tissue and ventricles of a label image; InputError as in `labels.mesh_labels`."""
    image = read_image(Path(labels.image))
    body, voxels, remarks = segment(image, labels)
    size = labels.element_size
    key = f"labels.element_size = {1e3 * size:g} mm"
    if size < image.voxel.min():
        remarks.append(
            f"warning: {key}: is smaller than a voxel of {image.path}, {1e3 * image.voxel.min():.3g} mm; smaller "
            "hexahedra show no more of the anatomy"
        )
    if not image.placed:
        remarks.append(
            f"warning: {image.path}: its header does not give the position of its voxels; check that left is left"
        )
    check_size(float(body.sum() * (image.voxel / size).prod()), key, "enlarge it")
    grid = _grid(image, body, size)
    shares = {name: _filled_shares(image, mask, grid) for name, mask in {"solid": body, **voxels}.items()}
    solid, repaired = solid_cells(shares["solid"])
    if not solid.any():
        raise InputError(f"{key}: is too large for {image.path}; make it smaller")
    if repaired:
        remarks.append(f"{repaired} hexahedra added where hexahedra of the solid shared only an edge or a vertex")
    interior = ndimage.binary_erosion(solid, np.ones((3, 3, 3)))
    ventricles = _ventricles(shares, interior)
    for name, mask in ventricles.items():
        if not mask.any():
            raise InputError(
                f"{key}: the {name.replace('_', ' ')} of {image.path} is too small or too near the surface for it; "
                "make it smaller"
            )
    parts = {"tissue": solid & ~np.any([np.zeros_like(solid), *ventricles.values()], axis=0), **ventricles}
    counts = {name: float(mask.sum()) for name, mask in {"solid": solid, **parts}.items()}
    counts |= {f"image_{name}": float(share.sum()) for name, share in shares.items()}
    figures = {f"{name}_volume_m3": n * size**3 for name, n in counts.items()}
    return Head(grid, solid, interior, parts, figures, image.to_world, tuple(remarks))


def _grid(image: Image, body: Mask, size: float) -> Grid:
    """A grid of cubes centred on the body, so that a symmetric body has symmetric cubes."""
    low, high = np.empty(3), np.empty(3)
    for i in range(3):
        occupied = np.flatnonzero(body.any(axis=tuple({0, 1, 2} - {2 - i})))
        low[i] = image.origin[i] + image.voxel[i] * occupied[0]
        high[i] = image.origin[i] + image.voxel[i] * (occupied[-1] + 1)
    # Two layers more than the body needs: repairs may add to it, and the outside must stay in one piece.
    wanted = np.ceil((high - low) / size - 1e-9) + 4
    overlaps = (wanted * image.labels.shape[::-1]).sum()  # see _filled_shares
    request = f"labels.element_size = {1e3 * size:g} mm: a grid of {wanted.prod():.3g} cubes"
    resources.check_memory(_CUBE_BYTES * (wanted.prod() + overlaps), request, "enlarge it")
    n = wanted.astype(int)
    return Grid((low + high) / 2 - size * n / 2, size, (int(n[0]), int(n[1]), int(n[2])))


def _filled_shares(image: Image, mask: Mask, grid: Grid) -> Floats:
    """Volume fraction (nz, ny, nx) of masked voxels in each cube of the grid: an exact box integral."""
    share = mask.astype(float)
    for axis, i in ((0, 2), (1, 1), (2, 0)):
        cubes = grid.origin[i] + grid.size * np.arange(grid.shape[i] + 1)
        voxels = image.origin[i] + image.voxel[i] * np.arange(mask.shape[axis] + 1)
        overlap = np.minimum(cubes[1:, None], voxels[None, 1:]) - np.maximum(cubes[:-1, None], voxels[None, :-1])
        share = np.moveaxis(np.tensordot(np.maximum(overlap, 0) / grid.size, share, axes=(1, axis)), 0, axis)
    return share


def solid_cells(share: Floats) -> tuple[Mask, int]:
    """A face-connected manifold solid with the total volume of the shares, and the number of cubes added by repairs."""
    target = round(float(share.sum()))
    n, best, error, repaired = target, np.zeros(share.shape, bool), np.inf, 0
    # Repairs only add cubes, so the next trial starts with fewer cubes.
    for _ in range(4):
        chosen = largest_piece(_fullest(share, n))
        trial = _manifold(chosen, share)
        surplus = int(trial.sum()) - target
        if abs(surplus) < error:
            best, error, repaired = trial, abs(surplus), int(trial.sum() - chosen.sum())
        if surplus == 0:
            break
        n -= surplus
    return best, repaired


def _fullest(share: Floats, n: int) -> Mask:
    """The n cubes with the largest shares; the fuller neighbourhood breaks ties."""
    around = ndimage.uniform_filter(share, 3, mode="constant")
    order = np.argsort(-(share + 1e-3 * around), axis=None, kind="stable")
    order = order[share.ravel()[order] > 0][:n]
    mask = np.zeros(share.size, bool)
    mask[order] = True
    return mask.reshape(share.shape)


def _manifold_patterns() -> Bools:
    """Valid patterns (256,) of the 8 cubes at a node: the full and the empty cubes are each face-connected.

    In a valid pattern the surface at the node is a disc or absent. The test includes edges.
    """
    valid = np.zeros(256, bool)
    for code in range(256):
        pattern = np.array([code >> bit & 1 for bit in range(8)], bool).reshape(2, 2, 2)
        valid[code] = ndimage.label(pattern)[1] <= 1 and ndimage.label(~pattern)[1] <= 1
    return valid


def _manifold(mask: Mask, share: Floats) -> Mask:
    """The mask with added cubes, those of largest share first, without non-manifold edges or vertices."""
    valid = _manifold_patterns()
    mask = without_cavities(mask)
    around = list(product((0, 1), repeat=3))
    while True:
        full = np.pad(mask, 1)
        nz, ny, nx = (n - 1 for n in full.shape)
        code = sum(full[k : k + nz, j : j + ny, i : i + nx].astype(int) << bit for bit, (k, j, i) in enumerate(around))
        bad = np.stack(np.nonzero(~valid[code]), axis=1)
        if len(bad) == 0:
            return mask
        neighbours = (bad[:, None] + np.array(around)).transpose(2, 0, 1)
        empty_share = np.where(full[tuple(neighbours)], -1.0, np.pad(share, 1)[tuple(neighbours)])
        added = neighbours[:, np.arange(len(bad)), empty_share.argmax(axis=1)]
        full[tuple(added)] = True
        mask = without_cavities(full[1:-1, 1:-1, 1:-1])


def _ventricles(shares: dict[str, Floats], interior: Mask) -> dict[str, Mask]:
    """Cubes of each ventricle: a face-connected piece inside the interior, with the volume of the label."""
    names = [name for name in VENTRICLES if name in shares]
    parts = {}
    for name in names:
        share = np.where(interior, shares[name], 0.0)
        for other in names:
            # A cube in both ventricles belongs to the ventricle with the larger share, in a tie to the first ventricle.
            if other != name:
                larger = share >= shares[other] if names.index(name) < names.index(other) else share > shares[other]
                share = np.where(larger, share, 0.0)
        parts[name] = _connected_part(share, round(float(shares[name].sum())))
    return parts


def _connected_part(share: Floats, target: int) -> Mask:
    """The largest piece of the fullest cubes; its number of cubes is as near to `target` as possible."""
    part = np.zeros(share.shape, bool)
    if target == 0 or not share.any():
        return part
    box = ndimage.find_objects((share > 0).astype(np.int8))[0]
    share_in_box = share[box]
    low, high = target, max(target, int(np.count_nonzero(share_in_box)))
    while low < high:
        middle = (low + high) // 2
        if largest_piece(_fullest(share_in_box, middle)).sum() >= target:
            high = middle
        else:
            low = middle + 1
    more, less = (largest_piece(_fullest(share_in_box, n)) for n in (low, low - 1))
    part[box] = more if more.sum() - target <= target - less.sum() else less
    return part
