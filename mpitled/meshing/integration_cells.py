"""Integration cells of the cloud: hexahedra cut through their trilinear maps, with exact volumes and centroids."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mpitled.mesh import CORNERS, Floats, Ints
from mpitled.meshing.spacing import Spacing

_SAMPLES = 8  # points per direction in a cell that the seed's surface cuts
_SLIVER = 0.5  # a cut cell is merged into its neighbour if a smaller share of it lies outside the seed
_GAUSS = CORNERS / np.sqrt(3.0)  # exact to degree 3 in each coordinate: volume and first moments of trilinear cells


def subdivide(cells: Floats, cuts: Ints) -> Floats:
    """Corners (n_parts, 8, 3) of hexahedra (n, 8, 3) that are cut into `cuts` (n, 3) parts along their axes.

    A part of a trilinear cell is the trilinear cell of the part's corners, so the parts fill the cell exactly.
    """
    n_parts = cuts.prod(axis=1)
    parent = np.repeat(np.arange(len(cells)), n_parts)
    part = np.arange(len(parent)) - np.repeat(np.cumsum(n_parts) - n_parts, n_parts)
    k = cuts[parent]
    index = np.stack([part % k[:, 0], part // k[:, 0] % k[:, 1], part // (k[:, 0] * k[:, 1])], axis=1)
    parents = cells[parent]
    corners = [trilinear(parents, 2 * (index + (corner + 1) / 2) / k - 1) for corner in CORNERS]
    return np.stack(corners, axis=1)


def volumes_and_centroids(cells: Floats) -> tuple[Floats, Floats]:
    """Volumes (n,), m^3, and centroids (n, 3), m, of trilinear hexahedra with corners (n, 8, 3), exact to round-off."""
    volumes, moments = np.zeros(len(cells)), np.zeros((len(cells), 3))
    for point in _GAUSS:
        slopes = [CORNERS[:, i] * np.delete(1 + CORNERS * point, i, axis=1).prod(axis=1) / 8 for i in range(3)]
        r, s, t = (_weighted(slope, cells) for slope in slopes)
        weight = (r * np.cross(s, t)).sum(axis=1)
        volumes += weight
        moments += weight[:, None] * trilinear(cells, np.broadcast_to(point, (len(cells), 3)))
    return volumes, moments / volumes[:, None]


def trilinear(cells: Floats, local: Floats) -> Floats:
    """Points (n, 3) of hexahedra (n, 8, 3) at local coordinates (n, 3) in [-1, 1]^3 (paper, eq. 4.4)."""
    return _weighted((1 + CORNERS * local[:, None, :]).prod(axis=2) / 8, cells)


def _weighted(weights: Floats, cells: Floats) -> Floats:
    """Sums (n, 3) over the corners of hexahedra (n, 8, 3) with weights (n, 8), or with weights (8,) for all cells.

    The sum runs corner by corner. A BLAS product may differ between machines in the last bit and so move nodes.
    """
    total = weights[..., 0, None] * cells[:, 0]
    for corner in range(1, 8):
        total += weights[..., corner, None] * cells[:, corner]
    return np.asarray(total)


def edge_lengths(cells: Floats) -> Floats:
    """Lengths (n, 3), m, of hexahedra (n, 8, 3) along their three axes, through the centre."""
    return np.linalg.norm(np.stack([_weighted(axis, cells) for axis in CORNERS.T / 4], axis=1), axis=2)


def cut(cells: Floats, spacing: Spacing, per_spacing: float, rng: np.random.Generator) -> Floats:
    """Parts (m, 8, 3) of hexahedra (n, 8, 3), about `per_spacing` times smaller than the local node spacing.

    If the spacing changes much over a hexahedron, it is first halved. Each hexahedron is then cut into k or k + 1 parts
    along each axis. The axes with k + 1 parts are chosen at random so that the mean number of parts is as requested.
    """
    parts = []
    while len(cells):
        centres = cells.mean(axis=1)
        reach = np.linalg.norm(cells - centres[:, None], axis=2).max(axis=1)
        distance = spacing.distance(centres)
        ratio = edge_lengths(cells) * per_spacing / spacing(centres)[:, None]
        uneven = spacing.at_distance(distance + reach) > 1.6 * spacing.at_distance(distance - reach)
        halve = uneven & (ratio.max(axis=1) > 1.5)
        parts.append(subdivide(cells[~halve], _random_cuts(ratio[~halve], rng)))
        cells = subdivide(cells[halve], np.where(ratio[halve] > 1.5, 2, 1))
    return np.concatenate(parts)


def _random_cuts(ratio: Floats, rng: np.random.Generator) -> Ints:
    """Numbers of parts (n, 3) along the axes; the mean of their product is the product of the ratios (n, 3)."""
    low = np.maximum(np.floor(ratio), 1).astype(np.int64)
    # The axis with the largest ratio to its number of parts comes first; noise breaks ties at random.
    lack = (ratio / low) * rng.uniform(1, 1.001, ratio.shape)
    rank = np.argsort(np.argsort(-lack, axis=1), axis=1)
    steps = np.stack([(low + (rank < m)).prod(axis=1) for m in range(4)], axis=1)
    wanted = np.clip(np.maximum(ratio, 1).prod(axis=1), steps[:, 0], steps[:, 3])
    m = np.minimum((steps <= wanted[:, None]).sum(axis=1) - 1, 2)
    below, above = np.take_along_axis(steps, np.stack([m, m + 1], axis=1), axis=1).T
    m = m + (rng.random(len(m)) < (wanted - below) / (above - below))
    return low + (rank < m[:, None])


def outside_seed(
    cells: Floats, volumes: Floats, centroids: Floats, spacing: Spacing
) -> tuple[Floats, Floats, Ints, float]:
    """Volumes, centroids and rows of the cells (n, 8, 3) outside the seed, and the sampled volume, m^3.

    Cells that the sphere cuts are sampled. Slivers are merged into the nearest point. The volumes of cut cells are
    rescaled so that the sum is exact.
    """
    assert spacing.centre is not None
    middle = cells.mean(axis=1)
    reach = np.linalg.norm(cells - middle[:, None], axis=2).max(axis=1)
    near = np.flatnonzero(spacing.distance(middle) < spacing.radius + reach)
    local = 2 * (np.indices((_SAMPLES,) * 3).reshape(3, -1).T + 0.5) / _SAMPLES - 1
    shapes = (1 + CORNERS * local[:, None, :]).prod(axis=2) / 8
    samples = np.stack([_weighted(shape, cells[near]) for shape in shapes], axis=1)
    outside = spacing.distance(samples.reshape(-1, 3)).reshape(len(near), -1) >= spacing.radius
    share = outside.mean(axis=1)
    is_cut = (share > 0) & (share < 1)
    uncut = volumes
    volumes, centroids = volumes.copy(), centroids.copy()
    volumes[near] *= share
    cut_cells = near[is_cut]
    sums = np.where(outside[is_cut][:, :, None], samples[is_cut], 0.0).sum(axis=1)
    centroids[cut_cells] = sums / outside[is_cut].sum(axis=1)[:, None]

    sampled = volumes.sum()
    volumes[cut_cells] *= 1 + (uncut.sum() - spacing.seed_volume - sampled) / volumes[cut_cells].sum()

    sliver = (volumes > 0) & (volumes < _SLIVER * uncut)
    kept = np.flatnonzero((volumes > 0) & ~sliver)
    into = kept[cKDTree(centroids[kept]).query(centroids[sliver])[1]]
    moments = centroids * volumes[:, None]
    np.add.at(moments, into, moments[sliver])
    np.add.at(volumes, into, volumes[sliver])
    centroids = moments[kept] / volumes[kept, None]
    # The centroid of a thin, curved shell may lie slightly inside the sphere.
    stretch = np.maximum(1.0, spacing.radius / spacing.distance(centroids))
    centroids += (stretch - 1)[:, None] * (centroids - spacing.centre)
    return volumes[kept], centroids, kept, float(sampled)
