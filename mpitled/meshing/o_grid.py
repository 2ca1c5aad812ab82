"""O-grids of discs and balls: a square or cube-like core and shells around it."""

from __future__ import annotations

import numpy as np

from mpitled.mesh import Bools, Floats, Ints, grid_points, structured_hexahedra
from mpitled.meshing.faces import boundary_faces, unshared

# Half the core's width over the radius, and the bulge of the core's sides towards the circle or sphere. Found by a
# search for even cells with good corners (minimum scaled Jacobian 0.85 in a cylinder, 0.71 in a ball).
_CORE, _BULGE = 0.5, 0.4


class OGrid:
    """The mesh of a disc or ball of radius 1: a square or cube-like core and shells around it.

    Lines of the core are straight near the middle and bend towards the sphere. Between core and sphere the lines are
    straight. Nodes of the core come first, x fastest, then one shell after the other.
    """

    points: Floats  # (n_nodes, d)
    cells: Ints  # (n_cells, 2^d), in VTK's order
    surface: Ints  # nodes on the sphere, ascending
    cube: Floats  # (n_surface, d), the surface nodes on the cube [-1, 1]^d before the mapping
    faces: Ints  # (n_faces, 2^(d-1)) rows of `surface`, anticlockwise seen from outside

    def __init__(
        self, shape: tuple[int, ...], radius: float, element_size: float, outermost: float = 1.0, lines: float = 1.0
    ) -> None:
        """`shape`: cells along each axis of the core. `radius` and `element_size` (m) give the number of shells.

        `outermost` is the thickness of the outermost shell over the mean thickness. `lines` is, in the core of a ball,
        the width of cells beside the coordinates 1/2 and 1 of the cube over the mean width.
        """
        d = len(shape)
        nx, ny, nz = (*shape, 1)[:3]
        grid = grid_points((nx, ny, nz), (2.0, 2.0, 2.0))[:, :d] - 1
        core_cells = structured_hexahedra((nx, ny, nz))
        if d == 2:
            grid, core_cells = grid[: len(grid) // 2], core_cells[:, :4]
        # Integers remove the round-off of the coordinates 1 (faces) and 1/2 (edge of the patch).
        grid = np.rint((grid + 1) / 2 * shape) * 2 / shape - 1
        grid = _crowded(grid, lines)
        level = np.abs(grid).max(axis=1)
        edge = np.flatnonzero(level == 1)
        self.cube = grid[edge]
        direction = grid / np.where(level > 0, level, 1)[:, None]
        bulge = _BULGE * level[:, None]
        core = _CORE * level[:, None] * ((1 - bulge) * direction + bulge * on_sphere(direction))
        inner, outer = core[edge], on_sphere(self.cube)
        thickness = radius * (1 - np.linalg.norm(inner, axis=1).mean())
        self.n_shells = whole_number(thickness / element_size)
        ends = graded(self.n_shells, outermost)
        share = ends[1:, None, None]
        self.points = np.concatenate([core, ((1 - share) * inner + share * outer).reshape(-1, d)])

        row = np.full(len(grid), -1)
        row[edge] = np.arange(len(edge))
        self.faces = row[boundary_faces(core_cells) if d == 3 else _boundary_edges(core_cells)]
        # Rows of the core's surface and of each shell.
        nodes = np.concatenate([edge[None], len(grid) + np.arange(self.n_shells * len(edge)).reshape(-1, len(edge))])
        self.surface = nodes[-1]
        bottom, top = nodes[:-1][:, self.faces], nodes[1:][:, self.faces]
        shells = np.concatenate([bottom if d == 3 else bottom[..., ::-1], top], axis=2).reshape(-1, 2**d)
        self.cells = np.concatenate([core_cells, shells])
        middle = np.abs(grid[core_cells].mean(axis=1)).max(axis=1)
        shell = np.repeat((ends[1:] + ends[:-1]) / 2, len(self.faces))
        self._radius = np.concatenate([_CORE * middle, _CORE + (1 - _CORE) * shell])
        self._outermost = np.arange(len(self.cells)) >= len(self.cells) - len(self.faces)

    def core(self, share: float) -> Bools:
        """Mask (n_cells,) of cells with their middle within that share of the radius, without the outermost shell."""
        return (self._radius <= share) & ~self._outermost


def graded(n: int, smallest: float, both_ends: bool = False) -> Floats:
    """Ends (n + 1,) of n parts of [0, 1]; lengths decrease to `smallest` times the mean at 1, or at both ends.

    The map is smooth, so the order of convergence is that of equal parts.
    """
    s, cycles = np.arange(n + 1) / n, 2 if both_ends else 1
    shift = (1 - smallest) * np.sin(cycles * np.pi * s) / (cycles * np.pi)
    ends: Floats = s - shift if both_ends else s + shift
    ends[-1] = 1.0
    return ends


def _crowded(grid: Floats, smallest: float) -> Floats:
    """Equidistant grid points (n, d) in [-1, 1]^d, moved towards the coordinates 1/2 and 1: see `graded`."""
    if smallest == 1:
        return grid
    w = np.abs(grid)
    inner = w + (1 - smallest) * np.sin(2 * np.pi * w) / (2 * np.pi)
    outer = w - (1 - smallest) * np.sin(4 * np.pi * w) / (4 * np.pi)
    exact = np.isin(w, (0.5, 1.0))  # the patch's edge without round-off
    return np.sign(grid) * np.where(exact, w, np.where(w < 0.5, inner, outer))


def on_sphere(cube: Floats) -> Floats:
    """Unit vectors (n, d) of points (n, d) on the cube's surface: the equiangular map of the cubed sphere.

    Ronchi, Iacono and Paolucci 1996, J. Comput. Phys. 124. Zero vectors stay zero.
    """
    slopes = np.tan(np.pi / 4 * cube)
    return slopes / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-300)


def _boundary_edges(quads: Ints) -> Ints:
    """Edges (n, 2) that belong to one quadrilateral (n, 4) only, in the direction of its nodes."""
    edges = np.stack([quads, np.roll(quads, -1, axis=1)], axis=2).reshape(-1, 2)
    return edges[unshared(edges)]


def shell_cells(nodes: Ints, faces: Ints) -> Ints:
    """Hexahedra (n, 8) between successive layers of nodes (n_layers + 1, m), over faces (k, 4) that index into m."""
    return np.concatenate([nodes[:-1][:, faces], nodes[1:][:, faces]], axis=2).reshape(-1, 8)


def whole_number(wanted: float) -> int:
    """The nearest whole number, but at least 1."""
    return max(1, int(np.floor(wanted + 0.5)))
