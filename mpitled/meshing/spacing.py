"""The grading of the cloud: the distance between EFG nodes at each point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mpitled.mesh import Floats, Ints
from mpitled.meshing.faces import area_vectors

# Growth of the spacing with the distance from faces between parts. With 0.1 the error of a soft sphere is 1.3 to 1.5
# times larger.
_GROWTH_FROM_FACES = 0.05


@dataclass(frozen=True, slots=True)
class Spacing:
    """Distance between EFG nodes. It grows from the seed's surface outwards by `growth` per metre, up to `largest`.

    If the surface spacing is `growth` times the seed's radius, the spacing is `growth` times the distance to the
    centre. A smaller surface spacing reduces the spacing everywhere, without a jump. Without a seed the spacing is
    `largest`.
    """

    largest: float  # m
    growth: float = 0.0
    centre: Floats | None = None  # of the seed, m; None without a seed
    radius: float = 0.0  # of the seed, m
    at_surface: float = 0.0  # m
    # Tree of centres (n, 3), m, of faces between parts, and sizes (n,), m; a size limits the spacing near its face.
    faces: tuple[cKDTree, Floats] | None = None

    @property
    def seed_volume(self) -> float:
        """Volume of the seed, m^3."""
        return 4 / 3 * np.pi * self.radius**3

    def distance(self, points: Floats) -> Floats:
        """Distance (n,) of points (n, 3) to the seed's centre, m; infinite without a seed."""
        if self.centre is None:
            return np.full(len(points), np.inf)
        return np.linalg.norm(points - self.centre, axis=1)

    def at_distance(self, distance: Floats) -> Floats:
        """Spacing (n,), m, at distances (n,), m, to the seed's centre."""
        if self.centre is None:
            return np.full(len(distance), self.largest)
        return np.minimum(self.largest, self.at_surface + self.growth * np.maximum(distance - self.radius, 0.0))

    def __call__(self, points: Floats) -> Floats:
        """Spacing (n,), m, at points (n, 3), m."""
        spacing = self.at_distance(self.distance(points))
        if self.faces is None:
            return spacing
        tree, sizes = self.faces
        distance, nearest = tree.query(points)
        return np.minimum(spacing, sizes[nearest] + _GROWTH_FROM_FACES * distance)

    def n_nodes(self, volume: float) -> float:
        """Upper bound of the nodes in a volume, m^3: those of a ball around the seed, where nodes are densest."""
        if self.centre is None:
            return volume / self.largest**3
        reach = np.cbrt(self.radius**3 + volume * 3 / (4 * np.pi))
        r = np.geomspace(self.radius, reach, 1000)
        density = 4 * np.pi * r**2 / self.at_distance(r) ** 3
        return float(((density[1:] + density[:-1]) / 2 * np.diff(r)).sum())

    def refined(self, points: Floats, boundaries: list[Ints]) -> Spacing:
        """This spacing, limited near faces (n, 4) of two boundaries to the size of the face."""
        faces = np.concatenate(boundaries)
        _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        if not (count > 1).any():
            return self
        corners = points[faces[first[count > 1]]]
        sizes = np.linalg.norm(area_vectors(corners), axis=1) ** 0.5
        return replace(self, faces=(cKDTree(corners.mean(axis=1)), sizes))
