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
_ITERATIONS = 30  # of Newton; undistorted cells need 4
#: Newton in the cloud: most steps, the longest step (m), and the distance (m) at which it has converged.
_STEPS, _STEP, _CLOSE = 12, 1e-3, 1e-6
_CHUNK = 1 << 12  # points at once, to keep temporary arrays small
# The eight sign products of the corners, whose coefficients make the trilinear map a polynomial.
_r, _s, _t = CORNERS.T.astype(float)
_MODES = np.stack([np.ones(8), _r, _s, _t, _r * _s, _s * _t, _r * _t, _r * _s * _t])


class Values(NamedTuple):
    """The field at places (n, 3)."""

    displacement: NDArray[np.float64]  # (n, 3), m
    source: NDArray[np.int8]  # (n,), IN_HEXAHEDRON, IN_CLOUD or OUTSIDE
    outside: NDArray[np.float64]  # (n,), m from the mesh; 0 inside


class Origins(NamedTuple):
    """Points of the undeformed body for points (n, 3) of the deformed body."""

    place: NDArray[np.float64]  # (n, 3), m
    missed: NDArray[np.float64]  # (n,), m: distance of their deformed positions from the given points


@dataclass(frozen=True, slots=True)
class Field:
    """A model and the displacements of its nodes in one frame."""

    model: Model
    parameters: NDArray[np.float64]  # (n_nodes, 3), m; at EFG nodes they are not values of the field
    at_nodes: NDArray[np.float64]  # (n_nodes, 3), m: the field at the nodes
    basis: int
    weight: str
    share: float  # of the load time
    complete: bool  # whether the run came to its end
    metadata: dict[str, Any]  # recorded at the start of the run

    def at(self, places: NDArray[np.float64]) -> Values:
        """The field at places (n, 3), m, of the undeformed body.

        A point outside the mesh, for instance on a curved surface, has the value of the map of the nearest hexahedron.
        In the cloud the support domain of the nearest integration point gives the value.
        """
        model, n = self.model, len(places)
        cells, xi, outside = locate(model.points, model.hexahedra, places)
        source = np.where(outside > 0, OUTSIDE, IN_HEXAHEDRON).astype(np.int8)
        if len(model.domains):
            source[self._across_interface(cells, xi) & (outside > 0)] = IN_CLOUD
        displacement = np.empty((n, 3))
        fe = source != IN_CLOUD
        displacement[fe] = np.einsum("na,nai->ni", _shapes(xi[fe]), self.parameters[model.hexahedra[cells[fe]]])
        if not fe.all():
            displacement[~fe] = self._in_cloud(places[~fe])[0]
        return Values(displacement, source, np.where(fe, outside, 0.0))

    def origins(self, places: NDArray[np.float64]) -> Origins:
        """Undeformed positions of the tissue at points (n, 3), m, of the deformed body.

        In hexahedra and outside the mesh it is the inverse of the hexahedron's map, to round-off. In the cloud Newton's
        method finds it: near a grown tumour the gradient is too large for a fixed-point iteration. The field jumps
        between support domains, so a few points in the cloud are only found to within such a jump.
        """
        model, n = self.model, len(places)
        cells, xi, outside = locate(model.points + self.parameters, model.hexahedra, places)
        cloud = np.zeros(n, bool)
        if len(model.domains):
            cloud = self._across_interface(cells, xi) & (outside > 0)
        found, missed = np.empty((n, 3)), np.zeros(n)
        fe = ~cloud
        found[fe] = np.einsum("na,nai->ni", _shapes(xi[fe]), model.points[model.hexahedra[cells[fe]]])
        if cloud.any():
            there = found[cloud] = self._origins_in_cloud(places[cloud])
            missed[cloud] = np.linalg.norm(there + self.at(there).displacement - places[cloud], axis=1)
        return Origins(found, missed)

    def _origins_in_cloud(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """The best of a few Newton steps from the integration points whose deformed positions are nearest.

        The seed of a tumour has no tissue: a point inside it is not an origin, although moving least squares has a
        value there.
        """
        points, tumour = self.model.domain_points, self.metadata.get("tumour")
        centre, seed = (np.array(tumour["centre_m"]), tumour["seed_radius_m"]) if tumour else (np.zeros(3), 0.0)
        trial = points[cKDTree(points + self._in_cloud(points)[0]).query(places)[1]]
        best, least = trial.copy(), np.full(len(places), np.inf)
        moving = np.arange(len(places))
        for _ in range(_STEPS):
            at = trial[moving]
            displacement, gradient = self._in_cloud(at)
            apart = at + displacement - places[moving]
            size = np.linalg.norm(apart, axis=1)
            better = (size < least[moving]) & (np.linalg.norm(at - centre, axis=1) >= seed)
            least[moving[better]], best[moving[better]] = size[better], at[better]
            step = np.linalg.solve(np.eye(3) + gradient, apart[..., None])[..., 0]
            trial[moving] = at - step * (_STEP / np.maximum(np.linalg.norm(step, axis=1), _STEP))[:, None]
            moving = moving[least[moving] > _CLOSE]
        return best

    def _in_cloud(self, places: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Displacements (n, 3), m, by the nearest integration points' support domains, and gradients (n, 3, 3)."""
        nodes = self.model.domains[cKDTree(self.model.domain_points).query(places)[1]]
        values, gradients, _ = moving_least_squares(self.model.points[nodes], places, self.basis, self.weight)
        parameters = self.parameters[nodes]
        return np.einsum("na,nai->ni", values, parameters), np.einsum("naj,nai->nij", gradients, parameters)

    def _across_interface(self, cells: NDArray[np.int64], xi: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the nearest face, edge or corner of the hexahedron has interface nodes only, for points outside it.

        All points are across the interface if there are no hexahedra.
        """
        if not len(self.model.hexahedra):
            return np.ones(len(cells), bool)
        interface = np.zeros(self.model.n_nodes, bool)
        interface[self.model.node_sets.get("interface", [])] = True
        beyond = np.abs(xi) > 1
        nearest = ((CORNERS * xi[:, None, :] > 0) | ~beyond[:, None, :]).all(axis=2)  # (n, 8)
        return np.asarray(beyond.any(axis=1) & (interface[self.model.hexahedra[cells]] | ~nearest).all(axis=1))


def open_field(path: Path, frame: int = -1) -> Field:
    """The field of a run's folder, or of its result.vtkhdf beside model.h5, in a frame (negative: from the last).

    InputError if one of the files is missing, or they do not belong together.
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
    points: NDArray[np.float64], hexahedra: NDArray[np.int64], places: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Cells (n,), reference coordinates in them (n, 3), and distances to them (n,), m, of places (n, 3).

    A point in no hexahedron gets the nearest hexahedron, and coordinates beyond [-1, 1]. Its distance is that from the
    point with the coordinates clipped to [-1, 1]; it is infinite without hexahedra.
    """
    n = len(places)
    cells, xi, distance = np.zeros(n, np.int64), np.zeros((n, 3)), np.full(n, np.inf)
    if not len(hexahedra):
        return cells, xi, distance
    middles = points[hexahedra].mean(axis=1)
    reach = max(np.linalg.norm(points[corner] - middles, axis=1).max() for corner in hexahedra.T)
    tree = cKDTree(middles)
    missed = np.arange(n)
    for k in _CANDIDATES:
        nearer = np.zeros(n, bool)  # whether a hexahedron that was not tried may be nearer
        for first in range(0, len(missed), _CHUNK):
            rows = missed[first : first + _CHUNK]
            apart, near = (of.reshape(len(rows), -1) for of in tree.query(places[rows], min(k, len(hexahedra))))
            cells[rows], xi[rows], distance[rows] = _best(points, hexahedra, near, places[rows])
            nearer[rows] = distance[rows] > np.maximum(apart[:, -1] - reach, 0)
        missed = np.flatnonzero(nearer)
    return cells, xi, distance


def _best(
    points: NDArray[np.float64], hexahedra: NDArray[np.int64], near: NDArray[np.int64], places: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Of candidates (n, k) the cell that contains the point or is nearest to it; see `locate`."""
    n, k = near.shape
    corners = points[hexahedra[near.ravel()]]
    at = np.repeat(places, k, axis=0)
    xi, converged = _inverse(corners, at)
    inside = np.abs(xi).max(axis=1) <= _INSIDE
    cut = np.einsum("na,nai->ni", _shapes(np.clip(xi, -1, 1)), corners)
    distance = np.where(inside, 0.0, np.linalg.norm(cut - at, axis=1))
    distance[~converged] = np.inf
    # Of cells that share the point the one that contains it best: the answer depends on the geometry only.
    order = np.lexsort((np.abs(xi).max(axis=1).reshape(n, k), distance.reshape(n, k)), axis=1)[:, 0]
    best = np.arange(n) * k + order
    return near.ravel()[best], xi[best], distance[best]


def _inverse(corners: NDArray[np.float64], at: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Reference coordinates (n, 3) of places (n, 3) in trilinear cells (n, 8, 3) by Newton, and where it converged.

    Coordinates stay within [-8, 8]: beyond these limits it suffices that the cell is far away.
    """
    modes = _MODES @ corners / 8
    size = np.abs(modes[:, 1:4]).max(axis=(1, 2))[:, None]
    xi = np.zeros_like(at)
    moving = np.arange(len(at))
    for _ in range(_ITERATIONS):
        before, some = xi[moving], modes[moving]
        apart = (at[moving] - _place(some, before))[..., None]
        step = np.linalg.solve(_slopes(some, before, size[moving]), apart)[..., 0]
        xi[moving] = np.clip(before + np.clip(step, -2, 2), -8, 8)
        # Coordinates that stay at a limit are done as well.
        moving = moving[np.abs(xi[moving] - before).max(axis=1) >= 1e-13]
        if not len(moving):
            break
    return xi, np.abs(at - _place(modes, xi)).max(axis=1) < 1e-9 * size[:, 0]


def _place(modes: NDArray[np.float64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (n, 3) at reference coordinates (n, 3)."""
    r, s, t = xi.T
    return np.einsum("mn,nmi->ni", np.stack([np.ones_like(r), r, s, t, r * s, s * t, r * t, r * s * t]), modes)


def _slopes(modes: NDArray[np.float64], xi: NDArray[np.float64], size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives (n, 3, 3), place by reference coordinate, plus a small multiple of the identity: never singular."""
    r, s, t = (x[:, None] for x in xi.T)
    _, R, S, T, RS, ST, RT, RST = modes.transpose(1, 0, 2)
    slopes = np.stack(
        [R + s * RS + t * RT + s * t * RST, S + r * RS + t * ST + r * t * RST, T + s * ST + r * RT + r * s * RST]
    )
    return slopes.transpose(1, 2, 0) + 1e-12 * size[..., None] * np.eye(3)


def _shapes(xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Trilinear shape functions (n, 8) at reference coordinates (n, 3) (paper, eq. 4.4)."""
    return (1 + CORNERS * xi[:, None, :]).prod(axis=2) / 8


def prescribed(model: Model) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Nodes (n_nodes,) that are prescribed in all three directions, and those of them that move."""
    nodes = model.prescribed_dofs // 3
    every = np.bincount(nodes, minlength=model.n_nodes) == 3
    moves = np.bincount(nodes, (model.prescribed_displacements != 0) | model.rotation_paths.any(1), model.n_nodes) > 0
    return every, every & moves


def outer_faces(model: Model) -> NDArray[np.int64]:
    """Faces (n, 4) of hexahedra on the body's surface: those of one hexahedron only and not on the cloud."""
    faces = boundary_faces(model.hexahedra)
    interface = np.zeros(model.n_nodes, bool)
    interface[model.node_sets.get("interface", [])] = True
    return faces[~interface[faces].all(axis=1)]
