"""Hexahedra of any shape against quadrature of the trilinear map, and their quality on shapes that have a name."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_kernels import box

from mpitled.cells.hexahedra import (
    FLAT,
    HOURGLASS_MODES,
    aspect,
    check,
    corner_jacobians,
    geometry,
    hourglass_vectors,
    nodal_mass,
    scaled_jacobian,
    volumes,
)
from mpitled.mesh import CORNERS, grid_points, structured_hexahedra

CUBE = (CORNERS + 1) / 2
ONE = np.arange(8)[None]
AFFINE = np.array([[0.3, 0.1, -0.2], [0.0, -0.1, 0.4], [0.2, 0.0, 0.1]])


def slopes(places):
    """Derivatives (n, 8, 3) of the trilinear shape functions by r, s, t at places (n, 3) of the reference cube."""
    factors = 1 + CORNERS * places[:, None]
    return CORNERS / 8 * np.stack([np.delete(factors, i, axis=2).prod(axis=2) for i in range(3)], axis=2)


def integrated(points, cells):
    """Mean gradients and volumes by 4^3 Gauss points, exact to degree 7: det J times grad N has degree 4 at most."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    places = np.stack(np.meshgrid(nodes, nodes, nodes), axis=-1).reshape(-1, 3)
    weight = np.einsum("i,j,k->ijk", weights, weights, weights).ravel()
    dN = slopes(places)
    J = np.einsum("eai,gaj->egij", points[cells], dN)
    dV = weight * np.linalg.det(J)
    B = np.einsum("eg,gaj,egji->eai", dV, dN, np.linalg.inv(J))
    volume = dV.sum(axis=1)
    return B / volume[:, None, None], volume


def distorted(shape=(5, 4, 3), distortion=0.25, seed=0):
    """A box in the metre, its inner nodes moved; which nodes are inner."""
    points, cells = grid_points(shape, (1.0, 0.8, 0.6)), structured_hexahedra(shape)
    inner = ((points > 1e-9) & (points < np.array([1.0, 0.8, 0.6]) - 1e-9)).all(axis=1)
    shift = np.random.default_rng(seed).uniform(-distortion, distortion, points.shape) * 0.2
    return np.where(inner[:, None], points + shift, points), cells, inner


@pytest.mark.parametrize("seed", range(3))
def test_volumes_and_mean_gradients_are_the_integrals(seed):
    points, cells, _ = box((4, 4, 4), edge=1.0, distortion=0.3, seed=seed)
    points += 3.0
    B, volume = geometry(points, cells)
    expected, exact = integrated(points, cells)
    # Some hundred products of lengths up to 1.6, and differences of coordinates up to 7.
    assert np.abs(volume - exact).max() < 1e-13
    assert np.abs(volume[:, None, None] * B - exact[:, None, None] * expected).max() < 1e-13
    np.testing.assert_array_equal(volume, volumes(points, cells))


def test_the_centre_rule_is_the_papers():
    """(4.4)-(4.6): B = dN/dr J^-1 and 8 det J at the centre; on parallelepipeds the mean is the same."""
    points, cells, _ = box((4, 4, 4), edge=1.0, distortion=0.3)
    dN = slopes(np.zeros((1, 3)))[0]
    J = np.einsum("eai,aj->eij", points[cells], dN)
    B, volume = geometry(points, cells, "centre")
    assert np.abs(volume - 8 * np.linalg.det(J)).max() < 1e-14
    assert np.abs(B - np.einsum("aj,eji->eai", dN, np.linalg.inv(J))).max() < 1e-13
    skew = (grid_points((3, 3, 3), (1.0, 2.0, 3.0)) @ (np.eye(3) + AFFINE), structured_hexahedra((3, 3, 3)))
    for one, other in zip(geometry(*skew, "mean"), geometry(*skew, "centre"), strict=True):
        assert np.abs(one - other).max() < 1e-14


@pytest.mark.parametrize("rule", ["mean", "centre"])
def test_affine_fields_have_their_gradient_and_no_hourglass_part(rule):
    points, cells, _ = distorted()
    B, _ = geometry(points, cells, rule)
    u = points @ AFFINE.T + [1, 2, 3]
    assert np.abs(np.einsum("eai,eaj->eij", u[cells], B) - AFFINE).max() < 1e-13
    assert np.abs(B.sum(axis=1)).max() < 1e-14
    gamma = hourglass_vectors(points, cells, B)
    assert np.abs(np.einsum("eam,eai->emi", gamma, u[cells])).max() < 1e-13
    # Yet they are the hourglass modes for fields without gradient: together with affine fields, all eight.
    x = np.concatenate([points[cells], np.ones((len(cells), 8, 1)), gamma], axis=2)
    assert np.linalg.matrix_rank(x).min() == 8
    moved = HOURGLASS_MODES.T - np.einsum("eai,ebi,bm->eam", B, points[cells], HOURGLASS_MODES.T)  # (4.20)
    assert np.abs(gamma - moved).max() < 1e-13


@pytest.mark.parametrize("seed", range(3))
def test_constant_stress_balances_at_inner_nodes_with_the_mean_alone(seed):
    """The centre-point gradient of eq. 4.6 misses this by 8e-3 on such a mesh."""
    points, cells, inner = distorted(seed=seed)
    worst = {}
    for rule in ("mean", "centre"):
        B, volume = geometry(points, cells, rule)
        force = np.zeros_like(points)
        np.add.at(force, cells, volume[:, None, None] * B)
        worst[rule] = np.abs(force[inner]).max() / np.abs(force).max()
    assert worst["mean"] < 1e-14
    assert worst["centre"] > 1e-3


def test_total_mass_is_exact_on_distorted_cells():
    points, cells, _ = distorted(distortion=0.3)
    mass = nodal_mass(cells, 1000 * volumes(points, cells), len(points))
    assert mass.sum() == pytest.approx(1000 * 1.0 * 0.8 * 0.6, rel=1e-14)
    # With 8 det J at the centre, as (4.17) has it, it is not.
    assert abs(geometry(points, cells, "centre")[1].sum() - 0.48) > 1e-5
    even = nodal_mass(structured_hexahedra((2, 2, 2)), np.full(8, 8.0), 28)
    assert even.reshape(-1)[[0, 1, 4, 13, 26, 27]].tolist() == [1, 2, 4, 8, 1, 0]  # corner ... centre, and unused
    assert len(nodal_mass(np.zeros((0, 8), int), np.zeros(0), 5)) == 5


# ------------------------------------------------------------ quality


def cell(**corners):
    """The unit cube with some corners ("c6") elsewhere."""
    points = CUBE.copy()
    for name, place in corners.items():
        points[int(name[1:])] = place
    return points


SHEARED = CUBE + 0.75 * CUBE[:, [1]] * [1, 0, 0]  # edges 1, 1.25, 1 with det 1
WEDGE = cell(c2=CUBE[1], c6=CUBE[5])  # a face collapsed to an edge
DENTED = cell(c6=[0.3, 0.3, 0.3])  # a corner beyond the plane of its neighbours
INVERTED = CUBE[[4, 5, 6, 7, 0, 1, 2, 3]]
TWISTED = CUBE[[0, 1, 2, 3, 6, 7, 4, 5]]  # the top turned by half: x_r = x_s = 0 at the centre
POINT = np.zeros((8, 3))


@pytest.mark.parametrize(
    ("points", "jacobian", "ratio"),
    [
        (CUBE, 1.0, 1.0),
        (CUBE * [1, 2, 5], 1.0, 5.0),
        (SHEARED, 0.8, 1.25),
        (INVERTED, -1.0, 1.0),
        (WEDGE, 0.0, np.inf),
        # At the corner itself: edges (0.3, -0.7, -0.7) and its turns, of length 1.07^(1/2), with det 0.3 - 1.4.
        (DENTED, -1.1 / 1.07**1.5, 1.07**0.5),
        (POINT, 0.0, np.inf),
    ],
)
def test_quality_of_known_shapes(points, jacobian, ratio):
    turn = Rotation.from_rotvec([0.3, -1.0, 0.7]).as_matrix()
    for placed in (points, 1e-3 * points @ turn.T + 0.05):  # whatever the place, direction and size
        assert scaled_jacobian(placed, ONE)[0] == pytest.approx(jacobian, abs=1e-12)
        assert aspect(placed, ONE)[0] == pytest.approx(ratio, rel=1e-12)


def test_corner_jacobians_are_those_of_the_map():
    points, cells, _ = box((3, 3, 3), edge=1.0, distortion=0.3)
    J = np.einsum("eai,gaj->egij", points[cells], slopes(CORNERS.astype(float)))
    assert np.abs(corner_jacobians(points, cells) - np.linalg.det(J)).max() < 1e-14


@pytest.mark.parametrize(
    ("points", "verdict"),
    [
        (CUBE, "sound"),
        (SHEARED, "sound"),
        (CUBE * [1, 1, 2 * FLAT], "sound"),
        (CUBE * [1, 1, 0.5 * FLAT], "unusable"),
        (INVERTED, "unusable"),
        (TWISTED, "unusable"),
        (POINT, "unusable"),
        (WEDGE, "poor"),
        (DENTED, "poor"),
    ],
)
@pytest.mark.parametrize("size", [1.0, 1e-3])
def test_what_can_be_computed_with(points, verdict, size):
    unusable, poor = check(size * points, ONE)
    assert (unusable.tolist(), poor.tolist()) == {
        "sound": ([], []), "poor": ([], [0]), "unusable": ([0], [])
    }[verdict]  # fmt: skip


def test_many_cells_are_as_few():
    """Cells are worked on in chunks: bad ones at their ends keep their numbers."""
    n = 20_000
    rng = np.random.default_rng(0)
    points = CUBE + rng.uniform(-0.1, 0.1, (n, 8, 3))
    bad, dented = [0, 8191, 8192, n - 1], [1, 16383, 16384]
    points[bad], points[dented] = INVERTED, DENTED
    cells = np.arange(8 * n).reshape(n, 8)
    flat = points.reshape(-1, 3)
    unusable, poor = check(flat, cells)
    assert (unusable.tolist(), poor.tolist()) == (bad, dented)
    last = cells[-3000:]
    for measure in (volumes, scaled_jacobian, aspect, lambda p, c: geometry(p, c)[0]):
        np.testing.assert_allclose(measure(flat, cells)[-3000:], measure(flat, last), rtol=1e-13, atol=1e-15)
