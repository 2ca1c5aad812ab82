"""The displacement field of a result at any point: trilinear in hexahedra, moving least squares in the cloud."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpitled import store
from mpitled.cells.support_domains import moving_least_squares
from mpitled.errors import InputError, damaged
from mpitled.mesh import CORNERS
from mpitled.meshing.faces import boundary_faces
from mpitled.model import Model

#: Source of a value: the hexahedron around the point, a support domain, or the hexahedron nearest to a point outside.
IN_HEXAHEDRON, IN_CLOUD, OUTSIDE = 0, 1, 2

_CANDIDATES = (1, 16, 64)  # hexahedra with the nearest centres, more if a nearer hexahedron is possible
_INSIDE = 1 + 1e-9  # in reference coordinates: a point on a face belongs to both cells
_MAX_ITERATIONS = 30  # of Newton's method; undistorted cells need 4
#: Newton's method in the cloud: number of steps, length of a step (m), and the distance (m) at which it has converged.
_MAX_STEPS, _MAX_STEP, _TOLERANCE = 12, 1e-3, 1e-6
_CHUNK = 1 << 12  # points in one batch, to keep temporary arrays small
# Signs of the eight monomials 1, r, s, t, rs, st, rt, rst at the corners: they give the trilinear map's coefficients.
_r, _s, _t = CORNERS.T.astype(float)
_MODES = np.stack([np.ones(8), _r, _s, _t, _r * _s, _s * _t, _r * _t, _r * _s * _t])


class Values(NamedTuple):
    """The field at n points."""

    displacement: NDArray[np.float64]  # (n, 3), m
    source: NDArray[np.int8]  # (n,), IN_HEXAHEDRON, IN_CLOUD or OUTSIDE
    outside: NDArray[np.float64]  # (n,), m from the mesh; 0 inside


class Origins(NamedTuple):
    """Undeformed positions of n points of the deformed body."""

    position: NDArray[np.float64]  # (n, 3), m
    missed: NDArray[np.float64]  # (n,), m: distance between the deformed origin and the given point


@dataclass(frozen=True, slots=True)
class Field:
    """A model and the displacements of its nodes in one frame."""

    model: Model
    parameters: NDArray[np.float64]  # (n_nodes, 3), m; at EFG nodes they are not values of the field
    at_nodes: NDArray[np.float64]  # (n_nodes, 3), m: the field at the nodes
    basis: int
    weight: str
    share: float  # of the load time
    complete: bool  # whether the run reached its end
    metadata: dict[str, Any]  # recorded at the start of the run

    def at(self, positions: NDArray[np.float64]) -> Values:
        """The field at positions (n, 3), m, of the undeformed body.

        A point outside the mesh, for instance on a curved surface, has the extrapolated value of the nearest
        hexahedron. In the cloud the support domain of the nearest integration point gives the value.
        """
        model = self.model
        cells, xi, outside = locate(model.points, model.hexahedra, positions)
        source = np.where(outside > 0, OUTSIDE, IN_HEXAHEDRON).astype(np.int8)
        if len(model.domains):
            source[self._across_interface(cells, xi) & (outside > 0)] = IN_CLOUD
        displacement = np.empty((len(positions), 3))
        fe = source != IN_CLOUD
        displacement[fe] = np.einsum(
            "na,nai->ni", _shape_functions(xi[fe]), self.parameters[model.hexahedra[cells[fe]]]
        )
        if not fe.all():
            displacement[~fe] = self._in_cloud(positions[~fe])[0]
        return Values(displacement, source, np.where(fe, outside, 0.0))

    def origins(self, positions: NDArray[np.float64]) -> Origins:
        """Undeformed positions of the tissue at points (n, 3), m, of the deformed body.

        In hexahedra and outside the mesh the hexahedron's map is inverted, to round-off. In the cloud Newton's method
        is used, because near a grown tumour the gradient is too large for a fixed-point iteration. The field is not
        continuous between support domains. The error at a few points in the cloud is therefore as large as a jump.
        """
        model, n = self.model, len(positions)
        cells, xi, outside = locate(model.points + self.parameters, model.hexahedra, positions)
        cloud = np.zeros(n, bool)
        if len(model.domains):
            cloud = self._across_interface(cells, xi) & (outside > 0)
        undeformed, missed = np.empty((n, 3)), np.zeros(n)
        fe = ~cloud
        undeformed[fe] = np.einsum("na,nai->ni", _shape_functions(xi[fe]), model.points[model.hexahedra[cells[fe]]])
        if cloud.any():
            in_cloud = undeformed[cloud] = self._origins_in_cloud(positions[cloud])
            missed[cloud] = np.linalg.norm(in_cloud + self.at(in_cloud).displacement - positions[cloud], axis=1)
        return Origins(undeformed, missed)

    def _origins_in_cloud(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Undeformed positions (n, 3), m: the best iterates of Newton's method, which starts at the nearest
        integration points of the deformed cloud.

        Points inside the seed of a tumour are excluded: moving least squares has a value there, but there is no tissue.
        """
        points, tumour = self.model.domain_points, self.metadata.get("tumour")
        centre, seed = (np.array(tumour["centre_m"]), tumour["seed_radius_m"]) if tumour else (np.zeros(3), 0.0)
        trial = points[cKDTree(points + self._in_cloud(points)[0]).query(positions)[1]]
        best, error = trial.copy(), np.full(len(positions), np.inf)
        active = np.arange(len(positions))
        for _ in range(_MAX_STEPS):
            x = trial[active]
            displacement, gradient = self._in_cloud(x)
            residual = x + displacement - positions[active]
            size = np.linalg.norm(residual, axis=1)
            better = (size < error[active]) & (np.linalg.norm(x - centre, axis=1) >= seed)
            error[active[better]], best[active[better]] = size[better], x[better]
            step = np.linalg.solve(np.eye(3) + gradient, residual[..., None])[..., 0]
            trial[active] = x - step * (_MAX_STEP / np.maximum(np.linalg.norm(step, axis=1), _MAX_STEP))[:, None]
            active = active[error[active] > _TOLERANCE]
        return best

    def _in_cloud(self, positions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Displacements (n, 3), m, and gradients (n, 3, 3), by the nearest integration points' support domains."""
        nodes = self.model.domains[cKDTree(self.model.domain_points).query(positions)[1]]
        values, gradients, _ = moving_least_squares(self.model.points[nodes], positions, self.basis, self.weight)
        parameters = self.parameters[nodes]
        return np.einsum("na,nai->ni", values, parameters), np.einsum("naj,nai->nij", gradients, parameters)

    def _across_interface(self, cells: NDArray[np.int64], xi: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether each point is outside its cell and next to a face, edge or corner that has interface nodes only (n,).

        All points are across the interface if there are no hexahedra.
        """
        if not len(self.model.hexahedra):
            return np.ones(len(cells), bool)
        beyond = np.abs(xi) > 1
        nearest = ((CORNERS * xi[:, None, :] > 0) | ~beyond[:, None, :]).all(axis=2)  # (n, 8)
        on_interface = _on_interface(self.model)[self.model.hexahedra[cells]]
        return np.asarray(beyond.any(axis=1) & (on_interface | ~nearest).all(axis=1))


def open_field(path: Path, frame: int = -1) -> Field:
    """The field of a run in a frame, from the run's folder or its result.vtkhdf; frame -1 is the last.

    InputError if the result or model.h5 is missing, or if the files do not belong together.
    """
    with store.open_result(path) as result, damaged(result.path, "run the deck again"):
        model = store.read_model(result.path.parent / "model.h5")
        if not np.array_equal(result.node_points, model.points):
            raise InputError(f"{result.path}: does not belong to the model beside it; run the deck again")
        if result.n_frames == 0:
            raise InputError(f"{result.path}: has no frame; run the deck again")
        support = result.metadata["deck"]["support"]
        return Field(
            model=model,
            parameters=result.at_nodes("parameters", frame),
            at_nodes=result.at_nodes("displacement", frame),
            basis=support["basis"],
            weight=support["weight"],
            share=float(result.times[frame] / result.metadata["load_time_s"]),
            complete=result.complete,
            metadata=result.metadata,
        )


def locate(
    points: NDArray[np.float64], hexahedra: NDArray[np.int64], positions: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Cells (n,), reference coordinates in the cells (n, 3), and distances from the cells (n,), m, of positions (n, 3).

    A point in no hexahedron gets the nearest hexahedron and coordinates beyond [-1, 1]. The distance is measured from
    the point with the coordinates clipped to [-1, 1]. Distances are infinite if there are no hexahedra.
    """
    n = len(positions)
    cells, xi, distance = np.zeros(n, np.int64), np.zeros((n, 3)), np.full(n, np.inf)
    if not len(hexahedra):
        return cells, xi, distance
    centres = points[hexahedra].mean(axis=1)
    radius = max(np.linalg.norm(points[corner] - centres, axis=1).max() for corner in hexahedra.T)
    tree = cKDTree(centres)
    remaining = np.arange(n)
    for k in _CANDIDATES:
        untried = np.zeros(n, bool)  # whether a hexahedron that was not tried may be nearer
        for first in range(0, len(remaining), _CHUNK):
            rows = remaining[first : first + _CHUNK]
            nearest = tree.query(positions[rows], min(k, len(hexahedra)))
            to_centres, candidates = (array.reshape(len(rows), -1) for array in nearest)
            cells[rows], xi[rows], distance[rows] = _best(points, hexahedra, candidates, positions[rows])
            untried[rows] = distance[rows] > np.maximum(to_centres[:, -1] - radius, 0)
        remaining = np.flatnonzero(untried)
    return cells, xi, distance


def _best(
    points: NDArray[np.float64],
    hexahedra: NDArray[np.int64],
    candidates: NDArray[np.int64],
    positions: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """The candidate cell of (n, k) that contains each point or is nearest to the point; returns as `locate`."""
    n, k = candidates.shape
    corners = points[hexahedra[candidates.ravel()]]
    x = np.repeat(positions, k, axis=0)
    xi, converged = _invert_map(corners, x)
    inside = np.abs(xi).max(axis=1) <= _INSIDE
    clipped = np.einsum("na,nai->ni", _shape_functions(np.clip(xi, -1, 1)), corners)
    distance = np.where(inside, 0.0, np.linalg.norm(clipped - x, axis=1))
    distance[~converged] = np.inf
    # If several cells share the point, the smallest coordinates decide: the answer depends on the geometry only.
    order = np.lexsort((np.abs(xi).max(axis=1).reshape(n, k), distance.reshape(n, k)), axis=1)[:, 0]
    best = np.arange(n) * k + order
    return candidates.ravel()[best], xi[best], distance[best]


def _invert_map(corners: NDArray[np.float64], x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Reference coordinates (n, 3) of positions (n, 3) in trilinear cells (n, 8, 3), and whether Newton converged (n,).

    Coordinates are limited to [-8, 8]: a point with such coordinates is far from the cell.
    """
    modes = _MODES @ corners / 8
    size = np.abs(modes[:, 1:4]).max(axis=(1, 2))[:, None]
    xi = np.zeros_like(x)
    active = np.arange(len(x))
    for _ in range(_MAX_ITERATIONS):
        old, active_modes = xi[active], modes[active]
        residual = (x[active] - _map(active_modes, old))[..., None]
        step = np.linalg.solve(_map_gradients(active_modes, old, size[active]), residual)[..., 0]
        xi[active] = np.clip(old + np.clip(step, -2, 2), -8, 8)
        active = active[np.abs(xi[active] - old).max(axis=1) >= 1e-13]  # coordinates at a limit do not change either
        if not len(active):
            break
    return xi, np.abs(x - _map(modes, xi)).max(axis=1) < 1e-9 * size[:, 0]


def _map(modes: NDArray[np.float64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions (n, 3) at reference coordinates (n, 3)."""
    r, s, t = xi.T
    return np.einsum("mn,nmi->ni", np.stack([np.ones_like(r), r, s, t, r * s, s * t, r * t, r * s * t]), modes)


def _map_gradients(
    modes: NDArray[np.float64], xi: NDArray[np.float64], size: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivatives dx_i/dxi_j (n, 3, 3), plus a small multiple of the identity so that they are never singular."""
    r, s, t = (x[:, None] for x in xi.T)
    _, R, S, T, RS, ST, RT, RST = modes.transpose(1, 0, 2)
    columns = (R + s * RS + t * RT + s * t * RST, S + r * RS + t * ST + r * t * RST, T + s * ST + r * RT + r * s * RST)
    return np.stack(columns, axis=2) + 1e-12 * size[..., None] * np.eye(3)


def _shape_functions(xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Trilinear shape functions (n, 8) at reference coordinates (n, 3) (paper, eq. 4.4)."""
    return (1 + CORNERS * xi[:, None, :]).prod(axis=2) / 8


def prescribed(model: Model) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether each node (n_nodes,) is prescribed in all three directions, and whether it also moves."""
    nodes = model.prescribed_dofs // 3
    in_all = np.bincount(nodes, minlength=model.n_nodes) == 3
    moves = np.bincount(nodes, (model.prescribed_displacements != 0) | model.rotation_paths.any(1), model.n_nodes) > 0
    return in_all, in_all & moves


def outer_faces(model: Model) -> NDArray[np.int64]:
    """Faces (n, 4) of hexahedra on the body's surface: not shared by two hexahedra, and not on the interface."""
    faces = boundary_faces(model.hexahedra)
    return faces[~_on_interface(model)[faces].all(axis=1)]


def _on_interface(model: Model) -> NDArray[np.bool_]:
    """Whether each node (n_nodes,) is on the interface between hexahedra and cloud."""
    interface = np.zeros(model.n_nodes, bool)
    interface[model.node_sets.get("interface", [])] = True
    return interface
